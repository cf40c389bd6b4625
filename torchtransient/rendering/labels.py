"""Labels: depth, normals, shapes and materials at each pixel of a renderer's sensors, for the values of a call.

They come from one intersection at each pixel's centre, in the built scene and with the values that a render uses. They
have no derivatives.
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
from torchtransient.rendering.engine import Session, check_values, open_session
from torchtransient.rendering.job import RenderJob, Seeding
from torchtransient.rendering.recording import NotRecordedError, Numbered, groups_of, raise_if_broken, reason_to_trace
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.load import Scene
from torchtransient.scene.opaque import opaque
from torchtransient.scene.variant import active_variant

LABELS = (
    "depth", "z_depth", "position", "normals", "uv", "albedo", "velocity", "radial_velocity", "shape", "primitive",
    "material",
)  # fmt: skip
# Labels that are indices, which have no mean.
NUMBERED = ("shape", "primitive", "material")
_SCALARS = ("depth", "z_depth", "radial_velocity", *NUMBERED)


@opaque
def scene_labels(
    renderer: TransientRenderer,
    values: Mapping[str, Any] | None = None,
    names: Sequence[str] = ("depth",),
    *,
    average: bool = False,
    samples: int = 16,
) -> dict[str, torch.Tensor]:
    """Return labels of the pixels of a renderer's sensors, by name.

    =============== =============== ====================================================================================
    name            shape, dtype    content
    =============== =============== ====================================================================================
    depth           (H, W) float32  metres from the sensor's origin (the pinhole, the middle of a lens, the sensor plane
                                    of an orthographic camera) to the surface along the pixel's ray: not along the axis,
                                    and not from the near clip plane. Half the optical path of a light that stands
                                    there, in air
    z_depth         (H, W) float32  metres from the sensor's origin along its optical axis
    position        (3, H, W)       the point of the surface in the world, metres; of a scan the scanned point
    normals         (3, H, W)       shading normal in the world, unit length, on the side where the surface has its
                                    front: not turned to the sensor, without normal maps and bump maps
    uv              (2, H, W)       texture coordinates
    albedo          (C, H, W)       diffuse reflectance by channel of the film, 0 for materials without a diffuse lobe;
                                    of wavelengths the mean in daylight (D65), or evenly over the film's own response
                                    curves. Where Mitsuba has none of a material it is its brightness at the normal
    velocity        (3, H, W)       velocity of the surface's point in the world, m/s, zero where nothing moves
                                    (``scene.moving``)
    radial_velocity (H, W) float32  how fast that point moves away from the sensor along the pixel's ray, m/s; of a
                                    sensor that moves, too. Half the rate of a light that stands beside the sensor and
                                    moves with it
    shape           (H, W) int32    index into :func:`label_names`: the shape, or the instance of a group
    primitive       (H, W) int32    number of the triangle, ellipsoid or segment in its shape, 0 where it has one
                                    surface
    material        (H, W) int32    index into :func:`material_names`
    =============== =============== ====================================================================================

    Where a pixel meets nothing, floats are NaN and numbers are -1. A pixel looks through surfaces that let more than
    half of the light pass unbent (BSDF ``null``, a ``mask`` of an opacity below one half, a thin pane), 64 of them at
    most, and through area lights under an integrator that hides emitters; a glass that bends light is a surface, and so
    is a mirror. ``camera_unwarp`` changes nothing.

    Calls are recorded as renders are, unless the renderer was made with ``freeze=False``. Not supported:
    ``torch.func.vmap``.

    Args:
        renderer: the renderer; its own parameters count for keys without a value.
        values: values by key, as in a call of the renderer.
        names: labels of the table.
        average: the mean over places in each pixel (the same in all, spread evenly; of a thin lens over the aperture,
            too) that meet something, instead of the pixel's centre. Normals become shorter than one where they differ,
            depths of an edge lie between those of its sides. Not for indices.
        samples: number of places, 1 to 4096.

    Returns:
        Tensors by name, with the leading dimensions of the render: the batch of the values, the sensors of a list. On
        the scene's device, without gradients, owned by the caller.

    Raises:
        ArgumentError: for unknown names, and for means of indices.
        SceneError: for unknown keys, for sensors whose pixels have no direction (``irradiancemeter``, ``distant``), and
            for ``z_depth`` of a sensor without an axis (``nlos_capture_meter``).
        ShapeError, UnitError, DeviceError: for values, as the renderer raises them.
    """
    return _labels(renderer, values, names, average, samples)[0]


@opaque
def label_names(renderer: TransientRenderer) -> tuple[str, ...]:
    """Return the names of the shapes that the label "shape" is an index into.

    Args:
        renderer: the renderer.

    Returns:
        Names in the order of the scene's description.

    Raises:
        ArgumentError: for other objects.
    """
    return tuple(_tables(renderer).shape_names)


@opaque
def material_names(renderer: TransientRenderer) -> tuple[str, ...]:
    """Return the names of the materials that the label "material" is an index into.

    Args:
        renderer: the renderer.

    Returns:
        Names in the order of their shapes.

    Raises:
        ArgumentError: for other objects.
    """
    return tuple(_tables(renderer).material_names)


def first_return(
    transient: torch.Tensor, axis: TimeAxis, *, polarized: bool = False, threshold: float = 0.0
) -> torch.Tensor:
    """Return the optical path length at the start of the first bin with light in any channel.

    Filters wider than a bin bring light to the bins before. Not supported: exhaustive scans.

    Args:
        transient: transient (..., C, T, H, W), or (..., 4, C, T, H, W) with ``polarized``.
        axis: time axis of the transient, of T bins.
        polarized: the transient has Stokes components, of which S0 counts.
        threshold: largest value of a dark bin, in units of the transient.

    Returns:
        Metres, float32 (..., H, W), without gradients; NaN without light.

    Raises:
        ShapeError: for other shapes, and complex numbers.
        UnitError: for a negative threshold.
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
    """Return the labels, and how the call of each item was made (recorded, launched or traced)."""
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
        sampler=renderer.sampler,
        watch=renderer._watch,
        needs=(False,) * len(tensors),
        freeze=renderer.freeze,
    )
    check_values(job, tensors)
    found: list[list[torch.Tensor]] = []
    calls: list[str] = []
    with open_session(job) as session:
        for group in groups_of(session):
            session.install(group[0][1], tensors, job.needs)
            how, per_item = _group_labels(session, group, wanted, samples if average else 0)
            calls += how
            found += per_item
    leading = (*(() if batch is None else (batch,)), *((len(renderer._sensors),) if renderer._stack_sensors else ()))
    labels = {}
    for n, name in enumerate(wanted):
        together = torch.stack([item[n] for item in found])
        labels[name] = together.reshape(*leading, *together.shape[1:])
    return labels, calls


