"""The dictionary of a capture as the scan says it, entry by entry; one mesh is one capture, whichever file it is in."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ArgumentError, SceneError, StorageError, UnitError

N = tt.nlos
VARIANT = "llvm_ad_mono"
WALL = N.Wall.plane(2.0, 1.6, albedo=0.7)
Z = tt.scenes.nlos_z()
CONFOCAL = N.Scan.grid(WALL, 2, kind="confocal")
KINDS = {"single": {}, "confocal": {}, "exhaustive": {"laser_grid": (2, 5)}}


def shapes_of(hidden):
    """What is hidden in the scene of a capture."""
    own = ("type", "integrator", "laser", "wall")
    return {name: node for name, node in N.capture_scene(hidden, CONFOCAL).items() if name not in own}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("bounces", "first", "last"), [
    (range(4, 9), 4, 8), ("all", 0, -1), (2, 2, 2), (torch.tensor([4, 3]), 3, 4),
])  # fmt: skip
def test_scenes_say_what_a_scan_does(kind, bounces, first, last):
    scan = N.Scan.grid(WALL, (4, 3), kind=kind, first_and_last_leg=True, **KINDS[kind])
    scene = N.capture_scene(Z, scan, bounces=bounces, energy=2.5)
    assert set(scene) == {"type", "integrator", "laser", "wall", *Z}
    assert scene["integrator"] == {
        "type": "transient_nlos_path", "capture_type": kind, "max_depth": last, "min_bounces": first,
        "rr_depth": max(5, last), "account_first_and_last_bounces": True, "nlos_laser_sampling": True,
        "nlos_hidden_geometry_sampling": True,
    }  # fmt: skip
    assert scene["laser"] == {"type": "laser_beam", "energy": 2.5}
    sensor = scene["wall"]["sensor"]
    for name in ("sensor_origin", "laser_origin"):
        assert sensor[name] == getattr(scan, name).tolist()
    np.testing.assert_array_equal(sensor["points"], scan.sensor_points.reshape(-1, 3).numpy())
    assert (sensor["film"]["width"], sensor["film"]["height"], sensor["film"]["temporal_bins"]) == (4, 3, 1)
    if kind == "confocal":
        assert "laser_points" not in sensor
    else:
        np.testing.assert_array_equal(sensor["laser_points"], scan.laser_points.reshape(-1, 3).numpy())
    grid = {name: value for name, value in sensor["film"].items() if "scan" in name}
    wanted = {"exhaustive_scan": True, "laser_scan_height": 5, "laser_scan_width": 2}
    assert grid == (wanted if kind == "exhaustive" else {})
    assert scene["wall"]["type"] == "rectangle" and "sensor" not in scan.wall


def test_points_with_gradients_stand_in_a_scene_as_numbers():
    scan = N.Scan.grid(WALL, (4, 3), kind="confocal")
    points = scan.sensor_points.clone().requires_grad_()
    given = N.Scan.points(points, kind="confocal", sensor_origin=scan.sensor_origin, laser_origin=scan.laser_origin,
                          wall=WALL)  # fmt: skip
    with no_gradient_is_lost():
        found = N.capture_scene(Z, given)["wall"]["sensor"]["points"]
    np.testing.assert_array_equal(found, scan.sensor_points.reshape(-1, 3).numpy())


def test_bounces_and_joules_that_are_none():
    for bounces in ((), (1, 2), (3, 5), (3, 3), (3.5,), (True,), "some", (2, None)):
        with pytest.raises(SceneError, match="bounces: expected whole numbers of at least 2 without gaps"):
            N.capture_scene(Z, CONFOCAL, bounces=bounces)
    for energy in (0, np.float32(2.0), {"type": "rgb", "value": [1.0, 2.0, 3.0]}):
        assert N.capture_scene(Z, CONFOCAL, energy=energy)["laser"]["energy"] is energy
    for energy in (-1e-9, math.inf, math.nan):
        with pytest.raises(UnitError, match="energy: expected joules"):
            N.capture_scene(Z, CONFOCAL, energy=energy)


@pytest.mark.parametrize(("hidden", "names"), [
    ({"type": "sphere"}, ["hidden"]), ({"a": {"type": "sphere"}, "b": {"type": "cube"}}, ["a", "b"]),
    ({"type": "scene", "a": {"type": "sphere"}}, ["a"]), ([np.eye(3), [[0, 1, 2]]], ["hidden"]),
])  # fmt: skip
def test_things_have_names(hidden, names):
    assert sorted(shapes_of(hidden)) == names


def test_objects_with_vertices_and_faces_are_meshes():
    found = shapes_of(SimpleNamespace(vertices=np.eye(3), faces=[[0, 1, 2]]))["hidden"]
    assert found["type"] == "mesh_arrays"
    np.testing.assert_array_equal(found["vertices"], np.eye(3))
    np.testing.assert_array_equal(found["faces"], [[0, 1, 2]])


@pytest.mark.parametrize("kind", ["area", "point", "projector", "constant", "directional"])
def test_light_among_hidden_things_is_found_wherever_it_is(kind):
    deep = {"thing": {"type": "shapegroup", "inner": {"type": "cube", "lamp": {"type": kind}}}}
    with pytest.raises(SceneError, match=rf"'thing\.inner\.lamp' \({kind}\) emits light"):
        shapes_of(deep)


def test_what_belongs_to_the_capture_is_no_hidden_thing():
    for given in ({"sensor": {"type": "perspective"}}, {"a": {"type": "transient_path"}}):
        with pytest.raises(SceneError, match="is no hidden thing"):
            shapes_of(given)


def test_albedos_are_those_of_walls_and_meshes():
    """One number of any library, or three in a list, a tuple or an array."""
    for given in (0.5, torch.tensor(0.5), 1):
        wall, mesh = N.Wall.plane(albedo=given).shape, tt.scenes.triangle_mesh(CORNERS, FACES, reflectance=given)
        assert wall["bsdf"] == mesh["bsdf"] == {"type": "diffuse", "reflectance": float(given)}
    for three in ([0.25, 0.5, 1], np.array([0.25, 0.5, 1.0]), torch.tensor([0.25, 0.5, 1.0])):
        wall, mesh = N.Wall.plane(albedo=three).shape, tt.scenes.triangle_mesh(CORNERS, FACES, reflectance=three)
        assert wall["bsdf"] == mesh["bsdf"]
        assert mesh["bsdf"]["reflectance"] == {"type": "rgb", "value": [0.25, 0.5, 1.0]}


def test_forecasts_take_the_arguments_of_simulate():
    with pytest.raises(ArgumentError, match="forecast: expected the arguments of simulate, got more, other"):
        N.forecast(Z, CONFOCAL, other=1, seed=0, more=2)
    # Those that change nothing about what it takes are taken too.
    others = {"seed": 1, "sensor": None, "keep_part": True, "progress": False, "generator": None}
    found = N.forecast(Z, CONFOCAL, time_axis=tt.TimeAxis(1.9, 0.05, 20), spp=16, variant="llvm_ad_mono", **others)
    assert found.shape == (1, 20, 2, 2) and found.spp == 16 and found.parts == 1 and found.bytes == 320


def test_setups_are_files_of_three_kinds(tmp_path):
    (tmp_path / "a.yaml").write_text("scan: {kind: confocal, size: 2}\n")
    for path, given, words in (
        ("a.yaml", {}, r"a\.yaml: expected an entry 'hidden' .* got scan"), ("a.txt", {}, "expected a capture as YAML"),
        ("a.yaml", {"spp": 3}, r"a\.yaml: parameters fill the \$NAMES of XML files alone, got spp; leave them out"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=words):
            N.read_setup(tmp_path / path, **given)


# -------------------------------------------------------------------------------------------------------------- meshes


AXIS = tt.TimeAxis(1.0, 0.05, 60)
# Two triangles that meet at an angle: interpolated normals would be others than theirs.
CORNERS = np.array([[-0.5, -0.4, 0.9], [0.0, -0.4, 1.1], [0.0, 0.4, 1.1], [0.5, -0.4, 0.9]])
FACES = np.array([[0, 2, 1], [1, 2, 3]])
HEADER = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{normals}element face 2
property list uchar int vertex_indices
end_header
"""


