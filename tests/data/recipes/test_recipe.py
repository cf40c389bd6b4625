"""Recipes: sample i depends on the recipe and i alone, and what is wrong is said before anything is rendered."""

from __future__ import annotations

import json
import pickle
import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import (
    ArgumentError,
    PhysicsError,
    PhysicsWarning,
    SceneError,
    ShapeError,
    TorchTransientError,
    TorchTransientWarning,
    UnitError,
)
from torchtransient.scenes import look_at, translate

D = tt.data
VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(2.0, 0.2, 60)


def box(**changes):
    return tt.scenes.cornell_box(resolution=8, num_bins=60, bin_width_opl=0.2, start_opl=2.0, **changes)


def small(scene=None, vary=None, **settings):
    varied = {
        "red.reflectance.value": D.Uniform(0.05, 0.9),
        "small-box.to_world": D.Compose([D.Turn(), D.Offset([-0.2, 0, -0.3], [0.2, 0, 0.3])]),
    }
    settings = {"variant": VARIANT, "spp": 4} | settings
    return D.Recipe(box() if scene is None else scene, varied if vary is None else vary, **settings)


@pytest.fixture(autouse=True)
def one_thread():
    with tt.threads(1):
        yield


def same(a, b):
    assert a.index == b.index and a.seed == b.seed and a.structure == b.structure and a.outside == b.outside
    assert list(a.arrays) == list(b.arrays) and list(a.values) == list(b.values)
    for name in a.arrays:
        assert a.arrays[name].dtype == b.arrays[name].dtype
        assert a.arrays[name].tobytes() == b.arrays[name].tobytes(), name
    assert all(np.array_equal(a.values[key], b.values[key]) for key in a.values)


@pytest.mark.slow
def test_bytes_depend_on_recipe_and_number_alone():
    recipe = small(labels=("depth", "normals", "shape", "first_return"))
    forwards = [recipe.sample(index) for index in range(6)]
    other = pickle.loads(pickle.dumps(recipe))
    for index in (5, 0, 3, 3, 1):
        same(other.sample(index), forwards[index])
    same(D.Recipe.from_dict(json.loads(json.dumps(recipe.to_dict()))).sample(4), forwards[4])
    assert not np.array_equal(forwards[0].arrays["transient"], forwards[1].arrays["transient"])
    assert forwards[0].arrays["depth"].shape == (8, 8) and forwards[0].arrays["normals"].shape == (3, 8, 8)
    # Equal to what a user renders by hand.
    values = {key: torch.as_tensor(value) for key, value in forwards[2].values.items()}
    renderer = tt.TransientRenderer(
        tt.load(box(), variant=VARIANT), parameters=list(values), spp=4, temporal_filter="box"
    )
    with torch.no_grad():
        out = renderer(values, seed=forwards[2].seed)
    assert out.transient.numpy().tobytes() == forwards[2].arrays["transient"].tobytes()


@pytest.mark.slow
def test_what_is_kept_of_a_sample():
    settings = {"device": "vl53l8_like", "labels": ("depth", "first_return")}
    whole, kept = small(**settings), small(**settings, keep=["first_return", "measurement"])
    one, other = whole.sample(2), kept.sample(2)
    assert list(one.arrays) == ["transient", "steady", "depth", "first_return", "measurement"]
    assert list(other.arrays) == ["first_return", "measurement"]
    assert all(other.arrays[name].tobytes() == one.arrays[name].tobytes() for name in other.arrays)
    assert (one.seed, one.outside) == (other.seed, other.outside) and whole.key() != kept.key()
    same(D.Recipe.from_dict(json.loads(json.dumps(kept.to_dict()))).sample(2), other)
    kept.preview(1)


