"""Coefficients of smooth spectra: what keeps them, and the colours that they belong to, the inverse of
``mi.srgb_model_fetch``.

Mitsuba keeps a reflectance in spectral variants as three coefficients of a smooth spectrum, which it looks up in a
table by the colour (Jakob and Hanika 2019, A Low-Dimensional Function Space for Efficient Spectral Upsampling). The
table is inverted here by Gauss-Newton steps with damping, on the spectrum at some wavelengths.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError

_WAVELENGTHS = np.linspace(380.0, 740.0, 19)
_STEP, _STEPS = 1e-3, 40
# Largest difference of the spectra of a colour that counts as found.
TOLERANCE = 2e-5


def keeps_coefficients(node: Any, key: str) -> bool:
    """Return True if the numbers of a parameter are coefficients of a smooth spectrum instead of a colour.

    Those of colours are, in spectral variants (Jakob and Hanika 2019).

    Args:
        node: texture, volume or mesh.
        key: name of the parameter, without the path to ``node``.
    """
    if not mi.is_spectral:
        return False
    name = node.class_name()
    if isinstance(node, mi.Mesh):
        attribute = "color" in key and key.startswith(("vertex_", "face_"))
        return attribute and dr.width(mi.traverse(node)[key]) == 3 * _places(node, key)
    if name.startswith(("SRGBReflectanceSpectrum", "D65Spectrum")):
        return key == "value"
    if key != "data" or not name.startswith(("BitmapTextureImpl", "GridVolume")):
        return False
    channels = mi.traverse(node)[key].shape[-1]
    # Beside the three of a grid is the factor of its colour.
    return channels == 4 if name.startswith("GridVolume") else channels == 3 and "raw = 0" in str(node)


def _places(mesh: Any, attribute: str) -> int:
    return int(mesh.vertex_count() if attribute.startswith("vertex_") else mesh.face_count())


def colours_of(coefficients: np.ndarray) -> tuple[np.ndarray, float]:
    """Find the colours whose spectra have given coefficients. Needs a spectral variant.

    Args:
        coefficients: Mitsuba's coefficients of a reflectance spectrum, (..., 3).

    Returns:
        (colours, error): linear sRGB in [0, 1], (..., 3), and the largest difference between their spectra and the
        requested ones. Above :data:`TOLERANCE` there is no such colour.
    """
    rows = np.asarray(coefficients, dtype=np.float64).reshape(-1, 3)
    found = np.array([_colour_of(row) for row in rows])
    errors = [np.abs(_spectrum(_fetch(rgb)) - _spectrum(row)).max() for rgb, row in zip(found, rows, strict=True)]
    return found.reshape(np.shape(coefficients)), float(max(errors, default=0.0))


def as_colours(coefficients: np.ndarray, where: str) -> np.ndarray:
    """Return the colours whose spectra have given coefficients.

    Args:
        coefficients: coefficients of spectra, (..., 3).
        where: key of the parameter, for messages.

    Returns:
        Linear sRGB in [0, 1], (..., 3).

    Raises:
        SceneError: if there are no such colours.
    """
    found, error = colours_of(coefficients)
    if error > TOLERANCE:
        raise SceneError(
            f"scene.save: {where!r} cannot be said in XML: its coefficients of a spectral model are those of no colour "
            f"(nearest spectrum: {error:.2g} away). Leave it out of values, or keep the values themselves."
        )
    return found


def same_spectra(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if coefficients describe the same spectra, to the precision of files.

    Args:
        a, b: coefficients, (..., 3), of any shapes.
    """
    if a.shape != b.shape or a.size % 3:
        return False
    pairs = zip(a.reshape(-1, 3), b.reshape(-1, 3), strict=True)
    return all(np.abs(_spectrum(one) - _spectrum(other)).max() < 5 * TOLERANCE for one, other in pairs)


def _fetch(rgb: np.ndarray) -> np.ndarray:
    return np.array(mi.srgb_model_fetch(mi.ScalarColor3f(*rgb.tolist())), dtype=np.float64).ravel()


def _spectrum(row: np.ndarray) -> np.ndarray:
    x: np.ndarray = (row[0] * _WAVELENGTHS + row[1]) * _WAVELENGTHS + row[2]
    return 0.5 + 0.5 * x / np.sqrt(1 + x * x)


def _colour_of(row: np.ndarray) -> np.ndarray:
    wanted = _spectrum(row)
    if np.ptp(wanted) < 1e-6:
        # Greys have no place in the table: their spectrum is flat.
        return np.full(3, wanted.mean())
    bands = [(600, 740), (500, 600), (380, 500)]
    start = [wanted[_inside(low, high)].mean() for low, high in bands]
    rgb, damping = np.clip(start, 0.005, 0.995), 1e-3
    residual = _spectrum(_fetch(rgb)) - wanted
    for _ in range(_STEPS):
        if np.abs(residual).max() < 0.1 * TOLERANCE:
            break
        # Away from the nearer end of the range.
        steps = np.where(rgb < 0.5, _STEP, -_STEP)
        moved = zip(steps.tolist(), np.eye(3), strict=True)
        columns = [(_spectrum(_fetch(rgb + step * axis)) - wanted - residual) / step for step, axis in moved]
        slope = np.stack(columns, axis=1)
        move = np.linalg.solve(slope.T @ slope + damping * np.eye(3), slope.T @ residual)
        tried = np.clip(rgb - move, 0.0, 1.0)
        after = _spectrum(_fetch(tried)) - wanted
        if np.square(after).sum() < np.square(residual).sum():
            rgb, residual, damping = tried, after, damping / 10
        else:
            damping *= 10
    return rgb


def _inside(low: float, high: float) -> np.ndarray:
    return np.abs(_WAVELENGTHS - (low + high) / 2) <= (high - low) / 2
