"""Noise of the spectra of beats: speckle of rough surfaces, shot noise of the local oscillator.

A rendered spectrum is the expected power of the beat in each bin: the variance of a circular Gaussian field, since
light of rough surfaces arrives with random phases. A bin has the width c / B, which is one mode of a chirp: fields of
different bins, chirps and pixels are drawn independently. That is right for light that is spread over several bins. The
bins of a single line, of a flat surface that faces the lidar, rise and fall together in truth: `CoherentReceiver` draws
the fields themselves, and positions that are read between bins are less noisy there.

Sources: Goodman, "Speckle phenomena in optics" (2007), chapters 3 and 4; Fink, "Coherent detection signal-to-noise"
(Appl. Opt. 14, 1975); Jiang & Luu, "Heterodyne detection with a weak local oscillator" (Appl. Opt. 47, 2008), for
diffuse and mirror-like targets in the limit of a strong one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.chirps import Chirps
from torchtransient.errors import UnitError
from torchtransient.floating import product
from torchtransient.sensing.checks import check_count, check_number, check_transient
from torchtransient.sensing.sensor import GradPolicy, RandomSensor, standard_normal

# Photons below which a field grows like its power in place of the root, whose slope is infinite at zero.
_FAINT = 1e-4
# Lines beside the light that spectra go on for.
_MARGIN = 4
# Order of 0F1 from which on three terms of the uniform expansion are right to 1e-8.
_HIGH = 40


class _Averaged(RandomSensor):
    """A draw of spectra (..., T, H, W), of which ``looks`` are averaged; pathwise under every policy but "expected"."""

    looks: float

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.expected(x) if self.grad == "expected" else self.gaussian(x, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self.gaussian(x, generator)


class Speckle(_Averaged):
    """Fully developed speckle: spectra (..., C, T, H, W) times independent Gamma numbers of mean 1, variance 1 / looks.

    The field of a bin is circular Gaussian with the expected power as variance; its square, averaged over ``looks``
    independent fields (chirps of a rough surface that moves on, polarizations, pixels), has the contrast
    ``1 / sqrt(looks)``. The draw is linear in the input: every policy but ``expected`` gives its ordinary gradient,
    which is unbiased for any loss.

    Args:
        looks: number of averaged fields, 1 or more; an effective number need not be whole.
        grad: policy of gradients.

    Raises:
        UnitError: for fewer looks, and for negative power and NaN in a draw.
    """

    gives = "the same"

    def __init__(self, looks: float = 1, *, grad: GradPolicy = "expected") -> None:
        super().__init__(grad)
        self.looks = check_number(looks, "looks", "Speckle", low=1.0)

    def expected(self, x: Tensor) -> Tensor:
        return check_transient(x, "Speckle")

    def variance(self, x: Tensor) -> Tensor:
        return check_transient(x, "Speckle").square() / self.looks

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw, differentiable in `x`; these draws need no normal surrogate.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.

        Returns:
            The shape of the expectation.
        """
        _check_power(check_transient(x, "Speckle"), "Speckle")
        return x * (_gamma(self.looks, x, generator) / self.looks)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        """Return the logarithm of the density of spectra whose expectation is `x`, summed over time.

        Args:
            measurement: drawn spectra (..., C, T, H, W).
            x: expectation, of the same shape.

        Returns:
            (..., C, H, W).

        Behind a `BeatNoise` of as many looks, speckled light has this density with the expectation of the `BeatNoise`:
        ``speckle.log_prob(measured, noise.expected(beats))``. Bins without light, which have no density, are left out.
        """
        y, x = check_transient(measurement, "Speckle"), check_transient(x, "Speckle")
        lit = x > 0
        mean = torch.where(lit, x, 1.0)
        k = self.looks
        # xlogy: of one look, and no power at all, the first term is none
        terms = torch.xlogy(torch.full_like(y, k - 1), y) - k * (mean.log() + y / mean) + k * math.log(k)
        return torch.where(lit, terms - math.lgamma(k), 0.0).sum(-3)