@pytest.mark.slow
def test_structures_are_built_again_the_same():
    """One scene is kept; one that is built again makes the same bytes."""
    ball = {"type": "sphere", "center": [0.0, -0.6, 0.2], "radius": 0.1, "bsdf": {"type": "ref", "id": "white"}}
    vary = {"ball.radius": D.Choice([0.1, 0.12, 0.14]), "red.reflectance.value": D.Uniform(0.1, 0.9)}
    recipe = small(box() | {"ball": ball}, vary)
    assert recipe.exchanged == ["ball.radius"]
    alone = [small(box() | {"ball": ball}, vary).sample(index) for index in range(4)]
    order = recipe.maker().order(range(30))
    texts = [recipe.structure(index).text for index in order]
    assert sorted(order) == list(range(30)) and len(set(texts)) == 3
    assert texts == sorted(texts, key=texts.index)
    made = {index: recipe.sample(index) for index in order}
    for index in range(4):
        same(made[index], alone[index])
    assert made[0].values["ball.radius"] in np.float32(vary["ball.radius"].values)


def test_scenes_one_of():
    recipe = small(
        D.OneOf({"full": box(), "empty": without("small-box")}, weights=[1, 2]),
        {"red.reflectance.value": D.Uniform(0.1, 0.9)},
    )
    found = [recipe.sample(index) for index in range(8)]
    assert {sample.values["scene"] for sample in found} == {"full", "empty"}
    share = np.mean([recipe.structure(index).name == "empty" for index in range(1000)])
    assert abs(share - 2 / 3) < 4 * np.sqrt(2 / 9 / 1000)


@pytest.mark.slow
def test_nodes_and_texts_are_exchanged():
    d = box()
    nodes = [d["small-box"], {"type": "sphere", "to_world": d["small-box"]["to_world"], "bsdf": d["small-box"]["bsdf"]}]
    recipe = small(d, {"small-box": D.Choice(nodes), "small-box.to_world": D.Turn()})
    assert recipe.exchanged == ["small-box"]
    assert {recipe.sample(index).values["small-box"] for index in range(6)} == {"#0", "#1"}
    by_type = small(d, {"small-box.type": D.Choice(["cube", "sphere"])})
    assert {by_type.sample(index).values["small-box.type"] for index in range(6)} == {"cube", "sphere"}
    # Values of a key are of one kind.
    mixed = small(vary={"red.reflectance": D.Choice([0.5, {"type": "rgb", "value": [0.1, 0.2, 0.3]}])})
    assert {type(mixed.sample(index).values["red.reflectance"]) for index in range(6)} == {str}
    numbers = small(vary={"integrator.max_depth": D.Choice(np.array([2, 3, 4]))})
    again = D.Recipe.from_dict(json.loads(json.dumps(numbers.to_dict())))
    for index in range(2):
        same(numbers.sample(index), again.sample(index))
    assert numbers.key() == again.key()


def test_a_key_more_leaves_the_others_as_they_were():
    one = small(vary={"red.reflectance.value": D.Uniform(0, 1)})
    two = small(vary={"green.reflectance.value": D.Uniform(0, 1), "red.reflectance.value": D.Uniform(0, 1)})
    for index in range(3):
        assert one.draw(index)["red.reflectance.value"] == two.draw(index)["red.reflectance.value"]
        assert one.sample(index).seed == two.sample(index).seed
    assert one.draw(0) != small(vary={"red.reflectance.value": D.Uniform(0, 1)}, seed=1).draw(0)
    assert one.key() != two.key()


def test_poses_leave_the_temporal_filter_alone():
    """A box, whatever varies: the layer would take a tent for a pose that could have a gradient."""
    assert small()._maker.about()["temporal_filter"] == "box"
    tent = small(temporal_filter="tent")._maker.about()
    assert tent["temporal_filter"] == "tent"


def test_calls_are_recorded_and_nothing_is_traced_within_a_structure():
    recipe = small()
    maker = recipe.maker()
    for index in range(4):
        maker.sample(index)
    kept = maker.kept(recipe.structure(9))
    with torch.no_grad():
        assert kept.renderer(kept.values(kept.draw(9)), seed=9).stats.recorded == ("launched",)


