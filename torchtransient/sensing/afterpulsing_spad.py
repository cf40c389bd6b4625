"""A detector whose afterpulses obey its dead time, start dead times of their own and keep photons from being seen."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.afterpulsing import Afterpulsing
from torchtransient.sensing.free_running import FreeRunningSPAD
from torchtransient.sensing.layout import TIME, check_transient
from torchtransient.sensing.own_bins import common_bins
from torchtransient.sensing.pixel_maps import kept_map, over_time
from torchtransient.sensing.policies import GradPolicy
from torchtransient.sensing.spad import SynchronousSPAD
from torchtransient.sensing.time_convolution import filter_rows
from torchtransient.sensing.wrapped_detector import WrappedDetector, cycles_of

_LEFT = 1e-8  # of all counts, where generations end


class AfterpulsingSPAD(WrappedDetector):
    """A `SynchronousSPAD` or `FreeRunningSPAD` with afterpulses: rates (..., C, T, H, W) in, counts out.

    Carriers that are set free act on the detector as photons do: they fire it when it is armed and are lost when it is
    dead; those that fire start a dead time and leave carriers of their own. Their rate, `released(x)`, follows from the
    mean of all detections round the laser period, which follows from it: iterated until 1e-8 of the counts is left. It
    is added to that of the photons, so that means, draws and all four policies are the detector's own.

    `afterpulsing`: an `Afterpulsing`, of the detector's bins and dead time. One detection per cycle (`SynchronousSPAD`
    without dead time) leaves the detector dead to the end of the cycle: only afterpulses of later cycles are seen. A
    closed gate stops them, too. With a `period_s` beyond the window the `background` of the Afterpulsing, counts of a
    bin of the whole exposure, goes on outside of it; inside a `MacroPixel` or `CoincidencePixel` it is that of the
    whole pixel, of which every SPAD has its share.

    Releases are taken as independent of whether a photon has fired the detector since the detection that they come
    from: right in dim light and where most delays are longer than the next dead time; else off by up to a third of the
    probability, in total variation (see docs/photon_counting.md). Carriers that are set free right after the dead time
    find the detector armed more often than on the mean: totals are then short by up to a quarter of the probability, in
    constant light too (3.7 % for a probability of .3, 3 photons a dead time and delays of an eighth of it).
    Draws have the variance of the
    detector at that rate: afterpulses vary as photons do, short by twice their share in dim light.

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
        if own is not None and not math.isclose(float(own), afterpulsing.dead_time_s, rel_tol=1e-6):
            raise UnitError(
                f"{where}: expected the detector's dead time of {float(own):g} s in afterpulsing, got "
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

    @in_single
    def released(self, x: Tensor) -> Tensor:
        """Rate of carriers set free, per cycle and bin, in the shape and dtype of `x`; they fire an armed detector."""
        transfers = self._transfers(x)
        most = float(self.afterpulsing.kernel(transfers[2]).detach().sum())
        outside = self._from_outside(x, transfers[0], transfers[2])
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
