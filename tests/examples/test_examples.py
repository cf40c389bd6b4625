"""The training examples run, and their errors fall, at sizes that take seconds."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import mitsuba as mi
import pytest
import torch

FOLDER = Path(__file__).parents[2] / "training_examples"


def example(name: str) -> ModuleType:
    """One of the example scripts as a module."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)

    sys.modules[name] = module  # dataclasses look their module up while they are made
    spec.loader.exec_module(module)
    return module


def check_line_and_picture(name: str, folder: Path, printed: str) -> None:
    lines = printed.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"{name}: ")
    assert (folder / f"{name}.png").stat().st_size > 10_000


def test_fit_albedo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mi.set_variant("llvm_ad_rgb")  # the example's own: with another one active, every step would switch to and fro
    sizes = ["--steps", "14", "--spp", "16", "--resolution", "16", "--target-spp", "256", "--output"]
    fit = example("fit_albedo").main([*sizes, str(tmp_path)])
    check_line_and_picture("fit_albedo", tmp_path, capsys.readouterr().out)
    before, after = (albedos - fit.truth for albedos in (fit.albedos[0], fit.albedos[-1]))
    assert float(after.abs().mean()) < 0.4 * float(before.abs().mean())


def test_fit_wall(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mi.set_variant("llvm_ad_mono")
    sizes = ["--steps", "60", "--spp", "16", "--resolution", "6", "--target-spp", "1024", "--output"]
    fit = example("fit_wall").main([*sizes, str(tmp_path)])
    check_line_and_picture("fit_wall", tmp_path, capsys.readouterr().out)
    assert fit.distance_errors[0] == pytest.approx(0.3)
    assert fit.distance_errors[-1] < 0.005
    assert fit.tilt_errors[-1] < 0.25


def test_the_wall_fit_cannot_see_brightness() -> None:
    mi.set_variant("llvm_ad_mono")
    module = example("fit_wall")
    renderer = module.wall_renderer(0.5, 4)
    pose = module.wall_to_world(torch.tensor(4.1), torch.tensor(3.0))
    transient = renderer({module.KEY: pose}, seed=0, spp=16).transient
    brightness = torch.rand((4, 4), generator=torch.Generator().manual_seed(0)) + 0.1
    measured, dimmed = (module.mean_arrival(cube, renderer.axis) for cube in (transient, transient * brightness))
    torch.testing.assert_close(measured, dimmed, rtol=1e-6, atol=1e-6)