def test_light_outside_of_the_window():
    recipe = small(time_axis=tt.TimeAxis(6.0, 0.2, 10))
    sample = recipe.sample(0)
    whole = small(time_axis=tt.TimeAxis(0.0, 0.2, 400)).sample(0).arrays["transient"].sum((0, 2, 3), dtype=np.float64)
    assert sample.outside[0] == pytest.approx(whole[:30].sum() / whole.sum(), rel=1e-3)
    assert sample.outside[1] == pytest.approx(whole[40:].sum() / whole.sum(), rel=1e-2)


def test_light_outside_is_measured_with_65536_camera_paths_at_most():
    """1024 for each of 4 by 16 pixels, however many more the recipe has."""

    def found(spp):
        recipe = small(tt.scenes.cornell_box((4, 16)), {}, time_axis=tt.TimeAxis(6.0, 0.2, 10), spp=spp)
        return recipe.maker().kept(recipe.structure(0)).outside(0)

    assert found(4096) == found(1024) != found(512)


def test_samples_whose_light_the_window_misses(monkeypatch):
    """They are counted before the run as they come in it; no sample is left out for it."""
    recipe = small(time_axis=tt.TimeAxis(2.0, 0.2, 45), vary={"white.reflectance.value": D.Uniform(0.1, 0.95)})
    with pytest.warns(PhysicsWarning, match=r"more than 1% in \d+ of 64 samples.* of all samples .*kept all the same"):
        found = recipe.check()
    missed = [sum(recipe.sample(index).outside) for index in range(64)]
    assert found.samples == 64 and found.cut == sum(share > 0.01 for share in missed) and 0 < found.cut < 64
    assert found.mean == pytest.approx(np.mean(missed), rel=1e-6) and found.most == pytest.approx(max(missed), rel=1e-6)
    # It is looked at once.
    with monkeypatch.context() as patch:
        patch.delattr(tt.TransientRenderer, "forward")
        with pytest.warns(PhysicsWarning, match=f"in {found.cut} of 64 samples"):
            data = D.RecipeDataset(recipe, 64)
    assert pickle.loads(pickle.dumps(recipe)) == recipe
    assert float(data[3]["outside"].sum()) == pytest.approx(missed[3], rel=1e-6)
    # As many others: their share lies within the interval, but once in 20 times.
    others = sum(sum(recipe.sample(index).outside) > 0.01 for index in range(64, 128))
    low, high = found.expected
    assert low < found.cut / 64 < high and low - 0.1 < others / 64 < high + 0.1
    # Wilson's: its ends p are 1.96 standard deviations of a share of n samples away from k / n.
    for cut, samples in ((0, 64), (8, 64), (63, 64), (16, 16)):
        for p in replace(found, cut=cut, samples=samples).expected:
            if 0 < p < 1:
                assert (p - cut / samples) ** 2 == pytest.approx(1.96**2 * p * (1 - p) / samples, rel=1e-9)
            else:
                assert p == cut / samples


@pytest.mark.slow
def test_all_processes_make_the_same_bytes(tmp_path):
    recipe = small(time_axis=tt.TimeAxis(2.0, 0.2, 40), vary={"white.reflectance.value": D.Uniform(0.1, 0.95)})
    with pytest.warns(PhysicsWarning, match="of 64 samples"):
        done = D.generate(recipe, tmp_path / "set", 8, workers=1, progress=False)
    with pytest.warns(PhysicsWarning, match="of 64 samples"):
        read = D.RecipeDataset(recipe, 8)
    stored = D.TransientDataset(tmp_path / "set")
    assert (done.samples, done.failed, len(stored)) == (8, 0, 8)
    with pytest.warns(PhysicsWarning, match="of 8 samples"), D.OnlineDataset(recipe, 8, warm=8, uses=9) as online:
        drawn = {one["index"]: one for one in (online.draw() for _ in range(40))}
    for index in range(8):
        for other in (read[index], drawn.get(index, read[index])):
            assert torch.equal(stored[index]["transient"], other["transient"])
            assert torch.equal(stored.outside[index], other["outside"])


