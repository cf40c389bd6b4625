"""``tt.nlos.CaptureRenderer``: hidden things as a function of torch tensors, seen around a corner."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import count
from torchtransient.errors import ArgumentError, PhysicsWarning, SceneError, TorchTransientError
from torchtransient.nlos.scene import (
    DEFAULT_BIN_WIDTH_OPL,
    DEFAULT_BOUNCES,
    DEFAULT_ENERGY,
    SENSOR,
    WALL,
    capture_scene,
    film_size,
    hidden_bounds,
    laser_size,
)
from torchtransient.nlos.scene_scan import check_scan_is_seen, reaches_before, tolerance_of
from torchtransient.rendering.arguments import checked_samples
from torchtransient.rendering.job import SEED_RANGE
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.load import Scene, load
from torchtransient.scene.opaque import opaque
from torchtransient.scene.parameters import needing_slope
from torchtransient.scene.variant import active_variant
from torchtransient.sensing import Compose, Device, GradPolicy, Sensor
from torchtransient.sensing.chain.stages import check_axis


def checked_module(sensor: nn.Module | Device, axis: TimeAxis, grad: GradPolicy = "expected") -> nn.Module:
    """Return a sensor as the module that takes transients.

    Args:
        sensor: module or device.
        axis: time axis of the transients.
        grad: treatment of a device's noise.

    Raises:
        UnitError: for a sensor that was made for another axis.
        SceneError: for a sensor whose output has other bins.
    """
    module = sensor.sensor(axis, grad=grad) if isinstance(sensor, Device) else sensor
    check_axis(module, axis)
    if isinstance(module, Sensor | Compose):
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            given = next((tensor for tensor in (*module.parameters(), *module.buffers())), None)
            dark = torch.zeros(1, axis.num_bins, 1, 1, device=None if given is None else given.device)
            bins = module(dark).shape[-3]
        if bins != axis.num_bins:
            raise SceneError(
                f"sensor: expected an answer with the transient's {axis.num_bins} bins, got {bins} of {sensor!r}."
            )
    return module


def _is_readable(tensor: torch.Tensor) -> bool:
    """Return False under ``torch.vmap``, where Python cannot look at values (torch has no public question for that)."""
    try:
        bool(tensor.any())
    except RuntimeError:
        return False
    return True


def _black_message(who: str, within: str = "") -> str:
    """Return the warning of a capture without light; ``within``: a part of the record, "" for all of it."""
    return (
        f"{who}: no light comes back from the hidden things{within}. Meshes scatter on the side that their normals "
        "point to (corners run counterclockwise as seen from there), which has to face the wall; others need a "
        "'twosided' bsdf. Black albedos, energy 0, things behind the wall and bounces= that no light takes give none "
        "either."
    )


def say_black(who: str, capture: Capture) -> None:
    """Warn of a capture without light.

    Args:
        who: begins the message.
        capture: rendered capture.
    """
    found = (capture.steady, capture.transient, capture.phasor)
    light = next(tensor for tensor in found if tensor is not None)
    if not bool(light.any()):
        within = " within the bins" if light is capture.transient else ""
        warnings.warn(_black_message(who, within), PhysicsWarning, stacklevel=3)


def measured(transient: torch.Tensor, scan: Scan, sensor: nn.Module, generator: torch.Generator | None) -> torch.Tensor:
    """Apply a sensor to a transient, in which each pair of laser and sensor point is a pixel of its own.

    Args:
        transient: (..., T, [Lh, Lw,] H, W).
        scan: scan of the capture.
        sensor: module.
        generator: source of randomness for the sensor's noise.

    Returns:
        Tensor of the same shape.
    """
    flat = transient
    if scan.kind == "exhaustive":
        flat = transient.reshape(*transient.shape[:-4], math.prod(laser_size(scan)), math.prod(film_size(scan)))
    # Modules of ``tt.sensing`` take a generator, others may not.
    known = inspect.signature(sensor.forward).parameters.values()
    takes_generator = any(one.name == "generator" or one.kind is one.VAR_KEYWORD for one in known)
    seen: torch.Tensor = sensor(flat, generator=generator) if takes_generator else sensor(flat)
    return seen.reshape(*seen.shape[:-2], *transient.shape[-4:]) if scan.kind == "exhaustive" else seen


def checked_seed(who: str, value: Any) -> int:
    """Return a seed that samplers of 32 bits tell from others.

    Args:
        who: begins the message.
        value: whole number from 0 to 2^32 - 1.

    Raises:
        ArgumentError: for other values.
    """
    return count(f"{who}: seed", value, 0, ArgumentError, SEED_RANGE - 1)


# What findings are about.
SENSOR_RAYS, LASER_RAYS, HIDDEN = "sensor of a scan", "laser of a scan", "hidden things of a scan"


@dataclass(frozen=True, eq=False)
class ScanWatch:
    """Check of a capture's scene with the values of a call, in one pass of rays to scan points and laser spots.

    It finds things that have moved between the wall and an origin, or behind the wall. ``tolerance``: in metres,
    distance from its point at which a ray may end. ``normals``: of the wall at the scan points (N, 3), None where they
    may change. It runs in every render, so it does not look up the shapes that rays meet: every end in the wrong place
    counts.
    """

    tolerance: float
    normals: NDArray[np.float64] | None

    def __call__(self, scene: Any, number: int) -> dict[str, str]:
        """Return findings about sensor ``number`` of a scene that holds the values of a call, by their subject."""
        import drjit as dr
        import mitsuba as mi

        from torchtransient.interfaces import CaptureType
        from torchtransient.plugins.around_corner.scan_table import aims_of, origin_of, scanned_points

        sensor, capture = scene.sensors()[number], scene.integrator().capture
        with dr.suspend_grad():
            points, origin = scanned_points(scene, sensor), mi.Point3f(sensor.origin)
            laser = origin_of(scene, sensor)
            ways = {"sensor": (origin, points - origin)}
            if capture is not CaptureType.CONFOCAL or not np.array_equal(laser, origin):
                ways["laser"] = laser, aims_of(scene, sensor, capture, None)
            tolerance, off, rays = dr.opaque(mi.Float, self.tolerance), {}, {}
            for who, (start, way) in ways.items():
                length = dr.norm(way)
                rays[who] = mi.Ray3f(start, way / length)
                met = scene.ray_intersect_preliminary(rays[who], coherent=True)
                # NaN is elsewhere, too.
                off[who] = ~(dr.abs(met.t - length) <= tolerance)
            normals = None if self.normals is not None else _normals(scene, rays["sensor"])
            dr.eval(points, normals, off)
        found = {}
        for who, elsewhere in off.items():
            wrong = np.array(elsewhere)
            if wrong.any():
                found[SENSOR_RAYS if who == "sensor" else LASER_RAYS] = (
                    f"{wrong.sum()} of {len(wrong)} rays of the {who} do not end at their points of the wall, for the "
                    f"values of a call: something stands between the wall and {who}_origin, or points and wall have "
                    "parted. What the rays meet is what is rendered there."
                )
        wall = sensor.get_shape()
        hidden = [shape for shape in scene.shapes() if shape.ptr != wall.ptr]
        upright = self.normals if self.normals is not None else np.array(normals).T
        if not reaches_before(hidden, np.array(points).T, upright):
            found[HIDDEN] = (
                "nothing hidden is before the wall, for the values of a call: what is behind it sends it no light, and "
                "has no gradient that would bring it back."
            )
        return found


def _normals(scene: Any, ray: Any) -> Any:
    """Normals where rays end, on the side that they come from."""
    import drjit as dr
    import mitsuba as mi

    si = scene.ray_intersect(ray, +mi.RayFlags.Minimal, coherent=True)
    return dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)


# Where the points of a scan stand in the scene.
POINTS, SPOTS = f"{WALL}.{SENSOR}.points", f"{WALL}.{SENSOR}.laser_points"
ORIGIN, LASER_ORIGIN = f"{WALL}.{SENSOR}.sensor_origin", f"{WALL}.{SENSOR}.laser_origin"
_FIELDS = {POINTS: "sensor_points", SPOTS: "laser_points", ORIGIN: "sensor_origin", LASER_ORIGIN: "laser_origin"}
# What a finding about a capture without light is about.
_BLACK = "light of a capture"
# Settings of a renderer that say what is measured.
_WHAT_IS_MEASURED = frozenset(("time_axis", "frequencies", "gates", "film", "effects"))


class CaptureRenderer(nn.Module):
    """Captures of hidden things as a differentiable layer: :class:`TransientRenderer` behind a relay wall.

    Args:
        hidden: hidden shapes, see :func:`~torchtransient.nlos.scene.capture_scene`.
        scan: scan that knows its wall.
        parameters: keys of ``renderer.scene.parameters()`` that get an ``nn.Parameter`` each, or a mapping to start
            values; hidden nodes keep their names (``chair.vertex_positions``, ``hidden.to_world``,
            ``hidden.bsdf.reflectance.value``), the wall is ``wall``.
        bounces: numbers of bounces that count, without gaps, or "all"; 3 is light around one corner.
        energy: joules of the laser, a number or a Mitsuba spectrum dictionary.
        sensor: module of ``tt.sensing`` that the transient goes through, or a device, whose expected answer is taken
            (``device.sensor(axis, grad=...)`` makes modules with noise).
        variant: Mitsuba variant, None for the active one.
        settings: other arguments of :class:`TransientRenderer`, among them ``max_depth``, ``time_axis`` or another film
            (default: bins of 16 ps that hold all light of three bounces) and ``spp`` (paths for each sensor point, or
            for each pair of an exhaustive scan; default 4).

    Raises:
        SceneError, ArgumentError, UnitError: for a set-up that cannot be rendered.

    Where points of the scan require gradients they get them: the tensors of the scan themselves, as they are when it is
    called, so that an optimizer may change them. Points that were computed of other tensors (or given in another
    precision than the scan's float64) stay as they were when the scan was made: once those tensors have changed, a call
    raises SceneError. So does a key of ``parameters`` that the scan brings too. :meth:`forward` returns a
    :class:`Capture`, whose scan has the points of the call. ``parameters()`` and ``state_dict()`` hold nothing of
    points that the scan brings: give optimizers the leaves themselves.

    Values that put something hidden between the wall and an origin, all of it behind the wall, or points off the wall
    are rendered as they are, with a ``PhysicsWarning``, once a scene (the constructor raises SceneError for such a
    set-up; ``physics="error"`` raises PhysicsError for values too, ``"ignore"`` does not look). So are captures without
    any light.

    ``metadata`` of a capture: ``spp``, ``seed`` (a list of a batch), ``seconds``, ``variant``, and ``light``: the
    estimator of each number of bounces in the first call.
    """

    def __init__(
        self,
        hidden: Any,
        scan: Scan,
        parameters: Sequence[str] | Mapping[str, Any] = (),
        *,
        bounces: Sequence[int] | str = DEFAULT_BOUNCES,
        energy: Any = DEFAULT_ENERGY,
        sensor: nn.Module | Device | None = None,
        variant: str | None = None,
        **settings: Any,
    ):
        super().__init__()
        wanted = dict(parameters) if isinstance(parameters, Mapping) else dict.fromkeys(parameters)
        settings["spp"] = checked_samples("CaptureRenderer: spp", settings.get("spp"))
        if settings.get("max_depth") is not None:
            raise ArgumentError("CaptureRenderer: max_depth: bounces= says how far light is followed; leave it out.")
        scene = load(capture_scene(hidden, scan, bounces=bounces, energy=energy), variant=variant)
        if not _WHAT_IS_MEASURED & {name for name, value in settings.items() if value is not None}:
            bounds = hidden_bounds(hidden, scene.variant)
            settings["time_axis"] = scan.default_axis(bounds, DEFAULT_BIN_WIDTH_OPL)
        self.scan, self.bounces = scan, bounces
        followed = _attached(scan)
        _check_once(wanted, followed)
        self._own, self._sources = tuple(wanted), _Sources(_points_of(scan)[key] for key in followed)
        self.renderer = TransientRenderer(scene, {**wanted, **dict.fromkeys(followed)}, **settings)
        for key in followed:
            self.renderer.values[key].requires_grad_(False)
        self.sensor: nn.Module | None = None
        if sensor is not None:
            axis = self.renderer.axis
            if axis is None:
                raise ArgumentError(
                    "CaptureRenderer: a sensor takes transients; give time_axis= instead of another film."
                )
            self.sensor = checked_module(sensor, axis)
        self.says_black = True
        self._explained: str | None = None
        check_scan(self.renderer.scene, scan, self.renderer._options)
        moving = needing_slope(self.renderer._infos, self.renderer._keys)
        if moving:
            self.renderer._watch.installed = ScanWatch(tolerance_of(scan), _lasting_normals(scan, moving))

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
        """Render a :class:`Capture`.

        Args:
            values: values by key of ``parameters``, see :meth:`TransientRenderer.forward`.
            seed: seed of the paths, or one for each item of a batch; None draws one from torch's generator.
            spp: paths for each sensor point, or for each pair of an exhaustive scan; None for the renderer's.
            progress: show a bar.
            generator: source of randomness for the noise of ``sensor``.

        Raises:
            SceneError, ArgumentError: as there.
        """
        checked_samples("CaptureRenderer: spp", spp)
        self._sources.check()
        given = _attached(self.scan)
        if values is not None:
            given |= dict(values)
        out = self.renderer(given, seed=seed, spp=spp, progress=progress)
        self._say_black(out)
        capture = as_capture(out, self._scan_of(given), sensor=self.sensor, generator=generator)
        return replace(capture, metadata={**capture.metadata, "light": self._light()})

    def _light(self) -> str:
        """Return the estimators of light, as they were with the values of the first call."""
        if self._explained is None:
            self._explained = light_of(self.renderer)
        return self._explained

    def _say_black(self, out: RenderOutput) -> None:
        """Warn of a capture without light, unless a finding about its scan explains it."""
        watch, told = self.renderer._watch, self.renderer.scene.warned
        if not self.says_black or not watch.enabled or told & {SENSOR_RAYS, LASER_RAYS, HIDDEN}:
            return
        if (watch.mode == "error" or _BLACK not in told) and _is_readable(out.steady) and not bool(out.steady.any()):
            watch.warn(_BLACK, _black_message("CaptureRenderer"))

    def _scan_of(self, given: Mapping[str, Any]) -> Scan:
        """The scan with the points of this call, which later steps do not change. Points that differ in a batch, or
        that ``torch.vmap`` hides, leave it as it was made.
        """
        now = {key: {**self.renderer.values, **given}.get(key) for key in _points_of(self.scan)}
        if all(value is None for value in now.values()):
            return self.scan
        changed: dict[str, Any] = {}
        for key, old in _points_of(self.scan).items():
            value = now[key]
            if value is not None and (value.numel() != old.numel() or not _is_readable(value)):
                return self.scan
            changed[_FIELDS[key]] = old if value is None else value.to(old.dtype).reshape(old.shape).clone()
        if self.scan.kind == "confocal":
            changed["laser_points"] = changed["sensor_points"]
        try:
            return replace(self.scan, **changed, **_lasting(self.scan))
        except TorchTransientError as error:
            if self.renderer._watch.enabled:
                self.renderer._watch.warn(
                    "points of a scan",
                    f"CaptureRenderer: points of a call are no scan, capture.scan is the constructor's: {error}",
                )
            return self.scan


def _lasting(scan: Scan) -> dict[str, Any]:
    """Return normals of points that have moved: of a flat wall, None elsewhere."""
    found = {"sensor_normals": scan.sensor_normals, "laser_normals": scan.laser_normals}
    flat = all(n is None or bool((n == n.reshape(-1, 3)[0]).all()) for n in found.values())
    return found if flat else dict.fromkeys(found)


def light_of(renderer: TransientRenderer) -> str:
    """Return a sentence on the estimators that find the light of a capture's scene, as it is built.

    Args:
        renderer: renderer of the capture's scene.
    """
    with active_variant(renderer.scene.variant):
        from torchtransient.plugins.around_corner.division import explanation

        built = renderer.scene.built(renderer._options).scene
        integrator, sensor = built.integrator(), built.sensors()[0]
        return explanation(integrator, built, integrator.contents(built, sensor))


def check_scan(scene: Scene, scan: Scan, options: BuildOptions | None = None) -> None:
    """Check that sensor and laser of a capture's scene look at the points of its scan.

    Args:
        scene: scene of the capture.
        scan: scan that the scene was made of.
        options: build options, None for a transient film.

    Raises:
        SceneError: for a hidden thing in their way, or a wall that is elsewhere.
    """
    with active_variant(scene.variant):
        built = scene.built(BuildOptions(transient=True) if options is None else options)
        check_scan_is_seen(built.scene, scan)


class _Sources:
    """The leaves that tensors were computed of, and how often they had been changed by then."""

    def __init__(self, tensors: Iterable[torch.Tensor]):
        self._versions = [(leaf, leaf._version) for tensor in tensors for leaf in _leaves(tensor)]

    def __getstate__(self) -> dict[str, Any]:
        # Points of a copy are leaves.
        return {"_versions": []}

    def check(self) -> None:
        """Raise SceneError where one was changed since."""
        if any(leaf._version != version for leaf, version in self._versions):
            raise SceneError(
                "CaptureRenderer: tensors that points of its scan were computed of have changed, and the points have "
                "not. Give Scan the leaves themselves (float64), or the points of each step to the call: "
                f"renderer({{'{POINTS}': points}}, ...); or make scan and renderer anew in each step."
            )


def _leaves(tensor: torch.Tensor) -> list[torch.Tensor]:
    """The leaves that a tensor was computed of; none for a leaf and its views, which see what becomes of it."""
    if tensor.is_leaf or (tensor._base is not None and tensor._base.is_leaf):
        return []
    found, seen, ahead = [], set(), [tensor.grad_fn]
    while ahead:
        node = ahead.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if hasattr(node, "variable"):
            found.append(node.variable)
        ahead += [before for before, _ in node.next_functions]
    return found


def _lasting_normals(scan: Scan, moving: Iterable[str]) -> Any:
    """Normals of the wall at the scan points (N, 3) as numpy array, None where they may change or are not known."""
    changing = any(key == POINTS or key.split(".")[:2] != [WALL, SENSOR] for key in moving if key.startswith(WALL))
    known = scan.sensor_normals
    return None if changing or known is None else known.detach().cpu().reshape(-1, 3).numpy().copy()


def _check_once(parameters: Mapping[str, Any], followed: Mapping[str, torch.Tensor]) -> None:
    """Raise SceneError where two tensors would be one value."""
    twice = [key for key in parameters if key in followed]
    if twice:
        raise SceneError(
            f"CaptureRenderer: {', '.join(twice)}: expected one tensor, got one of the scan too. Take scan.detach()."
        )


def _attached(scan: Scan) -> dict[str, torch.Tensor]:
    """The points of a scan that require gradients as they are now, by their keys in the scene."""
    points = {key: value for key, value in _points_of(scan).items() if value.requires_grad}
    return {key: value if value.ndim == 1 else value.reshape(-1, 3) for key, value in points.items()}


def _points_of(scan: Scan) -> dict[str, torch.Tensor]:
    points = {POINTS: scan.sensor_points, ORIGIN: scan.sensor_origin, LASER_ORIGIN: scan.laser_origin}
    return points if scan.kind == "confocal" else {**points, SPOTS: scan.laser_points}


def as_capture(
    out: RenderOutput, scan: Scan, sensor: nn.Module | None = None, generator: torch.Generator | None = None
) -> Capture:
    """Return the render of a capture's scene in the scan's shape, as views of its tensors.

    Args:
        out: output of the renderer.
        scan: scan of the capture.
        sensor: module that the transient goes through.
        generator: source of randomness for the sensor's noise.

    Raises:
        ArgumentError: for gated, rate or beat films.
    """

    def shaped(tensor: torch.Tensor | None) -> torch.Tensor | None:
        return None if tensor is None else in_scan_shape(tensor, scan)

    if out.transient is None and out.phasor is None:
        raise ArgumentError(
            "capture: expected a time axis or frequencies; a capture has no place for light of other films."
        )
    transient = out.transient
    if sensor is not None:
        assert transient is not None  # sensors of phasors have been refused
        transient = measured(transient, scan, sensor, generator)
    # The steady image of an exhaustive scan sums over the laser's positions.
    steady = None if scan.kind == "exhaustive" else steady_in_scan_shape(out.steady, scan)
    polarized = out.stats.variant.endswith("polarized")
    seeds = out.stats.seeds
    metadata = {
        "spp": out.stats.spp, "seed": seeds[0] if len(seeds) == 1 else list(seeds), "seconds": out.stats.seconds,
        "variant": out.stats.variant,
    }  # fmt: skip
    return Capture(
        transient=shaped(transient), axis=out.axis, scan=scan, metadata=metadata, phasor=shaped(out.phasor),
        frequencies=out.frequencies, steady=steady, channels=tuple(out.channels), polarized=polarized,
    )  # fmt: skip


def in_film_shape(tensor: torch.Tensor, scan: Scan) -> torch.Tensor:
    """Reshape a tensor from the scan's shape behind T to (..., T, [Lh, Lw,] H, W) of a film.

    Args:
        tensor: (..., T, *scan.shape).
        scan: scan of the capture.
    """
    laser = laser_size(scan) if scan.kind == "exhaustive" else ()
    return tensor.reshape(*tensor.shape[: tensor.ndim - len(scan.shape)], *laser, *film_size(scan))


def in_scan_shape(tensor: torch.Tensor, scan: Scan) -> torch.Tensor:
    """Reshape a tensor from (..., T, [Lh, Lw,] H, W) of a render to the scan's shape behind T.

    Args:
        tensor: (..., T, [Lh, Lw,] H, W).
        scan: scan of the capture.
    """
    film = 4 if scan.kind == "exhaustive" else 2
    return tensor.reshape(*tensor.shape[: tensor.ndim - film], *scan.shape)


def steady_in_scan_shape(tensor: torch.Tensor, scan: Scan) -> torch.Tensor:
    """Reshape an image (..., H, W) to (..., *scan.sensor_shape).

    Args:
        tensor: (..., H, W).
        scan: scan of the capture.
    """
    return tensor.reshape(*tensor.shape[:-2], *scan.sensor_shape)