def written(folder, ending):
    path = folder / f"mesh{ending}"
    vertices, faces = [" ".join(map(str, v)) for v in CORNERS], [" ".join(map(str, f)) for f in FACES]
    if ending == ".npz":
        np.savez(path, vertices=CORNERS, faces=FACES)
    elif ending == ".ply":  # with normals that are none of its triangles
        header = HEADER.format(normals="property float nx\nproperty float ny\nproperty float nz\n")
        rows = [f"{v} 0.6 0 -0.8" for v in vertices] + [f"3 {f}" for f in faces]
        path.write_text(header + "\n".join(rows) + "\n")
    else:
        lines = [f"v {v}" for v in vertices] + ["f " + " ".join(map(str, f + 1)) for f in FACES]
        path.write_text("\n".join(lines) + "\n")
    return path


def capture(hidden, **settings):
    scan = N.Scan.grid(N.Wall.plane(), 2, kind="confocal")
    settings = {"time_axis": AXIS, "spp": 64, "progress": False} | settings
    return N.simulate(hidden, settings.pop("scan", scan), **settings)


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".obj", ".ply", ".npz"])
def test_files_arrays_and_descriptions_agree(tmp_path, ending):
    path = written(tmp_path, ending)
    expected = capture((CORNERS, FACES)).transient
    text = f"""
hidden: {{mesh: {{file: {path}}}}}
scan: {{kind: confocal, size: 2}}
time_axis: {{start_opl: 1.0, bin_width_opl: 0.05, num_bins: 60}}
spp: 64
"""
    (tmp_path / "a.yaml").write_text(text)
    described = N.read_setup(tmp_path / "a.yaml")
    for found in (capture(path), N.simulate(**described, progress=False)):
        torch.testing.assert_close(found.transient, expected, rtol=0, atol=1e-5 * float(expected.max()))


def test_files_of_meshes(tmp_path):
    for name, error, message in (
        ("a.stl", SceneError, r"expected a mesh file \(\.obj, \.ply, \.serialized, \.npz\)"),
        ("a.xml", SceneError, "leave scan out"), ("a.obj", SceneError, "no file"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            shapes_of(tmp_path / name)
    path = tmp_path / "a.npz"
    path.write_bytes(b"nothing")
    with pytest.raises(StorageError, match="'vertices' and 'faces' in"):
        shapes_of(path)
    for arrays, got in (({"vertices": CORNERS}, "vertices alone"), ({"points": CORNERS}, "neither")):
        np.savez(path, **arrays)
        with pytest.raises(StorageError, match=rf"hidden: expected 'vertices' and 'faces' in .*, got {got}"):
            shapes_of(str(path))
    np.savez(path, vertices=CORNERS, faces=FACES)
    found = shapes_of(path)["hidden"]
    assert found["type"] == "mesh_arrays" and "bsdf" not in found
    path = tmp_path / "a.PLY"
    path.write_text("ply")
    assert shapes_of(path)["hidden"] == {"type": "ply", "filename": str(path), "face_normals": True}
