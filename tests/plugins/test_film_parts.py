"""The pieces of films by themselves: windows, temporal filters, what is declared and refused."""

from __future__ import annotations

import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import erf

from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.plugins.films.pulsed_filter import PulsedFilter
from torchtransient.plugins.films.temporal_filter import BoxFilter, GaussianFilter
from torchtransient.plugins.films.window import GappedWindow
from torchtransient.pulses import Pulse

KINDS = {
    "transient_hdr_film": {"temporal_bins": 4, "bin_width_opl": 1.0},
    "phasor_hdr_film": {"frequencies": "0 1"},
    "gated_hdr_film": {"gates": "rectangular 1 2"},
}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def make(kind, **changes):
    return mi.load_dict({"type": kind, "width": 2, "height": 3, **KINDS[kind], **changes})


# --------------------------------------------------------------------------------------------------------- windows


def test_cells_of_a_window_are_half_open():
    window = GappedWindow(2.0, 4.0, [1, 0, 1, 1])
    below = np.nextafter
    places = [1.9, below(2.0, 0), 2.0, below(2.5, 0), 2.5, below(3.0, 0), 3.0, below(4.0, 0), 4.0, 9.0]
    wanted = [False, False, True, True, False, False, True, True, False, False]
    assert list(window.counts(mi.Float64(places))) == wanted
    assert list(window.over(mi.Float64(places))) == [False] * 8 + [True, True]


def test_the_last_arrival_of_a_window_is_in_its_last_cell():
    """Also where its place, in cells, is rounded up to their number."""
    rounded = 0
    for count in (3, 5, 7, 10):
        for last in np.linspace(0.11, 3.7, 60):
            opl = np.nextafter(last, 0)
            rounded += opl * (count / last) >= count
            window = GappedWindow(0.0, last, [0] * (count - 1) + [1])
            assert list(window.counts(mi.Float64([opl]))) == [True]
    assert rounded > 10


# --------------------------------------------------------------------------------------------------------- filters


@pytest.mark.parametrize("stddev", [0.3, 0.7, 1.9])
def test_weights_and_slopes_of_a_gaussian(stddev):
    """Of the box of a bin, under a Gaussian that is cut at four standard deviations and rescaled."""
    x = np.array([5.0, 5.13, 5.5, 5.94])
    base, taps = GaussianFilter(stddev).weights(mi.Float64(x))
    assert np.array_equal(base, [5, 5, 5, 5])
    total = erf(4 / math.sqrt(2))

    def below(u):
        return np.clip(0.5 + 0.5 * erf(u / (stddev * math.sqrt(2))) / total, 0, 1)

    def height(u):
        inside = np.exp(-(u**2) / (2 * stddev**2)) / (stddev * math.sqrt(2 * math.pi) * total)
        return np.where(np.abs(u) < 4 * stddev, inside, 0)

    for k, weight, slope in taps:
        low, high = k - (x - 5), k + 1 - (x - 5)
        assert np.asarray(weight) == pytest.approx(below(high) - below(low), abs=4e-7)
        assert np.asarray(slope) == pytest.approx(height(low) - height(high), rel=1e-5, abs=4e-7 / stddev)
    assert sum(np.asarray(weight) for _, weight, _ in taps) == pytest.approx(np.ones(4), abs=1e-6)


@pytest.mark.parametrize("bins", [1, 2, 3])
@pytest.mark.parametrize("late", [-2, 0, 4])
def test_a_pulse_of_whole_bins_reaches_so_many_and_one_more(bins, late):
    """Of an arrival anywhere in a bin."""
    spread = PulsedFilter(BoxFilter(), [Pulse.rectangular(bins * 0.5, (late + bins / 2) * 0.5)], 0.5)
    assert (spread.first, spread.first + spread.count) == (late, late + bins + 1)
    assert spread.reach == (late, late + bins + 1)


# ------------------------------------------------------------------------------------------------- what is declared


@pytest.mark.parametrize("kind", ["transient_hdr_film", "gated_hdr_film"])
@pytest.mark.parametrize("exclusive", [False, True])
def test_lanes_are_alone_where_that_is_said(kind, exclusive):
    block = make(kind).create_event_block(SimpleNamespace(band=0), mi.UInt32([0, 0]), None, 1, exclusive=exclusive)
    assert block.exclusive is exclusive


@pytest.mark.parametrize("kind", ["transient_hdr_film", "gated_hdr_film"])
def test_adjoints_are_read_one_by_one_unless_a_film_says_otherwise(kind):
    block = make(kind).create_adjoint_block(None, None, [mi.Float(0)], None)
    assert block.together(3, False) == block.together(3, True) == 0
    with pytest.raises(NotImplementedError):
        block.read_together([mi.Float64(1)], False, mi.Bool(True))


@pytest.mark.parametrize("most", [1, 6])
def test_paths_of_a_phasor_film_fit_the_memory_of_their_events(most):
    """A length of eight bytes and a number of four for each channel, of every event of a path."""
    for variant, channels in (("llvm_ad_mono", 1), ("llvm_ad_rgb", 3)):
        mi.set_variant(variant)
        plugins.sync()
        # of the variant
        from torchtransient.plugins.films.phasor import MAX_EVENT_BYTES
        from torchtransient.plugins.films.phasor_events import slots_for

        lanes = make("phasor_hdr_film").lanes_at_most(most)
        path = slots_for(most) * (8 + 4 * channels)
        assert lanes * path <= MAX_EVENT_BYTES < (lanes + 1) * path


def test_frequencies_that_are_given_twice_are_named():
    with pytest.raises(Exception, match=r"phasor_hdr_film: frequencies and wl_mean, wl_sigma exclude each other"):
        make("phasor_hdr_film", wl_mean=0.5, wl_sigma=0.1)
    with pytest.raises(Exception, match=r"phasor_hdr_film: frequencies and frequency_step exclude each other"):
        make("phasor_hdr_film", frequency_step=0.5)


def test_an_image_that_was_not_begun():
    for kind in KINDS:
        for call in (lambda film: film.create_block(), lambda film: film.put_block(None)):
            with pytest.raises(SceneError, match=rf"{kind}: expected an image that was begun, prepare\(aovs\)"):
                call(make(kind))


def test_what_was_scheduled_is_evaluated():
    film = make("transient_hdr_film")
    film.start_render(4)
    film.steady += mi.Float(dr.arange(mi.Float, dr.width(film.steady)))
    assert film.steady.state == dr.VarState.Unevaluated
    film.schedule_storage()
    dr.eval()
    assert film.steady.state == dr.VarState.Evaluated
    without = make("transient_hdr_film", steady=False)
    without.start_render(4)
    without.schedule_storage()
