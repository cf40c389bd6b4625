"""Converters against photons converted one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing import TDC, random_code_widths


def widths(n=24, std=0.2, seed=0):
    return random_code_widths(n, std, torch.Generator().manual_seed(seed))


def image(values):
    return torch.as_tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"dither": True},
        {"sliding_scale": 5},
        {"offset_bins": 1.3},
        {"dither": True, "sliding_scale": 3, "offset_bins": -0.4},
    ],
)
def test_against_single_photons(options):
    n, w, rng = 24, widths(), np.random.default_rng(0)
    light = rng.random(n) + 5 * (np.arange(n) == 9)
    times = rng.choice(n, 400_000, p=light / light.sum()) + rng.random(400_000)
    shift = rng.integers(0, options.get("sliding_scale", 1), times.size)
    dither = rng.random(times.size) if options.get("dither") else 0.0
    codes = np.full(times.size, -1)
    for s in range(options.get("sliding_scale", 1)):
        edges = np.concatenate([[0.0], np.cumsum(np.roll(w.numpy(), -s))]) + options.get("offset_bins", 0.0)
        pick = shift == s
        codes[pick] = np.searchsorted(edges, times[pick], side="right") - 1
    # an unknown offset of a fraction of the code that was hit: half the events go to the next one
    codes = codes + (dither > 0.5) * (codes >= 0) if options.get("dither") else codes
    seen = np.bincount(codes[(codes >= 0) & (codes < n)], minlength=n)
    expected = TDC(w, **options)(image(light / light.sum() * times.size)).flatten().numpy()
    z = (seen - expected) / np.sqrt(np.maximum(expected, 1))
    assert np.abs(z).max() < 4.5


def test_ideal_converter_changes_nothing_and_widths_show_in_even_light():
    x = image(torch.rand(24, dtype=torch.float64))
    torch.testing.assert_close(TDC(torch.ones(24))(x), x)
    w = widths()
    converter = TDC(w)
    torch.testing.assert_close(converter(image(torch.ones(24))).flatten(), w)
    assert float(converter.integral_nonlinearity[-1]) == pytest.approx(0, abs=1e-12)
    torch.testing.assert_close(converter.differential_nonlinearity, w - 1)
    evened = TDC(w, sliding_scale=24)(image(torch.ones(24))).flatten()[4:-4]
    assert float((evened - 1).abs().max()) < 0.1 * float((w - 1).abs().max())


def test_what_falls_inside_is_conserved():
    x = torch.rand(2, 1, 24, 2, 2, dtype=torch.float64)
    torch.testing.assert_close(TDC(widths())(x).sum(-3), x.sum(-3))


def test_errors():
    with pytest.raises(UnitError, match="code_widths > 0"):
        TDC(torch.tensor([1.0, -1.0]))
    with pytest.raises(ShapeError, match="as in code_widths"):
        TDC(torch.ones(4))(torch.ones(1, 5, 1, 1))
