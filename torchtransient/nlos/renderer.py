"""``tt.nlos.CaptureRenderer``: hidden things as a function of torch tensors, seen around a corner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import SceneError
from torchtransient.nlos.scene import SENSOR, WALL, capture_scene, film_size, laser_size
from torchtransient.nlos.scene_scan import check_scan_is_seen
from torchtransient.render.build import BuildOptions
from torchtransient.render.opaque import opaque
from torchtransient.render.output import RenderOutput
from torchtransient.render.renderer import TransientRenderer
from torchtransient.render.scene_handle import Scene, load
from torchtransient.render.variant import active_variant
from torchtransient.sensing import Device, GradPolicy

# Where the points of a scan stand in the scene.
POINTS, SPOTS = f"{WALL}.{SENSOR}.points", f"{WALL}.{SENSOR}.laser_points"
ORIGIN, LASER_ORIGIN = f"{WALL}.{SENSOR}.sensor_origin", f"{WALL}.{SENSOR}.laser_origin"


class CaptureRenderer(nn.Module):
    """Captures of hidden things as a differentiable layer: :class:`TransientRenderer` behind a relay wall.

    ``hidden``, ``bounces``, ``energy``: as in :func:`~torchtransient.nlos.scene.capture_scene`. ``scan``: a
    :class:`Scan` that knows its wall. ``parameters``: keys of ``renderer.scene.parameters()`` that get an
    ``nn.Parameter`` each, or a mapping to start values; hidden nodes keep their names (``chair.vertex_positions``,
    ``hidden.to_world``, ``hidden.bsdf.reflectance.value``), the wall is ``wall``. ``settings``: those of
    :class:`TransientRenderer`, ``time_axis`` or another film and ``spp`` (paths for each sensor point, or for each pair
    of an exhaustive scan) among them. ``sensor``: a module of ``tt.sensing`` that the transient goes through, or a
    device, whose expected answer is taken (``device.sensor(axis, grad=...)`` makes modules with noise).

    Where points of the scan require gradients they get them. :meth:`forward` returns a :class:`Capture`.
    """

    def __init__(
        self,
        hidden: Any,
        scan: Scan,
        parameters: Sequence[str] | Mapping[str, Any] = (),
        *,
        bounces: Sequence[int] | str = (3,),
        energy: Any = 1.0,
        sensor: nn.Module | Device | None = None,
        variant: str | None = None,
        **settings: Any,
    ):
        super().__init__()
        scene = load(capture_scene(hidden, scan, bounces, energy), variant=variant)
        self.scan, self.bounces = scan, bounces
        self._followed = _attached(scan)
        own = {key: None for key in self._followed if key not in parameters}
        wanted = parameters if isinstance(parameters, Mapping) else dict.fromkeys(parameters)
        self._own = tuple(wanted)
        self.renderer = TransientRenderer(scene, {**wanted, **own}, **settings)
        for key in own:
            self.renderer.values[key].requires_grad_(requires_grad=False)
        if sensor is not None and self.renderer.axis is None:
            raise SceneError("CaptureRenderer: a sensor takes transients; give time_axis= instead of another film.")
        self.sensor = None if sensor is None else as_module(sensor, self.renderer.axis)
        check_scan(self.renderer.scene, scan, self.renderer._options)

    @property
    def values(self) -> Mapping[str, nn.Parameter]:
        """The parameters under their Mitsuba keys."""
        return {key: self.renderer.values[key] for key in self._own}

    @opaque
    def forward(
        self,
        values: Mapping[str, Any] | None = None,
        *,
        seed: int | Sequence[int] | None = None,
        spp: int | None = None,
        progress: bool = False,
        generator: torch.Generator | None = None,
    ) -> Capture:
        """Render a :class:`Capture`. ``values``, ``seed``, ``spp``, ``progress`` and errors as in
        :meth:`TransientRenderer.forward`; ``generator``: for the noise of ``sensor``.
        """
        given = self._followed | dict(values or {})
        out = self.renderer(given, seed=seed, spp=spp, progress=progress)
        return as_capture(out, self.scan, sensor=self.sensor, generator=generator)


def as_module(sensor: nn.Module | Device, axis: TimeAxis | None, grad: GradPolicy = "expected") -> nn.Module:
    """A sensor as the module that takes transients on ``axis``; ``grad``: what becomes of a device's noise."""
    return sensor.sensor(axis, grad=grad) if isinstance(sensor, Device) else sensor


