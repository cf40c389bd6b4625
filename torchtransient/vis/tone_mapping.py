"""From linear radiance to what a screen shows."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import positive
from torchtransient.errors import ArgumentError, ShapeError, UnitError

BROKEN = (1.0, 0.0, 1.0)  # magenta: a pixel that is not finite must not pass for black or white
# Share of the lit pixels of a video that are white.
_WHITE = 0.01
_FRAMES_AT_ONCE = 16
_LOG_STEPS = 4096


def exposure_of(image: Tensor, quantile: float = 0.99) -> float:
    """Return the factor that brings a quantile of the pixels' brightest channel to white.

    Args:
        image: linear radiance (C, H, W), C = 1 or 3. Values that are not finite are left out.
        quantile: share of the pixels below white, above 0 and at most 1.

    Returns:
        The factor, 1 for a black image.

    Raises:
        ShapeError: for another shape.
        UnitError: for another quantile.
    """
    image = _checked(image, "exposure_of")
    if not 0 < quantile <= 1:
        raise UnitError(f"exposure_of: expected 0 < quantile <= 1, got {quantile}.")
    brightest = image.amax(0).flatten().to(torch.float64)
    brightest = brightest[torch.isfinite(brightest)]
    if not bool((brightest > 0).any()):
        return 1.0
    lit = brightest.sort().values
    white = lit[min(lit.numel() - 1, int(quantile * lit.numel()))].item()
    # A picture with a few bright pixels only: show those.
    return 1.0 / (white if white > 0 else lit[-1].item())


def exposure_of_video(transient: Tensor) -> float:
    """Return one factor for all frames, which leaves 1 % of the *lit* pixels of all frames white.

    Most pixels of most frames are black. White is found to half a hundredth of its value over nine decades below the
    maximum, without memory of the size of the cube.

    Args:
        transient: linear radiance in a bin (C, T, H, W), C = 1 or 3.

    Returns:
        The factor, 1 for a black cube.
    """
    parts = list(range(0, transient.shape[1], _FRAMES_AT_ONCE))
    highest = max((_lit(transient, start).max().item() for start in parts if _lit(transient, start).numel()), default=0)
    if highest <= 0:
        return 1.0
    low, high = math.log(highest) - 9 * math.log(10), math.log(highest)
    counts = torch.zeros(_LOG_STEPS, dtype=torch.float64)
    for start in parts:
        values = _lit(transient, start).to(torch.float64).log()
        # Two libraries' logarithms of the highest may differ in their last digit.
        counts += torch.histc(values.clamp(low, high), _LOG_STEPS, low, high)
    reached = counts.cumsum(0) / counts.sum()
    step = int(torch.searchsorted(reached, torch.tensor(1 - _WHITE, dtype=torch.float64)))
    return 1.0 / math.exp(low + (step + 1) * (high - low) / _LOG_STEPS)


def _lit(transient: Tensor, start: int) -> Tensor:
    values = transient[:, start : start + _FRAMES_AT_ONCE].detach().amax(0)
    return values[torch.isfinite(values) & (values > 0)]


def tone_map(image: Tensor, exposure: float | None = None, curve: str = "srgb") -> Tensor:
    """Map linear radiance to colours of a screen.

    Args:
        image: linear radiance (C, H, W), C = 1 or 3 (linear sRGB).
        exposure: factor before the curve; None takes ``exposure_of(image)``.
        curve: "srgb" (IEC 61966-2-1), "gamma" (``x ** (1 / 2.2)``), "linear", or "log", which spreads ten factors of
            two below white evenly over the scale: the brightest channel is mapped, the others keep their ratio to it.

    Returns:
        (H, W, 3) float64 in [0, 1]. Negative values are black, pixels that are not finite magenta.

    Raises:
        ShapeError: for another shape.
        ArgumentError: for an unknown curve.
        UnitError: unless the exposure is positive.
    """
    image = _checked(image, "tone_map")
    factor = positive("tone_map: exposure", exposure_of(image) if exposure is None else exposure)
    mapped = image.detach().to(torch.float64) * factor
    broken = ~torch.isfinite(mapped).all(0)
    mapped = torch.nan_to_num(mapped, nan=0.0, posinf=1.0, neginf=0.0).clamp(min=0)
    mapped = _curve(mapped, curve).clamp(0, 1)
    mapped = mapped.expand(3, -1, -1).permute(1, 2, 0).contiguous()
    mapped[broken] = mapped.new_tensor(BROKEN)
    return mapped


def _curve(linear: Tensor, curve: str) -> Tensor:
    if curve == "srgb":
        return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    if curve == "gamma":
        return linear ** (1 / 2.2)
    if curve == "linear":
        return linear
    if curve != "log":
        raise ArgumentError(f"tone_map: expected a curve out of srgb, gamma, log, linear, got {curve!r}.")
    brightest = linear.amax(0)
    level = (1 + brightest.log2() / 10).clamp(0, 1)
    # The ratio of the channels is shown on the scale of the eye, else every colour would turn to its primary.
    ratio = linear / torch.where(brightest > 0, brightest, 1.0)
    return level * _curve(ratio, "srgb")


def _checked(given: Any, who: str) -> Tensor:
    image = torch.as_tensor(given)
    if image.ndim != 3 or image.shape[0] not in (1, 3) or image.is_complex():
        raise ShapeError(f"{who}: expected a real image (C, H, W) with C = 1 or 3, got {tuple(image.shape)}.")
    return image
