"""A detector whose afterpulses obey its dead time, start dead times of their own and keep photons from being seen."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.base.layout import TIME, check_transient
from torchtransient.sensing.base.pixel_maps import kept_map, over_time
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.base.sensor import common_bins
from torchtransient.sensing.base.wrapped_detector import WrappedDetector, cycles_of
from torchtransient.sensing.correlated_noise.afterpulsing import Afterpulsing
from torchtransient.sensing.correlated_noise.trapped_carriers import of_cycles, of_free_running
from torchtransient.sensing.numerics.draws import check_rates
from torchtransient.sensing.numerics.time_convolution import filter_rows
from torchtransient.sensing.spad.free_running import FreeRunningSPAD
from torchtransient.sensing.spad.spad import SynchronousSPAD

_LEFT = 1e-8  # of all counts, where generations end
_FEW = 1e-5  # carriers of a detection, whose time inside a bin nobody sees
_STEP, _MOST_STEPS = 1.2, 3  # mean delays that a part of a bin is wide, at most, and the logarithm of their number
_Detector = SynchronousSPAD | FreeRunningSPAD


class AfterpulsingSPAD(WrappedDetector):
    """A `SynchronousSPAD` or `FreeRunningSPAD` with afterpulses: rates (..., C, T, H, W) in, counts out.

    Carriers that are set free act on the detector as photons do: they fire it when it is armed and are lost when it is
    dead; those that fire start a dead time and leave carriers of their own. Their rate while the detector is armed,
    `released(x)`, is added to that of the photons, and means, draws and all four policies are the detector's own.

    `afterpulsing`: an `Afterpulsing`, of the detector's bins and dead time. One detection per cycle (`SynchronousSPAD`
    without dead time) leaves the detector dead to the end of the cycle: only afterpulses of later cycles are seen. A
    closed gate stops them, too. With a `period_s` beyond the window the `background` of the Afterpulsing, counts of a
    bin of the whole exposure, goes on outside of it; inside a `MacroPixel` or `CoincidencePixel` it is that of the
    whole pixel, of which every SPAD has its share.

    Exponential delays of a detector with dead time (SynchronousSPAD, or FreeRunningSPAD "non_paralyzable"): each
    carrier is followed from its detection on (`trapped_carriers`), so that one set free right after the dead time finds
    the detector armed, and all older carriers that are still trapped count. Pairs of carriers are exact, three and more
    by their pairs; means are within 1.5 times the noise of events for probabilities up to 0.3, delays of 0.3 to 300
    bins. Several exponentials are independent. Delays below 1.2 bins are followed in parts of bins, at the cost of as
    many bins (8 at most); `log_prob`, `variance` and pixels of several SPADs take them as constant inside a bin.

    Other laws of delays, "paralyzable" detectors and detectors without dead time of their own (one detection a cycle):
    releases are independent of whether a photon has fired the detector since. That is right for one detection a cycle;
    else off by up to a third of the probability in total variation, totals by a quarter, where most carriers are set
    free right after the dead time (see docs/photon_counting.md).

    Draws have the variance of the detector at that rate: afterpulses vary as photons do, short by twice their share in
    dim light (variance over mean of totals 0.83 for 1.41 with a probability of 0.3, 0.7 for 0.8 with 0.05).

    Raises UnitError for a dead time or bins that are not the detector's, and for periods that do not go with the
    window.
    """

    detector: SynchronousSPAD | FreeRunningSPAD
    takes, gives = ("rate",), "counts"

    def __init__(
        self,
        detector: SynchronousSPAD | FreeRunningSPAD,
        afterpulsing: Afterpulsing,
        *,
        grad: GradPolicy | None = None,
    ) -> None:
        where = "AfterpulsingSPAD"
        if not isinstance(detector, (SynchronousSPAD, FreeRunningSPAD)):
            raise UnitError(f"{where}: expected detector to be a SynchronousSPAD or FreeRunningSPAD, got {detector!r}.")
        if not isinstance(afterpulsing, Afterpulsing):
            raise UnitError(f"{where}: expected afterpulsing to be an Afterpulsing, got {afterpulsing!r}.")
        own = detector.dead_time_s
        own = float(own.detach()) if isinstance(own, Tensor) else own
        if own is not None and not math.isclose(own, afterpulsing.dead_time_s, rel_tol=1e-6):
            raise UnitError(
                f"{where}: expected the detector's dead time of {own:g} s in afterpulsing, got "
                f"{afterpulsing.dead_time_s:g} s. One detector has one dead time."
            )
        super().__init__(detector, grad)
        self.bin_width_s, self.num_bins = common_bins([detector, afterpulsing], where)
        self.afterpulsing = afterpulsing

    def check_bins(self, x: object) -> None:
        super().check_bins(x)
        self.afterpulsing.check_bins(x)

    def _transfers(self, x: Tensor) -> tuple[Tensor, Tensor | None, int]:
        """In the frequencies of a period, and of two windows for what has to be left out; the period in bins."""
        check_transient(x, "AfterpulsingSPAD")
        bins = x.shape[TIME]
        period = self.afterpulsing.period_bins or bins
        if period < bins or (isinstance(self.detector, FreeRunningSPAD) and period != bins):
            raise UnitError(
                f"AfterpulsingSPAD: expected a period of the afterpulses of the window's {bins} bins (or more, of a "
                f"SynchronousSPAD), got {period} bins. Set period_s."
            )
        round_period = torch.fft.rfft(self.afterpulsing.kernel(period).to(x.device))
        if self.detector.dead_time_s is not None:
            return round_period, None, period
        same_cycle = torch.fft.rfft(self.afterpulsing.first_kernel(bins).to(x.device), n=2 * bins)
        return round_period, same_cycle, period

    def _released(self, detected: Tensor, transfers: tuple[Tensor, Tensor | None, int]) -> Tensor:
        """Carriers set free per cycle and bin, of which those in a dead cycle are left out: float64."""
        bins = detected.shape[TIME]
        round_period, same_cycle, period = transfers
        rows = detected.movedim(TIME, -1).contiguous().double()
        free = filter_rows(rows, round_period, period, 0, bins)
        if same_cycle is not None:
            free = (free - filter_rows(rows, same_cycle, 2 * bins, 0, bins)).clamp_min(0)
        return free.movedim(-1, TIME)

    def _from_outside(self, x: Tensor, round_period: Tensor, period: int) -> Tensor | float:
        """Carriers of the constant counts outside of the window, per cycle and bin: float64."""
        given = self.afterpulsing.background
        if period == x.shape[TIME] or (not isinstance(given, Tensor) and given == 0):
            return 0.0
        cycles = self.exposure_cycles or cycles_of(self.detector)
        level = over_time(kept_map(self.afterpulsing, "background"), x, "background", "AfterpulsingSPAD")
        all_of_one = round_period[0].real
        ones = torch.ones(1, x.shape[TIME], dtype=torch.float64, device=x.device)
        missing = (all_of_one - filter_rows(ones, round_period, period, 0, x.shape[TIME])).clamp_min(0)
        return missing.view(-1, 1, 1) * level / ((1 - all_of_one) * cycles)

    @property
    def _follows_carriers(self) -> bool:
        """Whether what a detection meets is known for each of its carriers."""
        spad = self.detector
        dead = spad.dead_bins is not None if isinstance(spad, SynchronousSPAD) else spad.kind == "non_paralyzable"
        return self.afterpulsing.delays is None and dead

    def _of_armed(
        self, x: Tensor, transfers: tuple[Tensor, Tensor | None, int], outside: Tensor | float, steps: int
    ) -> Tensor:
        """Carriers set free per cycle, part of a bin (there are `steps`) and armed detector: float64."""
        module, spad, bins = self.afterpulsing, self.detector, x.shape[TIME]
        if x.numel() == 0:
            return x.double().repeat_interleave(steps, TIME)
        check_rates(x, "AfterpulsingSPAD")
        seen, tau = module.seen().to(x.device), (module.tau_s.reshape(-1) / module.bin_width_s).to(x.device)
        wide = x.double().movedim(TIME, -1)
        rows = wide.reshape(-1, bins)
        if isinstance(spad, SynchronousSPAD):
            dead = torch.as_tensor(spad.dead_bins, dtype=torch.float64, device=x.device)
            round_period, _, period = transfers
            same_cycle = torch.fft.rfft(module.first_kernel(bins).to(x.device), n=2 * bins)
            given = outside.expand(x.shape).movedim(TIME, -1).reshape(rows.shape) if isinstance(outside, Tensor) else 0

            def earlier(detected: Tensor, at: Tensor | slice) -> Tensor:
                """Of other cycles, which know nothing of this one."""
                free = filter_rows(detected, round_period, period, 0, bins)
                free = (free - filter_rows(detected, same_cycle, 2 * bins, 0, bins)).clamp_min(0)
                return free + given[at] if isinstance(given, Tensor) else free

            gate = None if spad.gate is None else spad.gate.to(x.device)
            found = of_cycles(rows, dead, gate, seen, tau, earlier, steps)
        else:
            dead = spad.dead_time_s.to(x.device) / module.bin_width_s
            found = of_free_running(rows, dead, seen, tau, steps)
        return found.view(*wide.shape[:-1], steps * bins).movedim(-1, TIME)

    @in_single
    def released(self, x: Tensor) -> Tensor:
        """Rate of carriers that fire an armed detector, per cycle and bin, in the shape and dtype of `x`."""
        return self._free(x, 1)

    def _free(self, x: Tensor, steps: int) -> Tensor:
        transfers = self._transfers(x)
        outside = self._from_outside(x, transfers[0], transfers[2])
        if self._follows_carriers:
            return self._of_armed(x, transfers, outside, steps).to(x.dtype)
        most = float(self.afterpulsing.kernel(transfers[2]).detach().sum())
        free = torch.zeros_like(x)
        # where all carriers are set free during the dead time, there is nothing to iterate
        rounds = max(1, math.ceil(math.log(_LEFT) / math.log(most)) - 1) if most > _LEFT else 1
        for _ in range(rounds):
            inside = self._released(self.detector.probabilities(x + free), transfers)
            free = (inside + outside).to(x.dtype)
        return free

    @in_single
    def rate(self, x: Tensor) -> Tensor:
        """Photons and carriers set free."""
        return x + self.released(x)

    def _steps(self) -> int:
        """Parts of a bin in which the rate of carriers is taken as constant."""
        if not self._follows_carriers:
            return 1
        seen, tau = self.afterpulsing.seen(), self.afterpulsing.tau_s.detach().reshape(-1)
        tau_bins = float(tau[seen > _FEW].min()) / self.afterpulsing.bin_width_s if bool((seen > _FEW).any()) else 1e9
        return 1 << min(_MOST_STEPS, max(0, math.ceil(math.log2(_STEP / tau_bins))))

    def _in_steps(self, x: Tensor, measure: Callable[[_Detector, Tensor], Tensor]) -> Tensor:
        """`measure(detector, rate)` in parts of bins, added up."""
        steps = self._steps()
        if steps == 1:
            return measure(self.detector, self.rate(x))
        rate = (x / steps).repeat_interleave(steps, TIME) + self._free(x, steps)
        found = measure(_in_parts(self.detector, steps), rate)
        return found.reshape(*x.shape[:TIME], x.shape[TIME], steps, *x.shape[TIME + 1 :]).sum(TIME)

    @in_single
    def probabilities(self, x: Tensor) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad.probabilities(rate))

    @in_single
    def expected(self, x: Tensor) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad.expected(rate))

    def gaussian(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad.gaussian(rate, generator))

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._in_steps(x, lambda spad, rate: spad.sample(rate, generator))

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._in_steps(x, lambda spad, rate: spad(rate, generator=generator))


def _in_parts(detector: _Detector, steps: int) -> _Detector:
    """The detector with bins cut in `steps`."""
    other = copy.copy(detector)
    if other.bin_width_s is not None:
        other.bin_width_s = other.bin_width_s / steps
    if other.num_bins is not None:
        other.num_bins = other.num_bins * steps
    if isinstance(other, SynchronousSPAD):
        if other.dead_bins is not None:
            other.dead_bins = other.dead_bins * steps
        if other.gate is not None:
            other._buffers = {**other._buffers, "gate": other.gate.repeat_interleave(steps)}
    return other
