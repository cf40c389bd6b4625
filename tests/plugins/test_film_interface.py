"""What is asked of every film is declared: a class that leaves something out is refused, and a film of another variant
is still one of ours.
"""

from __future__ import annotations

import mitsuba as mi
import pytest

from torchtransient import plugins
from torchtransient.errors import PluginRegistrationError, SceneError
from torchtransient.interfaces import FilmInterface, is_time_resolved, missing_members
from torchtransient.plugins import _registry
from torchtransient.plugins.films import pulsed_filter
from torchtransient.rendering.films import choices

FILMS = {
    "transient_hdr_film": {"temporal_bins": 4, "bin_width_opl": 1.0},
    "phasor_hdr_film": {"frequencies": "0 1"},
    "gated_hdr_film": {"gates": "rectangular 1 2"},
}
PULSED = {"type": "transient_hdr_film", "temporal_bins": 40, "pulse": "gaussian", "pulse_fwhm_opl": 0.05}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def make(kind):
    return mi.load_dict({"type": kind, "width": 2, "height": 2, **FILMS[kind]})


def test_every_film_is_looked_at():
    """Every film plugin of the library is here, and has an object that says what it measures."""
    ours = {name for module in _registry.PLUGIN_MODULES for kind, name in module.plugins if kind == "film"}
    assert ours == set(FILMS) == {choice.plugin for choice in choices.CHOICES}


def test_a_film_that_is_left_out_is_noticed(monkeypatch):
    """Of any of the three lists."""
    gated = ("film", "gated_hdr_film")
    fewer = {
        "FILMS": {name: settings for name, settings in FILMS.items() if name not in gated},
        "PLUGIN_MODULES": [module for module in _registry.PLUGIN_MODULES if gated not in module.plugins],
        "CHOICES": choices.CHOICES[:-1],
    }
    places = {"FILMS": globals(), "PLUGIN_MODULES": vars(_registry), "CHOICES": vars(choices)}
    for name, value in fewer.items():
        with monkeypatch.context() as patch:
            patch.setitem(places[name], name, value)
            with pytest.raises(AssertionError):
                test_every_film_is_looked_at()


@pytest.mark.parametrize("kind", FILMS)
def test_films_have_all_members(kind):
    film = make(kind)
    assert is_time_resolved(film) and not missing_members(type(film))
    for name in FilmInterface.__abstractmethods__ - {"energy_before", "energy_after"}:
        assert getattr(film, name) is not None, name
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

    with pytest.raises(PluginRegistrationError, match=r"half_film.*put, put_slope, read.*interfaces"):
        plugins.register("film", "half_film", Half)
    assert plugins.kind_of("half_film") is None


# ------------------------------------------------------------------------------------------ temporal filters


@pytest.fixture
def made(monkeypatch):
    """The settings for which the kernel table of a pulse was made."""
    calls, original = [], pulsed_filter.cumulative_of_sum

    def counting(pulses, step):
        calls.append((len(pulses), step))
        return original(pulses, step)

    monkeypatch.setattr(pulsed_filter, "cumulative_of_sum", counting)
    return calls


def test_settings_that_change_nothing_make_no_table(made):
    film = mi.load_dict({**PULSED, "bin_width_opl": 0.02})
    assert len(made) == 1
    film.temporal_filter = "box"
    film.gaussian_stddev = 0.5
    film.gaussian_stddev = 0.7  # no box has it
    film.take_filter("box", 0.7)
    film.take_filter("", None)
    assert len(made) == 1
    film.temporal_filter = "tent"
    film.temporal_filter = "box"
    film.temporal_filter = "tent"
    assert len(made) == 2 and film.filter.name == "tent"
    film.temporal_filter = "gaussian"
    film.gaussian_stddev = 0.9
    assert len(made) == 4
    film.bin_width_opl = 0.04
    film.take_filter("", None)
    assert len(made) == 5 and film.filter.count < 40


def test_a_filter_that_cannot_be_used_changes_nothing():
    film = mi.load_dict({**PULSED, "bin_width_opl": 0.02})
    with pytest.raises(SceneError, match="4096"):
        film.take_filter("gaussian", 1e4)
    with pytest.raises(SceneError, match="expected one of"):
        film.take_filter("triangle", 2.0)
    assert (film.temporal_filter, film.gaussian_stddev, film.filter.name) == ("box", 0.5, "box")


def test_films_without_a_temporal_filter():
    for kind in ("phasor_hdr_film", "gated_hdr_film"):
        film = make(kind)
        film.take_filter("tent", 2.0)
        assert film.temporal_filter == ""
        with pytest.raises(AttributeError):
            film.temporal_filter = "tent"
