"""Every film choice keeps the same promises: from argument to plugin and back, to files and back, as plain data."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient import plugins
from torchtransient.errors import ArgumentError, SceneError, ShapeError, StorageError, TorchTransientError
from torchtransient.files import read_result, write_result
from torchtransient.rendering import film_layout, films
from torchtransient.rendering.film_layout import measured
from torchtransient.rendering.films import Beats, Gates, Histogram, Phasors, Rates, SlowPhasors
from torchtransient.rendering.output import RenderOutput, RenderStats

VARIANT = "llvm_ad_rgb"
STATS = RenderStats(
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
    return RenderOutput.of(choice, torch.zeros(*image, 3, 2), response, stats=STATS, channels=("R", "G", "B"))


def test_the_list():
    assert list(films.FILMS) == [Histogram, Phasors, Gates, Rates, Beats, SlowPhasors]
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
@pytest.mark.parametrize("ending", ["h5", "npz"])
@pytest.mark.parametrize("leading, components", [((), 1), ((2,), 1), ((), 4)])
def test_output_and_file(tmp_path, argument, ending, leading, components):
    choice = choice_for(argument)
    out = output_of(choice, leading, components)
    assert films.layout_of_output(out) == choice and not out.others
    for name in ("transient", "phasor", "gated", "rates", "beats", "slow_phasor"):
        assert (getattr(out, name) is None) == (name != choice.measures)
    back = read_result(write_result(tmp_path / f"a.{ending}", out))
    assert films.layout_of_output(back) == choice
    assert torch.equal(choice.tensor(back), choice.tensor(out)) and torch.equal(back.steady, out.steady)


def first_version(values):
    """Return a file of the first version, without checksums."""
    kept = {name: value for name, value in values.items() if name != "checksums"}
    return {**kept, "format": np.array("torchtransient result 1")}


@pytest.mark.parametrize("ending", ["h5", "npz"])
def test_gated_files_of_earlier_versions(tmp_path, ending):
    """They hold the images as a transient without an axis."""
    from torchtransient.vis.sources import images_of, transient_of

    out = output_of(choice_for("gates"))
    path = write_result(tmp_path / f"a.{ending}", out)
    if ending == "npz":
        with np.load(path) as file:
            values = {("transient" if name == "gated" else name): file[name] for name in file.files}
        np.savez(path, **first_version(values))
    else:
        import h5py

        with h5py.File(path, "r+") as file:
            file.move("gated", "transient")
            file.attrs["format"] = "torchtransient result 1"
            del file.attrs["checksums"]
    for back in (read_result(path), path):
        images, axis, word = images_of(back)
        assert torch.equal(images, out.gated) and axis is None and word == "gate"
        with pytest.raises(ShapeError, match="3 images of time gates"):
            transient_of(back)
    assert read_result(path).gates == GIVEN["gates"] and read_result(path).transient is None


def test_files_that_do_not_fit_together(tmp_path):
    path = write_result(tmp_path / "a.npz", output_of(choice_for("gates")))
    with np.load(path) as file:
        values = first_version({name: file[name] for name in file.files})
    np.savez(path, **{**values, "gates": np.array("rectangular 1 2")})
    with pytest.raises(StorageError, match=r"gated of shape .* G = 1"):
        read_result(path)
    np.savez(path, **{name: value for name, value in values.items() if name not in ("gates", "gated")})
    with pytest.raises(StorageError, match="transient or phasor or gated or rates or beats or slow_phasor"):
        read_result(path)
    with pytest.raises(StorageError, match="neither"):
        write_result(path, replace(output_of(choice_for("gates")), gated=None))
    path = write_result(tmp_path / "b.npz", output_of(choice_for("rates")))
    with np.load(path) as file:
        values = first_version({name: file[name] for name in file.files})
    np.savez(path, **{**values, "rates_num_bins": np.array(3)})
    with pytest.raises(StorageError, match=r"rates of shape \(3, 4, 5, 3, 2\).* R x T = 3 x 5"):
        read_result(path)


def test_one_film_is_asked_for():
    assert films.film_of_arguments({}) is None and films.film_of_arguments({"gates": None}) is None
    with pytest.raises(ArgumentError, match="a rates film, a beats film or a slow_phasor film; give one of them"):
        films.film_of_arguments({"time_axis": GIVEN["time_axis"], "gates": GIVEN["gates"]})
    with pytest.raises(ArgumentError, match="give one of them"):
        films.film_of_arguments({"rates": GIVEN["rates"], "chirps": GIVEN["chirps"]})
    room = tt.scenes.cornell_box(4)
    with pytest.raises(ArgumentError, match="film, time_axis"):
        tt.TransientRenderer(room, film=choice_for("gates"), time_axis=GIVEN["time_axis"])
    with pytest.raises(ArgumentError, match=r"film: expected a film such as Histogram"):
        tt.TransientRenderer(room, film=GIVEN["time_axis"])
    for wrong in ({"time_axis": 3.0}, {"gates": ["rectangular 1 2"]}, {"frequencies": [float("nan")]}):
        with pytest.raises(TorchTransientError):
            tt.TransientRenderer(room, **wrong)


@pytest.mark.parametrize(
    "given, argument",
    [
        (lambda: Gates(list(GIVEN["gates"])), "gates"),
        (lambda: Gates(gate for gate in GIVEN["gates"]), "gates"),
        (lambda: Phasors(GIVEN["frequencies"]), "frequencies"),
    ],
)
def test_objects_take_what_their_keywords_take(given, argument):
    choice = given()
    assert choice == choice_for(argument) and hash(choice) == hash(choice_for(argument))


def test_a_single_setting():
    gate = GIVEN["gates"][0]
    assert Gates(gate) == Gates([gate]) == films.film_of_arguments({"gates": gate}) and Gates(gate).count == 1
    for numbers in ([0.5], (0.5,), 0.5, torch.tensor([0.5]), np.array([0.5])):
        found = films.film_of_arguments({"frequencies": numbers})
        assert Phasors(numbers) == Phasors(tt.FrequencyAxis((0.5,))) == found
    axis = GIVEN["time_axis"]
    assert tt.TransientRenderer(tt.scenes.cornell_box(4), film=Gates([gate])).gates == (gate,)
    assert Histogram(axis).axis == axis


@pytest.mark.parametrize(
    "kind, wrong",
    [
        (Histogram, 3), (Histogram, None), (Histogram, (0.0, 1.0, 3)),
        (Gates, 3), (Gates, []), (Gates, "rectangular 1 2"), (Gates, [GIVEN["gates"]]), (Gates, None),
        (Phasors, []), (Phasors, None), (Phasors, "high"), (Phasors, [[0.5]]), (Phasors, GIVEN["time_axis"]),
        (Rates, 3), (Rates, None), (Rates, GIVEN["time_axis"]), (Beats, 1e9), (Beats, None), (Beats, GIVEN["rates"]),
    ],
)  # fmt: skip
def test_objects_refuse_what_their_keywords_refuse(kind, wrong):
    with pytest.raises(TorchTransientError, match="expected"):
        kind(wrong)
    if wrong is not None:
        with pytest.raises(TorchTransientError, match="expected"):
            tt.TransientRenderer(tt.scenes.cornell_box(4), **{kind.argument: wrong})


@each
def test_an_object_says_the_same_as_the_argument(argument):
    scene = tt.load(tt.scenes.cornell_box(4, max_depth=2), variant=VARIANT)
    named = tt.TransientRenderer(scene, **arguments_for(argument), spp=2)
    plain = tt.TransientRenderer(scene, film=choice_for(argument), spp=2)
    assert named.film == plain.film == choice_for(argument) and repr(named) == repr(plain)


def test_films_that_are_not_ours(monkeypatch):
    mi.set_variant(VARIANT)
    ours = mi.load_dict(film_node(choice_for("gates")))
    with monkeypatch.context() as patch:
        patch.setattr(type(ours), "measures", "colour of time", raising=False)
        with pytest.raises(SceneError, match=r"'gated_hdr_film' measures 'colour of time', expected one of transient"):
            films.layout_of_film(ours)
    with pytest.raises(SceneError, match=r"transient_hdr_film, phasor_hdr_film, gated_hdr_film.*time_axis="):
        films.layout_of_film(mi.load_dict({"type": "hdrfilm"}))


def test_settings_in_a_scene():
    assert Gates.from_properties({}) is None and Phasors.from_properties({"frequencies": "1"}) is None
    assert Gates.from_properties({"gates": "rectangular 3 4"}) == Gates(GIVEN["gates"][0])
    with pytest.raises(SceneError, match=r"gated_hdr_film: .*kind out of"):
        Gates.from_properties({"gates": "round 1 2"})
    assert Histogram.from_properties({}) == Histogram(tt.TimeAxis(0.0, 0.003, 2048))
    found = Histogram.from_properties({"start_opl": 2, "bin_width_opl": 0.5, "temporal_bins": 7})
    assert found == Histogram(tt.TimeAxis(2.0, 0.5, 7))
    with pytest.raises(SceneError, match=r"rate_hdr_film: .*bin_width"):
        Rates.from_properties({"rate_start": -1.0, "rate_width": 0.0, "rate_bins": 4})


def test_rows_without_an_axis_have_that_of_the_scenes_film():
    film = {"temporal_bins": 5, "start_opl": 3.5, "bin_width_opl": 0.25}
    scene = tt.scenes.cornell_box(4, max_depth=2)
    scene["sensor"]["film"] = scene["sensor"]["film"] | film
    for argument in ("rates", "chirps"):
        renderer = tt.TransientRenderer(scene, **{argument: GIVEN[argument]}, spp=2, physics="ignore")
        out = renderer()
        assert films.layout_of_output(out) == choice_for(argument)
        assert tuple(choice_for(argument).tensor(out).shape) == (3, *choice_for(argument).shape, 4, 4)


@each
def test_outputs_and_files_without_the_film(argument):
    """Settings without an array, or an array without settings, are none of it."""
    choice = choice_for(argument)
    kind, output = type(choice), output_of(choice)
    assert kind.from_output(output) == choice
    without = replace(output, **{kind.measures: None})
    assert kind.from_output(without) is None and films.layout_of_output(without) is None
    assert kind.from_output(replace(output, **dict.fromkeys(choice.attributes()))) is None
    for other in GIVEN:
        if other != argument:
            assert type(choice_for(other)).from_output(output) is None
    assert kind.from_entries({}) is None
    assert kind.from_entries({"start_opl": 0.0, "bin_width_opl": 1.0}) is None


@pytest.mark.parametrize("leading", [(), (7,), (7, 1)])
@pytest.mark.parametrize("components", [1, 4])
def test_layouts_of_torch(leading, components):
    """Channels first, behind batch and sensors; of pairs the laser's rows and columns before the sensor's."""
    generator = np.random.default_rng(3)
    items, shape = leading[:1], {"h": 2, "w": 3, "l": 5, "m": 6, "t": 4, "s": components, "c": 11}

    def drawn(letters):
        return generator.normal(size=(*items, *(shape[letter] for letter in letters)))

    def expected(values, letters, order):
        axes = [letters.index(letter) - len(letters) for letter in order]
        moved = np.moveaxis(values, axes, range(-len(order), 0))
        moved = moved.reshape(*leading, *moved.shape[len(items) :])
        return moved if components > 1 else moved.squeeze(-len(order))

    def joined(values):
        return torch.from_numpy(values.reshape(*values.shape[:-2], -1))

    steady, cube, pairs = drawn("hwsc"), drawn("hwtsc"), drawn("hwlmtsc")
    layouts = (
        (film_layout.steady_channels_first, steady, "hwsc", "schw"),
        (film_layout.cube_channels_first, cube, "hwtsc", "scthw"),
        (film_layout.cube_channels_first, pairs, "hwlmtsc", "sctlmhw"),
    )
    for function, values, letters, order in layouts:
        found = function(joined(values), leading, components).numpy()
        np.testing.assert_array_equal(found, expected(values, letters, order))
    waves = cube[..., None] * np.array([2.0, -3.0])
    found = film_layout.phasor_channels_first(torch.from_numpy(waves.reshape(*items, 2, 3, 4, -1)), leading, components)
    np.testing.assert_allclose(found.numpy(), expected(cube * (2 - 3j), "hwtsc", "scthw"), rtol=1e-12)


def test_histograms_of_files_have_an_axis_and_an_array():
    axis = {"start_opl": 3.5, "bin_width_opl": 0.25, "num_bins": 5}
    assert Histogram.from_entries({**axis, "transient": 0}) == choice_for("time_axis")
    assert Histogram.from_entries(axis) is None
    assert Histogram.from_entries({"start_opl": 3.5, "bin_width_opl": 0.25, "transient": 0}) is None


def test_what_an_object_holds_under_a_name():
    held = SimpleNamespace(phasor=None, transient=3, others={"phasor": 5, "transient": 7})
    assert [measured(held, name) for name in ("transient", "phasor", "gated")] == [3, 5, None]
    assert measured(SimpleNamespace(transient=None), "transient") is None


def test_explicit_frequencies_replace_those_that_a_film_had():
    peers = {"wl_mean": 0.5, "wl_sigma": 0.1, "temporal_bins": 7, "bin_width_opl": 0.5, "frequency_first": 1.0,
             "frequency_step": 2.0, "frequency_count": 3}  # fmt: skip
    for given in (peers, dict.fromkeys(["wl_sigma"], 1.0)):
        props = dict(given) | {"width": 4}
        choice_for("frequencies").write(props)
        assert props == {"frequencies": "0.0, 0.5, -2.0", "start_opl": 1.5, "width": 4}