@pytest.mark.slow
def test_standard_error_falls_with_samples():
    """As the square root; of renders that are little but noise it is close to one."""
    plane = tt.scenes.light_over_plane()
    few, many = (
        np.mean([one._maker.standard_error(i) for i in range(3)])
        for one in (D.Recipe(plane, variant=VARIANT, spp=spp, sampler="independent") for spp in (256, 4096))
    )
    # By the power of the light instead of that of light and noise.
    assert (few / np.sqrt(1 - few**2)) / (many / np.sqrt(1 - many**2)) == pytest.approx(4, rel=0.2)
    assert 0.8 < small(spp=1, time_axis=tt.TimeAxis(2.0, 0.01, 1200))._maker.standard_error(0) < 1.1


def test_devices_measure_and_vary():
    axis = tt.sensing.device("vl53l8_like").axis()
    recipe = small(device="vl53l8_like", time_axis=axis)
    first, again = recipe.sample(1), pickle.loads(pickle.dumps(recipe)).sample(1)
    same(first, again)
    counts = first.arrays["measurement"]
    assert counts.shape == first.arrays["transient"].shape and (counts == np.round(counts)).all() and counts.any()
    vary = {"device.PhotonBudget.cycles": D.Choice([1000, 100000])}
    bright = small(vary=vary, device="vl53l8_like", time_axis=axis)
    found = [bright.sample(index) for index in range(6)]
    sums = {float(one.values["device.PhotonBudget.cycles"]): one.arrays["measurement"].sum() for one in found}
    assert sums[100000.0] > 20 * sums[1000.0]


@pytest.mark.slow
def test_captures_around_a_corner():
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(width=1.0, height=1.0), (4, 4), kind="confocal")
    turned = tt.scenes.transforms.rotate([0, 1, 0], 180) @ np.diag([0.3, 0.3, 1, 1])
    hidden = {"letter": {"type": "rectangle", "to_world": tt.scenes.transforms.translate([0, 0, 1.0]) @ turned}}

    def capture(bins, low=(-0.2, -0.2, 0), high=(0.2, 0.2, 0.3)):
        vary = {"letter.to_world": D.Offset(low, high)}
        axis = bins and tt.TimeAxis(0, 0.02, bins)
        return D.Recipe(hidden, vary, scan=scan, variant=VARIANT, time_axis=axis, spp=64)

    with pytest.raises(SceneError, match="time_axis"):
        capture(None)
    recipe = capture(200)
    sample = recipe.sample(2)
    assert sample.arrays["transient"].shape == (1, 200, 4, 4) and sample.arrays["transient"].sum() > 0
    again = D.Recipe.from_dict(json.loads(json.dumps(recipe.to_dict())))
    recipe.sample(5)
    same(recipe.sample(2), sample)
    same(again.sample(2), sample)
    over_time = sample.arrays["transient"].sum((0, 2, 3)).cumsum()
    short = capture(int(np.searchsorted(over_time, over_time[-1] / 2))).sample(2)
    share = 1 - short.arrays["transient"].sum() / sample.arrays["transient"].sum()
    assert sum(short.outside) == pytest.approx(share, abs=1e-3) and 0.05 < share < 0.95
    with pytest.raises(PhysicsError):  # an object in the way of the laser
        capture(200, [0, 0, -0.95], [0, 0, -0.95]).sample(0)


# ------------------------------------------------------------------------------------------------------ what is wrong


RED = "red.reflectance.value"
BOX, LIGHT, EYE = "small-box.to_world", "light.to_world", "sensor.to_world"
AWAY = D.Offset([0, 0, -30], [0, 0, 0])
CYCLES = "device.PhotonBudget.cycles"


def without(*names):
    return {key: node for key, node in box().items() if key not in names}


