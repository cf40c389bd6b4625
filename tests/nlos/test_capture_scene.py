"""The dictionary of a capture as the scan says it, entry by entry; and what files of one say beside it."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ArgumentError, SceneError, StorageError, UnitError
from torchtransient.nlos.scene import mesh_file, shapes_of
from torchtransient.nlos.tal_yaml import material, read_tal_yaml, spectrum

N = tt.nlos
WALL = N.Wall.plane(2.0, 1.6, albedo=0.7)
Z = tt.scenes.nlos_z()
KINDS = {"single": {}, "confocal": {}, "exhaustive": {"laser_grid": (2, 5)}}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("bounces", "first", "last"), [
    ((3,), 3, 3), (range(4, 9), 4, 8), ("all", 0, -1), (2, 2, 2), (np.array([4, 3]), 3, 4),
    (torch.tensor([6, 7]), 6, 7),
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


@pytest.mark.parametrize("bounces", [(), (1,), (1, 2), (3, 5), (3, 3), (3.0,), (True,), "some", None, (2, None)])
def test_bounces_that_are_none(bounces):
    with pytest.raises(SceneError, match="bounces: expected whole numbers of at least 2 without gaps"):
        N.capture_scene(Z, N.Scan.grid(WALL, 2, kind="confocal"), bounces=bounces)


def test_joules_from_zero_on():
    scan = N.Scan.grid(WALL, 2, kind="confocal")
    for energy in (0, 0.0, np.float32(2.0), {"type": "rgb", "value": [1.0, 2.0, 3.0]}):
        assert N.capture_scene(Z, scan, energy=energy)["laser"]["energy"] is energy
    for energy, error in ((-1e-9, UnitError), (math.inf, UnitError), (math.nan, UnitError), (True, SceneError),
                          ("1", SceneError), (None, SceneError)):  # fmt: skip
        with pytest.raises(error, match="energy: expected joules"):
            N.capture_scene(Z, scan, energy=energy)


@pytest.mark.parametrize(("hidden", "names"), [
    ({"type": "sphere"}, ["hidden"]), ({"a": {"type": "sphere"}, "b": {"type": "cube"}}, ["a", "b"]),
    ({"type": "scene", "a": {"type": "sphere"}}, ["a"]), ((np.eye(3), [[0, 1, 2]]), ["hidden"]),
    ([np.eye(3), [[0, 1, 2]]], ["hidden"]),
])  # fmt: skip
def test_things_have_names(hidden, names):
    assert sorted(shapes_of(hidden)) == names


def test_objects_with_vertices_and_faces_are_meshes():
    found = shapes_of(SimpleNamespace(vertices=np.eye(3), faces=[[0, 1, 2]]))["hidden"]
    assert found["type"] == "mesh_arrays"
    np.testing.assert_array_equal(found["vertices"], np.eye(3))
    np.testing.assert_array_equal(found["faces"], [[0, 1, 2]])


@pytest.mark.parametrize("kind", ["area", "point", "spot", "projector", "constant", "envmap", "directional"])
def test_light_among_hidden_things_is_found_wherever_it_is(kind):
    deep = {"thing": {"type": "shapegroup", "inner": {"type": "cube", "lamp": {"type": kind}}}}
    with pytest.raises(SceneError, match=rf"'thing\.inner\.lamp' \({kind}\) emits light"):
        shapes_of(deep)
    for other in ("sensor", "integrator"):
        with pytest.raises(SceneError, match="is no hidden thing"):
            shapes_of({other: {"type": "perspective"}})
    for other in ("transient_path", "nlos_capture_meter"):
        with pytest.raises(SceneError, match="is no hidden thing"):
            shapes_of({"a": {"type": other}})


# ------------------------------------------------------------------------------------------------------------ arguments


def test_forecasts_take_the_arguments_of_simulate():
    scan = N.Scan.grid(WALL, 2, kind="confocal")
    with pytest.raises(ArgumentError, match="forecast: expected the arguments of simulate, got more, other"):
        N.forecast(Z, scan, other=1, seed=0, more=2)
    # Those that change nothing about what it takes are taken too.
    others = {"seed": 1, "sensor": None, "keep_part": True, "progress": False, "generator": None}
    found = N.forecast(Z, scan, time_axis=tt.TimeAxis(1.9, 0.05, 20), spp=16, variant="llvm_ad_mono", **others)
    assert found.shape == (1, 20, 2, 2) and found.spp == 16 and found.parts == 1 and found.bytes == 320


# ---------------------------------------------------------------------------------------------------------------- files


def test_setups_are_files_of_three_kinds(tmp_path):
    (tmp_path / "a.yaml").write_text("scan: {kind: confocal, size: 2}\n")
    for path, given, words in (
        ("a.yaml", {}, r"a\.yaml: expected an entry 'hidden' .* got scan"), ("a.txt", {}, "expected a capture as YAML"),
        ("a.yaml", {"spp": 3}, r"a\.yaml: parameters fill the \$NAMES of XML files alone, got spp; leave them out"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=words):
            N.read_setup(tmp_path / path, **given)


@pytest.mark.parametrize(("entries", "wanted"), [
    ("", {"time_axis": tt.TimeAxis(0.0, 0.003, 16), "frequencies": None, "energy": 1.0, "variant": None,
          "bounces": "all", "spp": 1_000_000}),
    ("mitsuba_variant: llvm_ad_mono\nlaser_emission: 1, 2, 3",
     {"variant": "llvm_ad_mono", "energy": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}),
    ("laser_emission: 2.5, 2.5, 2.5\nintegrator_filter_bounces: 2\nsample_count: 7",
     {"energy": 2.5, "bounces": (3,), "spp": 7}),
    ("laser_emission_mode: mono\nlaser_emission: 4\nintegrator_max_depth: 5\nintegrator_discard_direct_paths: true",
     {"energy": 4.0, "bounces": (3, 4, 5)}),
    ("histogram_mode: frequency\nwl_mean: 0.02\nwl_sigma: 0.03", {"time_axis": None}),
])  # fmt: skip
def test_arguments_of_tals_scenes(tmp_path, entries, wanted):
    (tmp_path / "a").mkdir()
    path = tmp_path / "a" / "a.yaml"
    path.write_text(TAL + entries + "\n")
    said = read_tal_yaml(path)
    for source in (path, tmp_path / "a"):
        found = N.read_setup(source)
        assert set(found) == {"hidden", "scan", "time_axis", "frequencies", "spp", "bounces", "energy", "variant"}
        assert found["scan"] == said.scan and found["hidden"].keys() == {"ball"}
        assert {name: found[name] for name in wanted} == wanted
        assert (found["frequencies"] is None) == (found["time_axis"] is not None)


@pytest.mark.parametrize("entry", ["geometry: []", "relay_wall: wall"])
def test_scenes_of_tal_are_told_by_their_entries(tmp_path, entry):
    (tmp_path / "a.yaml").write_text(entry + "\n")
    with pytest.raises(SceneError, match=r"y-tal scene: .*geometry"):
        N.read_setup(tmp_path / "a.yaml")


def test_meshes_of_one_array(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=np.eye(3))
    with pytest.raises(StorageError, match=r"hidden: expected 'vertices' and 'faces' in .*, got vertices alone"):
        mesh_file(tmp_path / "a.npz", "hidden")
    np.savez(tmp_path / "a.npz", points=np.eye(3))
    with pytest.raises(StorageError, match="got neither"):
        mesh_file(tmp_path / "a.npz", "hidden")
    np.savez(tmp_path / "a.npz", vertices=np.eye(3), faces=[[0, 2, 1]])
    found = mesh_file(tmp_path / "a.npz", "hidden")
    assert found["type"] == "mesh_arrays" and "bsdf" not in found
    (tmp_path / "a.PLY").write_text("ply")
    path = tmp_path / "a.PLY"
    assert mesh_file(path, "x") == {"type": "ply", "filename": str(path), "face_normals": True}


def test_materials_and_spectra_of_tal():
    assert material({"id": "copper", "alpha": 0.25}, "here")["alpha"] == 0.25
    numbers = "<bsdf type='a'><integer name='b' value='3'/><float name='c' value='3'/></bsdf>"
    found = material({"id": "custom", "text": numbers}, "here")
    assert found["b"] == found["c"] == 3 and type(found["b"]) is int and type(found["c"]) is float
    text = "<!-- a --><bsdf type='a'><rgb name='b' value='0.5'/><boolean name='c' value='false'/></bsdf>"
    assert material({"id": "custom", "text": text}, "here") == {
        "type": "a", "b": {"type": "rgb", "value": [0.5, 0.5, 0.5]}, "c": False
    }  # fmt: skip
    assert spectrum("0.5", "here") == 0.5
    assert spectrum("400:1, 700:2.5", "here") == {"type": "spectrum", "value": [(400.0, 1.0), (700.0, 2.5)]}
    for text in ("400:1", "400:1, 700", "400:1:2, 700:1", "1 2", "", "400:x, 700:1"):
        with pytest.raises(SceneError, match="here: expected"):
            spectrum(text, "here")


TAL = """
geometry:
- {name: wall, mesh: {type: rectangle}, material: {id: white}, scale_x: 2.0}
- {name: ball, mesh: {type: sphere}, material: {id: white}, displacement_z: 3.0}
relay_wall: wall
sensor_width: 8
sensor_height: 4
num_bins: 16
"""
