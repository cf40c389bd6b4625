"""Photon counters that differ in response and background: a true one, random ones, and two kinds that learn."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from two_walls import AXIS, PIXELS, Background, bins, counter

from torchtransient import sensing

# Bins around the time zero of a response, and places of the pixels (H, W, 2) between -1 and 1.
LAGS = torch.arange(-10, 31.0)
PLACES = torch.stack(torch.meshgrid(*2 * [torch.linspace(-1, 1, PIXELS)], indexing="xy"), -1)


class Lamp(Background):
    """Brighter on one side."""

    def level(self) -> Tensor:
        x, y = PLACES.unbind(-1)
        return self.log_counts.exp() * torch.exp(0.9 * x - 0.5 * y - 0.6 * x * x)


def true_counter() -> sensing.Compose:
    """What nobody knows: a wider core, a second lobe, a long tail, five times the background."""
    lobes = torch.exp(-0.5 * (LAGS / 1.2) ** 2), torch.exp(-0.5 * (LAGS - 5.5) ** 2), (LAGS >= 0) * torch.exp(-LAGS / 4)
    shape = sum(share * lobe / lobe.sum() for share, lobe in zip((0.65, 0.15, 0.2), lobes, strict=True))
    response = sensing.MeasuredResponse(shape, bins(1), bins(-10.5), align="start", floor=False)
    return counter(response, Lamp(0.5)).requires_grad_(False)


def random_counter() -> sensing.Compose:
    """One of many: widths, tails, shares and backgrounds that a maker would think of."""
    u = torch.rand(4).tolist()
    response = sensing.TailedResponse(bins(1.6 + 2.4 * u[0]), [bins(0.3 + 4 * u[1])], [0.02 + 0.45 * u[2]])
    return counter(response, Background(0.03 * 25 ** u[3])).requires_grad_(False)


class SmallNetwork(nn.Sequential):
    """(..., inputs) -> (...); begins as the constant zero."""

    def __init__(self, inputs: int) -> None:
        super().__init__(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 1))
        nn.init.zeros_(self[-1].weight)
        nn.init.zeros_(self[-1].bias)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x)[..., 0]


class NeuralResponse(sensing.Response):
    """A normal core, and what a network says of the 20 bins behind its middle."""

    def __init__(self) -> None:
        super().__init__(0.0, learnable=False)
        self.core = sensing.GaussianResponse(bins(2.1), learnable=True)
        self.share, self.network = nn.Parameter(torch.tensor(-1.7)), SmallNetwork(1)

    def kernel(self, bin_width_s: float) -> tuple[int, Tensor]:
        first, core = self.core.kernel(bin_width_s)
        delay, share = torch.arange(20) / 8, self.share.sigmoid()
        later = torch.softmax(3 * self.network(2 * delay[:, None] - 1) - 2 * delay, 0).to(core)
        both = core.new_zeros(max(len(core), 20 - first)).index_add(0, torch.arange(len(core)), (1 - share) * core)
        return first, both.index_add(0, torch.arange(20) - first, share * later)


class NeuralBackground(Background):
    """A network over the film."""

    def __init__(self, counts: float) -> None:
        super().__init__(counts)
        self.network = SmallNetwork(2)

    def level(self) -> Tensor:
        return (self.log_counts + 2 * self.network(PLACES)).exp()


def learnable_counter(neural: bool, captures: Tensor) -> sensing.Compose:
    """Of networks, or of the kind that the random counters are. Two bins before all light say where to begin."""
    level = float(captures[:, :, :2].mean())
    if neural:
        sensor = counter(NeuralResponse(), NeuralBackground(level))
    else:
        sensor = counter(sensing.TailedResponse(bins(2.1), [bins(2)], [0.15], learnable=True), Background(level))
    for name, parameter in sensor.named_parameters():
        parameter.requires_grad_(not name.endswith("delay_ps"))
    return sensor


def kernel_of(sensor: sensing.Compose) -> Tensor:
    """Shares of the response at LAGS."""
    first, kernel = sensor.stages[1].response.kernel(AXIS.bin_width_s)
    return nn.functional.pad(kernel, (first + 10, 31 - first - len(kernel)))


def level_of(sensor: sensing.Compose) -> Tensor:
    """Background (H, W), counts a bin."""
    return sensor.stages[2].level().expand(PIXELS, PIXELS)
