"""Light that no method could make a volume of: numbers that are none."""

from __future__ import annotations

import torch

from torchtransient.capture import Capture
from torchtransient.errors import UnitError


def checked_light(capture: Capture, who: str) -> Capture:
    """A capture whose light is finite. Raises UnitError for NaN and infinities, which transforms spread over the whole
    volume: it says at how many points, and which is the first.
    """
    light = capture.transient
    assert light is not None  # a capture without one has been refused
    finite = torch.isfinite(light)
    if bool(finite.all()):
        return capture
    dims = len(capture.scan.shape)
    # All but the points: channels, batches and times.
    dead = ~finite.reshape(-1, *light.shape[light.ndim - dims :]).all(0)
    places = dead.nonzero().tolist()
    first = ", ".join(map(str, places[0]))
    what = "pairs of laser and sensor points" if capture.scan.kind == "exhaustive" else "points"
    raise UnitError(
        f"{who}: expected finite light, got NaN or infinity at {len(places)} of {dead.numel()} {what}, the first at "
        f"[{first}]. Put the mean of its neighbours in the place of a dead point, or leave it out: Scan.points takes "
        "those that are left, and fbp their light."
    )
