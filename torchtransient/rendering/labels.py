"""Labels of a scene: what each pixel of a renderer's sensors looks at, for the values that a render gets.

Depth, normals, shapes and the like come from one intersection at each pixel's centre, in the built scene and with the
values that the render uses. They have no derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from torchtransient.axes import TimeAxis
from torchtransient.checks import as_number, as_whole, of_class, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.rendering.carry_out import Numbered, check_whole, groups_of, refusal
from torchtransient.rendering.engine import check_values
from torchtransient.rendering.opaque import opaque
from torchtransient.rendering.recordings import NotRecordedError
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.rendering.scene_handle import Scene
from torchtransient.rendering.seeds import Seeding
from torchtransient.rendering.session import RenderJob, Session, session_of
from torchtransient.rendering.variant import active_variant

LABELS = ("depth", "z_depth", "position", "normals", "uv", "albedo", "shape", "primitive", "material")
# Numbers of things, of which there is no mean.
NUMBERED = ("shape", "primitive", "material")
_SCALARS = ("depth", "z_depth", *NUMBERED)


@opaque
def scene_labels(
    renderer: TransientRenderer,
    values: Mapping[str, Any] | None = None,
    names: Sequence[str] = ("depth",),
    *,
    average: bool = False,
    samples: int = 16,
) -> dict[str, torch.Tensor]:
    """What the pixels of a renderer's sensors look at, by name. ``values`` as in a call of the renderer, which uses its
    own parameters for those that are not given.

    ========= =============== ==========================================================================================
    name      shape, dtype    what
    ========= =============== ==========================================================================================
    depth     (H, W) float32  metres from the sensor's origin (the pinhole, the middle of a lens, the sensor plane of an
                              orthographic camera) to the surface along the pixel's ray: not along the axis, and not
                              from the near clip plane. Half the optical path of a light that stands there, in air
    z_depth   (H, W) float32  metres from the sensor's origin along its optical axis
    position  (3, H, W)       the point of the surface in the world, metres; of a scan the scanned point
    normals   (3, H, W)       shading normal in the world, unit length, on the side where the surface has its front: not
                              turned to the sensor, without normal maps and bump maps
    uv        (2, H, W)       texture coordinates
    albedo    (C, H, W)       diffuse reflectance by channel of the film, 0 for materials without a diffuse lobe; of
                              wavelengths the mean in daylight (D65), or evenly over the film's own response curves.
                              Where Mitsuba has none of a material it is its brightness at the normal
    shape     (H, W) int32    index into :func:`label_names`: the shape, or the instance of a group
    primitive (H, W) int32    number of the triangle, ellipsoid or segment in its shape, 0 where it has one surface
    material  (H, W) int32    index into :func:`material_names`
    ========= =============== ==========================================================================================

    Where a pixel meets nothing, floats are NaN and numbers are -1. A pixel looks through what lets more than half of
    the light pass unbent (BSDF ``null``, a ``mask`` of an opacity below one half, a thin pane), 64 such surfaces at
    most, and through area lights under an integrator that hides emitters; a
    glass that bends light is a surface, and so is a mirror. ``camera_unwarp`` changes nothing.

    ``average``: the mean over ``samples`` places in each pixel (the same in all, spread evenly; of a thin lens over the
    aperture, too) that meet something, instead of its centre. Normals become shorter than one where they differ, depths
    of an edge lie between those of its sides. Not for numbers.

    Tensors have the leading dimensions of the render: the batch of the values, the sensors of a list. They are on the
    scene's device, without gradients, and belong to the caller. Calls are recorded as renders are, unless the renderer
    was made with ``freeze=False``. Not supported: ``torch.func.vmap``.

    Raises ArgumentError for unknown names, SceneError for unknown keys, for sensors whose pixels have no direction
    (``irradiancemeter``, ``distant``), for ``z_depth`` of a sensor without an axis (``nlos_capture_meter``) and for
    means of numbers; ShapeError, UnitError and DeviceError for values as the renderer does.
    """
    return _labels(renderer, values, names, average, samples)[0]


@opaque
def label_names(renderer: TransientRenderer) -> tuple[str, ...]:
    """Names of the shapes that the label "shape" counts, in the order of the scene's description."""
    return tuple(_tables(renderer).shape_names)


@opaque
def material_names(renderer: TransientRenderer) -> tuple[str, ...]:
    """Names of the materials that the label "material" counts, in the order of the shapes that have them."""
    return tuple(_tables(renderer).material_names)


def first_return(
    transient: torch.Tensor, axis: TimeAxis, *, polarized: bool = False, threshold: float = 0.0
) -> torch.Tensor:
    """Optical path (metres) at the start of the first bin with light, in any channel; NaN without light.

    ``transient`` (..., C, T, H, W) with the T bins of ``axis``; ``polarized``: (..., 4, C, T, H, W), of which S0 is
    looked at. Light is more than ``threshold``, in the units of the transient. Returns float32 (..., H, W), without
    gradients. Filters wider than a bin bring light to the bins before. Raises ShapeError, UnitError. Not supported:
    exhaustive scans.
    """
    of_class("first_return: transient", transient, torch.Tensor)
    of_class("first_return: axis", axis, TimeAxis)
    least = 5 if polarized else 4
    if transient.ndim < least or transient.shape[-3] != axis.num_bins or transient.is_complex():
        expected = f"(..., {'4, ' if polarized else ''}C, {axis.num_bins}, H, W)"
        raise ShapeError(
            f"first_return: expected a real transient {expected} with the bins of its axis, got "
            f"{tuple(transient.shape)} of {transient.dtype}."
        )
    if polarized and transient.shape[-5] != 4:
        raise ShapeError(
            f"first_return: expected the 4 Stokes components in dimension -5, got {tuple(transient.shape)}; leave out "
            "polarized=True for a transient without them."
        )
    least_light = as_number(threshold)
    if least_light is None or not 0 <= least_light < math.inf:
        raise UnitError(f"first_return: expected a threshold of at least zero, got {shown(threshold)}.")
    light = transient.detach()
    lit = ((light.select(-5, 0) if polarized else light) > least_light).any(-4)
    first = lit.to(torch.uint8).argmax(-3).to(torch.float64)
    path = (axis.start_opl + axis.bin_width_opl * first).to(torch.float32)
    return torch.where(lit.any(-3), path, torch.nan)


