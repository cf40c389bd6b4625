"""Shafts in the integrator: rays are left out where that pays, and the light is the same."""

import mitsuba as mi
import numpy as np
import pytest

import torchtransient.plugins.around_corner.shared_light as shared_light
from support.hidden_shapes import ball, mesh, wall_grid
from support.marks import long
from support.nlos_scenes import captures, film, plane, ratio, scan_scene, side
from support.third_bounce_runs import table_of, wall_of
from torchtransient.plugins.around_corner.shared_light import SharedThirdBounce
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.sampling.shared_samples import ScanTiles
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.usefixtures("no_leftovers")


@pytest.mark.parametrize("kind", long(["confocal", "single", "exhaustive"], ["single"]))
def test_rays_that_are_left_out_change_nothing(monkeypatch, kind):
    """A plate before another one, and a wall beside them: some elements are clear and some are not."""
    hidden = {"a": plane(), "b": side(), "c": plane(0.8, 0.2, 0.3, 0.2, 0.3)}
    shares, runs = [], []
    found = shared_light.spare_rays
    monkeypatch.setattr(shared_light, "spare_rays", lambda *a: shares.append(found(*a)))
    for pays in (True, False):
        monkeypatch.setattr(shared_light, "saves_time", lambda scene, rays, p=pays: p)
        points = 2 if kind == "exhaustive" else 4
        scene = scan_scene(hidden, kind, film(points, kind=kind), max_depth=3, third_bounce="shared")
        runs.append(captures(scene, 2048, 8))
    assert len(shares) == 8 and 0.05 < min(shares) <= max(shares) < 0.95
    value, error = ratio(*runs)
    assert error < 2e-3 and abs(value - 1) < 4 * error


def test_small_jobs_look_for_no_shafts(monkeypatch):
    monkeypatch.setattr(shared_light, "spare_rays", lambda *a: pytest.fail("not worth its time"))
    captures(scan_scene({"a": plane()}, max_depth=3, third_bounce="shared"), 16, 1)


def named(name, **facts):
    return Local(id=lambda: name, class_name=lambda: "Kind", **facts)


AGAINST = {
    "nothing": ({}, {}, None),
    "a film that lists": ({"exhaustive_scan": True, "most": 5}, {}, "an exhaustive capture is a phasors, which lists"),
    "a list of one capture": ({"most": 5}, {}, None),
    "sums of an exhaustive one": ({"exhaustive_scan": True}, {}, None),
    "a camera": ({"looks_at_points": False}, {}, "the sensor (Class) is no nlos_capture_meter"),
    "fog": ({}, {"media": "fog"}, "participating media"),
    "late surfaces": ({}, {"delays": "some"}, "scatter late, or are mixtures"),
    "mixtures": ({}, {"mixtures": "some"}, "scatter late, or are mixtures"),
    "metal": ({}, {"bsdfs": [named("a", diffuse=True), named("b", diffuse=False), named("", diffuse=False)]},
              "not all surfaces are diffuse (b, Kind)"),
    "four of them": ({}, {"bsdfs": [named(name, diffuse=False) for name in "abcd"]}, "diffuse (a, b, c)"),
    "a smooth wall": ({"wall": named("w", smooth=True)}, {}, "interpolated on the relay wall (w)"),
    "one without a name": ({"wall": named("", smooth=True)}, {}, "interpolated on the relay wall (Class)"),
    "a wall": ({"wall": named("w", smooth=False)}, {}, None),
    "curves": ({"shapes": [named("c", listed=True), named("d", listed=False), named("", listed=False)]}, {},
               "points cannot be drawn on d, Kind"),
    "four curves": ({"shapes": [named(name, listed=False) for name in "abcd"]}, {}, "drawn on a, b, c"),
    "overlaps": ({"overlapping": list("abcd")}, {}, "areas would count twice (a, b, c)"),
}  # fmt: skip


