"""Jitter of detections: the delay between a photon's arrival and its time stamp, drawn for every detection."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.sensing.base.layout import TIME, bin_width_of, check_choice, check_transient
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.counts.moved_counts import MovedCounts, Moves
from torchtransient.sensing.numerics.time_convolution import Boundary, convolve_time, window_lags
from torchtransient.sensing.response.impulse_response import check_response
from torchtransient.sensing.response.responses import Response, WithinBin, kernel_of


class DetectionJitter(MovedCounts):
    """Moves every detection of counts (..., C, T, H, W) by a random delay of `response`; the same shape, in counts.

    Jitter of the detector and of the timing electronics acts on what is detected: it stands behind pile-up and dead
    time, which know only when photons arrived. In front of them it would let detections pile up at times at which
    none arrived. The laser's pulse is not jitter but light: `ImpulseResponse`, in front.

    The mean is a convolution. Whole counts are drawn one by one (multinomial over the delays); counts that are not
    whole stay means. Policies: all four. "gaussian" has the covariance of the moves, given the counts; "score" the
    probabilities of the delays that were drawn, for learnable responses, while the counts given pass with the gradient
    of the mean. `boundary` "periodic": what leaves the window comes in at the other end, so that constant counts stay
    constant; "zero": it is lost. `within_bin` as in `Response.kernel`.

    Behind a detector of one detection per cycle `Compose` draws both at once: the same distribution, in the time of
    the detector alone. Raises UnitError, ShapeError. Not modelled: jitter that depends on the rate (time walk).
    """

    takes, gives = ("counts",), "counts"

    def __init__(
        self,
        response: Response,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "periodic",
        within_bin: WithinBin = "uniform",
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        check_choice(boundary, Boundary, "boundary", "DetectionJitter")
        check_choice(within_bin, WithinBin, "within_bin", "DetectionJitter")
        self.response = check_response(response, "DetectionJitter")
        self.bin_width_s = bin_width_of(axis, bin_width_s, "DetectionJitter")
        self.num_bins = None if axis is None else axis.num_bins
        self.boundary: Boundary = boundary
        self.within_bin: WithinBin = within_bin

    def expected(self, x: Tensor) -> Tensor:
        first, kernel = kernel_of(self.response, self.bin_width_s, self.within_bin)
        return convolve_time(check_transient(x, "DetectionJitter"), kernel, first, boundary=self.boundary)

    def moves(self, x: Tensor) -> Moves:
        first, kernel = kernel_of(self.response, self.bin_width_s, self.within_bin)
        kernel, first = window_lags(kernel.to(x.device), first, x.shape[TIME], self.boundary)
        if not kernel.numel():
            kernel, first = torch.zeros(1, dtype=torch.float64, device=x.device), 0
        return Moves(first, kernel, self.boundary)
