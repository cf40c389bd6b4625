"""What recipes make of a renderer's answers, and what they refuse, number by number. Nothing is rendered."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.data.recipes import checks, kept_scene
from torchtransient.data.recipes.checks import _check_light, _check_names, _check_ranges, structures_of
from torchtransient.data.recipes.distribution import NUMBERS, POSE, Place
from torchtransient.data.recipes.kept_scene import Kept, Measures, _is_polarized, changed
from torchtransient.data.recipes.recipe_file import _hidden, from_dict
from torchtransient.data.recipes.structures import OneOf, Structure, _checked_scan, _exchanged
from torchtransient.data.recipes.written import read, read_gate, written
from torchtransient.errors import (
    ArgumentError,
    MissingPackageError,
    SceneError,
    ShapeError,
    TorchTransientError,
    UnitError,
)
from torchtransient.plugins.dictionaries import Pixels

D = tt.data
VARIANT = "llvm_ad_mono"
DEVICE = tt.sensing.device("vl53l8_like")


def box():
    return tt.scenes.cornell_box(resolution=4, num_bins=30, bin_width_opl=0.4, start_opl=2.0)


def recipe(scene=None, vary=None, **settings):
    return D.Recipe(box() if scene is None else scene, vary or {}, **{"variant": VARIANT, "spp": 2} | settings)


# ------------------------------------------------------------------------------------------------- of what is rendered


def test_shares_of_light_outside():
    """Over all items of a render, whatever became of its tensors."""

    def outside(before, after, total):
        stats = tt.rendering.output.RenderStats(
            spp=1, seconds=1.0, samples_per_second=1.0, variant="llvm_ad_rgb", integrator="",
            temporal_filter="", seeds=(), energy_before=before, energy_after=after, energy_total=total,
        )  # fmt: skip
        return tt.RenderOutput(None, torch.ones(3, 4, 5), None, axis=None, stats=stats).outside

    assert outside((10.0, 20.0), (30.0, 30.5), (100.0, 200.0)) == pytest.approx((0.1, 60.5 / 300), rel=1e-12)
    for before, after, total in ((0.0, 0.0, 9.0), (1.0, 2.0, 0.0), (-1.0, 0.5, 9.0)):
        assert outside((before,), (after,), (total,)) == (0.0, 0.0)


def test_samples_are_finite(monkeypatch):
    """What is measured; labels may have NaN."""
    found = recipe(labels=("depth",), device=DEVICE, time_axis=DEVICE.axis())
    broken = ""

    def arrays(kept, index, drawn, seed):
        names = ("transient", "steady", "measurement", "depth")
        return {name: np.array([1.0, np.nan if name == broken else 0.0]) for name in names}, (0.0, 0.0)

    monkeypatch.setattr(Kept, "arrays", arrays)
    for broken in ("depth", "transient", "steady", "measurement"):
        if broken == "depth":
            assert np.isnan(found.sample(5).arrays["depth"]).any()
            continue
        with pytest.raises(UnitError, match=f"sample 5: {broken} has numbers that are not finite"):
            found.sample(5)


def test_measures_are_the_same_for_all():
    one = Measures("transient", (4, 5, 6), tt.TimeAxis(0, 1, 6), None, None, None, None, ("y",), 4)
    one.check(one, "this", "that")
    for name, other in (("size", (4, 5, 7)), ("spp", 5), ("channels", ("r", "g")), ("name", "gated")):
        with pytest.raises(ShapeError, match=f"recipe: this has {name} .*, that has .*"):
            one.check(Measures(**{**one.__dict__, name: other}), "this", "that")


def test_devices_measure_transients():
    for axis, measures in ((None, "phasor"), (tt.TimeAxis(0, 1, 5), "own")):
        kept = SimpleNamespace(renderer=SimpleNamespace(axis=axis, film=SimpleNamespace(measures=measures)))
        with pytest.raises(SceneError, match="a device measures transients"):
            Kept._chain_of(kept, DEVICE)
    film = SimpleNamespace(measures="transient")
    kept = SimpleNamespace(renderer=SimpleNamespace(axis=DEVICE.axis(), film=film))
    assert not _is_polarized(Kept._chain_of(kept, DEVICE))
    mosaic = tt.sensing.device("imx250mzr_like").sensor(tt.TimeAxis(0, 12.0, 1))
    assert _is_polarized(mosaic)


def test_arguments_of_a_device():
    count = len(DEVICE.stages)
    number = next(k for k, stage in enumerate(DEVICE.to_dict()["stages"]) if "PhotonBudget" in str(stage))
    for key in ("device.PhotonBudget.cycles", f"device.{number}.cycles"):
        found = changed(DEVICE, key, np.array(1234.0))
        assert found != DEVICE and found == DEVICE.changed("PhotonBudget", cycles=1234.0)
    for key, words in (("device.cycles", "'device.STAGE.ARGUMENT'"), (f"device.{count}.cycles", f"has {count} stages")):
        with pytest.raises(SceneError, match=words):
            changed(DEVICE, key, 1)
    assert changed(DEVICE, f"device.{count - 1}.other", 1) != DEVICE


def test_polarized_light_for_a_detector(monkeypatch):
    """One that takes no notice of polarization counts the first Stokes component, of pixels that lead or not."""
    light = torch.arange(4 * 2 * 3 * 4 * 5, dtype=torch.float32).reshape(4, 2, 3, 4, 5)
    drawn = []

    def sample(transient, generator):
        drawn.append((transient, generator.initial_seed()))
        return transient

    kept = SimpleNamespace(
        recipe=SimpleNamespace(device=1, variant="llvm_ad_mono_polarized", seed=3),
        _chain_for=lambda drawn: SimpleNamespace(sample=sample, modules=list),
    )  # fmt: skip
    for index, given in ((0, light), (0, torch.stack([light, -light])), (1, light)):
        found = Kept._measured(kept, index, {}, {"transient": given})
        assert torch.equal(found, given[..., 0, :, :, :, :])
    assert drawn[0][1] == drawn[1][1] != drawn[2][1]
    kept.recipe.variant = VARIANT
    assert Kept._measured(kept, 0, {}, {"transient": light[0]}).shape == (2, 3, 4, 5)
    monkeypatch.setattr(kept_scene, "_is_polarized", lambda chain: True)
    kept.recipe.variant = "llvm_ad_mono_polarized"
    assert torch.equal(Kept._measured(kept, 0, {}, {"transient": light}), light)


# ------------------------------------------------------------------------------------------------------ what is checked


@dataclass(frozen=True, eq=False)
class Broken(D.Distribution):
    """Of what floats do not hold, or no number."""

    name = "test_broken"
    number: float = 0.0

    def draw(self, random, place):
        return np.full(place.shape, self.number if self.number else np.nan)


@pytest.mark.parametrize("number", [0.0, float("inf"), 1e39])
def test_numbers_that_are_none(number):
    kept = SimpleNamespace(places={"a.b": Place("a.b", NUMBERS, (3,))})
    drawn = {"a.b": Broken(number).draw(None, kept.places["a.b"])}
    with pytest.raises(UnitError, match=r"'a\.b' at the end: expected finite numbers, got \[(nan|inf), "):
        _check_ranges({}, kept, "at the end", drawn)


def test_ranges_at_their_ends():
    """A reflectance of one and of nothing are possible."""
    kept = SimpleNamespace(places={"red.reflectance.value": Place("red.reflectance.value", NUMBERS, (2,))})
    maker = recipe(vary={"red.reflectance.value": D.Uniform(0, 1)})._maker
    found = maker.kept(maker.recipe.structure(0))
    ranges = found.renderer.scene.built(found.renderer._options).ranges()
    for value, wrong in ((1.0, False), (0.0, False), (1.001, True), (-0.001, True)):
        drawn = {"red.reflectance.value": np.array([0.5, value])}
        if not wrong:
            _check_ranges(ranges, kept, "here", drawn)
            continue
        with pytest.raises(UnitError, match=r"recipe: vary: here, .* Choose a smaller range, or cut it off"):
            _check_ranges(ranges, kept, "here", drawn)
    kept.places = {"red.to_world": Place("red.to_world", POSE, (4, 4))}
    with pytest.raises(UnitError, match=r"recipe: vary: here: .*no inverse"):
        _check_ranges({}, kept, "here", {"red.to_world": np.diag([1.0, 0, 1, 1])})


def lit(monkeypatch, described, drawn, lights=("lamp",), emitters=("lamp",)):
    """The check of lights that are described with these radiances, of which some are drawn."""
    monkeypatch.setattr(checks, "_emitter_of", lambda params, key, kind: key.split(".")[0])
    from torchtransient.plugins import parameters as physical_ranges

    told = [(f"{name}.radiance.value", physical_ranges.LIGHT, 0.0, high) for name, high in described.items()]
    told.append(("wall.reflectance.value", "no light", 0.0, 9.0))
    monkeypatch.setattr(physical_ranges, "described_ranges", lambda params: told)
    built = SimpleNamespace(params=None, scene=SimpleNamespace(emitters=lambda: list(emitters)))
    places = {f"{name}.radiance.value" for name in (drawn[0] if drawn else ())} | {"wall.reflectance.value"}
    kept = SimpleNamespace(structure=SimpleNamespace(text="x=1"), places=dict.fromkeys(places))
    _check_light(built, kept, [{f"{name}.radiance.value": value for name, value in one.items()} for one in drawn])


def test_a_light_that_ever_shines(monkeypatch):
    lit(monkeypatch, {"lamp": 2.0}, [])
    lit(monkeypatch, {"lamp": 0.0}, [{"lamp": [0.0, 0.0]}, {"lamp": [0.0, 0.5]}, {"lamp": [0.0, 0.0]}])
    lit(monkeypatch, {"lamp": 0.0, "sun": 1.0}, [], emitters=("lamp", "sun"))
    # A light without such a number, a sky, shines.
    lit(monkeypatch, {"lamp": 0.0}, [], emitters=("lamp", "sky"))
    lit(monkeypatch, {}, [], emitters=("sky",))
    for described, drawn in (({"lamp": 0.0}, []), ({"lamp": 3.0}, [{"lamp": 0.0}] * 2)):
        with pytest.raises(SceneError, match=r"structure 'x=1': no light ever shines: 'lamp\.radiance\.value' is zero"):
            lit(monkeypatch, described, drawn)
    with pytest.raises(SceneError, match="structure 'x=1': expected a scene with a light, got one without any emitter"):
        lit(monkeypatch, {}, [], emitters=())


def test_labels_of_other_structures():
    kept = SimpleNamespace(named=lambda: {"plan": [1], "materials": ["a"]}, structure=SimpleNamespace(text="x=1"))
    _check_names({"plan": [2], "materials": ["a"]}, kept)
    with pytest.raises(SceneError, match=r"the materials of structure 'x=1' are \['a'\], others have \['b'\]"):
        _check_names({"materials": ["b"]}, kept)


def test_structures_that_are_looked_at(monkeypatch):
    """All scenes, eight structures at most, each with the samples that are of it."""
    monkeypatch.setattr(checks, "STRUCTURES", 3)
    made = SimpleNamespace(
        scenes=SimpleNamespace(names=[""]), structure=lambda index: Structure("", str(index % 5), (("k", index % 5),))
    )
    found = structures_of(made, range(11))
    assert [(one.text, indices) for one, indices in found] == [("0", [0, 5, 10]), ("1", [1, 6]), ("2", [2, 7])]
    made.scenes.names = ["a", "b"]
    found = structures_of(made, range(2))
    assert [(one.name, one.entries, indices) for one, indices in found[:2]] == [
        ("a", (("k", 0),), []), ("b", (("k", 0),), []),
    ]  # fmt: skip
    assert len(found) == 3 and found[2][1] == [0]


def test_other_errors_of_a_renderer_are_raised():
    """Also where keys are those of the scene."""
    with pytest.raises(TorchTransientError, match="sensor"):
        recipe(vary={"red.reflectance.value": D.Uniform(0, 1)}, sensors=7).check()
    with pytest.raises(SceneError, match=r"'sensor\.film\.size' cannot vary as a value: .* name that\."):
        recipe(vary={"sensor.film.size": D.Uniform(1, 2)}).check()


# -------------------------------------------------------------------------------------------------- what is no argument


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"physics": "warn"}, ArgumentError, "physics: expected 'ignore' or 'error', got 'warn'"),
        ({"scan": 3}, ArgumentError, "scan: expected a Scan, got"),
        ({"device": 3}, SceneError, "device: expected a device, its name or its file, got"),
        ({"time_axis": 3}, ArgumentError, "time_axis: expected a TimeAxis"),
        ({"pulse": 3}, ArgumentError, "pulse: expected a Pulse"),
        ({"frequencies": [[1.0]]}, ArgumentError, "frequencies: expected cycles per metre in a list"),
        ({"gates": [3]}, ArgumentError, "gates: expected a list"),
        ({"plugins": "a.b"}, SceneError, "plugins: expected several names of modules in a list"),
        ({"plugins": [3]}, SceneError, "plugins: expected several names of modules in a list"),
    ],
)
def test_what_is_no_argument(settings, error, words):
    with pytest.raises(error, match=f"recipe: {words}"):
        recipe(**settings)


def test_entries_that_do_not_fit(tmp_path):
    with pytest.raises(SceneError, match="expected several scenes by name, got one"):
        OneOf(box())
    with pytest.raises(SceneError, match=r"expected tt\.nlos\.Scan as choices of 'scan', got"):
        _checked_scan(3)
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(width=1.0, height=1.0), (2, 3), kind="confocal")
    assert _checked_scan(scan) is scan
    with pytest.raises(SceneError, match="a capture has none"):
        recipe({}, scan=scan, time_axis=tt.TimeAxis(0, 1, 3), parameters={"a": 1})
    path = tmp_path / "scene.xml"
    path.write_text('<scene version="3.0.0"><default name="a" value="1"/><default name="b" value="2"/></scene>')
    described = tt.load(path)._description
    for given, expected in ((True, "true"), (np.float64(0.5), "0.5"), (3, "3"), ("x", "x")):
        assert dict(_exchanged(described, "$a", given).parameters)["a"] == expected
    for wrong in ([1], {"type": "cube"}, None):
        with pytest.raises(SceneError, match="take texts and numbers, got"):
            _exchanged(described, "$a", wrong)


def test_devices_in_files(tmp_path):
    """YAML and JSON; beside the recipe, or wherever they are."""
    DEVICE.to_yaml(tmp_path / "mine.yaml")
    (tmp_path / "mine.json").write_text(json.dumps(DEVICE.to_dict()))
    for name in ("mine.yaml", "mine.json"):
        assert recipe(device=tmp_path / name).device == recipe(device=str(tmp_path / name)).device == DEVICE
        _, arguments = from_dict({"scene": {"builtin": "cornell_box"}, "device": name}, tmp_path)
        assert arguments["device"] == tmp_path / name
    assert from_dict({"scene": {"builtin": "cornell_box"}, "device": "vl53l8_like"}, tmp_path)[1]["device"] == (
        "vl53l8_like"
    )
    assert recipe(device=DEVICE.to_dict()).device == DEVICE


def test_scenes_in_files(tmp_path, monkeypatch):
    for wrong in (3, [1]):
        with pytest.raises(SceneError, match="expected a file, a scene dictionary or a builtin, got"):
            from_dict({"scene": wrong}, tmp_path)
    scenes = {"a": box(), "b": box()}
    plain = recipe(D.OneOf(scenes)).to_dict()
    assert set(plain["scene"]) == {"one_of"} and list(plain["scene"]["one_of"]) == ["a", "b"]
    weighted = recipe(D.OneOf(scenes, weights=[1, 3])).to_dict()
    assert weighted["scene"]["weights"] == [1, 3] and D.Recipe.from_dict(weighted).scenes.weights == [1, 3]
    hidden = _hidden(plain["scene"])
    assert list(hidden.scenes) == ["a", "b"] and hidden.weights is None
    with pytest.raises(SceneError, match="expected finite numbers and plain data throughout"):
        recipe(vary={"red.reflectance": D.Choice([float("nan")])}).to_dict()
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingPackageError, match="YAML needs PyYAML"):
        recipe().to_yaml()


def test_pixels_and_gates_as_plain_data():
    values = np.arange(2 * 3 * 3, dtype=np.float32).reshape(2, 3, 3)
    for given in (Pixels(values, True, "rgb"), Pixels(values, False, "")):
        plain = written(given)
        assert ("pixel_format" in plain) == bool(given.pixel_format)
        found = read(json.loads(json.dumps(plain)))
        assert np.array_equal(found.values, values)
        assert (found.srgb_gamma, found.pixel_format) == (given.srgb_gamma, given.pixel_format)
    gate = tt.Gate.gaussian(8.0, 2.0)
    assert read_gate(gate) is gate and recipe(gates=[gate]).to_dict()["gates"][0] == json.loads(
        json.dumps(written(gate.__dict__))
    )
    assert read_gate(recipe(gates=[gate]).to_dict()["gates"][0]) == gate
