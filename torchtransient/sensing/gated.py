"""Gated cameras: an intensifier or a fast shutter that integrates while its gate is open.

A gate opens and closes along normal cumulative edges: ``g(t) = Phi((t - delay) / s_open) - Phi((t - delay - width) /
s_close)``, whose means over bins have a closed form, so that delay and width have gradients. A picture per gate stands
where time was: (..., C, G, H, W).

Sources: Busck & Heiselberg, "Gated viewing and high-accuracy three-dimensional laser radar" (Appl. Opt. 2004);
Laurenzis et al., "Time-of-flight range gating" (2007).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import Numbers
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.checks import check_number, check_seconds, check_time_axis, reals
from torchtransient.sensing.itof.correlation import correlate
from torchtransient.sensing.parameters import keep_number
from torchtransient.sensing.responses import normal_integral
from torchtransient.sensing.sensor import Sensor

# A normal cumulative edge takes this many standard deviations from 10 % to 90 %.
RISE_PER_SIGMA = 2 * 1.2815515655446004


def gate_profiles(
    delays_s: Tensor, widths_s: Tensor, axis: TimeAxis, *, rise_s: float, fall_s: float, leakage: float = 0.0
) -> Tensor:
    """Mean transmission of every gate over every bin, between ``leakage`` and 1.

    Differentiable in delays and widths. A gate narrower than its edges does not open fully, and where the formula is
    negative before it, the transmission is zero.

    Args:
        delays_s: middle of the opening edge, counted from the emission of the light, (G,), in seconds.
        widths_s: time from there to the middle of the closing edge, (G,), in seconds.
        axis: axis of the light.
        rise_s: opening edge from 10 % to 90 %, above zero, in seconds.
        fall_s: closing edge from 90 % to 10 %, above zero, in seconds.
        leakage: transmission of the closed gate.

    Returns:
        (G, T) float64.

    Raises:
        UnitError: for numbers out of range.
        ShapeError: for other shapes.
    """
    me = "gate_profiles"
    rise = check_seconds(rise_s, "rise_s", me, open_low=True) / RISE_PER_SIGMA
    fall = check_seconds(fall_s, "fall_s", me, open_low=True) / RISE_PER_SIGMA
    leakage = check_number(leakage, "leakage", me, high=1.0)
    delays_s, widths_s = reals(me, delays_s=delays_s, widths_s=widths_s)
    if delays_s.ndim != 1 or delays_s.shape != widths_s.shape:
        raise ShapeError(
            f"{me}: expected delays and widths (G,), got {tuple(delays_s.shape)}, {tuple(widths_s.shape)}."
        )
    edges = axis.edges_s.to(delays_s.device)
    opened = delays_s.double().unsqueeze(1)
    closed = opened + widths_s.double().unsqueeze(1)
    open_part = _edge_integral(edges, opened, rise).diff(dim=1)
    close_part = _edge_integral(edges, closed, fall).diff(dim=1)
    # Far from the gate both parts are equal up to rounding; before a gate that closes much slower than it opens and is
    # narrower than that, the closing edge comes first. Neither leaves negative light.
    profile = ((open_part - close_part) / edges.diff()).clamp_min(0)
    return leakage + (1 - leakage) * profile


def _edge_integral(time_s: Tensor, middle_s: Tensor, sigma_s: float) -> Tensor:
    """Integral of ``Phi((t - middle) / sigma)`` up to each time, seconds."""
    return sigma_s * normal_integral((time_s - middle_s) / sigma_s)


class GatedIntegration(Sensor):
    """Photoelectrons per bin (..., C, T, H, W) to the mean electrons behind every gate (..., C, G, H, W).

    Shot noise, intensifier and read noise follow in `PixelElectronics`.

    Args:
        delays_s: delays of the G gates, in seconds.
        widths_s: width of all gates, or one for each, in seconds.
        axis: axis of the light.
        rise_s: opening edge from 10 % to 90 %, in seconds.
        fall_s: closing edge from 90 % to 10 %, in seconds; None: the same as `rise_s`.
        leakage: transmission of a closed gate; 1e-7 and less of an intensifier, 1e-3 of a shuttered CMOS pixel.
        electrons_per_unit: electrons of all exposures for light of 1.
        learnable: make delays and widths parameters, `delay_ps` and `log_width_s`.

    Raises:
        UnitError: for numbers out of range.
        ShapeError: for other numbers of widths than delays.
    """

    takes, gives = ("electrons", "counts"), "electrons"

    delay_ps: Tensor
    log_width_s: Tensor

    def __init__(
        self,
        delays_s: Numbers,
        widths_s: float | Numbers,
        axis: TimeAxis,
        *,
        rise_s: float = 0.2e-9,
        fall_s: float | None = None,
        leakage: float = 0.0,
        electrons_per_unit: float = 1.0,
        learnable: bool = False,
    ) -> None:
        super().__init__()
        me = type(self).__name__
        given = [torch.as_tensor(seconds, dtype=torch.float64) for seconds in (delays_s, widths_s)]
        if given[0].ndim != 1 or not len(given[0]) or given[1].shape not in ((), given[0].shape):
            shapes = " and ".join(str(tuple(seconds.shape)) for seconds in given)
            raise ShapeError(f"{me}: expected delays (G,) and one width or one per delay, got {shapes}.")
        delays = [check_seconds(d, "delays_s", me, signed=True) for d in given[0].tolist()]
        widths = [check_seconds(w, "widths_s", me, open_low=True) for w in given[1].expand_as(given[0]).tolist()]
        self.axis = check_time_axis(axis, me)
        self.num_bins = self.axis.num_bins
        self.rise_s = check_seconds(rise_s, "rise_s", me, open_low=True)
        self.fall_s = self.rise_s if fall_s is None else check_seconds(fall_s, "fall_s", me, open_low=True)
        if max(self.rise_s, self.fall_s) > 10 * self.num_bins * axis.bin_width_s:
            raise UnitError(f"{me}: expected edges of at most ten windows, got {self.rise_s:g} and {self.fall_s:g} s.")
        self.leakage = check_number(leakage, "leakage", me, high=1.0)
        self.electrons_per_unit = check_number(electrons_per_unit, "electrons_per_unit", me, open_low=True)
        keep_number(self, "delay_ps", torch.tensor(delays, dtype=torch.float64) * 1e12, learnable)
        keep_number(self, "log_width_s", torch.tensor(widths, dtype=torch.float64).log(), learnable)

    @property
    def delays_s(self) -> Tensor:
        """(G,) float64: opening times of the gates, in seconds."""
        return self.delay_ps.double() * 1e-12

    @property
    def widths_s(self) -> Tensor:
        """(G,) float64: open times of the gates, in seconds."""
        return self.log_width_s.double().exp()

    def profiles(self) -> Tensor:
        """(G, T) float64: the gates as they are now."""
        return gate_profiles(
            self.delays_s, self.widths_s, self.axis, rise_s=self.rise_s, fall_s=self.fall_s, leakage=self.leakage
        )

    def outside(self) -> Tensor:
        """(G,) float64: share of each gate's open time that lies outside the window, leakage left out."""
        with torch.no_grad():
            widths = self.widths_s
            inside = gate_profiles(self.delays_s, widths, self.axis, rise_s=self.rise_s, fall_s=self.fall_s)
            return 1 - inside.sum(1) * self.axis.bin_width_s / widths

    def expected(self, x: Tensor) -> Tensor:
        return correlate(x, self.profiles()) * self.electrons_per_unit
