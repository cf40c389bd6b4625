"""The renderer as a function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from torchtransient.checks import arguments_of
from torchtransient.rendering.arguments import checked_values
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.opaque import opaque


@opaque
def render(
    scene: Any,
    values: Mapping[str, Any] | None = None,
    *,
    spp: int | None = None,
    seed: int | Sequence[int] | None = None,
    progress: bool = False,
    **settings: Any,
) -> RenderOutput:
    """Functional twin of :class:`TransientRenderer`: the keys of ``values`` are its parameters, ``settings`` its
    other arguments.

    Same result as the module with the same keys and seed. For a loop, keep the scene of :func:`torchtransient.load`:
    it holds what was built.
    """
    given = checked_values(values)
    with arguments_of("render", TransientRenderer.__init__, ("scene", "parameters", "spp")):
        renderer = TransientRenderer(scene, parameters=list(given), spp=spp, **settings)
    for name, start in list(renderer.named_parameters()):
        # Not by `requires_grad_`, which torch.func forbids inside of its transforms.
        setattr(renderer, name, nn.Parameter(start, requires_grad=False))
    out: RenderOutput = renderer(values, seed=seed, progress=progress)
    return out
