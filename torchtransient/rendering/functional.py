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
    errors: bool | str = False,
    progress: bool = False,
    **settings: Any,
) -> RenderOutput:
    """Render a scene with values for some of its parameters: :class:`TransientRenderer` as a function.

    The result is that of the module with the same keys and seed. For a loop, keep the scene of
    :func:`torchtransient.load`: it keeps the built scene and its recordings.

    Args:
        scene: anything that :func:`torchtransient.load` takes.
        values: values by key of ``scene.parameters()``, with or without a leading batch dimension.
        spp: samples per pixel, None for the scene's.
        seed: one seed, or one for each entry of a batch; None draws one from torch's generator.
        errors: True, or "bins", for error bars: ``out.standard_error``.
        progress: show a progress bar.
        settings: other arguments of :class:`TransientRenderer`, such as ``time_axis``.

    Returns:
        A :class:`RenderOutput` whose tensors carry gradients to the values.

    Raises:
        ArgumentError: if ``values`` is no mapping, or a setting is wrong.
        TypeError: for settings that :class:`TransientRenderer` does not have.
        SceneError, ShapeError, UnitError, DeviceError, StorageError, GradientError: as :class:`TransientRenderer` and
            its ``forward`` raise them.
    """
    given = checked_values(values)
    with arguments_of("render", TransientRenderer.__init__, ("scene", "parameters", "spp")):
        renderer = TransientRenderer(scene, parameters=list(given), spp=spp, **settings)
    for name, start in list(renderer.named_parameters()):
        # Not by `requires_grad_`, which torch.func forbids inside of its transforms.
        setattr(renderer, name, nn.Parameter(start, requires_grad=False))
    out: RenderOutput = renderer(values, seed=seed, errors=errors, progress=progress)
    return out