@pytest.mark.parametrize("case", AGAINST)
def test_what_stands_against_shared_samples(monkeypatch, case):
    facts, more, expected = AGAINST[case]
    facts = {"exhaustive_scan": False, "most": None, "looks_at_points": True, "wall": None, "shapes": [],
             "overlapping": []} | facts  # fmt: skip
    response = Local(exhaustive_scan=facts["exhaustive_scan"], lanes_at_most=lambda events: facts["most"],
                     plugin="phasors")  # fmt: skip
    sensor, asked = Local(film=lambda: response, get_shape=lambda: facts["wall"]), []
    table = Local(scene=Local(shapes=lambda: facts["shapes"]), sensor=sensor, looks_at_points=facts["looks_at_points"],
                  overlaps=lambda with_wall: asked.append(with_wall) or facts["overlapping"])  # fmt: skip
    contents = Local(**{"media": None, "delays": None, "mixtures": None, "bsdfs": []} | more)
    monkeypatch.setattr(shared_light, "class_of", lambda node: "Class")
    for name, fact in (("is_lambertian", "diffuse"), ("has_shading_normals", "smooth"), ("can_be_listed", "listed")):
        monkeypatch.setattr(shared_light, name, lambda node, fact=fact: getattr(node, fact))
    found = shared_light.why_not(table, contents, "asked")
    assert (expected is None) == (found is None) and (expected is None or expected in found)
    assert not found or found.endswith(")") == expected.endswith(")")
    assert set(asked) <= {"asked"}


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono_polarized"])
def test_variants_whose_paths_are_not_alike(variant):
    with mi.variant_context(variant):
        assert f"the variant {variant} gives" in shared_light.why_not(Local(scene=None, sensor=None), None, False)


def test_rays_that_would_be_traced(monkeypatch):
    """To every scanned point and every spot, but once where these are the same."""
    asked, spared = [], []
    monkeypatch.setattr(shared_light, "saves_time", lambda scene, rays: asked.append(rays) or len(asked) != 2)
    monkeypatch.setattr(shared_light, "spare_rays", lambda *given: spared.append(given))
    points, normals = wall_grid(3)
    sensors, spot = wall_of(points, normals), wall_of(points[:1] + 0.25, normals[:1])
    for spots in (spot, sensors, sensors):
        job = Local(light=Local(sensors=sensors, spots=spots), world=Local(scene="scene"))
        SharedThirdBounce._spare_rays(job, "elements", 7)
    assert asked == [70, 63, 63] and len(spared) == 2
    for (scene, elements, p, n), count in zip(spared, (10, 9), strict=True):
        assert (scene, elements) == ("scene", "elements")
        np.testing.assert_allclose(p, np.concatenate([points, points[:1] + 0.25])[:count], atol=1e-6)
        np.testing.assert_allclose(n, np.tile([0, 0, 1], (count, 1)))


def test_scans_of_what_is_near_have_tiles(monkeypatch):
    """Nearer than half their width, to some of the points; a density of their own then, and a table for this job."""
    points, normals = wall_grid(8)
    looked, found_distance = [], shared_light.distance_to
    monkeypatch.setattr(shared_light, "distance_to", lambda v, p: looked.append(p) or found_distance(v, p))
    for z, tiled in ((0.2, True), (0.9, False)):
        job = Local(light=Local(sensors=wall_of(points, normals)), tile=None,
                    world=Local(contents=Local(memory=Cache())))  # fmt: skip
        elements = table_of([mesh("a", ball((0.1, 0, z), 0.05, 1))])
        found = SharedThirdBounce._near(job, elements)
        assert (found is not elements) == tiled == (job.tile is not None)
        if tiled:
            centers = elements.elements.centers()
            some = np.linspace(0, 63, 25).round().astype(int)
            np.testing.assert_allclose(looked[0], points[some], atol=1e-6)
            distance = np.linalg.norm(centers[:, None] - points[some], axis=2).min()
            tiles = ScanTiles(points, normals, distance)
            assert np.array(job.tile).tolist() == tiles.tile.tolist() and found.tile_count == tiles.count > 1
            again = SharedThirdBounce._near(job, elements)
            assert again is not found and again.key == found.key


