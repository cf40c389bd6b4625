"""From where outlines are looked for, what of them is lacking, and when a scan's light is that of its points."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import transform
from torchtransient.errors import TorchTransientWarning
from torchtransient.plugins.around_corner import outlines, shared_light
from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.parameter_effect import CORRECT
from torchtransient.plugins.parameters import effect_of
from torchtransient.plugins.transport.material_points import FoundVacuum, MaterialVacuum
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.vacuum import Vacuum

VARIANT = "llvm_ad_mono"


TRIANGLES, INTO = "without triangles", "run into"


@pytest.mark.parametrize(("least", "most", "words"), [
    (0, 2, []), (3, 3, [TRIANGLES, INTO]), (0, 7, [TRIANGLES, INTO]), (4, 7, [INTO]),
])  # fmt: skip
def test_what_is_lacking_in_words(least, most, words):
    """Of late light rims of shapes that have no edges at all, too."""
    cube, ones = {"type": "cube"}, mi.TensorXf(np.arange(8, dtype=np.float32).reshape(2, 2, 2, 1) - 4)
    effect = effect_of(mi.load_dict(cube), "to_world")
    for grid, rims in (({}, []), ({"grid": {"type": "sdfgrid", "grid": ones}}, ["at the rims"] * (most > 3))):
        edges = outlines.silhouettes(mi.load_dict({"type": "scene", "cube": cube, **grid}), least, most)
        said = edges.reason(None, "to_world", effect)
        assert [gap.where[:11] for gap in edges.lacking(None, "to_world", effect)] == rims
        assert (said == CORRECT) == (not words)
        assert [word for word in (TRIANGLES, INTO, "at the rims") if word in said] == words + rims


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


@pytest.mark.slow
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


RIM, NONE = Local(ends=[1]), Local(ends=[])
PARTS = [(0, RIM), (1, RIM), (2, NONE), (3, None)]


def term_of(monkeypatch, pairs, moving=(), spp=10, **facts):
    """(the job's boundary term, which pairs were asked for) of four parts, each a shape; scanned points lie on 3."""
    facts = {"geometry": True, "sensor": False, "light": False, "followed": True, "depths": (0, 7)} | facts
    points = Local(p=np.arange(12.0).reshape(4, 3), n=-np.arange(12.0).reshape(4, 3), references=[2, 0], shapes={13})
    shapes = [Local(ptr=100 + k, number=10 + k, id=lambda k=k: f"s{k}") for k in range(4)]
    parts, asked = [Local(shapes=frozenset([k]), edges=edges) for k, edges in PARTS], []

    def hiding_pairs(given, viewpoints, is_requested):
        assert given is parts and viewpoints is points.p
        asked.append([[is_requested(i, j) for j in range(4)] for i in range(4)])
        return pairs

    monkeypatch.setattr(outlines, "follows_outlines", lambda segment, contents: facts["followed"])
    monkeypatch.setattr(outlines, "Viewpoints", lambda scanned, spots, confocal: points)
    monkeypatch.setattr(outlines, "registry_number", lambda shape: shape.number)
    monkeypatch.setattr(outlines, "parts_of", lambda given: (parts, "triangles"))
    monkeypatch.setattr(outlines, "hiding_pairs", hiding_pairs)
    monkeypatch.setattr(outlines, "OutlineTable", lambda *given: given)
    monkeypatch.setattr(outlines, "passes_of", lambda *given: (given, None))
    spots = Local(spots=Local(si=mi.Float(0)), confocal=False)
    world = Local(wanted=Local(geometry=facts["geometry"], sensor=facts["sensor"], light=facts["light"],
                               shapes={100 + k for k in moving}), segment=None, contents=None, connections=[spots],
                  min_depth=facts["depths"][0], max_depth=facts["depths"][1],
                  scene=Local(shapes=lambda: shapes))  # fmt: skip
    sampler = Local(clone=lambda: Local(sample_count=lambda: 27))
    found = outlines.mutual_occlusion("integrator", world, Local(sampler=lambda: sampler), "film", 5, spp, "scanned")
    return found, asked


@pytest.mark.parametrize("facts", [
    {"geometry": False, "moving": [0]}, {"followed": False, "moving": [0]}, {}, {"moving": [0], "depths": (4, 7)},
    {"moving": [0], "depths": (0, 2)}, {"moving": [0], "pairs": []}, {"moving": [0], "pairs": [(2, 0)]},
])  # fmt: skip
def test_jobs_without_outlines_to_follow(monkeypatch, facts):
    """Nothing moves, no light of three bounces, nothing hides anything, or what does has no edges."""
    assert term_of(monkeypatch, **{"pairs": [(0, 1)], **facts})[0] is None


@pytest.mark.parametrize("depths", [(3, 3), (0, 7)])
def test_jobs_with_outlines(monkeypatch, depths):
    """The edges of all that hides something, seen from the points that stand for all; a quarter of the samples."""
    pairs = [(1, 0), (2, 0), (0, 1), (1, 3)]
    for spp, count in ((10, 2), (3, 1), (0, 6)):
        found, _ = term_of(monkeypatch, pairs, moving=[0], spp=spp, depths=depths)
        triangles, edges, p, n = found.edges
        assert triangles == "triangles" and edges == [RIM, RIM]
        assert (p[:, 0].tolist(), n[:, 0].tolist()) == ([6, 0], [-6, 0])
        _, film, seed, samples, _ = found.jobs
        assert film is found.film and samples == count and seed[0] not in (5, 0)
    with pytest.warns(TorchTransientWarning, match=r"\('s3' hides 's0'\)"):
        assert term_of(monkeypatch, [(0, 1), (3, 0)], moving=[0])[0].edges[1] == [RIM]


def test_pairs_that_may_change(monkeypatch):
    """Those of which one moves; all of them where points do that are looked from, or the shape that they lie on."""
    for facts in ({"sensor": True}, {"light": True}, {"moving": [3]}):
        assert np.all(term_of(monkeypatch, [], **facts)[1][0])
    expected = np.zeros((4, 4), dtype=bool)
    expected[1], expected[:, 1] = True, True
    np.testing.assert_array_equal(term_of(monkeypatch, [], moving=[1])[1][0], expected)


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