def other_names():
    nodes = [box()["small-box"], box()["small-box"] | {"bsdf": {"type": "conductor"}}]
    return small(vary={"small-box": D.Choice(nodes)}, labels=["material"])


def of_two(**settings):
    return small(D.OneOf([box(), tt.scenes.cornell_box(**{"resolution": 8, **settings})]), {})


WRONG = {
    "unknown key": (lambda: small(vary={"red.reflectnce.value": D.Uniform(0, 1)}), SceneError, "Did you mean 'red.re"),
    "too bright": (lambda: small(vary={RED: D.Uniform(0, 1.2)}), UnitError, "more than all"),
    "normal": (lambda: small(vary={RED: D.Normal(0.5, 0.2)}), UnitError, "share of the light"),
    "flat": (lambda: small(vary={BOX: D.Scale(0, 1)}), UnitError, "no inverse"),
    "leaves": (lambda: small(vary={BOX: AWAY}), SceneError, "leaves the window"),
    "light leaves": (lambda: small(vary={LIGHT: AWAY}), SceneError, "leaves the window"),
    "no light": (lambda: small(without("light"), {RED: D.Uniform(0, 1)}), SceneError, "without any emitter"),
    "light off": (lambda: small(vary={"light.emitter.radiance.value": D.Uniform(0, 0)}), SceneError, "no light ever"),
    "whole node": (lambda: small(vary={"red": D.Uniform(0, 1)}), SceneError, "whole 'diffuse'"),
    "unknown plugin": (lambda: small(vary={"small-box.type": D.Choice(["cube", "nonsense"])}), SceneError, "nonsense"),
    "label": (lambda: small(labels=("depht",)), ArgumentError, "depht"),
    "what is kept": (lambda: small(keep=["depth"]), ArgumentError, "expected some of transient, steady, got .'depth'"),
    "nothing kept": (lambda: small(keep=[]), ArgumentError, "expected some of transient"),
    "device": (lambda: small(device="vl53l9"), ArgumentError, "vl53l8_like"),
    "device key": (lambda: small(vary={CYCLES: D.Uniform(1, 2)}), SceneError, "give device="),
    "device argument": (
        lambda: small(vary={CYCLES[:-1]: D.Choice([1])}, device="vl53l8_like"), TorchTransientError, "cycle"
    ),
    "device of phasors": (lambda: small(frequencies=[0.0], device="vl53l8_like"), SceneError, "transients"),
    "films of two sizes": (lambda: of_two(resolution=4), ShapeError, "size"),
    "two axes": (lambda: of_two(num_bins=60, bin_width_opl=0.1, start_opl=4.0), ShapeError, "axis"),
    "label of phasors": (lambda: small(frequencies=[0.0], labels=["first_return"]), SceneError, "off a transient"),
    "label without pixels": (
        lambda: D.Recipe(tt.scenes.light_over_plane(), variant=VARIANT, labels=["depth"]), SceneError, "line of its own"
    ),
    "parameters of a dictionary": (lambda: small(parameters={"resolution": 64}), SceneError, "dictionary has none"),
    "labels that count other things": (other_names, SceneError, "would stand for another"),
    "key of one scene": (lambda: small(D.OneOf([box(), without("small-box")])), SceneError, "small-box"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_said_before_anything_is_rendered(wrong, monkeypatch):
    make, error, words = WRONG[wrong]

    def render(*arguments, **keywords):
        raise AssertionError("rendered")

    monkeypatch.setattr(tt.TransientRenderer, "forward", render)
    with pytest.raises(error, match=words):
        make().check()


@pytest.mark.slow
def test_a_scene_for_every_sample_is_told():
    scene = box() | {"ball": {"type": "sphere", "center": [0.0, -0.6, 0.2], "radius": 0.1}}
    for key, words in (
        ("red.reflectance", "'red.reflectance.value' varies as a value"), ("ball.radius", "as many as it"),
    ):  # fmt: skip
        with pytest.warns(TorchTransientWarning, match=words):
            small(scene, vary={key: D.Uniform(0.1, 0.3)}).check()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*builds a scene of its own")
        small(scene, vary={"ball.radius": D.Choice([0.1, 0.3])}).check()


@pytest.mark.parametrize("broken", ["transient", "steady"])
def test_light_that_is_not_finite_is_no_sample(monkeypatch, broken):
    """Labels may have NaN where nothing is seen."""
    forward, recipe = tt.TransientRenderer.forward, small(labels=("depth",))

    def unlit(*given, **more):
        out = forward(*given, **more)
        light = getattr(out, broken)
        light[(0,) * light.ndim] = float("nan")
        return out

    monkeypatch.setattr(tt.TransientRenderer, "forward", unlit)
    with pytest.raises(UnitError, match=f"sample 5: {broken} has numbers that are not finite"):
        recipe.sample(5)


@pytest.fixture
def unrendered(monkeypatch):
    """A check passes; its renders, which follow, fail at once."""

    def render(*arguments, **keywords):
        raise SceneError("not rendered")

    monkeypatch.setattr(tt.TransientRenderer, "forward", render)
    with pytest.warns(TorchTransientWarning, match="not rendered"):
        yield


def test_a_reflectance_of_nothing_and_of_all_is_possible(unrendered):
    small(vary={RED: D.Uniform(0, 1)}).check()


def test_numbers_of_samples():
    for wrong, words in ((-1, "at least 0"), (1.7, "whole number")):
        with pytest.raises(ShapeError, match=words):
            small().sample(wrong)
    assert small().sample(np.int64(1)).index == 1


# ------------------------------------------------------------------------------------------- distributions of one's own


@dataclass(frozen=True, eq=False)
class Blob(D.Distribution):
    """A texture with a square somewhere: arrays that look alike when they are printed."""

    name = "test_blob"

    def draw(self, random, place):
        pixels = np.zeros((40, 40, 3), np.float32)
        row, column = (random.random((2,)) * 14 + 4).astype(int)
        pixels[row : row + 18, column : column + 18] = 1
        return {"type": "bitmap", "data": pixels, "raw": True}


@dataclass(frozen=True, eq=False)
class Ball(D.Distribution):
    """By rejection: numbers at the ends never fit."""

    name = "test_ball"
    radius: float = 0.1

    def draw(self, random, place):
        moved = place.base("Ball").copy()
        while True:
            point = 2 * random.random((3,)) - 1
            if point @ point <= 1:
                break
        moved[:3, 3] += self.radius * point
        return moved


@dataclass(frozen=True, eq=False)
class Steps(D.Uniform):
    name = "test_steps"

    def draw(self, random, place):
        return np.round(super().draw(random, place) * 4) / 4


def test_entries_that_look_alike_are_other_structures():
    scene = box() | {"white": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1] * 3}}}
    recipe = small(scene, {"white.reflectance": Blob()}, variant="llvm_ad_rgb")
    assert len({recipe.structure(index).key for index in range(3)}) == 3
    assert len({recipe.structure(index).text for index in range(3)}) == 3