class BeatNoise(_Averaged):
    """Shot noise of a strong local oscillator: power spectra in photons, with one photon of noise in each mode.

    A bin of n photons, ``photons_per_unit`` times the light (..., C, T, H, W), is measured as ``|sqrt(n) + z|^2`` with
    circular Gaussian noise z of variance one: its signal-to-noise ratio is the number of detected photons in a chirp,
    `efficiency power duration / (h c / wavelength)`, with quadratures or without. ``looks`` spectra of n photons each
    are averaged. Mean n + 1, variance (1 + 2 n) / looks; 2 looks times the measurement has a noncentral chi-squared
    distribution of 2 looks degrees of freedom. A bin is one mode, c / B wide (`tt.Chirps.time_axis`).

    The input is power without speckle, or what `Speckle` of as many looks has drawn. Not modelled: noise of the laser's
    phase and intensity, of amplifiers, and a weak local oscillator.

    Every policy but ``expected`` gives the gradient of the draw, unbiased for any loss; below 1e-4 photons the field
    grows like the power, so that the slope is finite at zero.

    Args:
        photons_per_unit: detected photons in a bin of light 1.
        looks: number of averaged spectra, 1 or more.
        grad: policy of gradients.

    Raises:
        UnitError: for numbers out of range, and for negative power and NaN in a draw.
    """

    gives = "counts"

    def __init__(self, photons_per_unit: float = 1.0, looks: float = 1, *, grad: GradPolicy = "expected") -> None:
        super().__init__(grad)
        self.looks = check_number(looks, "looks", "BeatNoise", low=1.0)
        self.photons_per_unit = check_number(photons_per_unit, "photons_per_unit", "BeatNoise", open_low=True)

    def expected(self, x: Tensor) -> Tensor:
        return self._photons(x) + 1

    def variance(self, x: Tensor) -> Tensor:
        return (1 + 2 * self._photons(x)) / self.looks

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw, differentiable in `x`; these draws need no normal surrogate.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.

        Returns:
            The shape of the expectation.
        """
        n = self._photons(x)
        _check_power(n, "BeatNoise")
        field = _root(n)
        # The sum over looks of |field + noise|^2 is the same if one look holds all of the field. Its real part comes
        # first; left are the square of its imaginary part, Gamma(1/2), and those of the other looks, Gamma(1) each.
        noise = math.sqrt(0.5) * standard_normal(n, generator)
        rest = _gamma(self.looks - 0.5, n, generator)
        return n + (2 / math.sqrt(self.looks)) * field * noise + (noise.square() + rest) / self.looks

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        """Return the logarithm of the density of spectra of a power without speckle, summed over time.

        Args:
            measurement: drawn spectra (..., C, T, H, W), photons.
            x: power, of the same shape.

        Returns:
            (..., C, H, W).

        That of a noncentral chi-squared distribution, right to 1e-7, differentiable in `x` and the measurement. Behind
        a `Speckle` spectra have another one, :meth:`Speckle.log_prob` of the expectation.
        """
        y, n, k = check_transient(measurement, "BeatNoise").double(), self._photons(x).double(), self.looks
        bessel = _log_0f1(k, k * k * n * y)
        terms = torch.xlogy(torch.full_like(y, k - 1), y) - k * (y + n) + bessel
        return (terms + (k * math.log(k) - math.lgamma(k))).sum(-3).to(x.dtype)

    def _photons(self, x: Tensor) -> Tensor:
        return check_transient(x, "BeatNoise") * self.photons_per_unit


class CoherentReceiver(_Averaged):
    """Spectra of a chirp from fields: speckle, the line of the window and shot noise, correlated between bins.

    Each bin of the light has a circular Gaussian field whose variance is its power in photons, ``photons_per_unit``
    times the input (..., C, T, H, W). The fields meet in the transform of the chirp, with white noise of one photon in
    each mode, and ``looks`` squared moduli are averaged: (..., C, J, H, W), photons, samples at multiples of c / B over
    :attr:`spectrum_axis`. So the bins of one line rise and fall together, and light of two lines that are closer than
    c / B interferes. `Speckle` and `BeatNoise` have the same distribution of each bin for itself.

    The light has no line yet: a transient of a static scene, or beats that were rendered with ``chirps.longer(16)``, in
    bins of c / B / 8 (``chirps.time_axis(..., bins_per_line=8)``); bins wider than c / B / 4 are refused.

    Args:
        chirps: the chirps.
        axis: axis of the light.
        photons_per_unit: detected photons in a chirp for light of 1.
        looks: number of averaged spectra.
        grad: gradient policy; every one but "expected" gives the gradient of the draw. Below 1e-4 photons a field grows
            like the power in place of its root, so that the slope is finite at zero.

    Raises:
        UnitError: for numbers out of range, bins that are too wide, and negative power and NaN in a draw.
    """

    gives = None  # spectra over bins of their own
    looks: int
    transform: Tensor
    window: Tensor

    def __init__(
        self, chirps: Chirps, axis: TimeAxis, *, photons_per_unit: float = 1.0, looks: int = 1,
        grad: GradPolicy = "expected",
    ) -> None:  # fmt: skip
        super().__init__(grad)
        me = "CoherentReceiver"
        self.chirps = chirps
        self.axis, self.num_bins = axis, axis.num_bins
        self.photons_per_unit = check_number(photons_per_unit, "photons_per_unit", me, open_low=True)
        self.looks = check_count(looks, "looks", me)
        width = chirps.resolution_opl
        if axis.bin_width_opl > width / 4 * (1 + 1e-6):
            raise UnitError(
                f"{me}: expected bins of light of at most c / B / 4, {width / 4:.4g} m, got {axis.bin_width_opl:.4g} "
                "m. Take chirps.time_axis(..., bins_per_line=8)."
            )
        first, last = math.floor(axis.start_opl / width) - _MARGIN, math.ceil(axis.end_opl / width) + _MARGIN
        #: Axis of the spectra, one bin in c / B.
        self.spectrum_axis = TimeAxis((first - 0.5) * width, width, last - first + 1)
        places = self.spectrum_axis.centers_opl
        self.register_buffer("transform", self._lines(places[:, None] - axis.centers_opl))
        # Noise of the transform without a window, in a few bins more, that the window adds up.
        more = torch.arange(-_MARGIN, len(places) + _MARGIN) - torch.arange(len(places))[:, None]
        self.register_buffer("window", self._lines(more * width))

    def expected(self, x: Tensor) -> Tensor:
        return _over_bins(self.transform.square(), self._photons(x)) + 1

    def variance(self, x: Tensor) -> Tensor:
        """Return the variance of every bin; neighbours depend on each other.

        Args:
            x: light (..., C, T, H, W).
        """
        return self.expected(x).square() / self.looks

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw, differentiable in `x`; these draws need no normal surrogate.

        Args:
            x: light (..., C, T, H, W).
            generator: source of randomness.

        Returns:
            The shape of the expectation.
        """
        n = self._photons(x)
        _check_power(n, "CoherentReceiver")
        amplitude = _root(n)
        total = torch.zeros((), dtype=n.dtype, device=n.device)
        noise = n.new_empty((*n.shape[:-3], self.window.shape[1], *n.shape[-2:]))
        for _ in range(2 * self.looks):  # real and imaginary parts
            field = _over_bins(self.transform, amplitude * standard_normal(n, generator))
            field = field + _over_bins(self.window, standard_normal(noise, generator))
            total = total + field.square()
        return total / (2 * self.looks)

    def _photons(self, x: Tensor) -> Tensor:
        return check_transient(x, "CoherentReceiver") * self.photons_per_unit

    def _lines(self, opl: Tensor) -> Tensor:
        return torch.from_numpy(self.chirps.line_amplitude(opl))


