"""Scenes that are built of one description: how many are kept, which values they hold, and what keys ask for."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import SceneError, ShapeError, UnknownKeyError
from torchtransient.rendering import scene_state, session
from torchtransient.rendering.variant import active_variant
from torchtransient.testing.small_room import VARIANT, make_room

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