def test_a_distribution_that_rejects_is_checked(unrendered):
    small(vary={BOX: Ball()}).check()
    # Both ends at once have no direction, which no sample draws.
    point = D.Uniform([-0.5, -0.5, 3], [0.5, 0.5, 4])
    small(vary={EYE: D.LookAt(point, point)}).check()


def test_distributions_of_ones_own_are_told_apart():
    uniform, steps = small(vary={RED: D.Uniform(0.1, 0.9)}), small(vary={RED: Steps(0.1, 0.9)})
    assert uniform != steps and uniform.key() != steps.key()
    again = D.Recipe.from_dict(json.loads(json.dumps(steps.to_dict())))
    assert again == steps and again.draw(3) == steps.draw(3) != uniform.draw(3)
    assert small(vary={BOX: Ball(0.2)}).key() != small(vary={BOX: Ball(0.1)}).key()


def test_distributions_that_cannot_be_told_apart_are_refused():
    class Nameless(D.Uniform):
        pass

    class WithInit(D.Uniform):
        name = "test_with_init"

        def __init__(self, low):
            super().__init__(low, low)

    for wrong, words in ((Nameless(0, 1), "name of its own"), (WithInit(0.5), "settings are fields")):
        with pytest.raises(SceneError, match=words):
            small(vary={RED: wrong})
    with pytest.raises(SceneError, match="'uniform' is that of"):

        class Taken(D.Uniform):
            name = "uniform"