def _over_bins(matrix: Tensor, x: Tensor) -> Tensor:
    return product(matrix.to(x), x.flatten(-2)).reshape(*x.shape[:-3], len(matrix), *x.shape[-2:])


def _root(photons: Tensor) -> Tensor:
    """Modulus of a field of some photons, with a finite slope at none."""
    return torch.where(photons < _FAINT, photons / math.sqrt(_FAINT), photons.clamp_min(_FAINT).sqrt())


def _gamma(shape: float, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Gamma numbers of unit scale in the shape, dtype and on the device of ``like``."""
    return torch._standard_gamma(torch.full_like(like, shape, requires_grad=False), generator=generator)


def _check_power(x: Tensor, where: str) -> None:
    low, high = torch.aminmax(x.detach())
    if not bool(low >= 0) or not bool(torch.isfinite(high)):
        raise UnitError(
            f"{where}: expected finite power >= 0, got values from {float(low):g} to {float(high):g}. Films make no "
            "others with a temporal_filter of box or tent."
        )


# ------------------------------------------------------------------------------------------ hypergeometric functions


def _log_0f1(b: float, w: Tensor) -> Tensor:
    """Evaluate the logarithm of ``0F1(; b; w) = Gamma(b) w^((1 - b) / 2) I_(b - 1)(2 sqrt(w))``.

    For b >= 1 and w >= 0 in float64: right to 1e-8, differentiable at zero too. Of high orders by the uniform expansion
    of I (DLMF 10.41.3), from there down by the recurrence of ratios
    ``q_b = 0F1(b + 1) / 0F1(b) = 1 / (1 + w / (b (b + 1)) q_(b + 1))``, in which no digits cancel.
    """
    steps = max(0, math.ceil(_HIGH - b))
    top = b + steps
    total = _of_high_order(top, w)
    ratio = (_of_high_order(top + 1, w) - total).exp()
    for step in range(steps - 1, -1, -1):
        at = b + step
        ratio = 1 / (1 + w / (at * (at + 1)) * ratio)
        total = total - ratio.log()
    return total


def _of_high_order(b: float, w: Tensor) -> Tensor:
    v = b - 1
    s = (1 + 4 * w / v**2).sqrt()
    p = 1 / s
    terms = (
        (3 * p - 5 * p**3) / (24 * v)
        + (81 * p**2 - 462 * p**4 + 385 * p**6) / (1152 * v**2)
        + (30375 * p**3 - 369603 * p**5 + 765765 * p**7 - 425425 * p**9) / (414720 * v**3)
    )
    constant = math.lgamma(b) - 0.5 * math.log(2 * math.pi * v) - v * math.log(v / 2)
    return constant + v * s - v * torch.log1p(s) - 0.5 * s.log() + torch.log1p(terms)