def _renderer(given: Any) -> TransientRenderer:
    hint = "; make one of a scene: tt.TransientRenderer(scene)"
    return of_class("labels: renderer", given, TransientRenderer, hint)


def _checked_names(names: Sequence[str], average: bool) -> tuple[str, ...]:
    wanted = (names,) if isinstance(names, str) else tuple(names)
    if not wanted or len(set(wanted)) < len(wanted) or not set(wanted) <= set(LABELS):
        known = f"{', '.join(LABELS)} (in recipes first_return, too)"
        raise ArgumentError(f"labels: expected some of {known}, each once, got {list(wanted)}.")
    numbered = [name for name in wanted if name in NUMBERED]
    if average and numbered:
        raise ArgumentError(
            f"average: indices have no mean ({', '.join(numbered)}); ask for them in a call without it."
        )
    return wanted


def _options(renderer: TransientRenderer) -> Any:
    """Return the options of a build with the described shapes: merged ones cannot be told apart."""
    return replace(renderer._options, merge=False)


def _tables(renderer: TransientRenderer) -> Any:
    scene: Scene = _renderer(renderer).scene
    with active_variant(scene.variant):
        return label_tables(scene.built(_options(renderer)))


def label_tables(built: Any) -> Any:
    """Return the tables of a built scene. Called inside its variant.

    Args:
        built: the built scene, which keeps them.
    """
    from torchtransient.plugins.labels import LabelTables

    if built.label_tables is None:
        built.label_tables = LabelTables(built.scene, built.scene.integrator())
    return built.label_tables


def _group_labels(
    session: Session, group: Sequence[Numbered], names: tuple[str, ...], samples: int
) -> tuple[list[str], list[list[torch.Tensor]]]:
    """Return how the calls of items with the same values were made, and the labels of each item."""
    from torchtransient.plugins.labels import LabelJob

    tables = label_tables(session.slots.built)
    jobs = [
        LabelJob(session.scene, session.sensors[item.sensor], names, tables, samples).prepare() for _, item in group
    ]
    reason = reason_to_trace(session)
    if reason is None:
        try:
            how, results = session.recordings.run(jobs)
            return [how] * len(jobs), [
                _tensors(job, arrays, names) for job, arrays in zip(jobs, results, strict=True)
            ]
        except NotRecordedError as error:
            raise_if_broken(session, error)
            reason = str(error)
    found = []
    for job in jobs:
        job.run(job)
        found.append(_tensors(job, job.film.release_storage(), names))
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