@pytest.mark.parametrize("of_hidden", [True, False])
@pytest.mark.parametrize("of_scan", [True, False])
@pytest.mark.parametrize("capture", ["CONFOCAL", "SINGLE"])
def test_what_derivatives_of_a_job_are_attached(monkeypatch, capture, of_hidden, of_scan):
    """Points where the scan moves, samples where what is hidden does, or the spot that lights them."""

    class Kept(Local):
        def detached(self):
            return "detached"

    monkeypatch.setattr(shared_light, "draw_samples", lambda elements, count, seed: Local(clear=(count, seed)))
    monkeypatch.setattr(shared_light, "ends_of_samples", lambda scene, elements, samples, meshes, laser: Kept(
        fields={"p": "samples"}, laser=laser))  # fmt: skip
    monkeypatch.setattr(shared_light, "ends_of_points", lambda *given: Kept(fields={"p": "points"}, given=given))
    monkeypatch.setattr(shared_light, "ThirdBounceGradients", lambda *given: given)
    monkeypatch.setattr(shared_light, "moves", lambda world, shapes: of_hidden)
    monkeypatch.setattr(shared_light, "moves_scan", lambda world, shapes: of_scan)
    spared = []
    monkeypatch.setattr(SharedThirdBounce, "_spare_rays", lambda job, *given: spared.append(given))
    monkeypatch.setattr(SharedThirdBounce, "_near", lambda *given: pytest.fail("tiles are for renders"))
    world = Local(wanted=Local(), scene="scene", contents=Local(meshes="meshes"))
    light = Local(sensors=Local(p="p"), spots=Local(q="q"), energy="energy")
    elements = Local(tile_count=3, shapes=["shape"])
    kind = shared_light.CaptureType[capture]
    job = SharedThirdBounce(world, "film", light, elements, kind, ("seed", 7))
    scene, film, samples, points, clear = job.gradients
    assert (scene, film, clear, spared) == ("scene", "film", (7, "seed"), [(elements, 21)])
    assert (points == "detached") == (not of_scan)
    assert (samples == "detached") == (not of_hidden and not (of_scan and capture == "SINGLE"))
    assert job._tables == ["samples", "points", "p", "q", "energy"] and job.tile is None
    if of_hidden and of_scan:
        assert samples.laser is (None if capture == "CONFOCAL" else light.spots)
        assert points.given == (light.sensors, light.spots, "energy")


@pytest.mark.parametrize(("capture", "near"), [("CONFOCAL", True), ("SINGLE", True), ("EXHAUSTIVE", False)])
def test_renders_of_what_is_near(monkeypatch, capture, near):
    """Tiles are asked for but in exhaustive captures; nothing is attached."""
    monkeypatch.setattr(shared_light, "draw_samples", lambda elements, count, seed: (elements, count, seed))
    monkeypatch.setattr(SharedThirdBounce, "_spare_rays", lambda job, *given: None)
    monkeypatch.setattr(SharedThirdBounce, "_near", lambda job, elements: Local(tile_count=2, name="near"))
    elements = Local(tile_count=1, name="all")
    job = SharedThirdBounce(Local(wanted=None), "film", None, elements, shared_light.CaptureType[capture], ("seed", 7))
    assert job.samples[0].name == ("near" if near else "all") and job.samples[1:] == (7, "seed")
    assert job.gradients is None


@pytest.mark.parametrize("legs", [True, False])
@pytest.mark.parametrize("kind", ["a beam", "a beam from the sensor", "an emitter"])
def test_light_of_a_scan(monkeypatch, kind, legs):
    """Spots that are the scanned points are one object with them, where the ways to both are; a beam's energy is told
    beside them, and that of an emitter is in the spots.
    """
    monkeypatch.setattr(shared_light, "points_of", lambda si, factor, length: (si, factor, length))
    origin = mi.Point3f(0.5, 0, 1)
    seen = Local(p=mi.Point3f([0.5, 3.5], 0, [-2, 5]))
    beam = Local(energy_at=lambda wavelengths, active: mi.UnpolarizedSpectrum(3))
    emitter = Local() if kind == "an emitter" else beam
    spots = Local(emitter=emitter, origin=mi.Point3f(0.5, 0, 1 + (kind == "a beam")), lit_interactions=lambda: "lit",
                  points=lambda legs, energy=True: ("spots", legs, energy))  # fmt: skip
    table = Local(sensor=Local(origin=origin), spots=spots, interactions=lambda: seen)
    for same in (True, False):
        monkeypatch.setattr(shared_light, "_same", lambda lit, points, same=same: same)
        for capture in shared_light.CaptureType:
            light = shared_light.scan_light(table, capture, legs)
            si, factor, length = light.sensors
            assert si is seen and factor == pytest.approx(1 / np.pi)
            assert np.array(length).tolist() == ([3, 5] if legs else [0])
            one = same and capture.name == "EXHAUSTIVE" and (kind.endswith("sensor") or (kind == "a beam" and not legs))
            assert (light.spots is light.sensors) == one
            if not one:
                assert light.spots == ("spots", legs, kind == "an emitter")
            assert light.energy[0] == (1 if kind == "an emitter" else 3)
