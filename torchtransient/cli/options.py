"""Options that commands share, and what their values mean."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from torchtransient.cli.films import film_options

if TYPE_CHECKING:
    import torch

    from torchtransient.scene.load import Scene

Command = TypeVar("Command", bound=Callable[..., Any])


def scene_options(command: Command) -> Command:
    """The scene file and what changes how it is read and rendered, the settings of every film included."""
    options = (
        click.argument("scene", type=click.Path(path_type=Path)),
        click.option("--variant", help="Mitsuba variant, such as llvm_ad_rgb, llvm_ad_mono, cuda_ad_rgb."),
        click.option("--param", "params", multiple=True, metavar="NAME=VALUE", help="Fill $NAME of the scene file."),
        click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same image."),
        click.option("--max-depth", type=int, help="Longest path, in segments; -1 for no limit."),
        film_options,
    )
    for option in reversed(options):
        command = option(command)
    return command


def assignments(given: Sequence[str], option: str) -> dict[str, str]:
    """`("a=1", "b=x")` as a dictionary. A usage error names the option when there is no `=`, or a name comes twice."""
    found: dict[str, str] = {}
    for text in given:
        name, sign, value = text.partition("=")
        if not sign or not name:
            raise click.BadParameter(f"expected NAME=VALUE, got '{text}'", param_hint=option)
        if name in found:
            raise click.BadParameter(f"'{name}' is given twice", param_hint=option)
        found[name] = value
    return found


def scene_values(given: Sequence[str], option: str) -> dict[str, torch.Tensor]:
    """`("red.reflectance.value=0.5,0.1,0.1",)` as tensors. Nested lists as in Python give more dimensions."""
    import torch

    values = {}
    for key, text in assignments(given, option).items():
        try:
            values[key] = torch.tensor(ast.literal_eval(text), dtype=torch.float32)
        except (ValueError, SyntaxError, TypeError):
            raise click.BadParameter(
                f"expected a number, or numbers with commas, for '{key}', got '{text}'", param_hint=option
            ) from None
    return values


def load_scene(scene: Path, variant: str | None, params: Sequence[str]) -> Scene:
    """The scene of a command line."""
    import torchtransient as tt

    values: dict[str, Any] = dict(assignments(params, "--param"))
    return tt.load(scene, variant=variant, **values)