def check_scan(scene: Scene, scan: Scan, options: BuildOptions | None = None) -> None:
    """Raise SceneError where sensor or laser of a capture's scene look at something else than the points of its scan:
    a hidden thing in their way, a wall that is elsewhere.
    """
    with active_variant(scene.variant):
        built = scene.built(BuildOptions(transient=True) if options is None else options)
        check_scan_is_seen(built.scene, scan)


def _attached(scan: Scan) -> dict[str, torch.Tensor]:
    """The points of a scan that require gradients, by their keys in the scene."""
    points = {POINTS: scan.sensor_points, ORIGIN: scan.sensor_origin, LASER_ORIGIN: scan.laser_origin}
    if scan.kind != "confocal":
        points[SPOTS] = scan.laser_points
    listed = {key: value if value.ndim == 1 else value.reshape(-1, 3) for key, value in points.items()}
    return {key: value for key, value in listed.items() if value.requires_grad}


def as_capture(
    out: RenderOutput, scan: Scan, sensor: nn.Module | None = None, generator: torch.Generator | None = None
) -> Capture:
    """What a render of a capture's scene measured, in the scan's shape; views of its tensors."""

    def shaped(tensor: torch.Tensor | None) -> torch.Tensor | None:
        return None if tensor is None else in_scan_shape(tensor, scan)

    if out.gated is not None:
        raise SceneError(
            "capture: expected a time axis or frequencies; a capture has no place for gates. Render its scene with "
            "tt.TransientRenderer(tt.nlos.capture_scene(...), gates=...)."
        )
    transient = out.transient
    if transient is not None and sensor is not None:
        transient = measured(transient, scan, sensor, generator)
    # The steady image of an exhaustive scan sums over the laser's positions.
    steady = None if scan.kind == "exhaustive" else steady_in_scan_shape(out.steady, scan)
    polarized = out.stats.variant.endswith("polarized")
    metadata = {"spp": out.stats.spp, "variant": out.stats.variant, "seconds": out.stats.seconds}
    return Capture(
        transient=shaped(transient), axis=out.axis, scan=scan, metadata=metadata, phasor=shaped(out.phasor),
        frequencies=out.frequencies, steady=steady, channels=tuple(out.channels), polarized=polarized,
    )  # fmt: skip


def in_film_shape(tensor: torch.Tensor, scan: Scan) -> torch.Tensor:
    """From the scan's shape behind T to (..., T, [Lh, Lw,] H, W) of a film."""
    laser = laser_size(scan) if scan.kind == "exhaustive" else ()
    return tensor.reshape(*tensor.shape[: tensor.ndim - len(scan.shape)], *laser, *film_size(scan))


def in_scan_shape(tensor: torch.Tensor, scan: Scan) -> torch.Tensor:
    """From (..., T, [Lh, Lw,] H, W) of a render to the scan's shape behind T."""
    film = 4 if scan.kind == "exhaustive" else 2
    return tensor.reshape(*tensor.shape[: tensor.ndim - film], *scan.shape)


def steady_in_scan_shape(tensor: torch.Tensor, scan: Scan) -> torch.Tensor:
    """The same for an image (..., H, W)."""
    return tensor.reshape(*tensor.shape[:-2], *scan.sensor_shape)


def measured(transient: torch.Tensor, scan: Scan, sensor: nn.Module, generator: torch.Generator | None) -> torch.Tensor:
    """What ``sensor`` makes of (..., T, [Lh, Lw,] H, W): each pair is a pixel of its own."""
    if scan.kind == "exhaustive":
        (rows, columns), (laser_rows, laser_columns) = film_size(scan), laser_size(scan)
        flat = transient.reshape(*transient.shape[:-4], laser_rows * laser_columns, rows * columns)
        seen = sensor(flat, generator=generator)
        return seen.reshape(*seen.shape[:-2], *transient.shape[-4:])
    result: torch.Tensor = sensor(transient, generator=generator)
    return result
