"""Every metric with a pair that it takes, for the tests that hold for all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchtransient import TimeAxis, metrics

AXIS = TimeAxis(0.0, 0.05, 12)
DEPTHS = torch.linspace(0.5, 1.0, 6)


@dataclass
class Case:
    """`shape`: of a pair of batches of three; `counts`: of the mask, `places` dimensions of a pixel behind it."""

    function: Callable[..., Tensor]
    shape: tuple[int, ...]
    counts: tuple[int, ...]
    options: dict[str, Any] = field(default_factory=dict)
    best: float = 0.0
    name: str = ""

    def __str__(self) -> str:
        return self.name or self.function.__name__

    def pair(self, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Values between 0.5 and 1.5; Stokes components are those of light."""
        draw = torch.Generator().manual_seed(seed)
        x, y = (0.5 + torch.rand(self.shape, generator=draw) for _ in range(2))
        if "stokes_dim" in self.options or self.function in STOKES:
            for one in (x, y):
                one[:, 0] += 3
        return x, y

    def __call__(self, x: Any, y: Any, **more: Any) -> Tensor:
        return self.function(x, y, **{**self.options, **more})

    def mask(self, seed: int = 1) -> Tensor:
        """Some of each item."""
        found = torch.rand(self.counts, generator=torch.Generator().manual_seed(seed)) > 0.3
        found[..., 0] = True
        return found


STOKES = (metrics.dop_mae, metrics.dop_rmse, metrics.aolp_mae)
MAP, LIGHT = (3, 7, 5), (3, 2, 12, 7, 8)
CASES = [
    *(Case(f, MAP, MAP) for f in (metrics.depth_mae, metrics.depth_rmse, metrics.depth_bias, metrics.depth_abs_rel)),
    Case(metrics.depth_delta, MAP, MAP, best=1.0),
    Case(metrics.depth_gross_errors, MAP, MAP, {"beyond_m": 0.3}),
    *(Case(f, MAP, MAP) for f in (metrics.phase_mae, metrics.phase_rmse, metrics.phase_bias)),
    Case(metrics.phase_mae, MAP, MAP, {"period": 0.7}, name="phase_mae, short period"),
    *(Case(f, (3, 4, 2, 6, 5), (3, 2, 6, 5)) for f in STOKES),
    Case(metrics.dop_mae, (3, 4, 2, 6, 5), (3, 2, 6, 5), {"part": "circular"}, name="dop_mae, circular"),
    Case(metrics.dop_rmse, (3, 4, 2, 3, 6, 5), (3, 2, 3, 6, 5), {"stokes_dim": -5}, name="dop_rmse of transients"),
    Case(metrics.histogram_total_variation, LIGHT, LIGHT),
    Case(metrics.histogram_wasserstein_opl, LIGHT, LIGHT, {"axis": AXIS}),
    Case(metrics.histogram_wasserstein_s, LIGHT, LIGHT, {"axis": AXIS}),
    Case(metrics.histogram_wasserstein_opl, (3, 2, 12, 9), (3, 2, 12, 9), {"axis": AXIS, "dim": -2}, name="a list"),
    Case(metrics.histogram_kl, LIGHT, LIGHT),
    Case(metrics.histogram_kl, LIGHT, LIGHT, {"smoothing": 0.1}, best=0.01, name="histogram_kl, smooth"),
    Case(metrics.psnr, (3, 2, 7, 8), (3, 2, 7, 8), best=torch.inf),
    Case(metrics.ssim, (3, 2, 7, 8), (3, 2, 7, 8), {"window": 5}, best=1.0),
    Case(metrics.transient_psnr, LIGHT, LIGHT, best=torch.inf),
    Case(metrics.transient_psnr, LIGHT, LIGHT, {"view": "bins"}, best=torch.inf, name="transient_psnr, bins"),
    Case(metrics.transient_ssim, LIGHT, LIGHT, {"window": 5}, best=1.0),
    Case(metrics.transient_ssim, LIGHT, LIGHT, {"view": "bins", "window": 5}, best=1.0, name="transient_ssim, bins"),
    Case(metrics.picture_correlation, MAP, MAP, best=1.0),
    Case(metrics.picture_correlation, MAP, MAP, {"centered": False}, best=1.0, name="cosine"),
    Case(metrics.picture_iou, MAP, MAP, {"threshold": 0.8}, best=1.0),
    Case(metrics.volume_correlation, (3, 6, 7, 5), (3, 6, 7, 5), best=1.0),
    Case(metrics.volume_iou, (3, 6, 7, 5), (3, 6, 7, 5), {"threshold": 0.8}, best=1.0),
    Case(metrics.front_depth_mae, (3, 6, 7, 5), (3, 7, 5), {"depths": DEPTHS}),
]
