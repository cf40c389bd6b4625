"""`transient_hdr_film` by itself: how arrivals spread over bins, how the adjoint reads them back, parameters and
layout.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import erf

from support.film_storage import storage
from torchtransient import plugins
from torchtransient.errors import SceneError

SLOPED = [("tent", 0.5), ("gaussian", 0.5), pytest.param("gaussian", 3.0, marks=pytest.mark.slow)]
FILTERS = [("box", 0.5), *SLOPED]
BINS, WIDTH, START = 40, 0.25, 2.0


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def make_film(**arguments):
    description = {
        "type": "transient_hdr_film",
        "width": 1,
        "height": 1,
        "rfilter": {"type": "box"},
        "temporal_bins": BINS,
        "bin_width_opl": WIDTH,
        "start_opl": START,
        **arguments,
    }
    with plugins.plugin_errors():
        return mi.load_dict(description)


def exact_weights(name, stddev, x):
    """Weight of every bin (rows) for arrivals ``x`` in bins, in double precision."""
    edges = np.arange(BINS + 1)[:, None]
    u = edges - x[None]
    if name == "box":
        return ((u[:-1] <= 0) & (u[1:] > 0)).astype(float)
    if name == "tent":
        return np.maximum(0, 1 - np.abs(u[:-1] + 0.5))
    limit = 4 * stddev
    cdf = 0.5 + 0.5 * erf(np.clip(u, -limit, limit) / (stddev * np.sqrt(2))) / erf(4 / np.sqrt(2))
    return np.diff(cdf, axis=0)


def put_each(film, x, value=1.0):
    """Every arrival ``x`` (in bins) in a pixel of its own: histograms (n, T, C) and the fractions before and after."""
    n, channels = len(x), film.channel_count()
    cube = storage(film, n * film.entries_per_pixel())
    base = dr.arange(mi.UInt32, n) * film.entries_per_pixel()
    before, after = film.put(0, base, mi.Float64(x * WIDTH), [mi.Float(value)] * channels, mi.Bool(True))
    dr.eval(cube, before, after)  # in one kernel
    return np.array(cube, dtype=float).reshape(n, BINS, channels), np.array(before), np.array(after)


def arrivals(n=400, margin=16.0):
    return np.random.default_rng(5).uniform(-margin, BINS + margin, n)


@pytest.mark.parametrize("name, stddev", FILTERS)
def test_weights_are_those_of_the_filter(name, stddev):
    x = arrivals()
    cube, _, _ = put_each(make_film(temporal_filter=name, gaussian_stddev=stddev), x)
    # erf in single precision
    np.testing.assert_allclose(cube, np.repeat(exact_weights(name, stddev, x).T[..., None], 3, -1), atol=5e-7)


@pytest.mark.parametrize("name, stddev", FILTERS)
def test_stored_and_lost_make_one(name, stddev):
    cube, before, after = put_each(make_film(temporal_filter=name, gaussian_stddev=stddev), arrivals())
    np.testing.assert_allclose(cube.sum(1) + (before + after)[:, None], 1, atol=1e-6)
    deep = (arrivals() > 12) & (arrivals() < BINS - 12)
    assert deep.sum() > 50 and np.all(before[deep] == 0) and np.all(after[deep] == 0)
    early, late = arrivals() < -13, arrivals() > BINS + 13
    assert early.any() and late.any()
    np.testing.assert_allclose(before[early], 1, atol=1e-6)
    np.testing.assert_allclose(after[late], 1, atol=1e-6)
    assert np.all(cube[early | late] == 0)


@pytest.mark.parametrize(
    ("name", "stddev", "layout"),
    [("box", 0.5, "film"), ("tent", 0.5, "channels first"), ("gaussian", 0.5, "film")],
)
def test_read_is_the_transpose_of_put(name, stddev, layout):
    film = make_film(temporal_filter=name, gaussian_stddev=stddev)
    rng = np.random.default_rng(1)
    n, pixels = 700, 5
    x, pixel = rng.uniform(-8, BINS + 8, n), rng.integers(0, pixels, n)
    value, g = rng.normal(size=(3, n)), rng.normal(size=(pixels, BINS, 3))
    active = mi.Bool(rng.random(n) > 0.1)
    opl = mi.Float64(x * WIDTH)
    cube = storage(film, pixels * BINS * 3)
    film.put(0, mi.UInt32(pixel) * (BINS * 3), opl, [mi.Float(v) for v in value], active)
    if layout == "film":
        adjoint, base = (mi.Float(g.ravel()), 3, 1), mi.UInt32(pixel) * (BINS * 3)
    else:  # (C, T, pixels), as a torch gradient comes
        adjoint, base = (mi.Float(g.transpose(2, 1, 0).ravel()), pixels, BINS * pixels), mi.UInt32(pixel)
    A, _ = film.read(adjoint, base, opl, active)
    dr.eval(cube, A)
    stored = np.array(cube, dtype=float).reshape(g.shape)
    read = sum((np.array(A[c], dtype=float) * value[c] * np.array(active)).sum() for c in range(3))
    scale = np.abs(stored * g).sum()
    assert abs((stored * g).sum() - read) < 1e-6 * scale


@pytest.mark.parametrize("name, stddev", SLOPED)
def test_slope_is_the_derivative_of_what_is_read(name, stddev):
    film = make_film(temporal_filter=name, gaussian_stddev=stddev)
    rng = np.random.default_rng(2)
    x, h = rng.uniform(-4, BINS + 4, 600), 0.02
    # away from the kinks of the tent
    x = x[np.abs((x - 0.5) % 1.0 - 0.5) < 0.5 - 1.5 * h]
    adjoint = (mi.Float(rng.normal(size=BINS * 3)), 3, 1)

    def read(shift):
        A, slope = film.read(adjoint, mi.UInt32(0), mi.Float64((x + shift) * WIDTH), mi.Bool(True))
        dr.eval(A, slope)
        return [np.array(v, dtype=float) for v in A], [np.array(v, dtype=float) for v in slope]

    _, slope = read(0)
    near, far = [
        [(a - b) / (2 * s * h * WIDTH) for a, b in zip(read(s * h)[0], read(-s * h)[0], strict=True)] for s in (0.5, 1)
    ]
    for c in range(3):
        # the cut of the gaussian at four standard deviations is a kink of exp(-8) of its height
        np.testing.assert_allclose(slope[c], (4 * near[c] - far[c]) / 3, atol=2e-3 * np.abs(slope[c]).max())


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"temporal_bins": 0}, "temporal_bins"),
        ({"bin_width_opl": float("inf")}, "bin_width_opl"),
        ({"start_opl": float("nan")}, "start_opl"),
        ({"temporal_filter": "triangle"}, "box, tent, gaussian"),
        ({"temporal_filter": "gaussian", "gaussian_stddev": 0.0}, "gaussian_stddev"),
        ({"exhaustive_scan": True}, "laser_scan_width"),
    ],
)
def test_bad_parameters(arguments, words):
    with pytest.raises(SceneError, match=words):
        make_film(**arguments)


