"""The derivative of a scene with moving edges, in parts: interior term, each pass of the boundary term, differences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import torchtransient.plugins
from tools.boundary_cases.moving_edges import Array, MovingEdge
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.load import load
from torchtransient.scene.variant import active_variant

PASSES = ("primary", "vertex", "light", "specular")


def choose_passes(integrator: Any, passes: tuple[str, ...], spp: int | None = None) -> None:
    """Set the passes of the boundary term of an integrator's derivatives, and their edge samples per pixel; ``spp``:
    None for the integrator's own.
    """
    integrator.boundary, integrator.boundary_passes, integrator.spp_boundary = bool(passes), tuple(passes), spp


def pixel_weights(case: MovingEdge, height: int, width: int) -> Array:
    """Weights (H, W, 1, 1) of the pixels in a case's loss."""
    if case.weights != "random":
        return np.ones((height, width, 1, 1))
    return np.random.default_rng(1).uniform(0.3, 1.0, (height, width, 1, 1))


def components(channels: int) -> Array:
    """Weights (C,) of the channels in a loss, which differ."""
    return np.resize([1.0, 0.3, -0.5, 0.8, 0.2, -0.9], channels)


class EdgeProblem:
    """A case, loaded once. The loss weighs bins by sin(3 opl) and pixels by fixed numbers between 0.3 and 1."""

    def __init__(self, case: MovingEdge) -> None:
        self.case = case
        mi.set_variant(case.variant)
        torchtransient.plugins.sync()
        self._handle = load(case.scene(), variant=case.variant)
        with active_variant(self._handle.variant):
            built = self._handle.built(BuildOptions())
        self.scene, self.params = built.scene, built.params
        self.integrator, self.film = self.scene.integrator(), self.scene.sensors()[0].film()
        self._type = type(self.params[case.key])
        self._base = self._numbers(self.params[case.key])
        self._direction = np.asarray(case.direction(self._base), np.float64)
        height, width, *_, bins, channels = self.film.cube_shape()
        opl = self.film.start_opl + (np.arange(bins) + 0.5) * getattr(self.film, "bin_width_opl", 0.04)
        shares = pixel_weights(case, height, width) * components(channels)
        # (H, W, T, C)
        self.weights = (np.sin(3 * opl)[:, None] * shares).astype(np.float32)
        # The first look fixes the sphere around the scene, which distant lights are timed by.
        self.integrator.reference(self.scene)

    def _numbers(self, value: Any) -> Array:
        found = np.array(value.matrix if "Transform" in type(value).__name__ else value).astype(np.float64)
        if self.case.key.endswith("vertex_positions"):
            return found.reshape(-1, 3)
        return found.reshape(4, 4) if found.size == 16 else found.reshape(-1)

    def install(self, x: Any) -> None:
        """Write the unknown, which may be attached, into the scene."""
        base, direction = self._base.astype(np.float32), self._direction.astype(np.float32)
        value: Any
        if base.shape == (4, 4):
            rows = [[float(base[i, j]) + x * float(direction[i, j]) for j in range(4)] for i in range(4)]
            value = self._type(mi.Matrix4f(rows))
        elif self._type in (mi.Point3f, mi.Vector3f):
            value = self._type(*base.tolist()) + mi.Vector3f(*direction.tolist()) * x
        else:
            value = mi.Float(base.ravel()) + mi.Float(direction.ravel()) * x
        self.params[self.case.key] = value
        self.params.update()

    def cube(self, x: float, seed: int, spp: int) -> Array:
        """The transient (H, W, T, C) at a value of the unknown."""
        self.install(mi.Float(x))
        return np.array(self.integrator.render(self.scene, seed=seed, spp=spp)[1], dtype=np.float64)

    def loss(self, x: float, seed: int, spp: int) -> float:
        return float((self.cube(x, seed, spp) * self.weights).sum())

    def difference(self, seed: int, spp: int, step: float | None = None) -> float:
        """Central difference of the loss with common random numbers."""
        h = step or self.case.step
        return (self.loss(h, seed, spp) - self.loss(-h, seed, spp)) / (2 * h)

    def reverse(
        self,
        seed: int,
        spp: int,
        passes: tuple[str, ...] = PASSES,
        *,
        interior: bool = True,
        share: float | None = None,
    ) -> float:
        """The derivative of the loss in reverse mode, of some ``passes`` and of the interior term."""
        x = mi.Float(0)
        dr.enable_grad(x)
        self.install(x)
        choose_passes(self.integrator, passes, None if share is None else max(1, round(share * spp)))
        job = self.integrator.prepared(self.scene, 0, seed, spp, "backward", (None, mi.TensorXf(self.weights)))
        if not interior:
            job.launches = []
        self.integrator.run(job)
        if dr.grad_enabled(self.params[self.case.key]):
            dr.enqueue(dr.ADMode.Backward, self.params[self.case.key])
        dr.traverse(dr.ADMode.Backward)
        gradient = float(dr.grad(x)[0])
        self.install(mi.Float(0))
        return gradient

    def tangent(self, seed: int, spp: int, passes: tuple[str, ...] = PASSES, *, interior: bool = True) -> Array:
        """The derivative (H, W, T, C) of the transient in forward mode."""
        x = mi.Float(0)
        dr.enable_grad(x)
        self.install(x)
        dr.set_grad(x, 1)
        dr.forward_from(x, dr.ADFlag.ClearEdges)
        choose_passes(self.integrator, passes)
        job = self.integrator.prepared(self.scene, 0, seed, spp, "forward")
        if not interior:
            job.launches = []
        with dr.suspend_grad():
            self.integrator.run(job)
            found = np.array(job.film.develop()[1], dtype=np.float64)
        self.install(mi.Float(0))
        return found

    def forward(self, seed: int, spp: int, passes: tuple[str, ...] = PASSES, *, interior: bool = True) -> float:
        """The derivative of the loss in forward mode."""
        return float((self.tangent(seed, spp, passes, interior=interior) * self.weights).sum())
