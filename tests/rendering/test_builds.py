"""Scenes that are built of one description: how many are kept, which values they hold, and what keys ask for."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, GREY, VARIANT, make_room
from torchtransient.errors import ArgumentError, GradientError, SceneError, ShapeError, UnknownKeyError
from torchtransient.rendering import scene_handle, scene_state, session
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.taken import ReadyScene
from torchtransient.rendering.variant import active_variant


@pytest.fixture
def empty():
    """A scene that nobody has built."""
    return tt.load({"type": "scene"}, variant=VARIANT)


def test_eight_built_scenes_are_kept(empty, monkeypatch):
    """The last ones that were asked for, and what belongs to them."""
    built = []
    monkeypatch.setattr(scene_handle, "build", lambda *given: built.append(given[2].max_depth) or given[2].max_depth)
    options = [BuildOptions(max_depth=n) for n in range(10)]
    for one in options[:8]:
        assert empty._build(one) == one.max_depth
        empty.recordings(("a",), one)
    empty._build(options[0])
    assert built == list(range(8)) and len(empty._builds) == 8
    kept = empty.recordings(("a",), options[0])
    assert empty.recordings(["a"], options[0]) is kept and empty.recordings(("b",), options[0]) is not kept
    empty._build(options[8])
    assert [one.max_depth for one in empty._builds] == [2, 3, 4, 5, 6, 7, 0, 8]
    assert options[1] not in empty._recordings and empty.recordings(("a",), options[0]) is kept
    empty._build(options[1])
    assert built == [*range(9), 1]


class Table:
    """Values of a run, and whether they were put back."""

    def __init__(self, built, originals=(1,), fails=False):
        self.built, self.originals, self.fails, self.restored = built, originals, fails, 0

    def restore(self):
        self.restored += 1
        if self.fails:
            raise RuntimeError("torn")


def test_described_values_are_put_back_for_others(empty, monkeypatch):
    monkeypatch.setattr(scene_handle, "build", lambda *given: "built")
    options = BuildOptions(max_depth=3)
    empty._build(options)
    one = Table("built")
    empty.leave(options, one, attached=False)
    assert one.restored == 0
    empty.built(options)
    assert one.restored == 1 and empty.built(options) == "built" and one.restored == 1
    # At once, where a graph would live on and where others use the scene; not at all where nothing was written.
    empty.leave(options, one, attached=True)
    assert one.restored == 2
    monkeypatch.setattr(empty, "is_shared", True)
    empty.leave(options, one, attached=False)
    assert one.restored == 3
    monkeypatch.setattr(empty, "is_shared", False)
    nothing, dropped = Table("built", originals=()), Table("another")
    empty.leave(options, nothing, attached=True)
    empty.leave(options, dropped, attached=False)
    assert nothing.restored == dropped.restored == 0
    # Dropped in the middle of being put back, it may be alive and attached.
    empty.leave(options, dropped, attached=True)
    assert dropped.restored == 1 and empty._builds[options] == "built" and options not in empty._unsettled
    # A scene that cannot be put back is built anew.
    torn = Table("built", fails=True)
    with pytest.raises(RuntimeError, match="torn"):
        empty.leave(options, torn, attached=True)
    assert options not in empty._builds and options not in empty._unsettled


def test_runs_with_the_same_keys_find_what_they_left(empty, monkeypatch):
    monkeypatch.setattr(scene_handle, "build", lambda *given: object())
    monkeypatch.setattr(scene_handle, "SlotTable", lambda built, keys: Table(built))
    options, other = BuildOptions(max_depth=3), BuildOptions(max_depth=4)
    first = empty.slots(["a"], options)
    empty.slots(["a"], other)
    empty.leave(options, first, attached=False)
    assert empty.slots(("a",), options) is first and first.restored == 0
    assert list(empty._builds) == [other, options]
    empty.leave(options, first, attached=False)
    second = empty.slots(("b",), options)
    assert second is not first and first.restored == 1
    assert empty.slots(("a",), options) is first and first.restored == 1
    monkeypatch.setattr(empty, "is_shared", True)
    assert empty.slots(("a",), options) is not first


def test_what_keys_ask_for():
    scene = tt.load(make_room(), variant=VARIANT)
    plain = BuildOptions(max_depth=3)
    assert scene.options_for((), plain) == BuildOptions(max_depth=3, merge=True)
    assert scene.options_for([COLOUR], plain) == BuildOptions(max_depth=3, real_bitmaps=True)
    with pytest.raises(SceneError, match="the scene has no parameter 'colour'"):
        scene.options_for([COLOUR, "colour"], plain)
    with pytest.raises(GradientError, match=r"parameter 'box\.faces' has no derivative: a list of vertex numbers"):
        scene.options_for(["box.faces"], plain)
    assert scene.options_for(iter([GREY, COLOUR]), plain).real_bitmaps


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (3, "a tt.Scene or a mi.Scene, got int"), ([1], "got list"), (None, "got NoneType"),
        ({"type": "scene"}.items(), "got dict_items"),
    ],
)  # fmt: skip
def test_what_is_no_scene(given, words):
    with pytest.raises(ArgumentError, match=words):
        tt.load(given)


def test_parameters_of_files_are_for_files(empty):
    for given in ({"type": "scene"}, empty):
        with pytest.raises(ArgumentError, match=r"\$parameters of XML files \(a, b\) are for these alone, got"):
            tt.load(given, b=1, a=2)
    assert tt.load(empty) is empty and tt.load(empty, variant=VARIANT) is empty
    assert tt.load(empty, variant="llvm_ad_mono").variant == "llvm_ad_mono"
    mi.set_variant(VARIANT)
    ready = mi.load_dict({"type": "scene"})
    assert isinstance(tt.load(ready)._description, ReadyScene)
    with pytest.raises(ArgumentError, match="got the SceneParameters of one"):
        tt.load(mi.traverse(ready))


# -------------------------------------------------------------------------------------------------- values of scenes


@pytest.fixture(scope="module")
def params():
    """A mesh with texture coordinates, and a colour."""
    mi.set_variant(VARIANT)
    return mi.traverse(mi.load_dict({"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {
        "type": "rgb", "value": [0.1, 0.2, 0.7]}}}))  # fmt: skip


def test_values_are_the_same_memory_or_equal():
    same = scene_state._same
    one, two = mi.Float(1, 2), mi.Float(1, 2)
    assert same(one, mi.Float(one)) and not same(one, two) and not same(one, mi.UInt32(1, 2))
    assert same(1.5, 1.5) and not same(1.5, 2.5) and not same(1, 1.0) and same("a", "a")
    pose = mi.ScalarTransform4f().translate([1, 2, 3])
    assert same(pose, pose)


def test_parameters_that_are_not_set_are_no_values():
    """As the absorption of hair that has pigments: functions that reached it were a TypeError. Nor what is fixed."""
    fixed = mi.ParamFlags.ReadOnly.value

    def unset(*_):
        raise RuntimeError("not set")

    shown = {"a": (None, None, None, 0), "b": (2.5, None, None, 0), "c": (3.5, None, None, fixed),
             "d": (4.5, None, None, 2), "e": (5.5, None, None, 2 + fixed), "f": (unset, unset, unset, 0)}  # fmt: skip
    assert scene_state.values_of(SimpleNamespace(properties=shown)) == {"b": 2.5, "d": 4.5}
    hair = mi.load_dict({"type": "hair", "eumelanin": 0.25, "pheomelanin": 0.5})
    assert torch.equal(tt.wrap(lambda x: x * len((hair,)))(torch.ones(2)), torch.ones(2))


def test_only_what_has_changed_is_put_back(params, monkeypatch):
    written = []
    monkeypatch.setattr(scene_state, "_follow", lambda params, keys: written.append(list(keys)))
    before = scene_state.values_of(params)
    assert {"vertex_positions", "vertex_normals", "vertex_texcoords", "faces"} <= set(before)
    scene_state.put_back(params, before)
    scene_state.put_back(params, {}, {})
    assert written == []

    class Kept(dict):
        properties = params.properties

    target = Kept()
    now = dict(before) | {"vertex_texcoords": mi.Float([0.0] * 48)}
    scene_state.put_back(target, before, now)
    assert written == [["vertex_texcoords"]] and list(target) == ["vertex_texcoords"]
    # Normals go back with positions; what is not there any more, too.
    before = {f"a.{key}": value for key, value in before.items()}
    now = dict(before) | {"a.vertex_positions": mi.Float([0.0] * 72)}
    scene_state.put_back(target, before, now)
    del now["a.vertex_positions"]
    scene_state.put_back(target, before, now)
    assert written[1:] == [["a.vertex_positions", "a.vertex_normals"]] * 2
    assert target["a.vertex_normals"] is before["a.vertex_normals"]


def test_shapes_of_values(params):
    keys = ["vertex_positions", "bsdf.reflectance.value"]
    assert scene_state.shapes_of(params, keys, "f") == {keys[0]: (24, 3), keys[1]: (3,)}
    with pytest.raises(UnknownKeyError, match=r"f: `parameters` has no parameter 'colour'.*print\(params\) lists all"):
        scene_state.shapes_of(params, ["colour"], "f")
    with pytest.raises(SceneError, match="f: the parameter 'faces' is not an array of real numbers"):
        scene_state.shapes_of(params, ["faces"], "f")
    assert scene_state.variant_of(params) == VARIANT
    assert scene_state.variant_of(SimpleNamespace(properties={})) is None


def test_values_that_mitsuba_refuses(params):
    with pytest.raises(SceneError, match=r"f: values of bsdf\.reflectance\.value: Mitsuba refuses them: "):
        scene_state.write(params, {"bsdf.reflectance.value": "text"}, "f")


# ------------------------------------------------------------------------------------------------------ scenes in use


def test_values_that_are_installed(monkeypatch):
    """Of the entry of the item where they have a batch; derivatives for those that want one."""
    import drjit as dr

    mi.set_variant(VARIANT)
    got, checked = [], []
    slots = [
        SimpleNamespace(check=lambda v, n=n: checked.append((n, v.tolist())), loses_black=lambda n=n: n == 1)
        for n in range(3)
    ]
    table = SimpleNamespace(slots=slots, install=lambda leaves: got.extend(leaves))
    used = SimpleNamespace(slots=table, job=SimpleNamespace(batched=(True, False, True), keys=("a", "b", "c")))
    values = [torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([0.0, 0.5]), torch.tensor([5.0, 6.0])]
    monkeypatch.setattr(session, "lifted", lambda leaf: leaf + 1)
    leaves = session.Session.install(used, SimpleNamespace(entry=1), values, (False, True, True))
    assert checked == [(0, [3, 4]), (1, [0, 0.5]), (2, 6)] and got == leaves
    assert [np.array(leaf).tolist() for leaf in leaves] == [[3, 4], [1, 1.5], [6]]
    assert [dr.grad_enabled(leaf) for leaf in leaves] == [False, True, True]
    # What is black is lifted where it has a derivative alone.
    leaves = session.Session.install(used, SimpleNamespace(entry=0), values, (False, False, False))
    assert np.array(leaves[1]).tolist() == [0, 0.5] and np.array(leaves[2]).tolist() == [5]

    def refuse(error):
        def install(leaves):
            raise error

        table.install = install
        return lambda: session.Session.install(used, SimpleNamespace(entry=0), values, (False,) * 3)

    with pytest.raises(SceneError, match="values of a, b, c: Mitsuba refuses them: no"):
        refuse(RuntimeError("no"))()
    with pytest.raises(ShapeError, match=r"^no$"):
        refuse(ShapeError("no"))()


def test_loops_have_to_be_symbolic(monkeypatch):
    import drjit as dr

    session._check_flags()
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False), pytest.raises(tt.errors.VariantError, match="Symbolic"):
        session._check_flags()


@pytest.mark.parametrize(("seed", "items"), [(None, "own"), (torch.tensor(7), [7])])
def test_jobs_with_a_seed_that_is_known_later(seed, items):
    from dataclasses import fields

    given = dict.fromkeys((field.name for field in fields(session.RenderJob)), None)
    seeding = SimpleNamespace(items=lambda number: [number])
    job = session.RenderJob(**given | {"items": "own", "seeding": seeding, "keys": ("a",)})
    found = job.seeded(seed)
    assert found.items == items and found.keys == ("a",) and (found is job) == (seed is None)


# ------------------------------------------------------------------------------------------------------- of renderers


@pytest.mark.parametrize(
    ("bins", "filter_name", "looked"), [(1, "box", True), (1, "tent", False), (2, "tent", True), (2, "box", True)]
)
def test_windows_that_are_looked_at(room_scene, bins, filter_name, looked):
    """Of one bin for all times a wider filter spreads light over the rim."""
    made = tt.TransientRenderer(room_scene, time_axis=tt.TimeAxis(0.0, 50.0, bins), temporal_filter=filter_name)
    assert bool(made._watch.window_name) == looked


def test_samples_that_are_drawn():
    room = make_room()
    room["sensor"]["sampler"] = {"type": "stratified", "sample_count": 9}
    made = tt.TransientRenderer(tt.load(room, variant=VARIANT))
    assert [made.samples_drawn(n) for n in (None, 1, 9, 10, 16, 17)] == [9, 1, 9, 16, 16, 25]
    with active_variant(VARIANT):
        kept = made.scene.built(made._options).scene.sensors()[0].sampler().sample_count()
    assert kept == 9
