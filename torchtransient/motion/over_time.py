"""``tt.over_time``: a renderer whose scene moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

from torch import Tensor

from torchtransient.checks import as_whole, function, mapping, of_class, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError, UnknownKeyError
from torchtransient.floating import holds
from torchtransient.motion.rigid_motion import Motion
from torchtransient.motion.slow_times import Exposure, Frames, SlowTimes
from torchtransient.plugins.mitsuba_compat import POSITIONS, VELOCITY
from torchtransient.rendering.job import draw_seed
from torchtransient.rendering.output import RenderOutput
from torchtransient.rendering.poses import film_rows, pose_of, scene_size, watch_of
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.opaque import opaque
from torchtransient.scene.parameters import unknown_key
from torchtransient.scene.values import as_float
from torchtransient.scene.variant import device_type

# A motion or a function of times (K,) by key or name of a body, or one function of all.
Moving: TypeAlias = Mapping[str, "Motion | Callable[[Tensor], Any]"] | Callable[[Tensor], Mapping[str, Any]]

# Parameters that a rigid motion moves.
_PLACES = ("to_world", "position", POSITIONS)
_UNITS = "Times are seconds, and velocities m/s and rad/s: 1.5 ms are 1.5e-3."


@opaque
def over_time(
    renderer: TransientRenderer,
    moving: Moving,
    exposure: SlowTimes,
    *,
    values: Mapping[str, Any] | None = None,
    seed: int | None = None,
    spp: int | None = None,
    progress: bool = False,
) -> RenderOutput:
    """Render a moving scene as a camera sees it during an exposure.

    One batch of poses is rendered, all with the same samples, so that noise does not differ between instants; the
    result of the exposure is linear in their pictures. Costs as many renders as poses, and holds their pictures.

    Args:
        renderer: a renderer whose parameters include what moves, ``parameters=["fan.to_world"]``.
        moving: motions by key, or by name of a body ("fan" for its pose "fan.to_world", its position or the vertices of
            its mesh, whichever the renderer has):

            - a :class:`tt.Motion`, from the value of the call or of the renderer, which is that of t = 0;
            - a function of times (K,), seconds, float64, that returns the values (K, *shape) of the key;
            - or, in place of the mapping, one function of times that returns values by key.
        exposure: :class:`tt.Exposure`, :class:`tt.RollingShutter`, :class:`tt.PhaseSteps` or :class:`tt.Frames`.
        values: values by key in place of the renderer's own, without a batch.
        seed: one seed for all poses; None draws one from torch's generator.
        spp: samples per pixel of each pose, None for the renderer's.
        progress: show a progress bar.

    Returns:
        A :class:`RenderOutput` as a call of the renderer returns it, with one leading dimension more for
        ``PhaseSteps`` and ``Frames``. Its tensors carry gradients to velocities, to tensors that the functions use, and
        to all values.

    Raises:
        ArgumentError: for a renderer with a whole number as ``grad_seed``, whose poses would differ in noise; for films
            that do not measure what the exposure needs; for a motion of a value that is no place, and without motions.
        UnknownKeyError: for keys and names that the renderer does not have.
        ShapeError: for batches, and functions that return other than one value for each time.
        PhysicsError: with ``physics="error"`` of the renderer, for a body that moves further than the scene is large,
            or turns around, while the camera looks (of ``Frames``: from one frame to the next). Otherwise that is a
            ``PhysicsWarning``, as is a motion that slow phasors follow already, by the velocity of the same body.
        SceneError, UnitError, DeviceError, StorageError, GradientError: as the renderer raises them.

    Not supported: Doppler shifts of the light itself. See ``docs/motion.md``.
    """
    of_class("over_time: renderer", renderer, TransientRenderer)
    of_class("over_time: exposure", exposure, SlowTimes, ", such as tt.Exposure(1e-3)")  # type: ignore[type-abstract]
    if exposure.needs_phasors and not renderer.film.is_complex:
        raise ArgumentError(
            f"over_time: {exposure} is seen by a phasor film, got one that measures {renderer.film.measures}. Make the "
            "renderer with frequencies=..., or leave out beat_hz."
        )
    if isinstance(renderer.grad_seed, int):
        raise ArgumentError(
            f"over_time: expected a renderer with grad_seed=None or 'same', which give all poses the same samples, got "
            f"{renderer.grad_seed}."
        )
    number = as_whole(draw_seed(seed)[0])
    if number is None:
        raise UnitError(f"seed: expected one whole number for all poses, got {shown(seed)}.")
    own = pose_of(renderer, values, "over_time")
    time_s = exposure.poses_s(film_rows(renderer)).to(device_type(renderer.scene.variant))
    moved = _values_at(moving, time_s, own)
    if watch_of(renderer).enabled:
        _check_units(renderer, moving, moved, time_s, each=isinstance(exposure, Frames))
        if isinstance(exposure, Exposure) and renderer.film.measures == "slow_phasor":
            _check_once(renderer, moved)
    poses: RenderOutput = renderer(
        {**(values or {}), **moved}, seed=[number] * len(time_s), spp=spp, progress=progress
    )
    return poses.map(exposure.combine)


def _check_units(
    renderer: TransientRenderer, moving: Moving, moved: Mapping[str, Tensor], time_s: Tensor, each: bool
) -> None:
    """Warn of bodies that move further than the scene is large, or turn around, as they do for times in milliseconds.

    Args:
        renderer: the renderer.
        moving: motions, see :func:`over_time`.
        moved: values (K, *shape) of the moving keys.
        time_s: times (K,), seconds.
        each: compare each time with the next one, not the first with the last; turns do not count then.
    """
    size, watch = scene_size(renderer), watch_of(renderer)
    for key, value in moved.items():
        place = key.rpartition(".")[2]
        if place not in _PLACES or len(time_s) < 2:
            continue
        points = value.detach()[:, None, :3, 3] if place == "to_world" else value.detach().reshape(len(value), -1, 3)
        distance = (points.diff(dim=0) if each else points[-1] - points[0]).norm(dim=-1).amax()
        if not holds(distance <= size):
            travel = f"moves by {float(distance):.3g} m, in a scene that measures {size:.3g} m with its sensors"
            watch.warn(f"motion of {key}", f"over_time: {key!r} {travel}. {_UNITS}")
    for name, how in moving.items() if isinstance(moving, Mapping) and not each else ():
        if isinstance(how, Motion):
            turns = how.angular.detach().norm().cpu() * (time_s[-1] - time_s[0]).detach().cpu().abs() / (2 * math.pi)
            if not holds(turns <= 1):
                watch.warn(f"turns of {name}", f"over_time: {name!r} turns around {float(turns):.3g} times. {_UNITS}")


def _check_once(renderer: TransientRenderer, moved: Iterable[str]) -> None:
    """Warn of poses that move on while slow phasors follow the velocity of the same body."""
    known = list(renderer.scene.known_parameters())
    for key in moved:
        body = key.rpartition(".")[0]
        if any(name.startswith((f"{body}.{VELOCITY}", f"{body}.velocity.")) for name in known):
            watch_of(renderer).warn(
                f"twice {key}",
                f"over_time: {body!r} has a velocity, which slow phasors follow over their times: with {key!r} its "
                "motion counts twice. Take tt.Frames, a burst of pulses at each instant, or a scene without that "
                "velocity.",
            )


def _values_at(moving: Moving, time_s: Tensor, own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the values (K, *shape) of all moving keys; ``own``: values of all keys at t = 0."""
    if isinstance(moving, Mapping):
        at = {name: how if isinstance(how, Motion) else _called(name, how, time_s) for name, how in moving.items()}
    else:
        at = dict(mapping("over_time: function of times", _called("moving", moving, time_s), "{key: values}"))
    if not at:
        raise ArgumentError("over_time: expected something that moves, got nothing. renderer(...) renders still ones.")
    found: dict[str, Tensor] = {}
    for name, value in at.items():
        key = _key_of(name, own)
        if key in found:
            raise ArgumentError(f"over_time: {key!r} is moved twice.")
        still = own[key]
        if isinstance(value, Motion):
            found[key] = _moved(key, still, value.matrices(time_s))
            continue
        found[key] = as_float(key, value, still.device.type)
        if found[key].shape != (len(time_s), *still.shape):
            raise ShapeError(
                f"over_time: expected a function that returns {(len(time_s), *still.shape)} for {len(time_s)} times of "
                f"{key!r}, got {tuple(found[key].shape)}."
            )
    return found