def test_recipes_of_a_class_of_ones_own_have_another_key():
    class Own(D.Recipe):
        pass

    assert Own(box(), variant=VARIANT).key() != D.Recipe(box(), variant=VARIANT).key()


def test_what_scenes_have_of_their_own_is_told_by_scene():
    turned = dict(reversed(list(box().items())))
    recipe = small(D.OneOf({"a": box(), "b": turned}), {}, labels=["shape"])
    about = recipe._maker.about()
    assert about["shapes"]["a"] == about["shapes"]["b"][::-1]


# ------------------------------------------------------------------------------------------------ orders, kinds, ends


@pytest.mark.slow
def test_nodes_are_exchanged_before_what_is_in_them():
    """Whatever the order of the keys."""
    colours = [{"type": "diffuse", "reflectance": value} for value in (0.2, 0.7)]
    node = {"type": "sphere", "radius": 0.9, "center": [0.0, 0.0, 0.5], "bsdf": {"type": "diffuse", "reflectance": 0.1}}
    scene = box() | {"thing": node}
    first = {"thing.bsdf": D.Choice(colours), "thing": D.Choice([node, node | {"radius": 0.8}])}
    for vary in (first, dict(reversed(list(first.items())))):
        recipe = small(scene, vary, labels=["albedo"])
        sample = recipe.sample(0)
        expected = 0.2 if sample.values["thing.bsdf"] == "#0" else 0.7
        assert sample.arrays["albedo"][0, 4, 4] == pytest.approx(expected)
    lacking = first | {"thing": D.Choice([{"type": "sphere"}])}
    with pytest.raises(SceneError, match="no entry of the scene any more"):
        small(scene, lacking).check()


@pytest.mark.slow
def test_what_seldom_comes_is_checked():
    with pytest.raises(UnitError, match=r"with choice 1 of 'red.reflectance.value', .*more than all"):
        small(vary={RED: D.Choice([0.5, 7.0, 0.4], weights=[1, 1e-6, 1])}).check()
    broken = box() | {"thing": {"type": "ply", "filename": "nowhere.ply"}}
    with pytest.raises(SceneError, match="broken"):
        small(D.OneOf({"full": box(), "broken": broken}, weights=[1, 1e-6]), {}).check()
    device = {"device": "vl53l8_like", "time_axis": tt.sensing.device("vl53l8_like").axis()}
    with pytest.raises(TorchTransientError, match="cycles"):
        small(vary={CYCLES: D.Choice([10, 0, 20], weights=[1, 1e-6, 1])}, **device).check()
    with pytest.raises(SceneError, match="stages, numbered from 0"):
        small(vary={"device.99.cycles": D.Choice([10])}, **device).check()


@pytest.mark.slow
def test_devices_and_polarization():
    """Of polarized light a detector counts S0; one that looks at polarization needs polarized light."""
    axis = tt.sensing.device("vl53l8_like").axis()
    counted = small(variant="llvm_ad_mono_polarized", device="vl53l8_like", time_axis=axis).sample(0)
    assert counted.arrays["measurement"].shape == counted.arrays["transient"].shape[1:]
    mosaic = {"device": "imx250mzr_like", "time_axis": tt.TimeAxis(2.0, 12.0, 1)}
    small(variant="llvm_ad_mono_polarized", **mosaic).check()
    with pytest.raises(ShapeError):
        small(**mosaic).check()


