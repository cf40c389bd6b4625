"""The dictionary of a capture as the scan says it, entry by entry; and what files of one say beside it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ArgumentError, SceneError, StorageError, UnitError
from torchtransient.nlos.arguments import check_seeds, check_sensor, checked_seed, keys_and_values
from torchtransient.nlos.mesh_file import mesh_file
from torchtransient.nlos.part_file import PartFile
from torchtransient.nlos.renderer import in_film_shape, in_scan_shape, steady_in_scan_shape
from torchtransient.nlos.scene import capture_scene, film_size, laser_size, shapes_of
from torchtransient.nlos.tal_materials import material, spectrum
from torchtransient.nlos.tal_yaml import read_tal_yaml

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
    scene = capture_scene(Z, scan, bounces=bounces, energy=2.5)
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
        found = capture_scene(Z, given)["wall"]["sensor"]["points"]
    np.testing.assert_array_equal(found, scan.sensor_points.reshape(-1, 3).numpy())


@pytest.mark.parametrize("bounces", [(), (1,), (1, 2), (3, 5), (3, 3), (3.0,), (True,), "some", None, (2, None)])
def test_bounces_that_are_none(bounces):
    with pytest.raises(SceneError, match="bounces: expected whole numbers of at least 2 without gaps"):
        capture_scene(Z, N.Scan.grid(WALL, 2, kind="confocal"), bounces=bounces)


def test_joules_from_zero_on():
    scan = N.Scan.grid(WALL, 2, kind="confocal")
    for energy in (0, 0.0, np.float32(2.0), {"type": "rgb", "value": [1.0, 2.0, 3.0]}):
        assert capture_scene(Z, scan, energy=energy)["laser"]["energy"] is energy
    for energy, error in ((-1e-9, UnitError), (math.inf, UnitError), (math.nan, UnitError), (True, SceneError),
                          ("1", SceneError), (None, SceneError)):  # fmt: skip
        with pytest.raises(error, match="energy: expected joules"):
            capture_scene(Z, scan, energy=energy)


def test_sizes_of_films_and_lasers():
    origins = {"sensor_origin": (0, 0, 1.0), "laser_origin": (0, 0, 1.0)}
    listed = N.Scan.points(torch.zeros(5, 3), kind="exhaustive", laser_points=torch.rand(7, 3) * 0, **origins)
    assert film_size(listed) == (1, 5) and laser_size(listed) == (1, 7)
    pairs, single = (N.Scan.grid(WALL, (4, 3), kind=kind, **KINDS[kind]) for kind in ("exhaustive", "single"))
    assert film_size(pairs) == (3, 4) and laser_size(pairs) == (5, 2) and laser_size(single) == (1, 1)
    for scan, film in ((listed, (1, 7, 1, 5)), (pairs, (5, 2, 3, 4)), (single, (3, 4))):
        light = torch.rand(2, 6, *scan.shape)
        found = in_film_shape(light, scan)
        assert found.shape == (2, 6, *film) and torch.equal(in_scan_shape(found, scan), light)
        steady = torch.rand(2, *film_size(scan))
        assert torch.equal(steady_in_scan_shape(steady, scan).flatten(), steady.flatten())
        assert steady_in_scan_shape(steady, scan).shape == (2, *scan.sensor_shape)


@pytest.mark.parametrize(("hidden", "names"), [
    ({"type": "sphere"}, ["hidden"]), ({"a": {"type": "sphere"}, "b": {"type": "cube"}}, ["a", "b"]),
    ({"type": "scene", "a": {"type": "sphere"}}, ["a"]), ((np.eye(3), [[0, 1, 2]]), ["hidden"]),
    ([np.eye(3), [[0, 1, 2]]], ["hidden"]),
])  # fmt: skip
def test_things_have_names(hidden, names):
    assert sorted(shapes_of(hidden)) == names


@pytest.mark.parametrize(
    "hidden", [None, 3, (1, 2, 3), object(), SimpleNamespace(vertices=np.eye(3)), SimpleNamespace(faces=[[0, 1, 2]])]
)
def test_things_that_are_none(hidden):
    with pytest.raises(SceneError, match="hidden: expected a Mitsuba shape dictionary"):
        shapes_of(hidden)
    with pytest.raises(SceneError, match=r"hidden: expected 'a' as a dictionary with a type, got {}"):
        shapes_of({"a": {}})


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


def test_seeds_and_keys():
    assert checked_seed("f", 0) == 0 and checked_seed("f", 2**32 - 1) == 2**32 - 1
    for value in (-1, 2**32, 0.5, None):
        with pytest.raises(ArgumentError, match="f: seed: expected a whole number from 0 to 4294967295"):
            checked_seed("f", value)
    check_seeds("f", None)
    check_seeds("f", [0, (1, 2)])
    check_seeds("f", torch.tensor([0, 2**32 - 1]))
    for value in ([0, -1], (2**32,), np.array([3, -1]), torch.tensor([-1])):
        with pytest.raises(ArgumentError, match="seed"):
            check_seeds("f", value)
    assert keys_and_values("f", "p", ["a", "b"]) == {"a": None, "b": None}
    assert keys_and_values("f", "p", {"a": 1}) == {"a": 1}
    for value in ("a", b"a", 3, [1], {1: 2}, np.array(["a"])):
        with pytest.raises(SceneError, match=r"f: p: expected keys of scene\.parameters\(\)"):
            keys_and_values("f", "p", value)
    check_sensor("f", None, None)
    check_sensor("f", torch.nn.Identity(), torch.Generator())
    with pytest.raises(ArgumentError, match="f: expected sensor as a module or device"):
        check_sensor("f", abs)
    with pytest.raises(ArgumentError, match=r"f: expected generator as a torch\.Generator or None, got 3"):
        check_sensor("f", None, 3)


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


def test_setups_of_all_bounces(tmp_path):
    for bounces, found in (("all", "all"), ("[3, 4]", (3, 4))):
        text = f"hidden: {{a: {{shape: cube}}}}\nscan: {{kind: confocal, size: 2}}\nbounces: {bounces}\n"
        (tmp_path / "a.yml").write_text(text)
        assert N.read_setup(tmp_path / "a.yml")["bounces"] == found


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


@pytest.mark.parametrize(
    "done", [{"0": [-1, 1, 0]}, {"0": [0, -1, 0]}, {"0": [3, 2, 0]}, {"0": [0, 5, 0]}, {"x": [0, 1, 0]}]
)
def test_parts_beyond_the_last_row(tmp_path, done):
    path = tmp_path / "a.part"
    with PartFile(path, "key") as kept:
        kept.keep(0, 0, np.zeros((4, 2), np.float32), total=4, seconds=0.0, about={})
    with PartFile(path, "key") as kept:
        assert kept.has(0) and kept.last == 0
    path.write_text(json.dumps({**json.loads(path.read_text()), "done": done}))
    with pytest.raises(StorageError, match="is not the part file of a simulation"), PartFile(path, "key"):
        pass


@pytest.mark.parametrize(("data", "words"), [
    ({"id": "white", "alpha": 1.0}, "unknown entry 'alpha'"), ({"id": "copper"}, "an entry 'alpha'"),
    (None, "id: white"),
    ({"id": "custom", "text": "<bsdf type='a'><boolean name='b' value='yes'/></bsdf>"}, "b: expected true or false"),
    ({"id": "custom", "text": "<bsdf type='a'><float value='1'/></bsdf>"}, "<float> in a material is not supported"),
    ({"id": "custom", "text": "<bsdf type='a'><float name='b'/></bsdf>"}, "<float> in a material is not supported"),
    ({"id": "custom", "text": "<texture type='a'/>"}, "of one <bsdf>, got <texture>"),
    ({"id": "custom", "text": "<bsdf type='a'><matrix name='b' value='1'/></bsdf>"}, "<matrix> in a material is not"),
])  # fmt: skip
def test_materials_of_tal_that_are_none(data, words):
    with pytest.raises(SceneError, match=f"here: .*{words}"):
        material(data, "here")


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


@pytest.mark.parametrize("value", ["3", "[]", "{a: 1}", "null"])
def test_things_of_tal_are_a_list(value):
    with pytest.raises(SceneError, match=r"y-tal scene: .*geometry"):
        read_tal_yaml(f"relay_wall: wall\ngeometry: {value}\n")


@pytest.mark.parametrize(("entries", "found"), [
    # In sensor points of the 4 x 2 m of the wall; the last one is its edge.
    ("laser_lookat_x: 6\nlaser_lookat_y: 1", [1.0, -0.5, 0.0]), ("", [0.0, 0.0, 0.0]), ("laser_lookat_x: 8", None),
    ("laser_lookat_x: 8.001", SceneError), ("laser_lookat_y: -1", SceneError),
])  # fmt: skip
def test_where_tals_laser_looks(entries, found):
    if found is SceneError:
        with pytest.raises(SceneError, match=r"laser_lookat_.: expected null, or a number above 0 and at most"):
            read_tal_yaml(TAL + entries + "\n")
        return
    spot = read_tal_yaml(TAL + entries + "\n").scan.laser_points
    expected = [2.0, 0.0, 0.0] if found is None else found
    torch.testing.assert_close(spot, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("entries", "shape"), [
    ("simultaneous_scan: false", (32, 32, 4, 8)), ("simultaneous_scan: false\nlaser_width: 3", (32, 3, 4, 8)),
    ("simultaneous_scan: false\nlaser_height: 3", (3, 32, 4, 8)), ("simultaneous_scan: true", (4, 8, 4, 8)),
    ("laser_width: 8\nlaser_height: 4", (4, 8, 4, 8)),
])  # fmt: skip
def test_spots_of_tals_exhaustive_scans(entries, shape):
    scan = read_tal_yaml(f"{TAL}scan_type: exhaustive\n{entries}\n").scan
    assert scan.shape == shape
    if shape[0] == 32:
        # Thirty-two rows of cells over two metres.
        assert float(scan.laser_points[0, 0, 1]) == pytest.approx(-1.0 + 1 / 32)
    for given in ("laser_width: 4", "laser_aperture_start_y: 0.1"):
        with pytest.raises(SceneError, match="lights its own sensor points here, 8 x 4 of the whole wall"):
            read_tal_yaml(f"{TAL}scan_type: confocal\n{given}\n")


@pytest.mark.parametrize(("entries", "emission"), [
    ("laser_emission_mode: mono", 1.0), ("laser_emission_mode: mono\nlaser_emission: 2.5", 2.5), ("", (1.0, 1.0, 1.0)),
    ("laser_emission: [1, 2, 3]", (1.0, 2.0, 3.0)), ("laser_emission_mode: mono\nlaser_emission: 1, 2", SceneError),
    ("laser_emission: 1", SceneError), ("laser_emission_mode: spectrum\nlaser_emission: 3", 3.0),
])  # fmt: skip
def test_what_tals_laser_emits(entries, emission):
    if emission is SceneError:
        with pytest.raises(SceneError, match=r"laser_emission: expected . numbers for laser_emission_mode"):
            read_tal_yaml(TAL + entries + "\n")
        return
    assert read_tal_yaml(TAL + entries + "\n").laser_emission == emission


def test_normals_of_points_that_move_are_those_of_a_flat_wall():
    from torchtransient.nlos.renderer import _lasting, _lasting_normals

    flat = N.Scan.grid(WALL, (4, 3), kind="single")
    kept = _lasting(flat)
    assert kept["sensor_normals"] is flat.sensor_normals and kept["laser_normals"] is flat.laser_normals
    roof = np.array([[-1, -1, 0], [0, -1, 0.2], [1, -1, 0], [-1, 1, 0], [0, 1, 0.2], [1, 1, 0]], float)
    bent = N.Scan.grid((roof, [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]), (4, 3), kind="confocal")
    assert _lasting(bent) == {"sensor_normals": None, "laser_normals": None}
    bare = N.Scan.points(flat.sensor_points, kind="confocal", sensor_origin=(0, 0, 1), laser_origin=(0, 0, 1))
    assert _lasting(bare) == {"sensor_normals": None, "laser_normals": None} and _lasting_normals(bare, ()) is None
    one = N.Scan.grid(WALL, 1, kind="confocal")
    assert _lasting(one)["sensor_normals"] is one.sensor_normals
    carrying = replace(flat, sensor_normals=flat.sensor_normals.clone().requires_grad_())
    np.testing.assert_array_equal(_lasting_normals(carrying, ()), flat.sensor_normals.reshape(-1, 3))
    # Known while nothing of the wall or its points moves; origins and hidden things may.
    found = _lasting_normals(flat, ["letter.vertex_positions", "wall.sensor.sensor_origin"])
    assert found.shape == (12, 3) and (found == [0, 0, 1]).all()
    for key in ("wall.to_world", "wall.sensor.points", "wall.vertex_positions"):
        assert _lasting_normals(flat, ["letter.to_world", key]) is None
