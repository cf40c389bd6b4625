"""A sensor effect that the library does not have, written as an author of a new one would.

One class and the entry below: the contract's tests come with it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from support.sensing.contract import Entry
from torchtransient.errors import UnitError
from torchtransient.sensing import Sensor
from torchtransient.sensing.checks import check_transient


class StrayLight(Sensor):
    """A share of the light of every pixel is spread over all of them by reflections inside the lens."""

    def __init__(self, share: float) -> None:
        super().__init__()
        if not 0 <= share <= 1:
            raise UnitError(f"StrayLight: expected a share between 0 and 1, got {share!r}.")
        self.share = nn.Parameter(torch.tensor(float(share)))

    def expected(self, x: Tensor) -> Tensor:
        check_transient(x, "StrayLight")
        share = self.share.to(x.dtype)
        return (1 - share) * x + share * x.mean((-2, -1), keepdim=True)


ENTRIES = [Entry("StrayLight", lambda: StrayLight(0.1), conserves=lambda y: y.sum())]
