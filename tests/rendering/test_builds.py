"""Scenes that are built of one description: how many are kept, which values they hold, and what keys ask for."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT, make_room
from torchtransient.errors import SceneError, ShapeError
from torchtransient.rendering import session
from torchtransient.rendering.variant import active_variant

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
