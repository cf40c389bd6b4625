"""A turbid block half in the light of a projector, seen by a camera: its light by path tracing and by a formula."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

import torchtransient as tt
from torchtransient import sensing
from torchtransient.scenes import look_at, scale, translate
from torchtransient.scenes.parts import perspective, transient_film

SIGMA_T, ALBEDO = (f"block.interior_medium.{name}.value.value" for name in ("sigma_t", "albedo"))
HEIGHT, LIT, PIXEL, PIXELS = 1.0, 0.2, 0.005, 8  # metres; six pixels in the dark, two in the light
AXIS = tt.TimeAxis(1.9, 0.01, 50)
EXTRAPOLATION = 2 / 3  # free paths from a boundary without a step of the index to where the fluence vanishes
RESPONSE = sensing.GaussianResponse(fwhm_s=100e-12)


def block() -> dict[str, Any]:
    """The block below z = 0, light on x > 0, a row of pixels along x across its edge."""
    film = transient_film((PIXELS, 1), AXIS.num_bins, AXIS.start_opl, AXIS.bin_width_opl)
    row, middle, half = PIXEL * PIXELS / 2, -2 * PIXEL, LIT / 2
    above = look_at([middle, 0.0, HEIGHT], [middle, 0.0, 0.0], [0.0, 1.0, 0.0])
    camera = perspective(above, math.degrees(2 * math.atan(row / HEIGHT)), film, 64)
    return {
        "type": "scene",
        "integrator": {"type": "transient_prbvolpath", "max_depth": 400, "rr_depth": 1000},
        "sensor": {**camera, "fov_axis": "x"},
        "light": {
            "type": "projector", "fov": math.degrees(2 * math.atan(half / HEIGHT)), "irradiance": 1.0,
            "to_world": look_at([half, 0.0, HEIGHT], [half, 0.0, 0.0], [0.0, 1.0, 0.0]),
        },
        "block": {
            "type": "cube", "to_world": translate([0.0, 0.0, -0.05]) @ scale([0.3, 0.3, 0.05]),
            "bsdf": {"type": "null"},
            "interior": {"type": "homogeneous", "sigma_t": 100.0, "albedo": 0.9},
        },
    }  # fmt: skip


class Block(nn.Module):
    """Light (1, T, 1, W) of a block: its coefficients (2,), per metre, are what is learnt."""

    def __init__(self, coefficients: Sequence[float]) -> None:
        super().__init__()
        scene = tt.load(block(), variant="llvm_ad_mono")
        # No steady image: paths end where the histogram does.
        self.renderer = tt.TransientRenderer(scene, [SIGMA_T, ALBEDO], temporal_filter="box", steady=False)
        self.response = sensing.ImpulseResponse(RESPONSE, axis=AXIS)
        self.coefficients = nn.Parameter(torch.tensor(coefficients))
        parametrize.register_parametrization(self, "coefficients", tt.parametrize.Positive(function="exp"))

    def forward(self, seed: int, spp: int) -> Tensor:
        scattering, absorption = self.coefficients
        sigma_t = scattering + absorption
        light = self.renderer({SIGMA_T: sigma_t, ALBEDO: scattering / sigma_t}, seed=seed, spp=spp).transient
        return self.response(light)


def diffused(scattering: Tensor, absorption: Tensor) -> Tensor:
    """The same light by the closed form of a half-space (Contini, Martelli and Zaccanti 1997), isotropic scattering.

    A source one free path deep, its image beyond the extrapolated boundary; sideways light spreads as a Gaussian.
    """
    parts = 5  # of a bin and of a pixel
    opl = AXIS.start_opl + AXIS.bin_width_opl / parts * (torch.arange(parts * AXIS.num_bins).double() + 0.5)
    x = PIXEL * ((torch.arange(parts * PIXELS).double() + 0.5) / parts - PIXELS / 2 - 2)
    outside = (HEIGHT**2 + (x + 2 * PIXEL) ** 2).sqrt() + (HEIGHT**2 + (x - LIT / 2) ** 2).sqrt()
    inside = opl[:, None] - outside
    path = inside.clamp_min(1e-4)
    spread = 4 * path / (3 * (scattering + absorption))
    deep = 1 / scattering
    image = deep + 2 * EXTRAPOLATION * deep
    flux = deep * (-deep.square() / spread).exp() + image * (-image.square() / spread).exp()
    flux = flux / (path * spread.sqrt()) * (-absorption * path).exp() * torch.erfc(-x / spread.sqrt())
    light = torch.where(inside > 0, flux, 0).reshape(AXIS.num_bins, parts, PIXELS, parts).mean((1, 3))
    return sensing.ImpulseResponse(RESPONSE, axis=AXIS)(light[None, :, None])
