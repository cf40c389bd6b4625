"""docs/data_sheet_to_chain.md: its code runs, and gives the figures that stand there."""

from __future__ import annotations

import contextlib

import pytest
import torch

from support.pages import Page

PAGE = Page("docs/data_sheet_to_chain.md")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with contextlib.chdir(tmp_path_factory.mktemp("page")):
        return PAGE.names()


def test_figures(page):
    report, mean, counts = page["report"], page["mean"], page["counts"]
    assert float(report.signal_per_cycle) == pytest.approx(0.0185, abs=5e-5)
    assert not bool(report.piles_up)
    assert report.ambient_per_cycle == pytest.approx(0.0002, rel=1e-9)
    assert float(mean.sum()) == pytest.approx(1850, abs=1)
    assert 1e5 * float(report.signal_per_cycle) == pytest.approx(1846, abs=1)
    assert page["blocked"] == pytest.approx(0.0006, abs=1e-5)
    assert float(page["deviation_m"]) == pytest.approx(0.0005, abs=3e-5)
    assert float(counts.sum()) == pytest.approx(1850, abs=5 * 1850**0.5)
    assert torch.equal(counts, counts.round())
    # 20 ambient counts over 400 bins, the first ones and the last ones alike
    for ends in (mean[:, :50], mean[:, -50:]):
        assert ends.flatten().tolist() == pytest.approx([0.05] * 50, abs=0.005)


def test_widths_add(page):
    peak = page["mean"].flatten()
    assert int((peak > peak.max() / 2).sum()) == 13
    place = torch.arange(400, dtype=torch.float64)
    excess = (peak - 0.05).clamp_min(0) * ((place - 267).abs() < 40)
    variance = (excess * (place - 267) ** 2).sum() / excess.sum()
    # three responses, and two stages that spread light over a bin
    wanted = (120**2 + 300**2 + (2.355 * 20) ** 2) / 2.3548**2 / 25**2 + 2 / 6
    assert float(variance) == pytest.approx(wanted, rel=0.02)
    assert round((120**2 + 300**2 + (2.355 * 20) ** 2) ** 0.5) == 327


def test_a_chain_as_a_device_measures_the_samples_of_a_recipe(page):
    """Its counts are those of the chain on the light of the same sample, with the ambient light that was drawn."""
    sample = page["measured"].sample(0)
    light, counts = (torch.from_numpy(sample.arrays[name]).double() for name in ("transient", "measurement"))
    ambient = float(sample.values["device.PhotonBudget.ambient_rate_hz"])
    assert 1e3 <= ambient <= 1e6
    mean = page["device"].changed("PhotonBudget", ambient_rate_hz=ambient).sensor().expected(light)
    assert torch.equal(counts, counts.round())
    # sums of pixels: binomials of 1e5 cycles of less than one detection each
    z = (counts - mean).sum((0, 1)) / mean.sum((0, 1)).clamp_min(1).sqrt()
    assert float(z.abs().max()) < 5
    assert float(counts.sum()) > 1000
