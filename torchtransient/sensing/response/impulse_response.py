"""Instrument response functions (IRF) applied along time; their shapes are in `responses` and `composed_responses`."""

from __future__ import annotations

from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ArgumentError
from torchtransient.sensing.base.layout import bin_width_of, check_choice
from torchtransient.sensing.base.sensor import Sensor
from torchtransient.sensing.numerics.time_convolution import Boundary, Method, convolve_time
from torchtransient.sensing.response.composed_responses import ComposedResponse as ComposedResponse
from torchtransient.sensing.response.composed_responses import MeasuredResponse as MeasuredResponse
from torchtransient.sensing.response.responses import GaussianResponse as GaussianResponse
from torchtransient.sensing.response.responses import Response as Response
from torchtransient.sensing.response.responses import TailedResponse as TailedResponse
from torchtransient.sensing.response.responses import UniformResponse as UniformResponse
from torchtransient.sensing.response.responses import WithinBin, kernel_of
from torchtransient.sensing.response.responses import emg_response as emg_response


def check_response(response: object, where: str) -> Response:
    """`response` when it is a Response, else ArgumentError."""
    if not isinstance(response, Response):
        raise ArgumentError(
            f"{where}: expected a response such as GaussianResponse, got {type(response).__name__}. A "
            "measured histogram goes into MeasuredResponse(counts, bin_width_s)."
        )
    return response


class ImpulseResponse(Sensor):
    """Convolves a transient (..., C, T, H, W) with a response along time: the shape of light before it is detected.

    For the laser's pulse and the optics. What moves single detections, the jitter of the detector and of its timing,
    is `DetectionJitter`, behind the detector. Constant light, ambient and dark counts, comes after this too:
    `PhotonBudget` adds it. With boundary "zero" light that leaves the window is lost and nothing comes in, so that
    constant light would starve at its edges; `Compose` refuses that order.

    The bin width comes from `axis` or `bin_width_s`; boundary and method as in `convolve_time`. Sums over time are
    conserved with "periodic", and with "zero" as far as light stays in the window. `within_bin` "uniform": light lies
    evenly in its bin; "center": in the middle (`Response.kernel`). Raises UnitError, ShapeError.
    """

    gives = "the same"

    def __init__(
        self,
        response: Response,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "zero",
        method: Method = "auto",
        within_bin: WithinBin = "uniform",
    ) -> None:
        super().__init__()
        check_choice(boundary, Boundary, "boundary", "ImpulseResponse")
        check_choice(method, Method, "method", "ImpulseResponse")
        check_choice(within_bin, WithinBin, "within_bin", "ImpulseResponse")
        self.response = check_response(response, "ImpulseResponse")
        self.bin_width_s = bin_width_of(axis, bin_width_s, "ImpulseResponse")
        self.num_bins = None if axis is None else axis.num_bins
        self.boundary: Boundary = boundary
        self.method: Method = method
        self.within_bin: WithinBin = within_bin

    def expected(self, x: Tensor) -> Tensor:
        first, kernel = kernel_of(self.response, self.bin_width_s, self.within_bin)
        return convolve_time(x, kernel, first, boundary=self.boundary, method=self.method)
