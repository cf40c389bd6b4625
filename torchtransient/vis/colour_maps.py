"""Colours of equal lightness, so that hue can mean time or angle while brightness means intensity.

Colours are made in Oklch (B. Ottosson, "A perceptual color space for image processing", 2020): lightness, chroma, hue.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.vis.files import figure_type

if TYPE_CHECKING:
    from matplotlib.colors import ListedColormap

Array = NDArray[np.float64]

# Oklab to linear sRGB, by way of cone responses (Ottosson 2020).
_LAB_TO_LMS = np.array([
    [1.0, 0.3963377774, 0.2158037573],
    [1.0, -0.1055613458, -0.0638541728],
    [1.0, -0.0894841775, -1.2914855480],
])  # fmt: skip
_LMS_TO_RGB = np.array([
    [4.0767416621, -3.3077115913, 0.2309699292],
    [-1.2684380046, 2.6097574011, -0.3413193965],
    [-0.0041960863, -0.7034186147, 1.7076147010],
])  # fmt: skip

# Hues that run from red over yellow and green to violet: those of a rainbow, without the purple that would close it.
_FIRST_HUE, _LAST_HUE = 25.0, 305.0


def oklch(lightness: Any, chroma: Any, hue_deg: Any) -> Array:
    """Return sRGB colours (..., 3) in [0, 1] of Oklch colours; arguments broadcast, channels out of gamut are clipped.

    Args:
        lightness: lightness, 0 to 1.
        chroma: chroma, 0 for grey.
        hue_deg: hue in degrees.
    """
    light, chrom, hue = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (lightness, chroma, hue_deg)))
    angle = np.radians(hue)
    lab = np.stack([light, chrom * np.cos(angle), chrom * np.sin(angle)], axis=-1)
    linear = (lab @ _LAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T
    linear = np.clip(linear, 0, 1)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(shown, dtype=np.float64)


def rainbow(position: Any, value: Any = 1.0) -> Array:
    """Return sRGB colours (..., 3) of equal lightness, hue by position from red to violet.

    Args:
        position: position on the scale, 0 to 1; grey where it is not finite.
        value: brightness from 0, black, to 1, as vivid as the screen allows.
    """
    place = np.asarray(position, dtype=np.float64)
    known = np.isfinite(place)
    level = np.clip(np.nan_to_num(np.asarray(value, dtype=np.float64)), 0, 1)
    hue = _FIRST_HUE + (_LAST_HUE - _FIRST_HUE) * np.clip(np.where(known, place, 0.0), 0, 1)
    return oklch(0.78 * level, np.where(known, 0.16, 0.0) * level, hue)


def cyclic(turns: Any, value: Any = 1.0) -> Array:
    """Return sRGB colours (..., 3) for phases and angles: no jump, and no angle brighter than another.

    Args:
        turns: hue, of period 1; 0 is red.
        value: brightness from 0, black, to 1.
    """
    turn = np.mod(np.nan_to_num(np.asarray(turns, dtype=np.float64)), 1.0)
    level = np.clip(np.nan_to_num(np.asarray(value, dtype=np.float64)), 0, 1)
    return oklch(0.75 * level, 0.125 * level, _FIRST_HUE + 360.0 * turn)


def cyclic_map(kind: str = "even") -> ListedColormap:
    """Return a cyclic matplotlib colour map for bars over one period with angle 0 in the middle.

    Args:
        kind: "even" for :func:`cyclic`, or "hsv" for the hue circle of HSV, which papers on polarization often use: its
            yellow and cyan are lighter than its blue.
    """
    figure_type()  # says so where matplotlib is missing
    import matplotlib
    from matplotlib.colors import ListedColormap

    turns = np.mod((np.arange(256) + 0.5) / 256 - 0.5, 1.0)
    colours = matplotlib.colormaps["hsv"](turns) if kind == "hsv" else cyclic(turns)
    return ListedColormap(colours.tolist(), name=f"cyclic, {kind}")


def symmetric_limit(values: Any) -> float:
    """Return half the width of a scale centred at zero.

    Args:
        values: numbers of any shape; those that are not finite are left out.

    Returns:
        The size that 99 % of them are below; the maximum where that is zero, 1 where all are.
    """
    size = np.abs(np.asarray(values, dtype=np.float64)).ravel()
    size = size[np.isfinite(size)]
    if not size.size or size.max() == 0:
        return 1.0
    limit = float(np.percentile(size, 99))
    return limit if limit > 0 and math.isfinite(1 / limit) else float(size.max())
