"""Captures with a part that moves: the derivative of a linear loss in both modes, and by finite differences."""

from __future__ import annotations

from contextlib import contextmanager
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.around_corner.occlusion import LateOutlines, MutualOcclusion

SIGMAS = 4.0
# The parameter of differences: of the third derivative a share of (h / 0.3 m)^2 is left. No shadow of a plate may pass
# a rim meanwhile, where the capture has a kink.
STEP = 4e-3


def move(*v):
    """A transform, or vertices, or points, along ``v`` times the parameter."""

    def moved(start, θ):
        if "Transform" in type(start).__name__:
            return mi.Transform4f().translate(mi.Vector3f(*v) * θ) @ mi.Transform4f(start)
        if dr.depth_v(start) == 2:
            return start + mi.Vector3f(*v) * θ
        return start + mi.Float(np.tile(np.float32(v), dr.width(start) // 3)) * θ

    return moved


def turn(center):
    """A transform about the vertical through ``center``, by radians; the same for vertices, to first order."""

    def turned(start, θ):
        if "Transform" in type(start).__name__:
            there = mi.Transform4f().translate(list(center)).rotate([0, 1, 0], mi.Float(np.degrees(1.0)) * θ)
            return there.translate([-c for c in center]) @ mi.Transform4f(start)
        v = np.array(dr.detach(start)).reshape(-1, 3) - np.float32(center)
        return start + mi.Float(np.stack([v[:, 2], 0 * v[:, 0], -v[:, 0]], 1).ravel().astype(np.float32)) * θ

    return turned


class MovedCapture:
    """A scene, the parameters that ``change(start, θ)`` moves, and a loss that is linear in the capture, or in its
    steady image (``steady``). ``wave(i)`` is how much the weight of bin i differs from one.
    """

    def __init__(self, description, keys, change, steady=False, wave=lambda i: np.sin(i / 7)):
        self.scene = mi.load_dict(description, optimize=False)
        self.parameters, self.change = mi.traverse(self.scene), change
        keys = [keys] if isinstance(keys, str) else keys
        self.start = {key: type(self.parameters[key])(self.parameters[key]) for key in keys}
        self.steady = steady
        shape = tuple(self.scene.sensors()[0].film().cube_shape())
        rng = np.random.default_rng(5)
        # Of every point, and of every pair of a point and a spot in exhaustive captures.
        weights = 1 + 0.3 * rng.normal(size=shape[:2] if steady else shape[:-2])
        if not steady:
            weights = weights[..., None] * (1 + wave(np.arange(shape[-2])))
        weights = weights[..., None] * (1 + 0.5 * np.arange(shape[-1]))
        self.adjoint = mi.TensorXf(np.broadcast_to(weights, shape if not steady else weights.shape).astype(np.float32))

    def install(self, θ):
        for key, start in self.start.items():
            self.parameters[key] = self.change(start, θ)
        self.parameters.update()

    def weighed(self, images):
        image = images[0 if self.steady else 1]
        return float((np.array(image, dtype=np.float64) * np.array(self.adjoint, dtype=np.float64)).sum())

    def loss(self, θ, seed, spp):
        self.install(mi.Float(θ))
        with dr.suspend_grad():
            return self.weighed(self.scene.integrator().render(self.scene, seed=seed, spp=spp))

    def difference(self, h, seed, spp):
        return (self.loss(h, seed, spp) - self.loss(-h, seed, spp)) / (2 * h)

    @contextmanager
    def _attached(self):
        """The parameter, attached. Nothing is so afterwards: kernels are traced through the objects of every scene that
        is alive, and forward mode runs into what is attached there.
        """
        θ = mi.Float(0)
        dr.enable_grad(θ)
        self.install(θ)
        try:
            yield θ
        finally:
            self.install(mi.Float(0))

    def reverse(self, seed, spp):
        with self._attached() as θ:
            self._backward(seed, spp)
            return float(dr.grad(θ)[0])

    def _backward(self, seed, spp):
        adjoints = (self.adjoint, None) if self.steady else (None, self.adjoint)
        self.scene.integrator().render_backward(self.scene, self.parameters, adjoints, seed=seed, spp=spp)

    def forward(self, seed, spp):
        with self._attached() as θ:
            dr.set_grad(θ, 1.0)
            return self.weighed(self.scene.integrator().render_forward(self.scene, self.parameters, seed=seed, spp=spp))

    def boundary(self, spp=64):
        """The boundary term that a job of derivatives has, None for none."""
        with self._attached(), noted() as found:
            self._backward(0, spp)
        return found[0] if found else None


@contextmanager
def noted():
    """The boundary terms that are computed meanwhile, which are left out."""
    found, kept = [], lambda self, incoming: found.append(self)
    with patch.object(MutualOcclusion, "backward", kept), patch.object(LateOutlines, "backward", kept):
        yield found


def agree(capture, spp=2**12, seeds=6, spp_differences=2**16, seeds_differences=10, step=STEP, most_error=0.02):
    """Both modes are the same derivative, which is that of finite differences; returns what paths alone say of it."""
    found = np.array([capture.reverse(seed, spp) for seed in range(seeds)])
    assert capture.forward(0, spp) == pytest.approx(found[0], rel=2e-4)
    expected = np.array([capture.difference(step, 100 + seed, spp_differences) for seed in range(seeds_differences)])
    error = np.hypot(*(x.std(ddof=1) / len(x) ** 0.5 for x in (found, expected)))
    assert abs(found.mean() - expected.mean()) < SIGMAS * error
    assert error < most_error * abs(found.mean())
    with noted():
        return capture.reverse(0, spp), found.mean(), error
