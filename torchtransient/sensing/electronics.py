"""From photoelectrons to numbers: shot noise, full well, kTC and read noise, converter. For every integrating pixel.

The chain of a pixel with the mean charge ``m`` (electrons per exposure, tap or gate):

    n = Poisson(m g + d), amplified with excess noise            g: gain map, d: dark electrons
    q = min(n, full_well_e) + offset + normal(ktc_noise_e) + normal(read_noise_e)
    dn = clip(round(q / gain_e_per_dn + black_level_dn), 0, 2^bits - 1), or
    dn = clip(round(q / gain_e_per_dn + black_level_dn), -2^(bits - 1), 2^(bits - 1) - 1)    of a signed converter

and reported back in electrons, ``(dn - black_level_dn) gain_e_per_dn``. Sources: Janesick, "Photon transfer" (SPIE
2007); EMVA standard 1288, release 4.0 (2021).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import check_count, check_number, check_transient, reals
from torchtransient.sensing.counts import poisson, poisson_log_prob
from torchtransient.sensing.responses import normal_cdf, normal_integral
from torchtransient.sensing.sensor import (
    VARIANCE_FLOOR,
    GradPolicy,
    Quantity,
    RandomSensor,
    gaussian_noise,
    record_score,
    standard_normal,
    straight_through,
)

BOLTZMANN_J_PER_K = 1.380649e-23  # exact (SI)
ELEMENTARY_CHARGE_C = 1.602176634e-19  # exact (SI)


def ktc_noise(capacitance_f: float, temperature_k: float = 300.0) -> float:
    """Reset noise of a sense node, ``sqrt(k T C) / q``; 10 fF at 300 K: 40.2.

    Args:
        capacitance_f: capacitance in farads.
        temperature_k: temperature in kelvins.

    Returns:
        rms electrons.

    Raises:
        UnitError: for numbers out of range.
    """
    capacitance = check_number(capacitance_f, "capacitance_f", "ktc_noise", high=1e-9)
    temperature = check_number(temperature_k, "temperature_k", "ktc_noise")
    return math.sqrt(BOLTZMANN_J_PER_K * temperature * capacitance) / ELEMENTARY_CHARGE_C


def clipped_normal_mean(mean: Tensor, variance: Tensor, low: float = -math.inf, high: float = math.inf) -> Tensor:
    """Mean of a normal variable clipped to [low, high]; smooth in mean and variance.

    The variance is softened by ``VARIANCE_FLOOR`` so that the slope at zero variance is finite; at a variance of zero
    the result is off by at most 0.004, and only within 0.03 of a limit.

    Args:
        mean: tensor of any shape.
        variance: variance, in a shape that broadcasts.
        low: lower limit.
        high: upper limit.
    """
    scale = (variance.clamp_min(0) + VARIANCE_FLOOR).sqrt()
    result = mean
    if math.isfinite(high):
        result = result - scale * normal_integral((mean - high) / scale)
    if math.isfinite(low):
        result = result + scale * normal_integral((low - mean) / scale)
    return result


def clipped_normal_variance(mean: Tensor, variance: Tensor, high: float) -> Tensor:
    """Variance of ``min(X, high)`` for a normal X: the variance far below the limit, 0 far above.

    Args:
        mean: tensor of any shape.
        variance: variance, in a shape that broadcasts.
        high: upper limit.
    """
    variance = variance.clamp_min(0)
    # Beyond 12 standard deviations the answer is the variance or nothing, and the squares below would cancel.
    t = ((high - mean) / (variance + VARIANCE_FLOOR).sqrt()).clamp(-12, 12)
    density, below = torch.exp(-0.5 * t * t) / math.sqrt(2 * math.pi), normal_cdf(t)
    first, second = density + t * below, (1 + t * t) * below + t * density
    return variance * (second - first * first)


def fixed_pattern(
    shape: tuple[int, ...], spread: float, *, center: float = 0.0, generator: torch.Generator | None = None
) -> Tensor:
    """Draw fixed differences between pixels or taps: ``center + spread * normal``.

    For ``gain_map`` (center 1, spread 0.5 to 2 %) and ``offset_map_e`` of `PixelElectronics`.

    Args:
        shape: shape of the pattern.
        spread: standard deviation.
        center: mean.
        generator: source of randomness.

    Returns:
        Tensor of that shape, float32.

    Raises:
        UnitError: for a spread below zero.
    """
    return center + check_number(spread, "spread", "fixed_pattern") * torch.randn(shape, generator=generator)


class PixelElectronics(RandomSensor):
    """Pixel that collects charge and reads it out, on mean electrons (..., C, N, H, W): the chain of this file.

    N are exposures, taps or gates where time was. Output in electrons, in the shape of the input. ``expected`` is the
    mean with both clips, which takes the charge as normal: 0.01 e off for a full well of 100 e and better above.
    Rounding has the mean zero when the noise is at least half a step, which it does not check.

    Gradients: ``gaussian`` is pathwise (shot noise as normal), with the step of the converter passed straight through
    and zero beyond a clip; ``straight_through`` uses the slope of the mean; ``score`` has the exact score of the
    Poisson draw. All see the full chain's noise.

    Args:
        shot_noise: False if the input is a charge that an earlier stage has drawn.
        full_well_e: full well in electrons, None for no limit.
        read_noise_e: rms read noise in electrons.
        ktc_noise_e: rms reset noise in electrons, see `ktc_noise`.
        excess_noise: excess noise factor F^2 >= 1 of an intensifier (2 is an exponential pulse height), drawn as normal
            gain noise.
        dark_e: dark electrons of *one* element of the input: of one tap in one exposure, or of one gate.
        gain_e_per_dn: electrons per number of the converter, with ``bits``; None without one.
        bits: bits of the converter, None without one.
        signed: codes in two's complement, for the differences of two taps, which a converter without room below zero
            would clip.
        black_level_dn: number of the converter without charge.
        gain_map: gain of every pixel, tensor that broadcasts to the input: a buffer, or learnt as an `nn.Parameter`.
        offset_map_e: offset of every pixel in electrons, a tensor of the same kind.
        grad: gradient policy.

    Raises:
        UnitError: for numbers out of range.
        ShapeError: for a map that does not broadcast.
    """

    takes: tuple[Quantity, ...] = ("electrons",)
    gives = "counts"

    gain_map: Tensor | None
    offset_map_e: Tensor | None

    def __init__(
        self,
        *,
        shot_noise: bool = True,
        full_well_e: float | None = None,
        read_noise_e: float = 0.0,
        ktc_noise_e: float = 0.0,
        excess_noise: float = 1.0,
        dark_e: float = 0.0,
        gain_e_per_dn: float | None = None,
        bits: int | None = None,
        signed: bool = False,
        black_level_dn: float = 0.0,
        gain_map: Tensor | None = None,
        offset_map_e: Tensor | None = None,
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        me = "PixelElectronics"
        self.shot_noise = bool(shot_noise)
        self.takes = ("electrons",) if self.shot_noise else ()
        self.full_well_e = None if full_well_e is None else check_number(full_well_e, "full_well_e", me, open_low=True)
        self.read_noise_e = check_number(read_noise_e, "read_noise_e", me)
        self.ktc_noise_e = check_number(ktc_noise_e, "ktc_noise_e", me)
        self.excess_noise = check_number(excess_noise, "excess_noise", me, low=1.0)
        self.dark_e = check_number(dark_e, "dark_e", me)
        if (gain_e_per_dn is None) != (bits is None):
            raise UnitError(f"{me}: expected gain_e_per_dn and bits together, got {gain_e_per_dn!r} and {bits!r}.")
        self.gain_e_per_dn = (
            None if gain_e_per_dn is None else check_number(gain_e_per_dn, "gain_e_per_dn", me, open_low=True)
        )
        self.bits = None if bits is None else check_count(bits, "bits", me)
        self.signed = bool(signed)
        if self.signed and self.bits is None:
            raise UnitError(f"{me}: expected gain_e_per_dn and bits of a signed converter, got neither.")
        lowest, highest = self.range_dn
        self.black_level_dn = check_number(black_level_dn, "black_level_dn", me, low=lowest, high=highest)
        for name, values in (("gain_map", gain_map), ("offset_map_e", offset_map_e)):
            if values is not None:
                values = values if isinstance(values, nn.Parameter) else reals(me, None, **{name: values})[0]
            if isinstance(values, nn.Parameter):
                self.register_parameter(name, values)
            else:
                self.register_buffer(name, values)

    @property
    def range_dn(self) -> tuple[float, float]:
        """The lowest and the highest code of the converter; (0, 0) without one."""
        codes = 2.0 ** (self.bits or 0)
        return (-codes / 2, codes / 2 - 1) if self.signed else (0.0, codes - 1)

    @property
    def range_e(self) -> tuple[float, float]:
        """The lowest and the highest number that can be reported, in electrons."""
        high = math.inf if self.full_well_e is None else self.full_well_e
        if self.gain_e_per_dn is None or self.bits is None:
            return (-math.inf, high)
        low, high = ((code - self.black_level_dn) * self.gain_e_per_dn for code in self.range_dn)
        return low, high

    @in_single
    def collected(self, x: Tensor) -> Tensor:
        """Mean electrons before saturation: with the gain map and the dark electrons.

        Args:
            x: mean electrons (..., C, N, H, W).
        """
        check_transient(x, type(self).__name__)
        if self.gain_map is not None:
            x = x * self._map(self.gain_map, "gain_map", x)
        return x + self.dark_e if self.dark_e else x

    def expected(self, x: Tensor) -> Tensor:
        mean, variance = self._moments(x)
        low, high = self.range_e
        return clipped_normal_mean(mean, variance, low, high) if self.bits is not None else mean

    def variance(self, x: Tensor) -> Tensor:
        """Variance before the converter's clip, in electrons squared, with its rounding noise of 1/12 step squared.

        Args:
            x: mean electrons (..., C, N, H, W).
        """
        _, variance = self._moments(x)
        return variance if self.gain_e_per_dn is None else variance + self.gain_e_per_dn**2 / 12

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            mean = self.collected(x)
            return self._read_out(poisson(mean, generator) if self.shot_noise else mean, generator)

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        charge = self.collected(x)
        if self.shot_noise:
            charge = charge + gaussian_noise(charge, generator)
        return self._read_out(charge, generator)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if self.grad != "score":
            return super().forward(x, generator)
        if not self.shot_noise:
            # Noise that does not depend on the charge is added to it: the ordinary gradient is unbiased.
            return self.gaussian(x, generator)
        mean = self.collected(x)
        counts = poisson(mean, generator)
        # What follows the draw does not depend on x, so its score is that of the counts alone.
        record_score(lambda: poisson_log_prob(counts, mean).sum(-3), type(self).__name__)
        return self._read_out(counts, generator)

    def _moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the charge that reaches the converter."""
        mean = self.collected(x)
        # a charge below zero, as a difference of taps has them, has no noise of its own
        variance = mean.clamp_min(0) * (self.excess_noise if self.shot_noise else self.excess_noise - 1)
        if self.full_well_e is not None:
            clipped = clipped_normal_mean(mean, variance, high=self.full_well_e)
            mean, variance = clipped, clipped_normal_variance(mean, variance, self.full_well_e)
        if self.offset_map_e is not None:
            mean = mean + self._map(self.offset_map_e, "offset_map_e", x)
        return mean, variance + self.read_noise_e**2 + self.ktc_noise_e**2

    def _read_out(self, charge: Tensor, generator: torch.Generator | None) -> Tensor:
        if self.excess_noise > 1:
            charge = charge + gaussian_noise(charge * (self.excess_noise - 1), generator)
        if self.full_well_e is not None:
            charge = charge.clamp_max(self.full_well_e)
        if self.offset_map_e is not None:
            charge = charge + self._map(self.offset_map_e, "offset_map_e", charge)
        # Both are normal and independent, so one draw does.
        added = math.hypot(self.read_noise_e, self.ktc_noise_e)
        if added > 0:
            charge = charge + added * standard_normal(charge, generator)
        if self.gain_e_per_dn is None or self.bits is None:
            return charge
        level = charge / self.gain_e_per_dn + self.black_level_dn
        level = straight_through(level.round(), level) if level.requires_grad else level.round()
        return (level.clamp(*self.range_dn) - self.black_level_dn) * self.gain_e_per_dn

    def _map(self, values: Tensor, name: str, x: Tensor) -> Tensor:
        missing = x.ndim - values.ndim
        if missing < 0 or any(v not in (1, n) for v, n in zip(values.shape, x.shape[missing:], strict=True)):
            raise ShapeError(
                f"{type(self).__name__}: expected {name} to broadcast to {tuple(x.shape)}, got {tuple(values.shape)}."
            )
        return values.to(x.dtype)
