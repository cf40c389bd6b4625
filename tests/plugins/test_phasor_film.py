"""`phasor_hdr_film` by itself: which frequencies it keeps, sums of events against double precision, the adjoint."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.film_storage import storage
from support.marks import long_rows
from torchtransient import plugins
from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.plugins.films import phasor_sums

GRID = {"frequency_first": -0.4, "frequency_step": 0.11, "frequency_count": 37}
LIST = {"frequencies": "0, 3.7 -1.25, 0.5, 12.5"}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def make_film(width=1, height=1, **arguments):
    description = {"type": "phasor_hdr_film", "width": width, "height": height, "rfilter": {"type": "box"}, **arguments}
    with plugins.plugin_errors():
        return mi.load_dict(description)


# ------------------------------------------------------------------------------------------------- frequencies


def test_explicit_frequencies_in_any_form():
    expected = [0.0, 3.7, -1.25, 0.5, 12.5]
    assert make_film(**LIST).frequencies.tolist() == expected
    assert make_film(frequencies=mi.TensorXf(expected)).frequencies == pytest.approx(np.float32(expected))
    film = make_film(**GRID)
    np.testing.assert_array_equal(film.frequencies, -0.4 + 0.11 * np.arange(37))
    assert film.step == pytest.approx(0.11, rel=1e-12) and make_film(**LIST).step is None
    assert film.cube_shape() == (1, 1, 37, 6)


def test_a_list_that_is_a_grid_is_taken_as_one():
    assert make_film(frequencies="0.5 0.75 1.0").step == pytest.approx(0.25)
    assert make_film(frequencies="0.5 0.75 1.000001").step is None
    assert make_film(frequencies="7").step == 0.0


@pytest.mark.parametrize(
    "mean, sigma, bins, width, count",
    [(2.0, 1000.0, 400, 0.01, 3), (0.5, 0.25, 400, 0.01, 17), (1.0, 0.125, 100, 0.05, 26), (0.021, 1.0, 400, 0.01, 6)],
)
def test_bins_of_a_transform(mean, sigma, bins, width, count):
    film = make_film(wl_mean=mean, wl_sigma=sigma, temporal_bins=bins, bin_width_opl=width)
    window = bins * width
    low, high = window / mean - window / (2 * sigma), window / mean + window / (2 * sigma)
    first, last = max(0, int(np.floor(low))), min(bins // 2, int(np.ceil(high)))
    assert len(film.frequencies) == count
    np.testing.assert_allclose(film.frequencies, np.fft.fftfreq(bins, width)[first : last + 1], rtol=1e-14)


def test_defaults_are_the_peers():
    film = make_film()
    window = 4096 * 0.003
    np.testing.assert_allclose(film.frequencies, np.array([0, 1]) / window)
    assert film.start_opl == 0.0


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"frequencies": "1, two"}, "expected numbers"),
        ({"frequencies": ""}, "at least one"),
        ({"frequencies": "nan"}, "finite"),
        ({"frequencies": "1", "wl_mean": 2.0}, "exclude each other"),
        ({"frequencies": "1", "temporal_bins": 10}, "exclude each other"),
        ({"frequency_first": 1.0}, "is missing"),
        ({**GRID, "frequency_count": 0}, "at least 1"),
        ({"wl_mean": -1.0}, "wl_mean"),
        ({"wl_sigma": 0.0}, "wl_sigma"),
        ({"wl_mean": 0.001}, "shortest wavelength"),
        ({"temporal_bins": 0}, "temporal_bins"),
        ({"frequencies": "1", "start_opl": float("inf")}, "start_opl"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(SceneError, match=message):
        make_film(**arguments)


def test_unknown_parameters_are_reported():
    with pytest.raises(RuntimeError, match="temporal_filter"):
        make_film(temporal_filter="tent")


# ------------------------------------------------------------------------------------------------------ sums


class Copies:
    """Channels that are the values themselves."""

    def to_channels(self, value):
        return value


class Job:
    """One pass over some rows of a film."""

    def __init__(self, first_row, rows, spp):
        self.band, self.first_row, self.rows, self.spp = 0, first_row, rows, spp


def random_events(paths, events, channels, rng, far=40.0):
    """Path lengths (events, paths) and values (events, channels, paths); a third of the events does not exist."""
    opl = rng.uniform(0, far, (events, paths))
    value = rng.normal(size=(events, channels, paths))
    return opl, value, rng.random((events, paths)) > 0.33


def exact_sums(frequencies, opl, value, active, pixels, slope=None):
    """Phasors (pixels, F, C) in double precision."""
    kernel = np.exp(-2j * np.pi * frequencies[:, None, None] * opl) * active
    total = np.einsum("fen,ecn->fcn", kernel, value)
    if slope is not None:
        total += np.einsum("fen,ecn->fcn", -2j * np.pi * frequencies[:, None, None] * kernel, slope)
    return total.reshape(len(frequencies), value.shape[1], pixels, -1).sum(-1).transpose(2, 0, 1)


def summed(film, job, opl, value, active, slope=None):
    """What the film's block makes of these events: (pixels of the pass, F, C)."""
    film.start_render()
    width, channels = int(film.crop_size()[0]), film.channel_count()
    paths = width * job.rows * job.spp
    pixel = dr.arange(mi.UInt32, paths) // job.spp + job.first_row * width
    base = pixel * film.entries_per_pixel()
    block = film.create_event_block(job, base, Copies(), len(opl), tangents=slope is not None)
    events = block.begin()
    for e in range(len(opl)):
        v = [mi.Float(value[e, c]) for c in range(channels)]
        if slope is None:
            block.put(events, mi.Float64(opl[e]), v, mi.Bool(active[e]))
        else:
            s = [mi.Float(slope[e, c]) for c in range(channels)]
            block.put_slope(events, mi.Float64(opl[e]), v, s, mi.Bool(active[e]))
    block.end(events)
    block.finish()
    flat = np.array(film.bands[0][2], dtype=np.float64).reshape(-1, film.frequency_count(), channels, 2)
    result = flat[..., 0] + 1j * flat[..., 1]
    window = slice(job.first_row * width, (job.first_row + job.rows) * width)
    assert not np.delete(result, np.arange(window.start, window.stop), axis=0).any()
    return result[window]


