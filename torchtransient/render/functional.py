"""The renderer as a function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from torchtransient.render.output import RenderOutput
from torchtransient.render.renderer import TransientRenderer


def render(
    scene: Any,
    values: Mapping[str, torch.Tensor] | None = None,
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
    renderer = TransientRenderer(scene, parameters=list(values or {}), spp=spp, **settings)
    for parameter in renderer.parameters():
        parameter.requires_grad_(False)
    return renderer(values, seed=seed, progress=progress)
