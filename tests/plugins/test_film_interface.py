"""What is asked of every film is declared: a class that leaves something out is refused, and a film of another variant
is still one of ours.
"""

from __future__ import annotations

import mitsuba as mi
import pytest

from torchtransient import plugins
from torchtransient.errors import PluginRegistrationError
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


# -------------------------------------------------------------------------------------------------------- pictures


