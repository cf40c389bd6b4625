"""The pieces of films by themselves: windows, temporal filters, what is declared and refused."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import erf

from torchtransient import plugins
from torchtransient.errors import SceneError, StorageError
from torchtransient.plugins.films.block import AdjointBlock, FilmBlock, GappedWindow
from torchtransient.plugins.films.temporal_filters import BoxFilter, GaussianFilter, PulsedFilter
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


@pytest.mark.parametrize("stddev", [0.3, 0.5, 0.7, 1.9])
def test_weights_and_slopes_of_a_gaussian(stddev):
    """Of the box of a bin, under a Gaussian that is cut at four standard deviations and rescaled."""
    x = np.array([5.0, 5.13, 5.5, 5.94])
    base, taps = GaussianFilter(stddev).weights(mi.Float64(x))
    dr.eval(base, taps)  # in one kernel
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
        from torchtransient.plugins.films.phasor_sums import slots_for

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


# ----------------------------------------------------------------------------------------------------------- storage


def test_many_zeros_are_written_by_all_threads():
    """From 2^23 on, where a processor renders; fewer, and those of a graphics card, stay a literal until used."""
    from torchtransient.plugins.films import base

    assert base.zeros(mi.Float, 2**23 - 1).state == dr.VarState.Literal
    many = base.zeros(mi.Float64, 2**23)
    assert many.state == dr.VarState.Evaluated and type(many) is mi.Float64
    assert dr.width(many) == 2**23 and not dr.any(many != 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base.dr, "backend_v", lambda real: dr.JitBackend.CUDA)
        assert base.zeros(mi.Float, 2**23).state == dr.VarState.Literal


@pytest.mark.parametrize("kind", KINDS)
def test_sizes_of_storage(kind):
    """Rows of pixels of laser rows of laser columns; the steady image and what is outside have none of the laser."""
    lasers = {"exhaustive_scan": True, "laser_scan_width": 5, "laser_scan_height": 7}
    inner = {"transient_hdr_film": (4, 1), "phasor_hdr_film": (2, 2), "gated_hdr_film": (1, 1)}[kind]
    for settings, shape in (({}, ()), (lasers, (7, 5))):
        film = make(kind, **settings)
        assert film.cube_shape() == (3, 2, *shape, *inner)
        assert (film.laser_shape(), film.laser_count()) == (shape, math.prod(shape))
        assert film.entries_per_array() == math.prod(inner)
        assert film.entries_per_pixel() == math.prod((*shape, *inner))
        assert list(film.pixel_base(mi.UInt32(100), mi.UInt32(3))) == [100 + 3 * math.prod(inner)]
        film.start_render()
        bands = [(first, rows, dr.width(flat)) for first, rows, flat in film.bands]
        assert bands == [(0, 3, math.prod(film.cube_shape()))]
        assert dr.width(film.steady) == 6
        assert film.outside is None if kind != "transient_hdr_film" else dr.width(film.outside) == 12
        assert film.first_entry() is None


def test_a_row_may_have_as_many_values_as_indices_reach():
    """2^32 - 1 = 65535 x 65537."""
    film = {"type": "transient_hdr_film", "height": 3, "rfilter": {"type": "box"}}
    widest = mi.load_dict({**film, "width": 65535, "temporal_bins": 65537})
    assert widest.band_layout() == [(0, 1), (1, 1), (2, 1)] and widest.band_rows() == 1
    with pytest.raises(StorageError, match="one row of 65536 pixels with 65536 values each"):
        mi.load_dict({**film, "width": 65536, "temporal_bins": 65536}).band_layout()


def test_light_outside_is_counted_by_pixel():
    film = make("transient_hdr_film")
    film.start_render()
    film.add_outside(mi.UInt32([1, 5]), mi.Float([1, 2]), mi.Float([10, 20]))
    assert np.array(film.outside).reshape(6, 2).tolist() == [[0, 0], [1, 10], [0, 0], [0, 0], [0, 0], [2, 20]]
    film.add_steady(mi.UInt32([1, 5]), [mi.Float([3, 4])])
    film.finish_render()
    assert np.array(film.outside)[[2, 3, 10, 11]].tolist() == [1, 10, 2, 20]
    assert np.array(film.steady).tolist() == [0, 3, 0, 0, 0, 4]


@pytest.mark.parametrize("steady", [False, True])
def test_all_sums_in_double_precision_are_handed_over_in_single(steady):
    film = make("transient_hdr_film", steady=steady)
    film.start_render(2**16 + 1)
    assert type(film.band_array(0)) is type(film.steady) is mi.Float64
    dr.scatter_reduce(dr.ReduceOp.Add, film.band_array(0), mi.Float64([2, 3]), mi.UInt32([1, 22]))
    film.add_outside(mi.UInt32(4), mi.Float(5), mi.Float(7))
    film.add_steady(mi.UInt32(0), [mi.Float(2)])
    film.finish_render()
    assert type(film.band_array(0)) is type(film.steady) is mi.Float
    assert np.flatnonzero(np.array(film.band_array(0))).tolist() == [1, 22]
    # a film without a steady image has the sum over its bins
    assert np.array(film.steady).tolist() == ([2, 0, 0, 0, 0, 0] if steady else [2, 0, 0, 0, 0, 3])
    assert film.outside is None if not steady else type(film.outside) is mi.Float
    assert film.energies_outside() == ((5, 7) if steady else (0, 0))


def test_bands_are_summed_up_to_the_rows_where_they_are(monkeypatch):
    from torchtransient.plugins.films import base

    mi.set_variant("llvm_ad_rgb")
    plugins.sync()
    film = make("transient_hdr_film", steady=False)
    monkeypatch.setattr(base, "MAX_ARRAY_ENTRIES", 2 * 2 * film.entries_per_pixel())
    values = np.arange(1.0, 73.0).reshape(3, 2, 4, 3) ** 2
    film.start_render()
    assert [(first, rows) for first, rows, _ in film.bands] == [(0, 2), (2, 1)]
    film.adopt_storage([film.steady, None, mi.Float(values[:2].ravel()), mi.Float(values[2:].ravel())])
    film.finish_render()
    np.testing.assert_array_equal(np.array(film.steady).reshape(3, 2, 3), values.sum(2))


def test_films_that_are_made_out_of_ours_may_store_elsewhere():
    from torchtransient.plugins.films.histogram import TransientHDRFilm

    class Other(TransientHDRFilm):
        pass

    mi.register_film("other_histogram", Other)
    other = mi.load_dict({"type": "other_histogram", "width": 2, "height": 3, "temporal_bins": 4})
    assert make("transient_hdr_film").can_borrow(1) and not other.can_borrow(1)


@pytest.mark.parametrize("size", [(0, 4), (4, 0), (0, 0)])
def test_lasers_of_an_exhaustive_scan(size):
    width, height = size
    with pytest.raises(Exception, match=rf"at least 1, got {width} x {height}"):
        make("transient_hdr_film", exhaustive_scan=True, laser_scan_width=width, laser_scan_height=height)
    if max(size):
        with pytest.raises(Exception, match="have no effect without exhaustive_scan"):
            make("transient_hdr_film", laser_scan_width=width, laser_scan_height=height)
    film = make("transient_hdr_film", exhaustive_scan=True, laser_scan_width=1, laser_scan_height=1, temporal_bins=1)
    assert film.cube_shape() == (3, 2, 1, 1, 1, 1)


@pytest.mark.parametrize(("kind", "names"), [
    ("transient_hdr_film", {"temporal_bins": 4, "bin_width_opl": 1.0, "start_opl": 0.5}),
    ("phasor_hdr_film", {"start_opl": 0.5}),
])  # fmt: skip
def test_settings_of_a_film_are_seen(kind, names):
    seen = mi.traverse(make(kind, start_opl=0.5))
    assert {name: seen[name] for name in names} == names


# ----------------------------------------------------------------------------------------------------- pixel filters


def test_offsets_are_drawn_as_the_filter_is_high():
    """Of a tent of radius 1.5, whose integral is 1.5: the weights are one, and quantiles are those of a triangle."""
    film = make("transient_hdr_film", rfilter={"type": "tent", "radius": 1.5})
    u = np.array([[0.5, 0.125], [0.125, 0.875], [0.32, 0.5]])
    offset, weight = film.sample_offset(mi.Point2f(*u.T))
    expected = np.where(u < 0.5, -1.5 * (1 - np.sqrt(2 * u)), 1.5 * (1 - np.sqrt(2 * (1 - u))))
    np.testing.assert_allclose(np.array(offset).T, expected, atol=1e-3)
    np.testing.assert_allclose(np.array(weight), 1, rtol=1e-3)
    distribution, integral = film._offset_distribution
    density = np.array(distribution.pdf)
    np.testing.assert_allclose(density, np.maximum(1 - np.abs(np.linspace(-1, 1, 513)), 1e-4), atol=1e-6)
    # a floor of 1e-4 of the highest where the filter is zero
    assert density.min() == pytest.approx(1e-4, rel=1e-5) and integral == 1.5
    film.tabulate_filter()
    assert film._offset_distribution[0] is distribution


def test_offsets_of_a_box_are_even_and_need_no_table():
    film = make("transient_hdr_film", rfilter={"type": "box"})
    offset, weight = film.sample_offset(mi.Point2f(0.75, 0.125))
    film.tabulate_filter()
    assert np.array(offset).ravel().tolist() == [0.25, -0.375] and weight is None
    assert film._offset_distribution is None


def filter_of(height, radius=1.0):
    """A reconstruction filter of one's own."""
    return SimpleNamespace(
        is_box_filter=lambda: False, radius=lambda: radius, class_name=lambda: "Own", eval=lambda x: height(x)
    )


