"""A gradient case and its problem: one scalar unknown of a scene, the loss, its gradient in both modes.

A case builds a scene and says how the unknown enters the scene's parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Case:
    """One unknown: ``scene()`` is a Mitsuba dictionary, ``apply(params, x)`` writes the attached unknown into it.

    ``fd_spp``: samples of the renders for finite differences, as many as ``spp`` when it is not given. ``side``: 1 or
    -1 for differences on that side of the value alone, where it ends. ``off``: the share by which they are off.
    """

    name: str
    row: str
    scene: Callable[[], dict[str, Any]]
    apply: Callable[[Any, Any], None]
    value: float
    step: float
    variant: str = "llvm_ad_mono"
    spp: int = 1024
    seeds: int = 6
    fd_spp: int = 0
    side: int = 0
    off: float = 0.0
    tags: tuple[str, ...] = field(default=())

    def __post_init__(self):
        if not self.fd_spp:
            object.__setattr__(self, "fd_spp", self.spp)


def weights(scene_film):
    """Loss weights, of the shape that lies behind a pixel.

    Of a histogram the sine of three times the optical path length at each bin's centre, in polarized variants with
    factors that differ between the Stokes components and let the polarization count; of phasors and gates a
    pattern in which no two entries weigh the same.
    """
    if scene_film.measures != "transient":
        shape = scene_film.cube_shape()[2:]
        number = np.arange(int(np.prod(shape)))
        return (np.cos(1.7 * number + 0.4) / (1 + 0.3 * number)).reshape(shape)
    centers = scene_film.start_opl + (np.arange(scene_film.temporal_bins) + 0.5) * scene_film.bin_width_opl
    components = np.repeat([0.2, 1.0, -0.7, 1.3], scene_film.channel_count() // 4) if mi.is_polarized else np.ones(1)
    return np.sin(3 * centers)[:, None] * components


class Changes(dict):
    """Collects what a case writes, on top of the parameters' first values."""

    def __init__(self, base):
        super().__init__()
        self.base = base

    def __missing__(self, key):
        return self.base[key]


class Problem:
    """A case, loaded once: the loss, its gradient in reverse and in forward mode."""

    def __init__(self, case: Case):
        self.case = case
        mi.set_variant(case.variant)
        import torchtransient.plugins

        torchtransient.plugins.sync()
        self.scene = mi.load_dict(case.scene(), optimize=False)
        self.film = self.scene.sensors()[0].film()
        self.params = mi.traverse(self.scene)
        changes = Changes({key: self.params[key] for key in list(self.params.keys())})
        case.apply(changes, mi.Float(case.value))
        self.base = {key: dr.copy(self.params[key]) for key in changes}
        # The first look fixes the reference sphere of distant lights.
        self.scene.integrator().reference(self.scene)

    def install(self, x):
        """Write the unknown; ``x`` may be attached."""
        changes = Changes(self.base)
        self.case.apply(changes, x)
        for key, value in changes.items():
            self.params[key] = value
        self.params.update()
        return list(changes)

    def detach(self):
        """Leave nothing attached: Mitsuba traces what other scenes hold, and refuses some of it when attached."""
        self.install(mi.Float(self.case.value))

    def loss(self, x: float, seed: int) -> float:
        self.install(mi.Float(x))
        _, transient = self.scene.integrator().render(self.scene, seed=seed, spp=self.case.fd_spp)
        return float((np.array(transient).sum((0, 1)) * weights(self.film)).sum())

    def difference(self, seed: int) -> float:
        """Finite difference of the loss: central, or of second order on one side."""
        x, h = self.case.value, self.case.step
        if self.case.side:
            h *= self.case.side
            here, near, far = (self.loss(x + k * h, seed) for k in range(3))
            return (4 * near - 3 * here - far) / (2 * h)
        return (self.loss(x + h, seed) - self.loss(x - h, seed)) / (2 * h)

    def reverse(self, seed: int) -> float:
        x = mi.Float(self.case.value)
        dr.enable_grad(x)
        keys = self.install(x)
        try:
            g = np.broadcast_to(weights(self.film), self.film.cube_shape()).astype(np.float32)
            self.scene.integrator().render_backward(
                self.scene, self.params, (None, mi.TensorXf(g)), seed=seed, spp=self.case.spp
            )
            for key in keys:
                dr.enqueue(dr.ADMode.Backward, self.params[key])
            dr.traverse(dr.ADMode.Backward)
            return float(dr.grad(x)[0])
        finally:
            self.detach()

    def forward(self, seed: int) -> float:
        x = mi.Float(self.case.value)
        dr.enable_grad(x)
        self.install(x)
        try:
            dr.set_grad(x, 1.0)
            _, transient = self.scene.integrator().render_forward(self.scene, self.params, seed=seed, spp=self.case.spp)
        finally:
            self.detach()
        return float((np.array(transient).sum((0, 1)) * weights(self.film)).sum())
