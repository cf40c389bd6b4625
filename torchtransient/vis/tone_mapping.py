"""From linear radiance to what a screen shows."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError

BROKEN = (1.0, 0.0, 1.0)  # magenta: a pixel that is not finite must not pass for black or white


def exposure_of(image: Tensor, quantile: float = 0.99) -> float:
    """The factor that brings the given quantile of the pixels' brightest channel to white; 1 for a black image.

    `image`: (C, H, W) linear radiance. Values that are not finite are left out. Raises ShapeError and UnitError.
    """
    _check(image)
    if not 0 < quantile <= 1:
        raise UnitError(f"exposure_of: expected 0 < quantile <= 1, got {quantile!r}.")
    brightest = image.amax(0).flatten().to(torch.float64)
    brightest = brightest[torch.isfinite(brightest)]
    if not bool((brightest > 0).any()):
        return 1.0
    lit = brightest.sort().values
    white = lit[min(lit.numel() - 1, int(quantile * lit.numel()))].item()
    # A picture with a few bright pixels only: show those.
    return 1.0 / (white if white > 0 else lit[-1].item())


def tone_map(image: Tensor, exposure: float | None = None) -> Tensor:
    """(C, H, W) linear radiance, C = 1 or 3 (linear sRGB), to (H, W, 3) in [0, 1] with the sRGB curve (IEC 61966-2-1).

    `exposure` None takes `exposure_of(image)`. Negative values become black; pixels that are not finite magenta.
    Raises ShapeError for another shape.
    """
    _check(image)
    scale = exposure_of(image) if exposure is None else exposure
    shown = image.detach().to(torch.float64) * scale
    broken = ~torch.isfinite(shown).all(0)
    shown = torch.nan_to_num(shown, nan=0.0, posinf=1.0, neginf=0.0).clamp(0, 1)
    shown = torch.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown.clamp(min=1e-12) ** (1 / 2.4) - 0.055)
    shown = shown.expand(3, -1, -1).permute(1, 2, 0).contiguous()
    shown[broken] = shown.new_tensor(BROKEN)
    return shown


def _check(image: Tensor) -> None:
    if image.ndim != 3 or image.shape[0] not in (1, 3):
        raise ShapeError(f"tone mapping: expected an image (C, H, W) with C = 1 or 3, got {tuple(image.shape)}.")
