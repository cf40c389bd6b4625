"""Every film choice keeps the same promises: from argument to plugin and back, to files and back, as plain data."""

from __future__ import annotations

import copy
import json
import pickle

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.files import read_result, write_result
from torchtransient.rendering import films

VARIANT = "llvm_ad_rgb"
STATS = tt.RenderStats(
    spp=16,
    seconds=0.5,
    samples_per_second=1e4,
    variant=VARIANT,
    integrator="transient_path",
    temporal_filter="",
    seeds=(0,),
    energy_before=(0.0,),
    energy_after=(0.0,),
    energy_total=(1.0,),
)
GIVEN = {
    "time_axis": tt.TimeAxis(3.5, 0.25, 5),
    "frequencies": tt.FrequencyAxis((0.0, 0.5, -2.0), 1.5),
    "gates": (tt.Gate.rectangular(3, 4), tt.Gate.gaussian(7.0, 0.5), tt.Gate.tabulated([1, 2, 4], [0, 1, 0])),
    "rates": tt.RateAxis(-1.5, 0.5, 4),
    "chirps": tt.Chirps(1e9, 1e-5, 1550e-9, window="blackman"),
    "slow_times": (0.0, 1e-3, 2.5e-3, 4e-3),
}
each = pytest.mark.parametrize("argument", GIVEN)


def arguments_for(argument):
    beside = next(kind.beside for kind in films.FILMS if kind.argument == argument)
    return {name: GIVEN[name] for name in (argument, beside) if name}


def choice_for(argument):
    return films.film_of_arguments(arguments_for(argument))


def film_node(choice):
    props = mi.Properties(choice.plugin)
    choice.write(props)
    return {"type": choice.plugin, "width": 2, "height": 3, **{name: props[name] for name in list(props.keys())}}


def output_of(choice, leading=(), components=1):
    generator = torch.Generator().manual_seed(0)
    entries = components * 3 * (2 if choice.is_complex else 1)
    cube = torch.rand(*leading, 3, 2, *choice.shape, entries, generator=generator)
    items = cube.reshape(-1, *cube.shape[len(leading) :])
    response = choice.channels_first(items if leading else items[0], leading, components)
    image = (*leading, *((components,) if components > 1 else ()), 3)
    assert tuple(response.shape) == (*image, *choice.shape, 3, 2)
    return tt.RenderOutput.of(choice, torch.zeros(*image, 3, 2), response, stats=STATS, channels=("R", "G", "B"))


def test_the_list():
    assert [type(choice_for(argument)) for argument in GIVEN] == list(films.FILMS)
    for name in ("measures", "plugin", "argument", "output", "letter"):
        assert len({getattr(kind, name) for kind in films.FILMS}) == 6, name
    assert all(plugins.kind_of(kind.plugin) == "film" for kind in films.FILMS)


@each
def test_plugin_and_back(argument):
    """The plugin measures with the settings that are written into its node."""
    plugins.sync()
    choice = choice_for(argument)
    film = mi.load_dict(film_node(choice))
    assert film.plugin == choice.plugin and film.measures == choice.measures
    assert films.layout_of_film(film) == choice and films.layout_of_plugin(choice.plugin) is type(choice)
    assert bool(film.temporal_filter) == choice.has_bins
    assert film.cube_shape()[2:-1] == choice.shape and choice.shape[-1] == choice.count
    assert choice.from_properties(film_node(choice)) in (choice, None)


@each
def test_values_that_compare_travel_and_print(argument):
    choice = choice_for(argument)
    assert choice == choice_for(argument) and hash(choice) == hash(choice_for(argument))
    assert pickle.loads(pickle.dumps(choice)) == copy.deepcopy(choice) == choice
    assert choice.settings == GIVEN[argument]
    assert json.loads(json.dumps(choice.plain())) is not None
    assert argument in repr(choice) or "axis" in repr(choice)


@each
def test_output_and_file(tmp_path, argument):
    choice = choice_for(argument)
    for leading, components, ending in (((), 1, "h5"), ((2,), 1, "npz"), ((), 4, "h5"), ((), 1, "npz")):
        out = output_of(choice, leading, components)
        assert films.layout_of_output(out) == choice and not out.others
        for name in ("transient", "phasor", "gated", "rates", "beats", "slow_phasor"):
            assert (getattr(out, name) is None) == (name != choice.measures)
        back = read_result(write_result(tmp_path / f"{components}{len(leading)}.{ending}", out))
        assert films.layout_of_output(back) == choice
        assert torch.equal(choice.tensor(back), choice.tensor(out)) and torch.equal(back.steady, out.steady)


def test_settings_in_a_scene():
    assert films.Gates.from_properties({}) is None and films.Phasors.from_properties({"frequencies": "1"}) is None
    assert films.Gates.from_properties({"gates": "rectangular 3 4"}) == films.Gates(GIVEN["gates"][0])
    with pytest.raises(SceneError, match=r"gated_hdr_film: .*kind out of"):
        films.Gates.from_properties({"gates": "round 1 2"})
    assert films.Histogram.from_properties({}) == films.Histogram(tt.TimeAxis(0.0, 0.003, 2048))
    found = films.Histogram.from_properties({"start_opl": 2, "bin_width_opl": 0.5, "temporal_bins": 7})
    assert found == films.Histogram(tt.TimeAxis(2.0, 0.5, 7))
    with pytest.raises(SceneError, match=r"rate_hdr_film: .*bin_width"):
        films.Rates.from_properties({"rate_start": -1.0, "rate_width": 0.0, "rate_bins": 4})


def test_rows_without_an_axis_have_that_of_the_scenes_film():
    film = {"temporal_bins": 5, "start_opl": 3.5, "bin_width_opl": 0.25}
    scene = tt.scenes.cornell_box(4, max_depth=2)
    scene["sensor"]["film"] = scene["sensor"]["film"] | film
    for argument in ("rates", "chirps"):
        renderer = tt.TransientRenderer(scene, **{argument: GIVEN[argument]}, spp=2, physics="ignore")
        out = renderer()
        assert films.layout_of_output(out) == choice_for(argument)
        assert tuple(choice_for(argument).tensor(out).shape) == (3, *choice_for(argument).shape, 4, 4)


def test_frequencies_replace_a_pulse_that_the_scene_describes():
    pulse = {"wl_mean": 2.0, "wl_sigma": 1.0, "temporal_bins": 32, "bin_width_opl": 0.1}
    scene = tt.scenes.cornell_box(resolution=2)
    scene["sensor"]["film"] = {"type": "phasor_hdr_film", "width": 2, "height": 2, "rfilter": {"type": "box"}, **pulse}
    asked = GIVEN["frequencies"]
    out = tt.TransientRenderer(tt.load(scene, variant=VARIANT), frequencies=asked, spp=1)(seed=0)
    assert out.frequencies == asked and out.phasor.shape[1] == len(asked.frequencies)
