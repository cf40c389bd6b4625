"""From where outlines are looked for, what of them is lacking, and when a scan's light is that of its points."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import transform
from torchtransient.errors import TorchTransientWarning
from torchtransient.plugins.around_corner import outlines, shared_light
from torchtransient.plugins.parameter_effect import CORRECT
from torchtransient.plugins.pointer_table import registry_number
from torchtransient.plugins.transport.segment.material import FoundVacuum, MaterialVacuum
from torchtransient.plugins.transport.segment.vacuum import Vacuum
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"


@pytest.mark.parametrize(("least", "most", "exhaustive", "lacking"), [
    (0, 2, False, []), (4, 7, True, ["more than three"]), (3, 3, False, ["without triangles", "run into"]),
    (0, 7, False, ["without triangles", "run into", "more than three"]), (3, 3, True, ["refused"]),
    (2, 5, True, ["refused", "more than three"]), (4, 4, False, ["more than three"]),
])  # fmt: skip
def test_what_is_lacking_in_words(least, most, exhaustive, lacking):
    said = outlines.silhouettes(least, most, exhaustive)
    if not lacking:
        assert said == CORRECT
        return
    parts = said.removeprefix("correct except ").removesuffix(" (no boundary term)").split(", ")
    assert len(parts) == len(lacking) and all(word in part for word, part in zip(lacking, parts, strict=True)), said


def test_segments_whose_outlines_are_followed():
    for segment, followed in ((Vacuum, False), (MaterialVacuum, True), (FoundVacuum, True)):
        assert outlines.follows_outlines(segment, Local(delays=None)) is followed
        assert not outlines.follows_outlines(segment, Local(delays="some"))


@pytest.fixture(scope="module")
def walls():
    """One that faces the viewer, and one that shows its back."""
    back = transform().translate([5, 0, 0]).rotate([0, 1, 0], 180)
    shapes = {"front": {"type": "rectangle"}, "back": {"type": "rectangle", "to_world": back}}
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def seen(scene, *x):
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(mi.Float(list(x)), 0.25, 3), mi.Vector3f(0, 0, -1)))


def test_points_that_hidden_things_are_seen_from(walls):
    """Scanned points and, but for confocal captures, spots, with normals towards the viewer; what meets nothing is
    none. Of each kind twenty-five stand for all.
    """
    numbers = [registry_number(shape) for shape in sorted(walls.shapes(), key=lambda shape: shape.id() != "front")]
    scanned, spots = seen(walls, -0.5, 20, 0.25, 0.5), seen(walls, 5.5, 5.25)
    found = outlines.Viewpoints(scanned, spots, False)
    np.testing.assert_allclose(found.p, [[x, 0.25, 0] for x in (-0.5, 0.25, 0.5, 5.5, 5.25)], atol=1e-6)
    np.testing.assert_allclose(found.n, np.tile([0, 0, 1], (5, 1)), atol=1e-6)
    assert found.shapes == set(numbers)
    counts = np.bincount(found.references, minlength=5)
    assert len(found.references) == 50 and counts.tolist() == [9, 8, 8, 13, 12]
    confocal = outlines.Viewpoints(scanned, spots, True)
    assert len(confocal.p) == 3 and confocal.shapes == {numbers[0]} and len(confocal.references) == 25
    many = outlines.Viewpoints(seen(walls, *np.linspace(-0.9, 0.9, 97)), seen(walls, 20.0), False)
    assert many.references.tolist() == np.linspace(0, 96, 25).astype(int).tolist()
    assert outlines.Viewpoints(seen(walls, 20.0), seen(walls, 20.0), False).references.tolist() == []


def test_normals_of_points_that_are_seen_edge_on(walls):
    """Those of the front, by shading normals that rays do not know of."""
    si = seen(walls, -0.5, 0.5)
    for z, up in ((0, 1), (-0.8, -1)):
        si.wi = mi.Vector3f(0.6, 0, z)
        np.testing.assert_allclose(outlines._visible(si)[1], [[0, 0, up]] * 2, atol=1e-6)


def test_names_of_what_hides_what():
    """Each pair of names once, three of them, and how many more; shapes without a name by their class."""
    shapes = [Local(id=lambda name=name: name, class_name=lambda: "Mesh") for name in ("a", "b", "c", "")]
    parts = [Local(shapes=frozenset(numbers), edges=edges) for numbers, edges in (([0], 1), ([2, 1], 1), ([3], None))]

    def told(*pairs):
        return outlines._names(shapes, parts, list(pairs))

    assert told((0, 1), (0, 0), (0, 1)) == "'a' hides 'b' and 'c', 'a' hides another part of itself"
    assert told((0, 1), (0, 2), (1, 0)).endswith("'a' hides 'Mesh', 'b' and 'c' hides 'a'")
    assert told((0, 1), (0, 2), (1, 0), (2, 0), (2, 1), (2, 1)).endswith("hides 'a', and 2 more")
    with pytest.warns(TorchTransientWarning, match=r"changes behind them \('Mesh' hides 'a'\)"):
        outlines._warn_of_limbs(shapes, parts, [(0, 1), (2, 0)])
    assert outlines._warn_of_limbs(shapes, parts, [(0, 1)]) is None
    assert "('a' hides 'Mesh')" in outlines._refusal(shapes, parts, [(0, 2)])


# ---------------------------------------------------------------------------------------------------------- the light


def test_spots_that_are_the_scanned_points(walls):
    """As many, at the same places to rounding, on the same side, all of them met."""
    points = seen(walls, 0.25, 5.5, -0.5)
    assert shared_light._same(points, points) and shared_light._same(seen(walls, 0.25, 5.5 + 1e-6, -0.5), points)
    assert not shared_light._same(seen(walls, 0.25, 5.5 + 1e-4, -0.5), points)
    assert not shared_light._same(seen(walls, 0.25), points)
    missed = seen(walls, 0.25, 20, -0.5)
    assert not shared_light._same(missed, missed)
    # A millionth of their coordinates, and of a metre.
    for z, off, same in ((0, 1e-6, True), (0, 1.2e-6, False), (3, 3.5e-6, True), (3, 4.6e-6, False)):
        at, beside = (Local(p=mi.Point3f(0, 0, [5, z]), wi=mi.Vector3f(0, 0, 1), is_valid=lambda: mi.Bool([True] * 2))
                      for z in (z, z + off))  # fmt: skip
        assert shared_light._same(beside, at) is same
    # That much itself is near enough.
    origin, tie = (Local(p=mi.Point3f(x, 0, 0), wi=mi.Vector3f(0, 0, 1), is_valid=lambda: mi.Bool(True))
                   for x in (0, float(np.float32(1e-6))))  # fmt: skip
    assert shared_light._same(tie, origin)
    turned = seen(walls, 0.25, 5.5, -0.5)
    turned.wi = -turned.wi
    assert not shared_light._same(turned, points)
    turned.wi.z = 0
    assert not shared_light._same(turned, points)
    np.testing.assert_array_equal(shared_light._rows(mi.Vector3f(1, 2, 3), 2), [[1, 2, 3]] * 2)


def test_what_moves_hidden_things_or_the_scan(walls):
    """What hidden shapes are and hold, alone or not."""
    front, back = sorted(walls.shapes(), key=lambda shape: shape.id() != "front")

    def asked(*nodes):
        world = Local(scene=walls, wanted=Local(nodes={node.ptr for node in nodes}))
        return shared_light.moves(world, [back]), shared_light.moves_scan(world, [back])

    assert [asked(), asked(back), asked(back.bsdf())] == [(False, False), (True, False), (True, False)]
    assert [asked(front), asked(front.bsdf()), asked(front, back)] == [(False, True), (False, True), (True, True)]
    assert asked(Local(ptr=12345)) == (False, True)
