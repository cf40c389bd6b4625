"""Which points a scan's sensor looks at on walls of every kind, and what numbers it and its laser take."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.cases_curves import file_of
from torchtransient import plugins
from torchtransient.errors import PhysicsWarning, SceneError, UnitError
from torchtransient.scene.edits import BuildOptions

VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.5, 0.05, 40)
WALL = tt.nlos.Wall.plane(2.0, 1.6, albedo=0.7)
OBJ = """v -1 -0.8 0
v 1 -0.8 0
v 1 0.8 0
v -1 0.8 0
{coordinates}f 1{a} 2{b} 3{c}
f 1{a} 3{c} 4{d}
"""
# Texture coordinates of the corners: those of a rectangle; turned by a right angle; of a half of it.
UPRIGHT, TURNED, HALF = "00 10 11 01", "10 11 01 00", "00 h0 h1 01"


def wall_file(folder, corners=None):
    path = folder / "wall.obj"
    if corners is None:
        path.write_text(OBJ.format(coordinates="", a="", b="", c="", d=""))
    else:
        rows = [" ".join("0.5" if c == "h" else c for c in corner) for corner in corners.split()]
        lines = "".join(f"vt {row}\n" for row in rows)
        path.write_text(OBJ.format(coordinates=lines, a="/1", b="/2", c="/3", d="/4"))
    return {"type": "obj", "filename": str(path), "flip_tex_coords": False, "face_normals": True}


def complete(kind="confocal", size=(3, 2), **changed):
    """The scene of a capture, with what is changed of its meter, integrator, laser and film."""
    grid = {"laser_grid": (2, 1)} if kind == "exhaustive" else {}
    described = tt.nlos.capture_scene(tt.scenes.nlos_z(), tt.nlos.Scan.grid(WALL, size, kind=kind, **grid))
    sensor = described["wall"]["sensor"]
    sensor["film"] |= {"start_opl": AXIS.start_opl, "bin_width_opl": AXIS.bin_width_opl, "temporal_bins": AXIS.num_bins}
    sensor |= changed.get("meter", {})
    described["integrator"] |= changed.get("integrator", {})
    described["laser"] |= changed.get("laser", {})
    return described


def on(wall, kind="confocal", size=(3, 2), **meter):
    """The same on another shape, without points."""
    described = complete(kind, size)
    sensor = described["wall"]["sensor"]
    del sensor["points"]
    sensor.pop("laser_points", None)
    described["wall"] = wall | {"bsdf": described["wall"]["bsdf"], "sensor": sensor | meter}
    return described


def simulate(described):
    return tt.nlos.simulate(described, spp=64, progress=False)


# -------------------------------------------------------------------------------------------------- points of a shape


@pytest.mark.slow
def test_a_wall_of_two_triangles_is_a_rectangle(tmp_path):
    """Its grid is that of its texture coordinates, not of samples by area, which a mesh warps triangle by triangle."""
    found = simulate(on(wall_file(tmp_path, UPRIGHT)))
    expected = simulate(on({"type": "rectangle", "to_world": np.diag([1.0, 0.8, 1.0, 1.0])}))
    torch.testing.assert_close(found.scan.sensor_points, expected.scan.sensor_points, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.transient, expected.transient, rtol=0, atol=1e-5 * float(found.transient.max()))


def test_coordinates_that_are_turned(tmp_path):
    """u falls with y and v grows with x."""
    points = simulate(on(wall_file(tmp_path, TURNED), size=(2, 3))).scan.sensor_points
    u, v = (torch.arange(2, dtype=torch.float64) + 0.5) / 2, (torch.arange(3, dtype=torch.float64) + 0.5) / 3
    y, x = torch.broadcast_tensors(0.8 - 1.6 * u[None, :], 2 * v[:, None] - 1)
    torch.testing.assert_close(points, torch.stack([x, y, 0 * x], -1), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_every_point_of_a_mesh_is_another(tmp_path):
    points = simulate(on(wall_file(tmp_path, UPRIGHT), size=(17, 13))).scan.sensor_points
    expected = torch.tensor(WALL.grid((17, 13))[0])
    torch.testing.assert_close(points, expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_the_spot_of_a_mesh(tmp_path):
    found = simulate(on(wall_file(tmp_path, UPRIGHT), "single", laser_lookat_pixel=[2.5, 0.5, 0.0])).scan
    torch.testing.assert_close(found.laser_points, found.sensor_points[0, 2], rtol=0, atol=1e-6)


def test_points_of_a_mesh_move_with_it(tmp_path):
    """They are material points, for vertices that move and in derivatives by them."""
    scene = tt.load(on(wall_file(tmp_path, UPRIGHT)), variant=VARIANT).built(BuildOptions(transient=True))
    sensor, key = scene.scene.sensors()[0], "wall.vertex_positions"
    before = np.array(sensor.scanned())
    start, way = mi.Point3f(dr.unravel(mi.Point3f, scene.params[key])), mi.Vector3f(0.1, -0.2, 0.3)
    far = mi.Float(1.0)
    dr.enable_grad(far)
    scene.params[key] = dr.ravel(start + far * way)
    scene.params.update()
    after = sensor.scanned()
    dr.forward(far)
    np.testing.assert_allclose(np.array(after) - before, np.tile([[0.1], [-0.2], [0.3]], 6), atol=1e-6)
    np.testing.assert_allclose(np.array(dr.grad(after)), np.tile([[0.1], [-0.2], [0.3]], 6), atol=1e-6)


@pytest.mark.parametrize(
    ("wall", "message"),
    [
        (None, "a mesh without texture coordinates.*Give the points"),
        (HALF, r"texture coordinates of the mesh .* got none at 2 of 6 places of the film.*Give the points"),
        ({"type": "disk"}, "got the shape Disk.*Give the points"),
        ({"type": "sphere"}, "got the shape Sphere.*Give the points"),
    ],
)
def test_walls_that_have_no_grid(tmp_path, wall, message):
    shape = wall if isinstance(wall, dict) else wall_file(tmp_path, wall)
    with pytest.raises(SceneError, match=message):
        simulate(on(shape))


@pytest.mark.parametrize("kind", ["confocal", "single"])
def test_a_sensor_without_a_shape(kind):
    described = complete(kind)
    sensor = described["wall"].pop("sensor")
    del sensor["points"]
    sensor.pop("laser_points", None)
    described["meter"] = sensor | ({"laser_lookat_pixel": [1.0, 1.0, 0.0]} if kind == "single" else {})
    with pytest.raises(SceneError, match="expected a shape to scan or 'points', got neither"):
        simulate(described)


# ------------------------------------------------------------------------------------------------------------ numbers

NAN, INF = math.nan, math.inf
RGB = {"type": "rgb", "value": [1.0, -1.0, 1.0]}
NUMBERS = {
    "energy below zero": ({"laser": {"energy": -1.0}}, UnitError, "expected joules of at least 0.*-1"),
    "a colour below zero": ({"laser": {"energy": RGB}}, UnitError, "expected joules of at least 0.*-1"),
    "a spectrum below zero": (
        {"laser": {"energy": {"type": "uniform", "value": -2.0}}}, UnitError, "expected joules of at least 0.*-2",
    ),
    "energy that is no number": ({"laser": {"energy": NAN}}, SceneError, "expected finite numbers.*laser.energy"),
    "energy without end": ({"laser": {"energy": INF}}, SceneError, "expected finite numbers.*laser.energy"),
    "energy that is true": ({"laser": {"energy": True}}, UnitError, "expected joules or a spectrum, got True"),
    "energy in words": ({"laser": {"energy": "much"}}, UnitError, "expected joules or a spectrum, got 'much'"),
    "an origin that is no number": ({"meter": {"sensor_origin": [0.0, NAN, 1.0]}}, SceneError, "finite numbers"),
    "an origin that is true": ({"meter": {"sensor_origin": True}}, SceneError, "a point of three finite numbers"),
    "an origin of one number": ({"meter": {"laser_origin": 3.0}}, SceneError, "a point of three finite numbers"),
    "an origin far away": ({"meter": {"sensor_origin": [0.0, 0.0, INF]}}, SceneError, "finite numbers"),
    "points that are no numbers": ({"meter": {"points": np.full((6, 3), NAN)}}, SceneError, "finite numbers"),
    "points that are true": ({"meter": {"points": True}}, SceneError, "an array"),
    "too few points": ({"meter": {"points": np.zeros((5, 3))}}, SceneError, "one of 'points' for each"),
    "spots of a confocal scan": (
        {"meter": {"laser_points": np.zeros((6, 3))}}, SceneError, "a confocal capture lights its scanned points",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_of_a_scene(case):
    changed, error, message = NUMBERS[case]
    with pytest.raises(error, match=message):
        simulate(complete(**changed))


@pytest.mark.parametrize("place", [[NAN, 0.0, 0.0], [-1.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 2.5, 0.0]])
def test_places_beside_the_film(place):
    with pytest.raises(SceneError, match="laser_lookat_pixel"):
        simulate(on({"type": "rectangle"}, "single", laser_lookat_pixel=place))


@pytest.mark.parametrize("fov", [0.0, -3.0, 180.0, 1e9, NAN])
def test_fields_of_view_of_lasers(fov):
    described = complete(
        "exhaustive", integrator={"force_equal_illumination_scanning": False, "illumination_scan_fov": fov}
    )
    del described["wall"]["sensor"]["laser_points"]
    with pytest.raises(SceneError, match="illumination_scan_fov"):
        simulate(described)


def test_a_field_of_view_and_spots():
    described = complete("exhaustive", integrator={"force_equal_illumination_scanning": False})
    with pytest.raises(SceneError, match="both say where the laser points"):
        simulate(described)


def test_no_light_is_light_of_nothing():
    with pytest.warns(PhysicsWarning, match="no light comes back"):
        assert float(simulate(complete(laser={"energy": 0.0})).transient.abs().max()) == 0


def test_energy_below_zero_as_a_value():
    """As for every light: it is computed, and said."""
    key = "laser.energy.value"
    scan = tt.nlos.Scan.grid(WALL, (3, 2), kind="confocal")
    renderer = tt.nlos.CaptureRenderer(tt.scenes.nlos_z(), scan, [key], time_axis=AXIS, spp=16)
    with pytest.warns(PhysicsWarning, match="laser.energy.value' is the light of an emitter and reaches -1"):
        assert float(renderer({key: -1.0}, seed=0).total().sum()) < 0


SHEET = "v 0 0 1\nv 2 0 1\nv 2 3 1.5\nv 0 3 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


@pytest.fixture
def meter():
    """A meter on a wall of 2 m by 4 m around (1, 2, 0), with nothing around it."""
    mi.set_variant(VARIANT)
    plugins.sync()
    kept = []

    def make(size=(3, 2), crop=None, **more):
        film = {"type": "transient_hdr_film", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
        if crop:
            film |= dict(zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), crop, strict=True))
        node = {"type": "nlos_capture_meter", "film": film, "sampler": {"type": "independent"}, **more}
        pose = mi.ScalarTransform4f().translate([1, 2, 0]).scale([1, 2, 1])
        with plugins.plugin_errors():
            wall = {"type": "rectangle", "to_world": pose, "sensor": node}
            kept.append(mi.load_dict({"type": "scene", "wall": wall}))  # a sensor does not keep its wall
        return kept[-1].sensors()[0]

    return make


def test_pixels_and_their_points(meter):
    """Row by row, at the middles of as many parts of the wall; of a window those that it shows."""
    sensor = meter(sensor_origin=[1.0, 2.0, 3.0])
    x, y = np.meshgrid([1 / 3, 1, 5 / 3], [1.0, 3.0])
    everything = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    np.testing.assert_allclose(np.array(sensor.scanned()), everything, atol=1e-6)
    np.testing.assert_allclose(np.array(sensor.targets(mi.UInt32([4, 2]))), everything[:, [4, 2]], atol=1e-6)
    part = meter((5, 4), (3, 1, 2, 3))
    x, y = np.meshgrid([1.4, 1.8], [1.5, 2.5, 3.5])
    window = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    np.testing.assert_allclose(np.array(part.scanned()), window, atol=1e-6)
    # Every sample of a pixel looks along one ray, those at its edges as well.
    for one, points, places in (
        (sensor, everything, [(0.0, 0.0), (0.34, 0.1), (0.99, 0.0), (0.2, 0.5), (0.5, 0.9), (1.0, 1.0)]),
        (part, window, [(0.1, 0.1), (0.5, 0.3), (0.49, 0.34), (0.9, 0.5), (0.2, 0.9), (1.0, 1.0)]),
    ):  # fmt: skip
        ray, weight = one.sample_ray(0.25, 0.5, mi.Point2f(np.array(places, dtype=np.float32).T), mi.Point2f(0.5))
        origin = np.array([[1.0], [2.0], [3.0]]) if one is sensor else np.zeros((3, 1))
        away = points - origin
        np.testing.assert_allclose(np.array(ray.d), away / np.linalg.norm(away, axis=0), atol=1e-6)
        np.testing.assert_allclose(np.array(ray.o).reshape(3, -1), origin)
        assert dr.all(ray.time == 0.25) and dr.all(weight == 1, axis=None)
    moved = np.array(sensor.world_transform().matrix).reshape(4, 4)
    np.testing.assert_allclose(moved, np.array([[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]))


def points_of(name, **given):
    """Of the properties in a scene file, which are texts."""
    from torchtransient.plugins.sensors.nlos_capture_meter import _points_of

    return _points_of(given, name)


def test_points_that_are_given(meter):
    given = np.arange(18.0).reshape(6, 3)
    sensor = meter(points=mi.TensorXf(given.astype(np.float32)), laser_points=mi.TensorXf(np.float32([[7, 8, 9]])))
    np.testing.assert_allclose(np.array(sensor.scanned()), given.T)
    np.testing.assert_allclose(np.array(sensor.spots()).ravel(), [7, 8, 9])
    np.testing.assert_allclose(np.array(points_of("points", points="0 1 2, 3 4,5")), [[0, 3], [1, 4], [2, 5]])
    assert points_of("points") is None and meter().spots() is None
    for place, spot in (((3.0, 2.0, 0.0), (2, 4, 0)), ((0.0, 0.0, 0.0), (0, 0, 0)), ((1.5, 0.5, 0.0), (1, 1, 0))):
        np.testing.assert_allclose(np.array(meter(laser_lookat_pixel=place).spots()).ravel(), spot, atol=1e-6)


@pytest.mark.parametrize(("text", "message"), [
    ("0 1 2 3", r"finite points of shape \(N, 3\) or \(H, W, 3\) in metres, got shape \(4,\)"),
    ("0 1", r"finite points of shape .* got shape \(2,\)"), ("", r"finite points of shape .* got shape \(0"),
    ("0 1 nan", r"finite points of shape .* got shape \(1, 3\)"), ("0 one 2", "numbers with commas, .*'one'"),
])  # fmt: skip
def test_texts_that_are_no_points(meter, text, message):
    with pytest.raises(SceneError, match=f"nlos_capture_meter: expected laser_points as {message}"):
        points_of("laser_points", laser_points=text)


TWO = np.zeros((2, 3), dtype=np.float32)


@pytest.mark.parametrize(("more", "message"), [
    ({"points": TWO}, "one of 'points' for each of the film's 3 x 2 pixels, got 2"),
    ({"laser_points": TWO * NAN}, "expected laser_points as finite points of shape|expected finite"),
    ({"sensor_origin": "0 1 2"}, "expected sensor_origin as a point of three finite numbers"),
    ({"laser_origin": [0.0, 1.0, math.inf]}, "expected laser_origin as a point of three finite numbers"),
    ({"laser_lookat_pixel": [3.25, 1.0, 0.0]}, "laser_lookat_pixel as a place of the film's 3 x 2 pixels, got .3.25"),
    ({"laser_lookat_pixel": [1.0, 2.25, 0.0]}, "laser_lookat_pixel as a place of the film's 3 x 2 pixels"),
    ({"laser_lookat_pixel": [-0.25, 1.0, 0.0]}, "laser_lookat_pixel as a place of the film's 3 x 2 pixels"),
    ({"laser_lookat_pixel": [1.0, 1.0, 0.0], "laser_points": TWO}, "both say where the laser points; give one"),
])  # fmt: skip
def test_what_mitsuba_itself_is_refused(meter, more, message):
    arrays = {name: mi.TensorXf(x) if isinstance(x, np.ndarray) else x for name, x in more.items()}
    with pytest.raises(SceneError, match=message):
        meter(**arrays)


def test_places_of_a_texture_on_a_mesh():
    """Of the triangles that have their coordinates, as their vertices are now."""
    from torchtransient.plugins.sensors.nlos_capture_meter import PlacesOnMesh  # of a variant

    node = {"type": "obj", "filename": file_of("places.obj", SHEET), "id": "sheet", "flip_tex_coords": False}
    mesh = mi.load_dict(node)
    places = np.array([[0.5, 0.25], [0.25, 0.75], [0.9, 0.2]])
    found = PlacesOnMesh(mesh, places)
    vertices = np.array([line.split()[1:] for line in SHEET.splitlines() if line.startswith("v ")], dtype=float)
    lower = [True, False, True]
    for motion in (np.zeros((4, 3)), np.random.default_rng(1).normal(size=(4, 3))):
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float((vertices + motion).ravel())
        params.update()
        a, b, c, d = vertices + motion
        # u runs along the lower edge; the upper triangle has the corner at (0, 1) in place of that at (1, 0).
        expected = [
            a + (b - a) * (u - v) + (c - a) * v if below else a + (c - a) * u + (d - a) * (v - u)
            for (u, v), below in zip(places, lower, strict=True)
        ]
        np.testing.assert_allclose(np.array(found.points(mesh, mi.UInt32([0, 1, 2]))).T, expected, rtol=1e-5, atol=1e-5)
    assert np.array(found.points(mesh, mi.UInt32(2))).shape == (3, 1)
    with pytest.raises(SceneError, match=r"mesh 'sheet' that fill the square .* got none at 2 of 3 places"):
        PlacesOnMesh(mesh, np.array([[0.5, 0.5], [1.5, 0.5], [0.5, -0.1]]))
