"""What is asked of every film is declared: a class that leaves something out is refused, and a film of another variant
is still one of ours.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.errors import PluginRegistrationError, SceneError
from torchtransient.interfaces import is_time_resolved, missing_members
from torchtransient.plugins import _registry
from torchtransient.rendering import films

FILMS = {
    "transient_hdr_film": {"temporal_bins": 4, "bin_width_opl": 1.0},
    "phasor_hdr_film": {"frequencies": "0 1"},
    "gated_hdr_film": {"gates": "rectangular 1 2"},
    "rate_hdr_film": {"temporal_bins": 4, "bin_width_opl": 1.0, "rate_start": -1.0, "rate_width": 0.5, "rate_bins": 4},
    "beat_hdr_film": {
        "temporal_bins": 4, "bin_width_opl": 1.0, "chirp_bandwidth": 1e9, "chirp_duration": 1e-5,
        "chirp_wavelength": 1550e-9,
    },
    "slow_phasor_hdr_film": {"frequencies": "0 1", "slow_times": "0 0.5"},
}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def make(kind):
    return mi.load_dict({"type": kind, "width": 2, "height": 2, **FILMS[kind]})


def test_every_film_is_looked_at():
    """Every film plugin of the library is here, and has an object that says what it measures."""
    ours = {name for module in _registry.PLUGIN_MODULES for kind, name in module.plugins if kind == "film"}
    assert ours == set(FILMS) == {layout.plugin for layout in films.FILMS}


@pytest.mark.parametrize("kind", FILMS)
def test_films_have_all_members(kind):
    film = make(kind)
    assert is_time_resolved(film) and not missing_members(type(film))
    assert film.plugin == kind and film.start_opl == 0.0


@pytest.mark.parametrize("kind", FILMS)
def test_a_film_outlives_its_variant(kind):
    """Its module is executed again for the next variant, and its class is another one then."""
    film = make(kind)
    with mi.variant_context("llvm_ad_rgb"):
        plugins.sync()
        assert type(make(kind)) is not type(film)
        assert is_time_resolved(film) and is_time_resolved(make(kind))
    assert not is_time_resolved(mi.load_dict({"type": "hdrfilm"}))


def test_a_film_without_a_member_is_refused():
    from torchtransient.plugins.films.base import TimeResolvedFilm

    class Half(TimeResolvedFilm):
        plugin, measures = "half_film", "half"

        def cube_shape(self):
            return 1, 1, 1, 1

        def entries_per_pixel(self):
            return 1

    with pytest.raises(PluginRegistrationError, match=r"half_film.*put, put_slope, read"):
        plugins.register("film", "half_film", Half)
    assert plugins.kind_of("half_film") is None


# ------------------------------------------------------------------------------------------ temporal filters


def test_films_without_a_temporal_filter():
    for kind in ("phasor_hdr_film", "gated_hdr_film"):
        film = make(kind)
        film.take_filter("tent", 2.0)
        assert film.temporal_filter == ""
        with pytest.raises(AttributeError):
            film.temporal_filter = "tent"


# -------------------------------------------------------------------------------------------------------- pictures


def test_the_picture_of_a_steady_image():
    film = make("transient_hdr_film")
    with pytest.raises(SceneError, match="nothing was rendered yet"):
        film.bitmap()
    film.schedule_storage()  # of nothing yet
    film.start_render()
    film.add_steady(mi.UInt32([0, 1, 2, 3]), [mi.Float([3, 5, 7, 11])])
    film.add_outside(mi.UInt32([1, 2]), mi.Float([1, 2]), mi.Float([10, 20]))
    film.schedule_storage()
    film.finish_render()
    assert np.array(film.bitmap()).squeeze().tolist() == [[3, 5], [7, 11]]
    assert film.energies_outside() == (3, 30)
    assert (film.energy_before, film.energy_after) == (3, 30)
    assert film.base_channels_count() == 1
    with mi.variant_context("llvm_ad_rgb"):
        assert make("transient_hdr_film").base_channels_count() == 3


def test_sums_in_double_precision_are_handed_over_in_single():
    """Ones that are lost beside 2^24 in single precision."""
    film = make("transient_hdr_film")
    for samples, expected in ((2**16, 2**24), (2**16 + 1, 2**24 + 2)):
        film.start_render(samples)
        film.add_steady(mi.UInt32(3), [mi.Float(2**24)])
        for _ in range(2):
            film.add_steady(mi.UInt32(3), [mi.Float(1)])
            dr.eval(film.steady)
        film.finish_render()
        assert dr.type_v(film.steady) == dr.type_v(mi.Float)
        assert np.array(film.develop()[0]).ravel().tolist() == [0, 0, 0, expected]


def test_films_without_a_steady_image_sum_up_their_bins():
    film = mi.load_dict({"type": "transient_hdr_film", "width": 3, "height": 2, "steady": False, "temporal_bins": 5})
    film.start_render()
    assert film.outside is None and film.energies_outside() == (0, 0)
    values = np.arange(1.0, 31.0).reshape(2, 3, 5, 1) ** 2
    film.bands = [(0, 2, mi.Float(values.ravel()))]
    film.finish_render()
    np.testing.assert_array_equal(np.array(film.develop()[0]), values.sum(2))


@pytest.mark.parametrize(("variant", "pixels"), [("llvm_ad_mono", "Y"), ("llvm_ad_rgb", "RGB")])
def test_the_image_of_integrators_that_know_nothing_of_time(variant, pixels):
    """As large as the film, with its crop and its filter."""
    mi.set_variant(variant)
    size = {"width": 7, "height": 6, "crop_width": 4, "crop_height": 3, "crop_offset_x": 2, "crop_offset_y": 1}
    node = {"type": "transient_hdr_film", "sample_border": True, "rfilter": {"type": "tent", "radius": 1.5}}
    from torchtransient.plugins.films.base import plain_image

    image = plain_image(mi.load_dict(node | size))
    assert [list(part) for part in (image.size(), image.crop_size(), image.crop_offset())] == [[7, 6], [4, 3], [2, 1]]
    assert image.rfilter().radius() == 1.5 and image.sample_border()
    image.prepare([])
    assert (image.bitmap(raw=False).pixel_format().name, image.bitmap().component_format().name) == (pixels, "Float32")
