"""Which points a scan's sensor looks at on walls of every kind, and what numbers it and its laser take."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.plain_scenes import as_mitsuba
from torchtransient import plugins
from torchtransient.errors import SceneError

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


def test_points_of_a_mesh_move_with_it(tmp_path):
    """They are material points, for vertices that move and in derivatives by them."""
    mi.set_variant(VARIANT)
    scene = mi.load_dict(as_mitsuba(on(wall_file(tmp_path, UPRIGHT))), optimize=False)
    sensor, key, params = scene.sensors()[0], "wall.vertex_positions", mi.traverse(scene)
    before = np.array(sensor.scanned())
    start, way = mi.Point3f(dr.unravel(mi.Point3f, params[key])), mi.Vector3f(0.1, -0.2, 0.3)
    far = mi.Float(1.0)
    dr.enable_grad(far)
    params[key] = dr.ravel(start + far * way)
    params.update()
    after = sensor.scanned()
    dr.forward(far)
    np.testing.assert_allclose(np.array(after) - before, np.tile([[0.1], [-0.2], [0.3]], 6), atol=1e-6)
    np.testing.assert_allclose(np.array(dr.grad(after)), np.tile([[0.1], [-0.2], [0.3]], 6), atol=1e-6)


@pytest.mark.parametrize(
    ("wall", "message"),
    [
        (None, "a mesh without texture coordinates.*Give the points"),
        (HALF, r"texture coordinates of the mesh .* got none at 2 of 6 places of the film.*Give the points"),
        ({"type": "sphere"}, "got the shape Sphere.*Give the points"),
    ],
)
def test_walls_that_have_no_grid(tmp_path, wall, message):
    shape = wall if isinstance(wall, dict) else wall_file(tmp_path, wall)
    with pytest.raises(SceneError, match=message):
        simulate(on(shape))


def test_a_sensor_without_a_shape():
    described = complete()
    sensor = described["wall"].pop("sensor")
    del sensor["points"]
    described["meter"] = sensor
    with pytest.raises(SceneError, match="expected a shape to scan or 'points', got neither"):
        simulate(described)


# ------------------------------------------------------------------------------------------------------------ numbers


@pytest.mark.parametrize("place", [[math.nan, 0.0, 0.0], [4.0, 0.0, 0.0]])
def test_places_beside_the_film(place):
    with pytest.raises(SceneError, match="laser_lookat_pixel"):
        simulate(on({"type": "rectangle"}, "single", laser_lookat_pixel=place))


@pytest.mark.parametrize("fov", [0.0, 180.0])
def test_fields_of_view_of_lasers(fov):
    described = complete(
        "exhaustive", integrator={"force_equal_illumination_scanning": False, "illumination_scan_fov": fov}
    )
    del described["wall"]["sensor"]["laser_points"]
    with pytest.raises(SceneError, match="illumination_scan_fov"):
        simulate(described)


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


def test_points_that_are_given(meter):
    given = np.arange(18.0).reshape(6, 3)
    sensor = meter(points=mi.TensorXf(given.astype(np.float32)), laser_points=mi.TensorXf(np.float32([[7, 8, 9]])))
    np.testing.assert_allclose(np.array(sensor.scanned()), given.T)
    np.testing.assert_allclose(np.array(sensor.spots()).ravel(), [7, 8, 9])
    assert meter().spots() is None
    for place, spot in (((3.0, 2.0, 0.0), (2, 4, 0)), ((0.0, 0.0, 0.0), (0, 0, 0)), ((1.5, 0.5, 0.0), (1, 1, 0))):
        np.testing.assert_allclose(np.array(meter(laser_lookat_pixel=place).spots()).ravel(), spot, atol=1e-6)