SUMS = [(GRID, 150), (LIST, 64), ({"frequencies": "0.7"}, 3)]


@pytest.mark.parametrize(("frequencies", "spp"), long_rows(SUMS, SUMS[:1]), ids=["grid", "list", "single"])
def test_sums_of_events(frequencies, spp):
    """More samples than one thread sums up, rows in the middle of a film, events that do not exist."""
    film, rng = make_film(3, 4, **frequencies), np.random.default_rng(spp)
    job, events = Job(1, 2, spp), 7
    opl, value, active = random_events(6 * spp, events, 3, rng)
    found = summed(film, job, opl, value, active)
    expected = exact_sums(film.frequencies, opl, value, active, 6)
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.sqrt(spp * events) * np.abs(value).max())


@pytest.mark.slow
@pytest.mark.parametrize("tangents", [False, True], ids=["values", "tangents"])
def test_paths_with_more_events_than_fit(monkeypatch, tangents):
    """What exceeds the memory of a path is added event by event, with the same result."""
    film, rng = make_film(2, 1, **GRID), np.random.default_rng(1)
    opl, value, active = random_events(10, 9, 3, rng)
    slope = rng.normal(size=value.shape) if tangents else None
    roomy = summed(film, Job(0, 1, 5), opl, value, active, slope)
    monkeypatch.setattr(phasor_sums, "MAX_EVENTS", 4)
    block = film.create_event_block(Job(0, 1, 5), mi.UInt32(0), Copies(), 9, tangents)
    assert block.slots == 4 and block.overflows
    tight = summed(film, Job(0, 1, 5), opl, value, active, slope)
    scale = np.abs(roomy).max()
    np.testing.assert_allclose(tight, roomy, atol=2e-6 * scale)
    np.testing.assert_allclose(tight, exact_sums(film.frequencies, opl, value, active, 2, slope), atol=5e-6 * scale)


def test_tangents():
    """Forward mode writes ``k df + f k' dtau``."""
    film, rng = make_film(2, 2, **GRID), np.random.default_rng(2)
    opl, value, active = random_events(4 * 9, 5, 3, rng)
    slope = rng.normal(size=value.shape)
    found = summed(film, Job(0, 2, 9), opl, value, active, slope)
    expected = exact_sums(film.frequencies, opl, value, active, 4, slope)
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())


def test_zero_contributions_take_no_room():
    film = make_film(1, 1, **LIST)
    film.start_render()
    block = film.create_event_block(Job(0, 1, 2), mi.UInt32(0, 0), Copies(), 4)
    events = block.begin()
    block.put(events, mi.Float64(1.0), [mi.Float(0), mi.Float(0), mi.Float(0, 1)], mi.Bool(True))
    block.put(events, mi.Float64(1.0), [mi.Float(1)] * 3, mi.Bool(False, True))
    assert np.array(events["count"]).tolist() == [0, 2]


# --------------------------------------------------------------------------------------------------- adjoint


def put_directly(film, pixel, opl, value, active):
    cube = storage(film, (int(pixel.max()) + 1) * film.entries_per_pixel())
    base = mi.UInt32(pixel) * film.entries_per_pixel()
    film.put(0, base, mi.Float64(opl), [mi.Float(v) for v in value], mi.Bool(active))
    return np.array(cube, dtype=np.float64)


