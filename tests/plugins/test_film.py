"""`transient_hdr_film` by itself: how filters, pulses and impulse responses spread arrivals over bins, how the adjoint
reads them back, and parameters.
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
from torchtransient.pulses import Pulse

VARIANT = "llvm_ad_rgb"
BINS, WIDTH, START = 60, 0.25, 2.0
FILTERS = {
    "box": {"temporal_filter": "box"},
    "tent": {"temporal_filter": "tent"},
    "gaussian": {"temporal_filter": "gaussian"},
    "wide gaussian": {"temporal_filter": "gaussian", "gaussian_stddev": 3.0},
}
MEASURED = {"pulse": "tabulated", "pulse_opl": "-0.2 0.1, 0.9", "pulse_values": "0 1 0"}
TABULATED = Pulse.tabulated([-0.2, 0.1, 0.9], [0, 1, 0])
LATE = {"pulse": "rectangular", "pulse_width_opl": 0.6, "pulse_center_opl": 1.27}
KERNELS = {
    "short gaussian": ({"pulse": "gaussian", "pulse_fwhm_opl": 0.2}, [Pulse.gaussian(0.2)]),
    "long gaussian": ({"irf": "gaussian", "irf_fwhm_opl": 1.5}, [Pulse.gaussian(1.5)]),
    "box, late": (LATE, [Pulse.rectangular(0.6, 1.27)]),
    "measured": (MEASURED, [TABULATED]),
    "both": ({**MEASURED, "irf": "gaussian", "irf_fwhm_opl": 0.5}, [TABULATED, Pulse.gaussian(0.5)]),
    "far shorter than a bin": ({"pulse": "gaussian", "pulse_fwhm_opl": 0.01}, [Pulse.gaussian(0.01)]),
    "measured, tent": (MEASURED | FILTERS["tent"], [TABULATED, Pulse.rectangular(WIDTH)]),
    "measured, gaussian": (MEASURED | FILTERS["gaussian"], [TABULATED, Pulse.gaussian(0.5 * 2.35482 * WIDTH)]),
}


def make_film(temporal_filter="box", **arguments):
    film = {
        "type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "temporal_bins": BINS,
        "bin_width_opl": WIDTH, "start_opl": START, "temporal_filter": temporal_filter, **arguments,
    }  # fmt: skip
    with plugins.plugin_errors():
        return mi.load_dict(film)


def filter_weights(name, stddev, x):
    """Weight of every bin (rows) for arrivals ``x`` in bins, in double precision."""
    u = np.arange(BINS + 1)[:, None] - x[None]
    if name == "box":
        return ((u[:-1] <= 0) & (u[1:] > 0)).astype(float)
    if name == "tent":
        return np.maximum(0, 1 - np.abs(u[:-1] + 0.5))
    limit = 4 * stddev
    cdf = 0.5 + 0.5 * erf(np.clip(u, -limit, limit) / (stddev * np.sqrt(2))) / erf(4 / np.sqrt(2))
    return np.diff(cdf, axis=0)


def convolved_weights(pulses, x):
    """Mass of every bin (n, T) by brute force: the later pulses as many delayed copies of the first one."""
    first, *rest = pulses
    shifts, shares = np.zeros(1), np.ones(1)
    for pulse in rest:
        nodes = np.linspace(*pulse.support_opl, 161)
        shifts = (shifts[:, None] + 0.5 * (nodes[1:] + nodes[:-1])).ravel()
        shares = (shares[:, None] * np.diff(pulse.cumulative(nodes))).ravel()
    edges = np.arange(BINS + 1) * WIDTH
    total = np.zeros((len(x), BINS))
    for shift, share in zip(shifts, shares, strict=True):
        total += share * np.diff(first.cumulative(edges - shift - (x * WIDTH)[:, None]), axis=1)
    return total


def put_each(film, x):
    """Every arrival ``x`` (in bins) in a pixel of its own: histograms (n, T, C) and the fractions before and after."""
    n, channels = len(x), film.channel_count()
    cube = storage(film, n * film.entries_per_pixel())
    base = dr.arange(mi.UInt32, n) * film.entries_per_pixel()
    before, after = film.put(0, base, mi.Float64(x * WIDTH), [mi.Float(1)] * channels, mi.Bool(True))
    dr.eval(cube, before, after)  # in one kernel
    return np.array(cube, dtype=float).reshape(n, BINS, channels), np.array(before), np.array(after)


def arrivals(n=400, margin=20.0):
    return np.random.default_rng(5).uniform(-margin, BINS + margin, n)


@pytest.mark.parametrize("name", FILTERS)
def test_weights_are_those_of_the_filter(name):
    x, filter_ = arrivals(), FILTERS[name]
    cube, _, _ = put_each(make_film(**filter_), x)
    expected = filter_weights(filter_["temporal_filter"], filter_.get("gaussian_stddev", 0.5), x)
    # erf in single precision
    np.testing.assert_allclose(cube, np.repeat(expected.T[..., None], 3, -1), atol=5e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_weights_are_those_of_the_convolution(kernel):
    """What is the same both ways round would not notice that it is mirrored: asymmetric ones with each filter."""
    settings, pulses = KERNELS[kernel]
    x = arrivals(40) if len(pulses) > 1 else arrivals(120)
    cube, _, _ = put_each(make_film(**settings), x)
    # linear between 2048 nodes; the brute force has 160 nodes a pulse
    np.testing.assert_allclose(cube[..., 1], convolved_weights(pulses, x), atol=2e-4)
    np.testing.assert_array_equal(cube[..., 0], cube[..., 2])


@pytest.mark.parametrize("settings", [*FILTERS.values(), KERNELS["long gaussian"][0], KERNELS["measured, tent"][0]])
def test_stored_and_lost_make_one(settings):
    x = arrivals()
    cube, before, after = put_each(make_film(**settings), x)
    np.testing.assert_allclose(cube.sum(1) + (before + after)[:, None], 1, atol=1e-6 if "irf" not in settings else 2e-6)
    deep, early, late = (x > 16) & (x < BINS - 16), x < -16, x > BINS + 16
    assert min(deep.sum(), early.sum(), late.sum()) > 10 and np.all(before[deep] == 0) and np.all(after[deep] == 0)
    np.testing.assert_allclose(before[early], 1, atol=1e-6)
    np.testing.assert_allclose(after[late], 1, atol=1e-6)
    assert np.all(cube[early | late] == 0)


@pytest.mark.parametrize(("name", "layout"), [("box", "film"), ("tent", "channels first"), ("gaussian", "film")])
def test_read_is_the_transpose_of_put(name, layout):
    film = make_film(**FILTERS[name])
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
    assert abs((stored * g).sum() - read) < 1e-6 * np.abs(stored * g).sum()


@pytest.mark.parametrize(
    "settings", [FILTERS["tent"], FILTERS["gaussian"], KERNELS["box, late"][0], KERNELS["both"][0]]
)
def test_slope_is_the_derivative_of_what_is_read(settings):
    film = make_film(**settings)
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
        if settings in FILTERS.values():
            # the cut of the gaussian at four standard deviations is a kink of exp(-8) of its height
            np.testing.assert_allclose(slope[c], (4 * near[c] - far[c]) / 3, atol=2e-3 * np.abs(slope[c]).max())
        else:  # differences of a pulse with kinks are off at the few arrivals that meet one
            error = np.abs(slope[c] - near[c])
            assert np.median(error) < 2e-2 and error.mean() < 0.05 * np.abs(near[c]).mean()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"temporal_bins": 0}, "temporal_bins"),
        ({"bin_width_opl": float("inf")}, "bin_width_opl"),
        ({"start_opl": float("nan")}, "start_opl"),
        ({"temporal_filter": "triangle"}, "box, tent, gaussian"),
        ({"temporal_filter": "gaussian", "gaussian_stddev": 0.0}, "gaussian_stddev"),
        ({"exhaustive_scan": True}, "laser_scan_width"),
        ({"pulse": "sech"}, "gaussian, rectangular, tabulated"),
        ({"pulse": "gaussian"}, "needs pulse_fwhm_opl"),
        ({"pulse": "tabulated", "pulse_opl": "0 one", "pulse_values": "1 1"}, "pulse_opl must be numbers"),
        ({"pulse": "rectangular", "pulse_width_opl": 2000.0}, "apply_pulse"),
    ],
)
def test_bad_parameters(arguments, words):
    with pytest.raises(SceneError, match=words):
        make_film(**arguments)