def test_a_recipe_does_not_change():
    values = np.array([0.1, 0.2])
    recipe = small(vary={RED: D.Choice(values)})
    key = recipe.key()
    values[:] = 0.5
    assert recipe.key() == key
    with pytest.raises(TypeError):
        recipe.vary["x"] = D.Uniform(0, 1)


@pytest.mark.slow
def test_transforms_of_mitsuba():
    import mitsuba as mi

    mi.set_variant(VARIANT)
    pose = mi.ScalarTransform4f().translate([0.1, -0.7, 0.2]).scale(0.3)
    for vary in ({BOX: D.Choice([pose])}, {"small-box": D.Choice([box()["small-box"] | {"to_world": pose}])}):
        recipe = small(vary=vary)
        again = pickle.loads(pickle.dumps(recipe))
        assert again.key() == recipe.key()
        same(again.sample(0), recipe.sample(0))


# ------------------------------------------------------------------- the shortest path of light, between boxes

# A ball of radius one that moves to (0, 0, 11), seen from (0, 0, -4): its box spans (-1, -1, 10) to (1, 1, 12).
LAMP = {"type": "point", "position": [0.0, 3.0, 1.0], "intensity": 1.0}
TO_BALL, TO_EYE = np.hypot(2.0, 9.0), 14.0


def ball(end, lamp=LAMP, vary=None, integrator=None, **settings):
    scene = {
        "type": "scene",
        "integrator": integrator or {"type": "transient_path", "max_depth": 2},
        "sensor": {
            "type": "perspective", "fov": 40.0, "to_world": look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "transient_hdr_film", "width": 2, "height": 2},
        },
        "ball": {"type": "sphere", "to_world": translate([0.0, 0.0, 1.0]), "bsdf": {"type": "diffuse"}},
        "lamp": lamp,
    }  # fmt: skip
    away = {"ball.to_world": D.Offset([0, 0, 10], [0, 0, 10])}
    axis = tt.TimeAxis(0.0, end / 4, 4)
    return D.Recipe(scene, away | (vary or {}), variant="llvm_ad_mono", spp=1, time_axis=axis, **settings)


def shortest(made):
    """The shortest path, where the window is too short for it."""
    with pytest.raises(SceneError, match=r"'ball\.to_world' .* leaves the window") as caught:
        made.check()
    return float(str(caught.value).split(" is ")[1].split(" m,")[0])


@pytest.mark.usefixtures("unrendered")
def test_the_shortest_path_from_a_light_to_an_eye():
    assert shortest(ball((TO_BALL + TO_EYE) * (1 - 1e-3))) == pytest.approx(TO_BALL + TO_EYE, rel=1e-3)
    ball((TO_BALL + TO_EYE) * (1 + 1e-3)).check()


def test_lights_and_eyes_that_move():
    vary = {"lamp.position": D.Choice([[0.0, 1.0, 6.0]])}
    assert shortest(ball(5.0, vary=vary)) == pytest.approx(4 + TO_EYE)
    vary = {"sensor.to_world": D.Offset([0, 0, 12], [0, 0, 12])}
    assert shortest(ball(5.0, vary=vary)) == pytest.approx(TO_BALL + 2, rel=1e-3)


def test_lights_with_a_shape():
    panel = {"type": "rectangle", "to_world": translate([0, 0, 15.0]), "emitter": {"type": "area", "radiance": 1.0}}
    assert shortest(ball(5.0, panel)) == pytest.approx(3 + TO_EYE)


def test_lengths_that_are_counted_from_the_first_thing_seen():
    unwarped = {"type": "transient_path", "max_depth": 2, "camera_unwarp": True}
    assert shortest(ball(5.0, integrator=unwarped)) == pytest.approx(TO_BALL, rel=1e-3)


@pytest.mark.usefixtures("unrendered")
def test_lights_without_a_place_and_pulses_are_not_checked():
    ball(1.0, {"type": "constant", "radiance": 1.0}).check()
    ball(1.0, pulse=tt.Pulse.gaussian(0.5)).check()
