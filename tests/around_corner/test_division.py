"""Which light is found how, in scans that are not of one flat wall, and where surfaces all but touch."""

from __future__ import annotations

import functools

import mitsuba as mi
import numpy as np
import pytest

from support.marks import long, long_rows
from support.nlos_scenes import captures, film, plane, ratio, scan_scene, transform

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


BOUNCES = {"all to three": (0, 3), "three": (3, 3), "four": (4, 4)}
ON_AND_OFF = [("both on", "all to three"), ("spot off", "three"), ("points off", "four"), ("both off", "all to three")]


@pytest.mark.parametrize(("where", "which"), long_rows(ON_AND_OFF, ON_AND_OFF[:1]))
def test_points_and_spots_on_the_wall_and_off_it(where, which):
    """Light of two bounces from floor to wall, and hidden light by way of the wall, are there in every way."""
    bounces, spot, points = BOUNCES[which], where in ("spot off", "both off"), where in ("points off", "both off")
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


TWICE = ((0, 2, 1), (1, 2, 3), (0, 2, 1), (2, 3, 1))
BACK = ((0, 2, 1), (1, 2, 3), (0, 1, 2), (1, 3, 2))
CROSS = ((0, 2, 3), (0, 3, 1))
TWO_SIDED = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.7}}


def square(z=1.0, size=0.5):
    return {"type": "rectangle", "to_world": facing(z, size), "bsdf": {"type": "diffuse", "reflectance": 0.7}}


def disk(z=1.0, size=0.3):
    return square(z, size) | {"type": "disk"}


def facing(z, size):
    return transform().translate([0, 0, z]).rotate([0, 1, 0], 180).scale(size)


def sphere(x=0.0):
    return {"type": "sphere", "center": [x, 0, 1.0], "radius": 0.3, "bsdf": TWO_SIDED}


def cube(x=0.0, z=1.2, size=0.2):
    return {"type": "cube", "to_world": transform().translate([x, 0, z]).scale(size), "bsdf": TWO_SIDED}


def box_on_floor():
    below = transform().translate([0, -0.5, 1]).rotate([1, 0, 0], -90).scale([0.6, 0.4, 1])
    box = transform().translate([0, -0.3, 1]).scale(0.2)
    return {
        "floor": {"type": "rectangle", "to_world": below, "bsdf": TWO_SIDED},
        "box": {"type": "cube", "to_world": box, "bsdf": TWO_SIDED},
    }


def one_plate():
    return {"a": plate(1.0)}


@functools.cache
def light_of(alone):
    """Of what several hidden things look like, rendered once."""
    return captures(scan_scene(alone()), 2**11, 8)


# What is hidden, what it looks like (the same where None), and whether some of it lies in other parts.
OVERLAPS = {
    "listed twice": (lambda: {"a": plate(1.0, faces=TWICE)}, one_plate, True),
    "two plates": (lambda: {"a": plate(1.0), "b": plate(1.0, name="b")}, one_plate, True),
    "both sides, two-sided": (
        lambda: {"a": plate(1.0, faces=BACK, two_sided=True)}, one_plate, True
    ),
    "a millionth before": (lambda: {"a": plate(1.0), "b": disk(1 - 1e-6)}, one_plate, True),
    "disk in a disk": (lambda: {"a": disk(), "b": disk(size=0.1)}, lambda: {"a": disk()}, True),
    "front of cubes": (lambda: {"a": cube(), "b": cube(0.05, 1.1, 0.1)}, lambda: {"a": cube()}, True),
    "just behind": (lambda: {"a": plate(1.0), "b": plate(1.0 + 1e-5, name="b")}, lambda: {"a": plate(1.0)}, False),
    "box on a floor": (box_on_floor, None, False),
    "balls that cross": (lambda: {"a": sphere(), "b": sphere(0.2)}, None, False),
}  # fmt: skip


QUICK = ("listed twice", "just behind")


@pytest.mark.parametrize("name", long(OVERLAPS, QUICK))
def test_surfaces_in_surfaces_count_once(name):
    hidden, alone, overlap = OVERLAPS[name]
    found = division(scan_scene(hidden(), third_bounce="auto"))
    assert bool(found.shared) == (not overlap)
    if overlap:
        assert "some surfaces lie in others" in found.why_not
    if alone is None:
        expected = captures(scan_scene(hidden(), nlos_hidden_geometry_sampling=False), 2**13, 8)
    else:
        expected = light_of(alone)
    for way in ("auto", "paths"):
        # Where two surfaces are at one place, half of what is drawn is not what rays find.
        agree(captures(scan_scene(hidden(), **EVERY_WAY[way]), 2**11, 8), expected, 0.02)


@pytest.mark.slow
def test_overlaps_are_of_the_scene_as_it_is_now():
    apart, together = ({"a": plate(1.0), "b": plate(z, name="b")} for z in (1.2, 1.0))
    once = captures(scan_scene({"a": plate(1.0)}), 2**11, 4).sum() / 4
    for first, z in ((apart, 1.0), (together, 1.2)):
        scene = mi.load_dict(scan_scene(first), optimize=False)
        scene.integrator().render(scene, spp=16, seed=0)
        shown = mi.traverse(scene)
        moved = np.array(shown["b.vertex_positions"]).reshape(-1, 3)
        moved[:, 2] = z
        shown["b.vertex_positions"] = mi.Float(moved.ravel())
        shown.update()
        # Without the first plate's shadow on the second, light would be half as much again.
        assert np.array(scene.integrator().render(scene, spp=2**11, seed=1)[1]).sum() == pytest.approx(once, rel=0.02)


# -------------------------------------------------------------------------------------------------- fronts and backs


