"""Which light is found how, in scans that are not of one flat wall, and where surfaces all but touch."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import captures, film, plane, ratio, scan_scene, transform
from torchtransient.plugins.around_corner.division import Division
from torchtransient.plugins.sampling.doubled_faces import doubled_faces

VARIANT = "llvm_ad_mono"
SIGMAS = 4.0
FLOOR = [[0.2, -1.0, 0.6]]
EVERY_WAY = {
    "auto": {},
    "shared": {"third_bounce": "shared", "late_light": "chains"},
    "paths": {"third_bounce": "paths", "late_light": "paths"},
}


def agree(a, b, most_error):
    value, error = ratio(a, b)
    assert error < most_error
    assert abs(value - 1) < SIGMAS * error


def floor():
    to_world = transform().translate([0, -1, 0.6]) @ transform().rotate([1, 0, 0], -90)
    return {"type": "rectangle", "to_world": to_world @ transform().scale([1, 0.6, 1])}


def scan(points, spot, **integrator):
    """A plate before a wall with a floor, scanned and lit on either."""
    description = scan_scene({"a": plane(), "floor": floor()}, "single", film(2, start=0.0), **integrator)
    sensor = description["wall"]["sensor"] | {"sensor_origin": [-0.5, 0, 0.4], "laser_origin": [-0.5, 0, 0.4]}
    if points:
        x, z = np.meshgrid([-0.3, 0.3], [0.3, 0.8])
        sensor["points"] = mi.TensorXf(np.stack([x, np.full((2, 2), -1.0), z], -1).astype(np.float32))
    sensor["laser_points"] = mi.TensorXf(np.float32(FLOOR if spot else [[-0.2, 0.1, 0.0]]))
    description["wall"]["sensor"] = sensor
    return description


@pytest.mark.parametrize("bounces", [(0, 3), (3, 3), (4, 4)], ids=["all to three", "three", "four"])
@pytest.mark.parametrize(("points", "spot"), [(False, False), (False, True), (True, False), (True, True)])
def test_points_and_spots_on_the_wall_and_off_it(points, spot, bounces):
    """Light of two bounces from floor to wall, and hidden light by way of the wall, are there in every way."""
    given = {"min_bounces": bounces[0], "max_depth": bounces[1]}
    # Few of the paths of four bounces that begin on the floor go by way of the wall, and weigh much.
    spp, most_error = (2**13, 0.2) if bounces[0] == 4 else (2**11, 0.02)
    runs = {way: captures(scan(points, spot, **given, **choice), spp, 8) for way, choice in EVERY_WAY.items()}
    agree(runs["auto"], runs["paths"], most_error)
    agree(runs["shared"], runs["paths"], most_error)


def division(description):
    scene = mi.load_dict(description)
    integrator = scene.integrator()
    return integrator.division(scene, integrator.contents(scene, scene.sensors()[0]))


def test_a_wall_is_what_scan_and_laser_meet():
    on_wall = division(scan(False, False))
    assert list(on_wall.shared) == [3]
    assert not on_wall.walks
    for points, spot in ((False, True), (True, False)):
        found = division(scan(points, spot))
        assert not found.shared
        assert "the wall is not flat" in found.why_not
    # Everything on the floor: that is the wall of this scan.
    assert list(division(scan(True, True)).shared) == [3]
    shared = division(scan(True, False, third_bounce="shared"))
    assert list(shared.shared) == [3]
    assert shared.longest == 2


@pytest.mark.parametrize(
    ("shared", "first", "last", "itself", "longest"),
    [
        (range(3, 4), 0, 3, False, 0), (range(3, 4), 0, 3, True, 2), (range(3, 4), 3, 3, True, 0),
        (range(4, 8), 0, 7, False, 3), (range(4, 8), 4, 7, False, 0), (range(3, 6), 0, 9, False, 9),
        (range(3, 8), 2, 7, True, 2), (range(4, 6), 0, 5, True, 3),
    ],
)  # fmt: skip
def test_what_is_left_for_paths(shared, first, last, itself, longest):
    found = Division.of(shared, first, last, itself)
    assert (found.longest, found.walks) == (longest, longest > 0)


# ------------------------------------------------------------------------------------------- surfaces near each other


def plate(z, albedo=0.7, faces=((0, 2, 1), (1, 2, 3)), two_sided=False, name="a"):
    """A plate as a mesh with faces as they are listed."""
    mesh = mi.Mesh(name, 4, len(faces), props=properties(albedo, two_sided))
    shown = mi.traverse(mesh)
    corners = np.array([[-0.5, -0.5, z], [0.5, -0.5, z], [-0.5, 0.5, z], [0.5, 0.5, z]])
    shown["vertex_positions"] = mi.Float(corners.ravel().astype(np.float32))
    shown["faces"] = mi.UInt32(np.array(faces).ravel().astype(np.uint32))
    shown.update()
    return mesh


def properties(albedo, two_sided):
    props = mi.Properties()
    diffuse = {"type": "diffuse", "reflectance": {"type": "uniform", "value": albedo}}
    props["bsdf"] = mi.load_dict({"type": "twosided", "b": diffuse} if two_sided else diffuse)
    return props


@pytest.mark.parametrize("kind", ["confocal", "single"])
@pytest.mark.parametrize("way", EVERY_WAY)
def test_a_black_sheet_hides_what_is_just_behind_it(kind, way):
    hidden = {"a": plate(1.0), "sheet": plate(1.0 - 1e-5, 0.0, name="sheet")}
    open_plate = captures(scan_scene({"a": plate(1.0)}, kind, **EVERY_WAY[way]), 256, 1)
    assert captures(scan_scene(hidden, kind, **EVERY_WAY[way]), 256, 1).sum() < 1e-4 * open_plate.sum()


TWICE = ((0, 2, 1), (1, 2, 3), (0, 2, 1), (2, 3, 1))
BACK = ((0, 2, 1), (1, 2, 3), (0, 1, 2), (1, 3, 2))
DOUBLED = {
    "listed twice": (lambda: {"a": plate(1.0, faces=TWICE)}, 2),
    "two plates": (lambda: {"a": plate(1.0), "b": plate(1.0, name="b")}, 2),
    "both sides, one-sided": (lambda: {"a": plate(1.0, faces=BACK)}, 0),
    "both sides, two-sided": (lambda: {"a": plate(1.0, faces=BACK, two_sided=True)}, 2),
    "once": (lambda: {"a": plate(1.0)}, 0),
    "just behind": (lambda: {"a": plate(1.0), "b": plate(1.0 + 1e-5, name="b")}, 0),
}


@pytest.mark.parametrize("name", DOUBLED)
def test_triangles_in_triangles_count_once(name):
    hidden, faces = DOUBLED[name]
    assert sum(doubled_faces(list(hidden().values())).values()) == faces
    found = division(scan_scene(hidden(), third_bounce="auto"))
    assert bool(found.shared) == (not faces)
    if faces:
        assert "some triangles lie in others" in found.why_not
    runs = captures(scan_scene(hidden(), third_bounce="auto"), 2**11, 8)
    # Where two surfaces are at one place, half of what is drawn is not what rays find.
    agree(runs, captures(scan_scene({"a": plate(1.0)}), 2**11, 8), 0.02)