def _called(name: str, how: Any, time_s: Tensor) -> Any:
    return function(f"over_time: {name}", how, "times (K,), or a tt.Motion")(time_s)


def _key_of(name: str, own: Mapping[str, Tensor]) -> str:
    """Return the key of a name. Raises UnknownKeyError."""
    for key in (name, *(f"{name}.{place}" for place in _PLACES)):
        if key in own:
            return key
    example = name if "." in str(name) else f"{name}.to_world"
    raise UnknownKeyError(
        f"{unknown_key(name, list(own), 'this renderer')} What moves is one of its parameters: "
        f"TransientRenderer(scene, parameters=['{example}'])."
    )


def _moved(key: str, still: Tensor, matrices: Tensor) -> Tensor:
    """Return a pose, a position or vertices after each of the motions ``matrices`` (K, 4, 4)."""
    place = key.rpartition(".")[2]
    if place not in _PLACES:
        raise ArgumentError(
            f"over_time: a tt.Motion moves {', '.join(_PLACES)}, got {key!r}. Give a function of times in its place."
        )
    if place == "to_world":
        return matrices @ still.to(matrices)
    points = still.to(matrices).reshape(-1, 3)
    moved = points @ matrices[:, :3, :3].mT + matrices[:, None, :3, 3]
    return moved.reshape(len(matrices), *still.shape)