def turned(shape, albedo=0.7, two_sided=False):
    bsdf = {"type": "diffuse", "reflectance": albedo}
    return shape | {"bsdf": {"type": "twosided", "nested": bsdf} if two_sided else bsdf}


def mirrored(x, y, z, flip=False):
    def made(two_sided):
        to_world = transform().translate([0.1, 0.05, 0.9]).rotate([0, 1, 0], 160).scale([0.3 * x, 0.3 * y, 0.3 * z])
        return turned({"type": "rectangle", "to_world": to_world, "flip_normals": flip}, two_sided=two_sided)

    return made


def mirrored_cube(two_sided):
    to_world = transform().translate([0.1, 0.05, 0.9]).rotate([0, 1, 0], 30).scale([-0.2, 0.2, 0.2])
    return turned({"type": "cube", "to_world": to_world}, two_sided=two_sided)


def normals_against_corners(two_sided, interpolated=False):
    """A plate whose corners run clockwise as seen from where its normals point."""
    v = np.array([[-0.3, -0.3, 0.9], [0.4, -0.3, 0.8], [-0.3, 0.3, 0.9], [0.4, 0.3, 0.8]])
    made = mi.Mesh("a", 4, 2, has_vertex_normals=True, props=properties(0.7, two_sided))
    shown = mi.traverse(made)
    n = np.tile([-1 / 50**0.5, 0, -7 / 50**0.5], (4, 1))
    if interpolated:
        n[::2] = [-0.28, 0, -0.96]
    shown["vertex_positions"] = mi.Float(v.ravel().astype(np.float32))
    shown["faces"] = mi.UInt32([0, 1, 2, 2, 1, 3])
    shown["vertex_normals"] = mi.Float(n.ravel().astype(np.float32))
    shown.update()
    return made


# Faces the wall, or turns its back to it.
SIDES = {
    "as it is": (mirrored(1, 1, 1), True), "x": (mirrored(-1, 1, 1), True), "z": (mirrored(1, 1, -1), False),
    "z, flipped": (mirrored(1, 1, -1, True), True), "all": (mirrored(-1, -1, -1), False), "cube": (mirrored_cube, True),
    "normals against corners": (normals_against_corners, True),
    "interpolated against corners": (lambda two_sided: normals_against_corners(two_sided, True), True),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "two_sided"), long_rows([(name, n % 2 == 1) for n, name in enumerate(SIDES)], [("x", True)])
)
def test_fronts_are_where_shading_normals_point(name, two_sided):
    made, faces = SIDES[name]
    ways = {"brute": ({"nlos_hidden_geometry_sampling": False}, 2**14)}
    ways |= {way: (EVERY_WAY[way], 2**11) for way in ("auto", "paths")}
    runs = {
        way: captures(scan_scene({"a": made(two_sided)}, "single", film(3, start=0.0, width=0.05), **given), spp, 8)
        for way, (given, spp) in ways.items()
    }
    if not (faces or two_sided):
        assert all(run.sum() == 0 for run in runs.values())
        return
    agree(runs["auto"], runs["brute"], 0.02)
    agree(runs["paths"], runs["brute"], 0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "flip", "two_sided"), [([-0.5, 0.5, 1], True, True), ([0.5, 0.5, -1], True, False)])
def test_mirrored_walls(scale, flip, two_sided):
    wall = turned({"type": "rectangle", "to_world": transform().scale(scale), "flip_normals": flip}, 0.9, two_sided)
    expected = captures(scan_scene({"a": plane()}, "single"), 2**11, 8)
    for given in EVERY_WAY.values():
        agree(captures(scan_scene({"a": plane()}, "single", wall=wall, **given), 2**11, 8), expected, 0.02)


def seen_on_the_plate(size=800):
    """Mean over the picture of what the plate sends that the spot lights, without samples."""
    at = (2 * (np.arange(size) + 0.5) / size - 1) * np.tan(np.radians(30))
    x, y = (a.ravel() for a in np.meshgrid(at, at))
    # Where lines from (0, 0, 1) along (x, y, -1) meet the plane x = 0.42.
    t = 0.42 / np.where(x > 0, x, np.nan)
    p = np.stack([0.42 + 0 * t, t * y, 1 - t], 1)
    on = (np.abs(p[:, 1]) < 0.3) & (np.abs(p[:, 2] - 0.2) < 0.15)
    to = p[on] - [-0.2, 0.1, 0.0]
    r = np.linalg.norm(to, axis=1)
    return (0.9 * 0.7 / np.pi**2 * to[:, 0] * to[:, 2] / r**4).sum() / size**2


def test_cameras_whose_pixel_centres_lie_on_a_wall_see_more():
    """Light of two bounces comes by way of a plate at the edges of the pixels."""
    size, look = 2, transform().look_at([0, 0, 1.0], [0, 0, 0], [0, 1, 0])
    upright = transform().translate([0.42, 0, 0.2]).rotate([0, 1, 0], -90).scale([0.15, 0.3, 1])
    camera_film = film(size, start=0.0, width=0.1, bins=100)
    description = scan_scene({"plate": turned({"type": "rectangle", "to_world": upright}, two_sided=True)}, "single")
    description["wall"] = turned({"type": "rectangle", "to_world": transform().scale([2, 2, 1])}, 0.9)
    description["camera"] = {
        "type": "perspective", "fov": 60, "to_world": look, "film": camera_film, "sampler": {"type": "independent"}
    }  # fmt: skip
    description["integrator"] |= {"max_depth": 2}
    mean = captures(description, 2**16 // size**2, 8).reshape(8, -1).sum(1) / size**2
    error = mean.std(ddof=1) / 8**0.5
    assert error < 0.02 * mean.mean()
    assert abs(mean.mean() - seen_on_the_plate()) < SIGMAS * error