@pytest.mark.parametrize("layout", ["film", "channels first"])
def test_read_is_the_transpose_of_put(layout):
    film, rng = make_film(**LIST), np.random.default_rng(3)
    n, pixels, F = 500, 4, film.frequency_count()
    pixel, opl = rng.integers(0, pixels, n), rng.uniform(0, 30, n)
    pixel[0] = pixels - 1
    value, active = rng.normal(size=(3, n)), rng.random(n) > 0.1
    g = rng.normal(size=(pixels, F, 6)).astype(np.float32)
    stored = g if layout == "film" else np.ascontiguousarray(g.transpose(2, 1, 0))
    flat = mi.Float(stored.ravel())
    strides, base = ((6, 1), pixel * 6 * F) if layout == "film" else ((pixels, F * pixels), pixel)
    A, _ = film.read((flat, *strides), mi.UInt32(base), mi.Float64(opl), mi.Bool(active))
    left = (put_directly(film, pixel, opl, value, active) * g.ravel()).sum()
    right = sum((np.array(a, dtype=np.float64) * v).sum() for a, v in zip(A, value, strict=True))
    assert left == pytest.approx(right, abs=2e-5 * np.sqrt(n * F))
    assert all(np.all(np.array(a)[~active] == 0) for a in A)


def test_slope_of_the_adjoint():
    """The derivative of A in the path length, against the formula in double precision."""
    film, rng = make_film(**LIST), np.random.default_rng(4)
    opl, g = rng.uniform(0, 30, 200), rng.normal(size=(film.frequency_count(), 3, 2)).astype(np.float32)
    A, slope = film.read((mi.Float(g.ravel()), 6, 1), mi.UInt32(0), mi.Float64(opl), mi.Bool(True))
    ν = film.frequencies[:, None, None]
    kernel = np.exp(-2j * np.pi * ν * opl)
    weight = (g[..., 0] - 1j * g[..., 1])[..., None]
    np.testing.assert_allclose(np.array(A), (weight * kernel).real.sum(0), atol=2e-5)
    expected = (weight * (-2j * np.pi * ν) * kernel).real.sum(0)
    np.testing.assert_allclose(np.array(slope), expected, atol=2e-6 * np.abs(expected).max())


def test_defaults_that_nobody_asked_for_are_said():
    with pytest.warns(TorchTransientWarning, match=r"no frequencies are given.*mitransient's defaults, .* cycles per"):
        mi.load_dict({"type": "phasor_hdr_film"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.load_dict({"type": "phasor_hdr_film", "wl_mean": 100.0})
        mi.load_dict({"type": "phasor_hdr_film", "frequencies": "0.5"})


# ---------------------------------------------------------------------------------------------- pieces of the sums


def test_events_of_any_channel_and_sign_take_room():
    film = make_film(1, 1, **LIST)
    film.start_render()
    block = film.create_event_block(Job(0, 1, 5), mi.UInt32(0), Copies(), 4)
    events = block.begin()
    rows = [[1, 0, 0, -1, 0], [0, 2, 0, 0, 0], [0, 0, -3, 0, 0]]
    block.put(events, mi.Float64(1.0), [mi.Float(row) for row in rows], mi.Bool(True))
    assert np.array(events["count"]).tolist() == [1, 1, 1, 1, 0]


@pytest.mark.slow
@pytest.mark.parametrize(("frequencies", "tangents", "block", "sizes"), [
    (GRID, False, 48, 16), (GRID, True, 48, 8), (LIST, False, 48, 5), (GRID, False, 2, 1), (GRID, False, 99, 16),
])  # fmt: skip
def test_frequencies_of_one_thread(monkeypatch, frequencies, tangents, block, sizes):
    """As many as there is room for sums, 16 at most, one at least, and no more than there are."""
    made, original = [], phasor_sums.FrequencyBlock

    def noting(film, start, size):
        made.append(size)
        return original(film, start, size)

    monkeypatch.setattr(phasor_sums, "FrequencyBlock", noting)
    monkeypatch.setattr(phasor_sums, "BLOCK", block)
    film, rng = make_film(**frequencies), np.random.default_rng(3)
    opl, value, active = random_events(2, 2, 3, rng)
    slope = rng.normal(size=value.shape) if tangents else None
    found = summed(film, Job(0, 1, 2), opl, value, active, slope)
    expected = exact_sums(film.frequencies, opl, value, active, 1, slope)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert made == [sizes]


def test_sums_of_a_band_that_is_not_the_first(monkeypatch):
    """Rows of a pass are counted from the first of the band."""
    monkeypatch.setattr("torchtransient.plugins.films.base.MAX_ARRAY_ENTRIES", 2 * 3 * 30)
    film = make_film(3, 5, **LIST)
    film.start_render()
    assert [(first, rows) for first, rows, _ in film.bands] == [(0, 2), (2, 2), (4, 1)]
    job = Job(3, 1, 2)
    job.band = 1
    block = film.create_event_block(job, mi.UInt32(0), Copies(), 1)
    events = block.begin()
    block.put(events, mi.Float64(0.0), [mi.Float([1, 2, 3, 4, 5, 6])] * 3, mi.Bool(True))
    block.end(events)
    block.finish()
    found = [np.array(flat).reshape(-1, 3, 5, 3, 2) for _, _, flat in film.bands]
    assert not found[0].any() and not found[1][0].any() and not found[2].any()
    assert (found[1][1, ..., 0] == np.array([3, 7, 11])[:, None, None]).all() and not found[1][..., 1].any()