def test_filters_that_are_not_zero_at_their_ends():
    """The integral of 3 + x over [-1, 1] is 6, exactly."""
    film = make("transient_hdr_film")
    film.rfilter = lambda: filter_of(lambda x: 3 + x)
    film.tabulate_filter()
    assert film._offset_distribution[1] == 6
    np.testing.assert_allclose(np.array(film._offset_distribution[0].pdf), np.linspace(2, 4, 513), rtol=1e-6)
    # of one that changes its sign, the height without it
    film._offset_distribution, film.rfilter = None, lambda: filter_of(lambda x: x - 0.25)
    film.tabulate_filter()
    density = np.maximum(np.abs(np.linspace(-1.25, 0.75, 513)), 1.25e-4)
    np.testing.assert_allclose(np.array(film._offset_distribution[0].pdf), density, rtol=1e-5)


def test_what_is_no_filter_of_an_image():
    for radius, height, fits in (
        (4096.0, 1.0, True), (4097.0, 1.0, False), (0.0, 1.0, False), (-1.0, 1.0, False),
        (1.0, 0.9e6, True), (1.0, 1e6, False), (1.0, 1.1e-6, True), (1.0, 0.9e-6, False), (1.0, -2.0, True),
    ):  # fmt: skip
        film = make("transient_hdr_film")
        film.rfilter = lambda height=height, radius=radius: filter_of(lambda x: 0 * x + height, radius)
        if fits:
            film.tabulate_filter()
            continue
        with pytest.raises(SceneError, match=re.escape(f"got Own of radius {radius:g} and values up to {height:g}")):
            film.tabulate_filter()


