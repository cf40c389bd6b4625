"""The example of docs/photon_counting.md runs, and its numbers are sensible."""

from __future__ import annotations

import torch

from support.pages import Page

PAGE = Page("docs/photon_counting.md")


def test_every_example_runs():
    """All blocks, one after the other, as a reader would run them."""
    names: dict[str, object] = {}
    # Its light is drawn: two of four losses that are the same by chance would have a slope of zero.
    torch.manual_seed(0)
    for number, code in PAGE.run(names):
        if number == 0:
            assert names["counts"].shape == (1, 512, 8, 8)
            assert bool(torch.isfinite(names["loss"]))
            assert bool(torch.isfinite(names["rate"]).all())
        if "ScoreFunction" in code:
            assert names["losses"].shape == (4,) and 0 < float(names["losses"].mean()) < 1
            slope = names["brightness"].grad.flatten()
            assert bool(torch.isfinite(slope).all()) and bool((slope != 0).all())
        if "register_parametrization" in code:
            # 1.2 MHz in 5 us of bins are 3100 counts of a pixel, which tell the rate to 1.8 %; from a sixth of it
            found = names["learnt"].ambient_rate_hz.detach()
            assert float((found / (3 * (0.4e6 + 100)) - 1).abs().max()) < 5 * 0.018
    assert 0 < float(names["millimetres"]) < 1
