"""Spectra that are positive, or shares of the light, and smooth over the wavelength."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import count, numbers
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import floating, single, without_autocast
from torchtransient.parametrize.bounded import Albedo, Positive
from torchtransient.parametrize.settings import Settings


def spline_basis(wavelengths_nm: Any, coefficients: int) -> NDArray[np.float64]:
    """Return values of cubic B-splines with equal knots over a range of wavelengths; each row has the sum 1.

    A curve of coefficients (..., K) is `coefficients @ basis.T`; it has two continuous derivatives.

    Args:
        wavelengths_nm: wavelengths (N,) in rising order.
        coefficients: number of coefficients K, 4 <= K <= N.

    Returns:
        (N, K).

    Raises:
        ShapeError, UnitError: for other numbers.
    """
    where = "spline_basis"
    wavelengths = numbers(where, wavelengths_nm)
    if wavelengths.ndim != 1 or not (np.isfinite(wavelengths).all() and (np.diff(wavelengths) > 0).all()):
        raise UnitError(f"{where}: expected finite wavelengths (N,) in rising order, in nanometres.")
    number = count(f"{where}: coefficients", coefficients, 4, ShapeError, wavelengths.size)
    span = wavelengths[-1] - wavelengths[0]
    place = (wavelengths - wavelengths[0]) / span * (number - 3)
    t = np.abs(place[:, None] - (np.arange(number) - 1))
    return np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, np.where(t < 2, (2 - t) ** 3 / 6, 0.0))


class _SmoothSpectrum(Settings):
    """A spline over the wavelength, and a function that takes it into the range."""

    basis: Tensor

    def __init__(self, wavelengths_nm: Any, coefficients: int, outer: Albedo | Positive) -> None:
        super().__init__()
        self.outer = outer
        self._keep("basis", torch.tensor(spline_basis(wavelengths_nm, coefficients)))

    @without_autocast
    def forward(self, x: Tensor) -> Tensor:
        name = type(self).__name__
        x = floating(x, name)
        if x.ndim < 1 or x.shape[-1] != self.basis.shape[1]:
            raise ShapeError(f"{name}: expected coefficients (..., {self.basis.shape[1]}), got {tuple(x.shape)}.")
        curve = single(x) @ self.basis.to(single(x)).mT
        values: Tensor = self.outer(curve)
        return values.to(x.dtype)

    @without_autocast
    def right_inverse(self, values: Tensor) -> Tensor:
        """Return coefficients of the curve that is nearest to `values` (..., N) before the function is applied.

        Structure finer than the splines is smoothed. Raises ShapeError, and UnitError for values outside of the range.
        """
        name = type(self).__name__
        values = floating(values, name)
        if values.ndim < 1 or values.shape[-1] != self.basis.shape[0]:
            raise ShapeError(
                f"{name}: expected values of {self.basis.shape[0]} wavelengths, (..., {self.basis.shape[0]}), got "
                f"{tuple(values.shape)}."
            )
        curve = self.outer.right_inverse(single(values))
        coefficients: Tensor = curve @ torch.linalg.pinv(self.basis).to(curve).mT
        return coefficients.to(values.dtype)

    def extra_repr(self) -> str:
        return f"{self.basis.shape[0]} wavelengths, {self.basis.shape[1]} coefficients"


class PositiveSpectrum(_SmoothSpectrum):
    """A positive, smooth spectrum: `scale * exp(spline)`, of K coefficients (..., K) values (..., N) at wavelengths.

    For light, extinction, `eta` and `k` of metals; lines narrower than the steps are lost. The splines are part of
    `state_dict`.

    Args:
        wavelengths_nm: wavelengths (N,) in rising order, those of the plugin's `values` (`regular` spectra: its range
            in equal steps).
        coefficients: number of coefficients K, 4 or more; fewer are smoother, one for every (last - first) / (K - 3)
            nanometres.
        scale: typical size of the values.
    """

    def __init__(self, wavelengths_nm: Any, coefficients: int = 8, scale: float = 1.0) -> None:
        super().__init__(wavelengths_nm, coefficients, Positive(0.0, scale, "exp"))


class ReflectanceSpectrum(_SmoothSpectrum):
    """A smooth spectrum between 0 and 1, otherwise as `PositiveSpectrum`.

    Args:
        wavelengths_nm: wavelengths (N,) in rising order, those of the plugin's `values`, see `PositiveSpectrum`.
        coefficients: number of coefficients, 4 or more; fewer are smoother.
        margin: least distance from 0 and 1, a share between 0 and 0.5, or None, see `Bounded`.
    """

    def __init__(self, wavelengths_nm: Any, coefficients: int = 8, margin: float | None = None) -> None:
        super().__init__(wavelengths_nm, coefficients, Albedo(margin=margin))