# ------------------------------------------------------------------------------------------------------ one call


def _labels(
    renderer: TransientRenderer, values: Mapping[str, Any] | None, names: Sequence[str], average: bool, samples: int
) -> tuple[dict[str, torch.Tensor], list[str]]:
    """(labels, what became of the recording of each item)."""
    _renderer(renderer)
    wanted = _checked_names(names, average)
    number = as_whole(samples)
    if number is None or not 1 <= number <= 4096:
        raise UnitError(f"samples: expected an integer from 1 to 4096, got {shown(samples)}.")
    samples = number
    tensors, batched, batch = renderer._collect(values)
    tensors = [tensor.detach() for tensor in tensors]
    seeding = Seeding(renderer._sensors, 1 if batch is None else batch, None)
    job = RenderJob(
        scene=renderer.scene,
        options=_options(renderer),
        keys=renderer._keys,
        items=seeding.items(0),
        seeding=seeding,
        batched=tuple(batched),
        spp=1,
        spp_grad=1,
        temporal_filter=None,
        watch=renderer._watch,
        needs=(False,) * len(tensors),
        freeze=renderer.freeze,
    )
    check_values(job, tensors)
    found: list[list[torch.Tensor]] = []
    said: list[str] = []
    with session_of(job) as session:
        for group in groups_of(session):
            session.install(group[0][1], tensors, job.needs)
            how, of_group = _of_group(session, group, wanted, samples if average else 0)
            said += how
            found += of_group
    leading = (*(() if batch is None else (batch,)), *((len(renderer._sensors),) if renderer._stack_sensors else ()))
    labels = {}
    for n, name in enumerate(wanted):
        together = torch.stack([of_item[n] for of_item in found])
        labels[name] = together.reshape(*leading, *together.shape[1:])
    return labels, said


def _renderer(given: Any) -> TransientRenderer:
    hint = "; make one of a scene: tt.TransientRenderer(scene)"
    return of_class("labels: renderer", given, TransientRenderer, hint)


def _checked_names(names: Sequence[str], average: bool) -> tuple[str, ...]:
    wanted = (names,) if isinstance(names, str) else tuple(names)
    if not wanted or len(set(wanted)) < len(wanted) or not set(wanted) <= set(LABELS):
        raise ArgumentError(f"names: expected labels out of {', '.join(LABELS)}, each once, got {list(wanted)}.")
    numbered = [name for name in wanted if name in NUMBERED]
    if average and numbered:
        raise ArgumentError(
            f"average: numbers of things have no mean ({', '.join(numbered)}); ask for them in a call without it."
        )
    return wanted


def _options(renderer: TransientRenderer) -> Any:
    """Shapes that Mitsuba has merged cannot be told apart: labels are those of a build that leaves them as described,
    which renders with parameters use as well.
    """
    return replace(renderer._options, merge=False)


def _tables(renderer: TransientRenderer) -> Any:
    scene: Scene = _renderer(renderer).scene
    with active_variant(scene.variant):
        return tables_of(scene.built(_options(renderer)))


def tables_of(built: Any) -> Any:
    """What labels look up once of a built scene. Must be called inside its variant."""
    from torchtransient.plugins.labels import LabelTables

    if built.label_tables is None:
        built.label_tables = LabelTables(built.scene, built.scene.integrator())
    return built.label_tables


def _of_group(
    session: Session, group: Sequence[Numbered], names: tuple[str, ...], samples: int
) -> tuple[list[str], list[list[torch.Tensor]]]:
    """Labels of items with the same values: how they were computed, and the tensors of each by name."""
    from torchtransient.plugins.labels import LabelJob

    tables = tables_of(session.slots.built)
    jobs = [
        LabelJob(session.scene, session.sensors[item.sensor], names, tables, samples).prepare() for _, item in group
    ]
    reason = refusal(session, group)
    if reason is None:
        try:
            how, results = session.recordings.run(jobs)
            return [how] * len(jobs), [
                _tensors(job, arrays, names) for job, arrays in zip(jobs, results, strict=True)
            ]
        except NotRecordedError as error:
            check_whole(session, error)
            reason = str(error)
    found = []
    for job in jobs:
        job.run(job)
        found.append(_tensors(job, job.film.taken(), names))
    return [reason] * len(jobs), found


def _tensors(job: Any, arrays: list[Any], names: tuple[str, ...]) -> list[torch.Tensor]:
    import drjit as dr

    dr.eval(arrays)
    dr.sync_thread()
    width, height = job.size
    # Arrays of one number are literals of the kernel, and stay one.
    given = iter([array.torch().expand(width * height) for array in arrays])
    found = []
    for name in names:
        if name in _SCALARS:
            found.append(next(given).reshape(height, width))
        else:
            count = job.components(name)
            found.append(torch.stack([next(given) for _ in range(count)]).reshape(count, height, width))
    return found