# ------------------------------------------------------------------------------------------------ events and adjoints


class Recorder:
    """A film that notes what it is asked, and answers with its share of light before and after its window."""

    keeps_steady, knows_crowds, knows_exclusive_lanes = True, True, True

    def __init__(self):
        self.asked = []

    def put(self, *given, **how):
        self.asked.append(how)
        return mi.Float(0.25), mi.Float(0.5)

    def read(self, response, base, opl, active, steady=None):
        self.asked.append((response, steady))
        return [mi.Float(3)], [mi.Float(7)]


MATCH = SimpleNamespace(to_channels=lambda value: value, to_spectrum=lambda channels: channels[0])


@pytest.mark.parametrize("knows", [False, True])
@pytest.mark.parametrize("exclusive", [False, True])
@pytest.mark.parametrize("crowded", [False, True])
def test_films_are_told_what_they_know_of(knows, exclusive, crowded):
    film = Recorder()
    film.knows_crowds = knows
    block = FilmBlock(film, 0, mi.UInt32(0), MATCH, exclusive)
    lost = block.put({}, mi.Float64(1), [mi.Float(2), mi.Float(6)], mi.Bool([True, False]), crowded)
    assert film.asked == [({"exclusive": True} if exclusive else {}) | ({"crowded": True} if crowded and knows else {})]
    # of the mean over the channels, and of nothing where there is no event
    assert [list(part) for part in lost] == [[1, 0], [2, 0]]


def test_lanes_are_not_said_to_be_alone_to_films_that_know_nothing_of_it():
    film = make("transient_hdr_film")
    film.knows_exclusive_lanes = False
    assert not film.create_event_block(SimpleNamespace(band=0), mi.UInt32(0), None, 1, exclusive=True).exclusive


def test_adjoints_of_films_with_and_without_a_steady_image():
    """Beside the steady image its adjoint is added to what is read; alone it is all that there is; without one it is
    the film's to add it to every bin.
    """
    film, steady, opl = Recorder(), [mi.Float(0.5)], mi.Float64(1)
    block = AdjointBlock(film, "adjoint", None, steady, MATCH)
    assert [list(part) for part in block.read(opl, True)] == [[3.5], [7]]
    A, slope = block.as_spectra([mi.Float(3)], None)
    assert (list(A), slope) == ([3.5], None)
    block.response = None
    A, slope = block.read(opl, True)
    assert list(A) == [0.5] and np.all(np.array(slope) == 0) and film.asked == [("adjoint", None)]
    film.keeps_steady = False
    assert [list(part) for part in block.read(opl, True)] == [[3], [7]]
    assert film.asked[1:] == [(None, steady)]
