"""Converters against photons converted one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.sensing import TDC, random_code_widths


def widths(n=24, std=0.2, seed=0):
    return random_code_widths(n, std, torch.Generator().manual_seed(seed))


def image(values):
    return torch.as_tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


OPTIONS = [
    {},
    {"dither": True},
    {"sliding_scale": 5},
    {"offset_bins": 1.3},
    {"dither": True, "sliding_scale": 3, "offset_bins": -0.4},
]


@pytest.mark.parametrize("options, boundary", list(zip(OPTIONS, ["zero", "periodic"] * 3, strict=False)))
def test_against_single_photons(options, boundary):
    n, w, rng = 24, widths(), np.random.default_rng(0)
    light = rng.random(n) + 5 * (np.arange(n) == 9)
    times = rng.choice(n, 200_000, p=light / light.sum()) + rng.random(200_000)
    shift = rng.integers(0, options.get("sliding_scale", 1), times.size)
    # an unknown time of up to a bin on top
    dither = rng.random(times.size) * bool(options.get("dither"))
    # the converter's own edges, to which a whole number of nominal steps is added, and taken off the code
    edges = np.concatenate([[0.0], np.cumsum(np.tile(w.numpy(), 3))]) - n
    local = times + dither - options.get("offset_bins", 0.0) + shift
    codes = np.searchsorted(edges, local, side="right") - 1 - n - shift
    codes = codes % n if boundary == "periodic" else codes
    seen = np.bincount(codes[(codes >= 0) & (codes < n)], minlength=n)
    converter = TDC(w, boundary=boundary, **options)
    counts = image(np.bincount(times.astype(int), minlength=n))
    expected = converter(image(light / light.sum() * times.size)).flatten().numpy()
    drawn = converter.sample(counts, torch.Generator().manual_seed(0)).flatten().numpy()
    for found in (seen, drawn):
        z = (found - expected) / np.sqrt(np.maximum(expected, 1))
        assert np.abs(z).max() < 4.5
    assert np.array_equal(drawn, drawn.round())
    if boundary == "periodic":
        assert drawn.sum() == times.size


def test_dither_draws_whole_counts():
    """One detection gets one code: the next one for half of them, and never half a count."""
    x = image(torch.tensor([0.0, 5, 0, 1, 0, 0, 7, 0])).expand(4000, 1, 8, 1, 1)
    converter = TDC(torch.ones(8), dither=True, grad="straight_through")
    y = converter(x, generator=torch.Generator().manual_seed(1))
    assert torch.equal(y, y.round()) and torch.equal(y.sum(-3), x.sum(-3))
    later = y[:, 0, 7, 0, 0]
    # binomial(7, 1/2): standard errors of mean and variance over 4000 draws
    assert abs(float(later.mean()) - 3.5) < 5 * (1.75 / 4000) ** 0.5
    assert abs(float(later.var()) - 1.75) < 5 * 1.75 * (2 / 4000) ** 0.5
    # means stay means, and light in front of a detector is never drawn
    assert torch.equal(converter.sample(0.3 * x), converter.expected(0.3 * x))
    light = TDC(torch.ones(8), dither=True, acts_on="rates", grad="straight_through")
    assert torch.equal(light(x), converter.expected(x)) and torch.equal(light.sample(x), converter.expected(x))


def test_codes_that_do_not_fill_the_window_have_ends():
    x = image(torch.ones(24))
    assert float(TDC(torch.full((24,), 0.9))(x).sum()) == pytest.approx(0.9 * 24)
    assert not TDC(torch.full((24,), 0.9)).goes_round and TDC(widths().float()).goes_round


def test_ideal_converter_changes_nothing_and_widths_show_in_even_light():
    x = image(torch.rand(24, dtype=torch.float64))
    torch.testing.assert_close(TDC(torch.ones(24))(x), x)
    w = widths()
    converter = TDC(w)
    torch.testing.assert_close(converter(image(torch.ones(24))).flatten(), w)
    evened = TDC(w, sliding_scale=24)(image(torch.ones(24))).flatten()[4:-4]
    assert float((evened - 1).abs().max()) < 0.1 * float((w - 1).abs().max())


def test_a_sliding_scale_leaves_the_mean_of_the_non_linearity():
    """Light at one time, read with offsets of nominal steps: its mean code is off by the mean INL of the codes used."""
    steep = torch.tensor([1.0, 1.0, 1.3, 1.3, 0.9, 0.7, 0.8, 1.0], dtype=torch.float64)
    x = image([0.0, 1.0, 0, 0, 0, 0, 0, 0])
    codes = torch.arange(8, dtype=torch.float64).view(-1, 1, 1)
    # a bin spreads evenly over the codes that it meets: edges at 0 1 2 3.3 4.6 5.5 6.2 7.0
    by_hand = {1: 1.0, 2: 1.0, 4: 1 - (0.3 + 0.6) / 4, 5: 1 - (0.3 + 0.6 + 0.5) / 5}
    for offsets, mean in by_hand.items():
        y = TDC(steep, sliding_scale=offsets)(x)
        assert float((codes * y).sum()) == pytest.approx(mean, abs=1e-12)
