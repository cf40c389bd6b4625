"""Derivatives of one parameter in one scene of the sweep: reverse mode, forward mode, central finite differences.

The loss is the transient weighed by a sine of the optical path length, and of the rate where things move. All of them
use the same seeds, so that what is random cancels between the two sides of a difference, and mostly between difference
and derivative too.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.rendering.engine import run
from torchtransient.rendering.job import Item, RenderJob, Seeding
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.physics import PhysicsWatch
from torchtransient.scene.variant import active_variant

if TYPE_CHECKING:
    from torchtransient.scene.load import Scene

Array = NDArray[np.float64]
# Of the loss weights, per metre, and per metre and second.
PHASE = 3.0
RATE_PHASE = 0.7
# Components of a Stokes vector count differently, so that polarization matters.
STOKES = (0.2, 1.0, -0.7, 1.3)


@dataclass(frozen=True)
class Tangent:
    """A direction in the entries of a parameter. ``step``: of the differences, in units of the direction's length.
    ``one_sided``: the parameter is at an end of its range, and the direction leads inwards.
    """

    name: str
    direction: torch.Tensor
    step: float
    one_sided: bool = False


class Subject:
    """One parameter of a scene: its value, and the loss and its derivatives by seed and number of samples."""

    def __init__(self, scene: Scene, key: str):
        self.scene, self.key = scene, key
        self.info = scene.parameters()[key]
        self.options = scene.options_for([key], BuildOptions(transient=True))
        with active_variant(scene.variant):
            slot = scene.slots((key,), self.options).slots[0]
            self.kind = slot.kind
            self.value = torch.tensor(np.asarray(slot.initial, dtype=np.float32).reshape(slot.shape))
            sensors = scene.built(self.options).scene.sensors()
            self._weights = weights_of(sensors[0].film())
            self.pixels = int(np.prod(sensors[0].film().crop_size()))

    def _job(self, seed: int, spp: int, derivative: bool) -> RenderJob:
        return RenderJob(
            scene=self.scene,
            options=self.options,
            keys=(self.key,),
            items=(Item(0, 0, seed, seed),),
            seeding=Seeding((0,), 1, "same"),
            batched=(False,),
            spp=spp,
            spp_grad=spp,
            temporal_filter=None,
            watch=PhysicsWatch("ignore", set()),
            needs=(True,) if derivative else (),
        )

    def losses(self, value: torch.Tensor, seed: int, spp: int) -> tuple[float, float]:
        """The loss, and the loss by the absolute values of its weights."""
        _, response = run(self._job(seed, spp, False), RENDER, [value])
        response = response.double().sum((0, 1))
        return float((response * self._weights).sum()), float((response * self._weights.abs()).abs().sum())

    def reverse(self, seed: int, spp: int) -> Array:
        """The gradient of the loss, flat."""
        shape = self._cube_shape()
        weights = self._weights.float().expand(shape).contiguous()
        (gradient,) = run(self._job(seed, spp, True), BACKWARD, [self.value], [None, weights])
        return gradient.double().reshape(-1).numpy()

    def forward(self, direction: torch.Tensor, seed: int, spp: int) -> float:
        """The derivative of the loss along a direction."""
        _, response = run(self._job(seed, spp, True), FORWARD, [self.value], [direction])
        return float((response.double().sum((0, 1)) * self._weights).sum())

    def difference(self, tangent: Tangent, seed: int, spp: int, step: float) -> tuple[float, float]:
        """The difference along a direction, to second order in the step, and the loss of absolute weights."""
        if tangent.one_sided:
            here, scale = self.losses(self.value, seed, spp)
            near, _ = self.losses(self.value + step * tangent.direction, seed, spp)
            far, _ = self.losses(self.value + 2 * step * tangent.direction, seed, spp)
            return (4 * near - 3 * here - far) / (2 * step), scale
        above, scale = self.losses(self.value + step * tangent.direction, seed, spp)
        below, _ = self.losses(self.value - step * tangent.direction, seed, spp)
        return (above - below) / (2 * step), scale

    def _cube_shape(self) -> tuple[int, ...]:
        with active_variant(self.scene.variant):
            return tuple(self.scene.built(self.options).scene.sensors()[0].film().cube_shape())

    def tangents(self) -> list[Tangent]:
        """The directions that are tried."""
        turns = not self.info.place or self.info.place[0] not in _FIXED_AXES
        found = tangents_of(self.key, self.kind, self.value, turns, self.info.moves_path_length)
        if "spectral" in self.scene.variant and self.key.endswith(".value") and tuple(self.value.shape) == (3,):
            # Coefficients of a spectral model are of very different sizes: each changes by its own.
            return [replace(t, direction=t.direction.sign() * self.value.abs()) for t in found]
        return found


def weights_of(film: Any) -> torch.Tensor:
    """Weights of the loss behind a pixel, (T, C), of a film of rates (R, T, C)."""
    import mitsuba as mi

    centres = film.start_opl + (np.arange(film.temporal_bins) + 0.5) * film.bin_width_opl
    channels = film.channel_count()
    components = np.repeat(STOKES, channels // 4) if mi.is_polarized else np.ones(channels)
    # Colours count differently, lest what is opposite in two of them cancels.
    colours = 1.0 - 0.2 * np.arange(channels) / channels
    weights = np.sin(PHASE * centres)[:, None] * (components * colours)[None, :]
    if film.measures == "rates":
        rates = film.rate_start + (np.arange(film.rate_bins) + 0.5) * film.rate_width
        weights = np.sin(RATE_PHASE * rates + 0.5)[:, None, None] * weights
    return torch.tensor(weights)


# ---------------------------------------------------------------------------------------------------------- directions

_VALUE_STEP = 0.05
_LENGTH_STEP = 0.01
# By the last name of a key: the size of a change in its entries that is worth 1.
_SIZES = {
    "vertex_positions": 1.0, "vertex_normals": 0.2, "vertex_texcoords": 0.05, "control_points": 0.5,
    "principal_point_offset_x": 0.5, "principal_point_offset_y": 0.5, "points": 1.0, "laser_points": 1.0,
}  # fmt: skip


# Maps of normals hold half of what they lean by; mirrors swing with them, so that steps are short.
_NORMALMAP, _LEAN, _LEAN_STEP = "normalmap", 0.1, 0.1
# What poses turn about, seen from the origin of the object: turned about its middle, a plate hardly changes.
_PIVOT = np.array([0.7, -0.5, 0.4])
# Poses that cannot have a rotation.
_FIXED_AXES = ("SDFGrid.to_world",)
# Numbers that may be negative; of all others zero is the least.
_SIGNED = ("g", "theta", "delta", "scale_tilt", *_SIZES)
_PLACES = ("position", "sun_direction", "sensor_origin", "laser_origin")
# Shares, of which one is the largest.
_SHARES = ("opacity", "weight")


def generator_of(key: str) -> np.random.Generator:
    """Random numbers that belong to a key."""
    return np.random.default_rng(zlib.crc32(key.encode()))


def tangents_of(key: str, kind: str, value: torch.Tensor, turns: bool = True, moves: bool = False) -> list[Tangent]:
    """The directions that are tried: two for poses and positions, one otherwise. ``turns``: a pose may rotate.
    ``moves``: a number may change path lengths.
    """
    rng = generator_of(key)
    name = key.rsplit(".", 1)[-1]
    if kind in ("transform", "mesh_transform") and value.shape == (4, 4):
        return _motions(value.double().numpy(), rng, "sensor" in key, turns)
    shape = tuple(value.shape)
    if name in _PLACES:
        first, second = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
        return [
            Tangent("random direction", _tensor(first), _LENGTH_STEP),
            Tangent("across it", _tensor(second), _LENGTH_STEP),
        ]
    if name in _SIZES:
        direction = rng.normal(size=shape) * _SIZES[name]
        if name == "vertex_positions" and len(shape) == 2:
            # Faces must not come apart: vertices at one place move together.
            _, first, same = np.unique(value.numpy(), axis=0, return_index=True, return_inverse=True)
            direction = direction[first[same.reshape(-1)]]
        return [Tangent("random", _tensor(direction), _LENGTH_STEP)]
    size = float(value.double().square().mean().sqrt()) or 1.0
    step = _LENGTH_STEP if moves else _VALUE_STEP
    if _NORMALMAP in key.split("."):
        size, step = _LEAN, _LEAN_STEP
    direction = np.asarray(0.7 + 0.5 * rng.normal(size=shape)) if value.numel() > 1 else np.ones(shape)
    direction *= size / np.sqrt(np.mean(direction**2))
    words = "relative change" if value.numel() == 1 else "random"
    if not value.any() and name not in _SIGNED:
        return [Tangent(f"{words}, from zero", _tensor(direction), step, True)]
    if bool((value == 1).all()) and any(share in key.split(".") for share in _SHARES):
        return [Tangent(f"{words}, down from one", _tensor(-direction), step, True)]
    return [Tangent(words, _tensor(direction), step)]


def _tensor(array: Array) -> torch.Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32)


def _motions(pose: Array, rng: np.random.Generator, rigid: bool, turns: bool) -> list[Tangent]:
    """A translation by a metre, and a rotation by a fifth of a radian about a point near the object's origin, with
    a growth by a tenth unless it must stay rigid.
    """
    shift = np.zeros((4, 4))
    shift[:3, 3] = rng.normal(size=3) * 0.3 + [0.0, 0.0, 0.8]
    shift[:3, 3] /= np.linalg.norm(shift[:3, 3])
    axis = np.array([0.8, 0.9, 0.3]) + 0.3 * rng.normal(size=3)
    x, y, z = 0.2 * axis / np.linalg.norm(axis)
    turn = np.zeros((4, 4))
    turn[:3, :3] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) + (0.0 if rigid else 0.1) * np.eye(3)
    if not turns:
        turn = np.diag([0.1, 0.1, 0.1, 0.0])
    turn[:3, 3] = -turn[:3, :3] @ (pose[:3, 3] + _PIVOT)
    words = "rotation" if rigid else "rotation and growth" if turns else "growth"
    return [
        Tangent("translation", _tensor(shift @ pose), _LENGTH_STEP),
        Tangent(words, _tensor(turn @ pose), _LENGTH_STEP),
    ]


@contextmanager
def quiet() -> Iterator[None]:
    """Mitsuba's warnings are not of interest here."""
    import mitsuba as mi

    before = mi.logger().log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)
