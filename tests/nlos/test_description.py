"""Captures as YAML files: what the entries mean, and what is refused."""

import json

import numpy as np
import pytest

import torchtransient as tt
from support.sweeps import together
from torchtransient import scenes
from torchtransient.errors import ArgumentError, SceneError, ShapeError, StorageError, UnitError
from torchtransient.nlos import Scan, Wall, read_setup
from torchtransient.scenes import rotate, scale, translate
from torchtransient.sensing import Device
from torchtransient.units import SPEED_OF_LIGHT

SHORT = {"hidden": {"letter": {"scene": "nlos_letter"}}, "scan": {"kind": "confocal", "size": 8}}
ENTRIES = {"hidden", "scan", "time_axis", "frequencies", "spp", "bounces", "sensor", "seed", "variant"}
SCENES = ("nlos_z", "nlos_letter", "nlos_plates", "nlos_corner", "nlos_mannequin", "nlos_room")
OBJ = "v 0 0 1\nv 1 0 1\nv 0 1 1\nf 1 3 2\n"


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """`SHORT` with other entries, read from a file in a folder with ``letter.obj``, ``broken.npz`` and ``mesh.stl``."""
    folder = tmp_path_factory.mktemp("captures")
    (folder / "letter.obj").write_text(OBJ)
    (folder / "broken.npz").write_bytes(b"no archive")
    (folder / "mesh.stl").write_bytes(b"")

    def made(**entries):
        (folder / "capture.yaml").write_text(json.dumps(SHORT | entries))  # JSON is YAML
        return read_setup(folder / "capture.yaml")

    return made


def test_the_shortest_description(read):
    found = read()
    assert set(found) == ENTRIES
    assert found["scan"] == Scan.grid(Wall.plane(), 8, kind="confocal")
    assert repr(found["hidden"]) == repr(scenes.nlos_letter())
    axis = found["scan"].default_axis(scenes.bounds(scenes.nlos_letter()), 16e-12 * SPEED_OF_LIGHT)
    assert found["time_axis"] == axis
    assert [found[name] for name in ("spp", "bounces", "seed")] == [4096, (3,), 0]
    assert found["frequencies"] is found["variant"] is found["sensor"] is None


def test_the_example_of_the_documentation(tmp_path):
    example = tt.nlos.setup_files.__doc__.split("\n\n")[1].replace("    sensor: device", "    # sensor: device")
    (tmp_path / "a.yaml").write_text(example + "\n")
    found = read_setup(tmp_path / "a.yaml")
    assert set(found["hidden"]) == {"letter", "ball"} and found["scan"].shape == (32, 32)
    assert found["variant"] == "llvm_ad_mono"
    np.testing.assert_allclose(scenes.bounds({"b": found["hidden"]["ball"]}), [[0.2, -0.2, 0.6], [0.6, 0.2, 1.0]])


def test_files_lie_beside_the_description(tmp_path):
    vertices, faces = scenes.meshes.ellipsoid([0, 0, 1], 0.3, 1)
    np.savez(tmp_path / "ball.npz", vertices=vertices, faces=faces)
    (tmp_path / "letter.obj").write_text(OBJ)
    wall, wall_faces = scenes.meshes.plate(2.0, 1.0)
    np.savez(tmp_path / "wall.npz", vertices=wall, faces=wall_faces[:, ::-1])
    stages = ({"kind": "GaussianResponse", "fwhm_s": 5e-11},)
    device = Device("d", description="a detector", sources=("assumed: all of it",), stages=stages)
    device.to_yaml(tmp_path / "device.yaml")
    path = tmp_path / "office.yaml"
    path.write_text(
        "hidden:\n  ball: {file: ball.npz, albedo: [0.1, 0.2, 0.3]}\n  letter: {file: letter.obj}\n"
        "wall: {file: wall.npz, albedo: 0.9}\n"
        "scan: {kind: single, size: [4, 2], laser: [0.25, 0.5]}\n"
        "time_axis: {start_opl: 1.5, bin_width_opl: 3e-3, num_bins: 512}\nsensor: device.yaml\n"
        "spp: 1_024\nbounces: [4, 3, 3]\nseed: 7\nname: test\n"
    )
    found = read_setup(path)
    assert found["hidden"]["ball"]["type"] == "mesh_arrays"
    assert found["hidden"]["ball"]["bsdf"]["reflectance"] == {"type": "rgb", "value": [0.1, 0.2, 0.3]}
    assert found["hidden"]["letter"]["filename"] == str(tmp_path / "letter.obj")
    assert found["scan"].wall["type"] == "mesh_arrays" and found["scan"].wall["bsdf"]["reflectance"] == 0.9
    np.testing.assert_allclose(found["scan"].laser_points, [-0.5, 0, 0], atol=1e-12)
    assert found["time_axis"] == tt.TimeAxis(1.5, 0.003, 512), "YAML 1.1 reads 3e-3 as a text"
    assert found["sensor"] == device
    assert [found[name] for name in ("spp", "bounces", "seed")] == [1024, (3, 4), 7]


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_can_be_hidden(read, name):
    found = read(hidden={"thing": {"scene": name}}, time_axis={"bin_width_opl": 0.02})["hidden"]
    made = getattr(scenes, name)()
    expected = ["thing"] if len(made) == 1 else [f"thing_{part}" for part in made]
    assert list(found) == expected


def test_arguments_of_scenes(read):
    given = {"scene": "nlos_letter", "letter": "K", "depth": 0.7, "thickness": 0.1, "albedo": [0.1, 0.2, 0.3]}
    found = read(hidden={"k": given})["hidden"]["k"]
    made = scenes.nlos_letter("K", size=1.0, depth=0.7, albedo=(0.1, 0.2, 0.3), thickness=0.1)
    assert repr(found) == repr(made["letter"])


def test_places(read):
    turns = [[[1, 0, 0], 10], [[0, 1, 0], 20]]
    found = read(hidden={
        "a": {"shape": "cube", "scale": [1, 2, 3], "rotate": turns, "translate": [0, 0, 5], "albedo": 0.3},
        "b": {"shape": "rectangle", "rotate": [[0, 1, 0], 180], "translate": [0, 0, 1], "flip_normals": True},
        "c": {"shape": "sphere", "to_world": np.diag([0.1, 0.1, 0.1, 1]).tolist(), "bsdf": {"type": "conductor"}},
        "d": {"vertices": [[0, 0, 1], [1, 0, 1], [0, 1, 1]], "faces": [[0, 2, 1]]},
    })["hidden"]  # fmt: skip
    expected = translate([0, 0, 5]) @ rotate([0, 1, 0], 20) @ rotate([1, 0, 0], 10) @ scale([1, 2, 3])
    np.testing.assert_allclose(found["a"]["to_world"], expected)
    assert found["a"]["bsdf"]["reflectance"] == 0.3 and "flip_normals" not in found["a"]
    np.testing.assert_allclose(found["b"]["to_world"], translate([0, 0, 1]) @ rotate([0, 1, 0], 180))
    assert found["b"]["flip_normals"] is True
    assert found["c"]["to_world"][0, 0] == 0.1 and found["c"]["bsdf"] == {"type": "conductor"}
    assert found["d"]["vertices"].shape == (3, 3) and "to_world" not in found["d"]


def test_walls_and_scans(read):
    wall = {"width": 1.0, "height": 3.0, "center": [0, 1, 0], "normal": [0, 0, 2], "up": [0, 1, 0.0], "albedo": 0.7}
    scan = {
        "kind": "exhaustive", "size": [4, 3], "laser_grid": 2, "sensor_origin": [0, 0, 1], "laser_origin": [0, 1, 1],
        "extent": [0, 0, 0.5, 1], "cell_centers": False, "first_and_last_leg": True,
    }  # fmt: skip
    found = read(wall=wall, scan=scan)["scan"]
    surface = Wall.plane(1.0, 3.0, center=(0, 1, 0), albedo=0.7)
    assert found == Scan.grid(
        surface, (4, 3), kind="exhaustive", laser_grid=(2, 2), sensor_origin=(0, 0, 1), laser_origin=(0, 1, 1),
        extent=(0, 0, 0.5, 1), cell_centers=False, first_and_last_leg=True,
    )  # fmt: skip


def test_axes_bounces_and_sensors(read):
    listed = read(frequencies=[1.0, 2, "3e0"])
    assert listed["time_axis"] is None and listed["frequencies"] == tt.FrequencyAxis((1.0, 2.0, 3.0))
    for given, bounces in (("all", "all"), (4, (4,)), ([2, 1], (1, 2))):
        assert read(bounces=given)["bounces"] == bounces
    assert read(sensor=DEVICE)["sensor"] == Device.from_dict(DEVICE)


DEVICE = {"name": "d", "description": "a detector", "sources": ["assumed: all"], "stages": [{"kind": "ShotNoise"}]}
MESH = {"vertices": [[0, 0, 1], [1, 0, 1], [0, 1, 1]], "faces": [[0, 2, 1]]}


@together(
    "entries, error, message",
    [
        ({"samples": 3}, SceneError, "unknown entry 'samples'"),
        ({"hidden": None}, SceneError, "an entry 'hidden'"),
        ({"hidden": {"a": {}}}, SceneError, "one of scene, file, shape, vertices"),
        ({"hidden": {"a.b": {"shape": "cube"}}}, SceneError, "without dots"),
        ({"hidden": {"": {"shape": "cube"}}}, SceneError, "without dots"),
        ({"hidden": {"a": {"scene": "cornell_box"}}}, SceneError, "nlos_z, nlos_letter"),
        ({"hidden": {"a": {"scene": "nlos_letter", "leter": "K"}}}, SceneError, "Did you mean 'letter'"),
        ({"hidden": {"a": {"scene": "nlos_letter", "size": "big"}}}, UnitError, "a: size: expected a finite"),
        ({"hidden": {"a": {"file": "none.obj"}}}, SceneError, "no file 'none.obj'"),
        ({"hidden": {"a": {"file": "letter.obj"}}}, SceneError, "bins can be found for shapes alone.*'obj' at a"),
        ({"hidden": {"a": {"file": "broken.npz"}}}, StorageError, "'vertices' and 'faces' in"),
        ({"hidden": {"a": {"file": "mesh.stl"}}}, SceneError, "expected a mesh"),
        ({"hidden": {"a": {"shape": "torus"}}}, SceneError, "rectangle, disk, cube, sphere"),
        ({"hidden": {"a": {"shape": "cube", "albedo": 2}}}, UnitError, "between 0 and 1"),
        ({"hidden": {"a": {"shape": "cube", "albedo": 0.5, "bsdf": {}}}}, SceneError, "exclude each other"),
        *(
            ({"hidden": {"a": {"shape": "cube", "rotate": value}}}, SceneError, "hidden: a: rotate: expected")
            for value in (30, "y", {"y": 30}, [[0, 1, 0]], [[0, 1, 0], [30]])
        ),
        *(
            ({"hidden": {"a": {"shape": "cube", "bsdf": value}}}, SceneError, "hidden: a: bsdf: expected a dict")
            for value in ("conductor", {}, {"type": 3})
        ),
        ({"hidden": {"a": {"shape": "cube", "scale": 10**400}}}, SceneError, "a: scale: expected a finite number"),
        ({"hidden": {"a": {"shape": "cube", "to_world": [[1]]}}}, SceneError, "four rows"),
        ({"hidden": {"a": {"shape": "cube", "scale": 2, "to_world": []}}}, SceneError, "excludes scale"),
        ({"hidden": {"a": {**MESH, "faces": [[0, 1, 5]]}}}, ShapeError, "hidden: a: .*0 to 2"),
        ({"wall": {"widht": 1}}, SceneError, "Did you mean 'width'"),
        ({"wall": {"file": "letter.obj"}}, SceneError, r"wall: expected an \.npz file with vertices and faces"),
        ({"scan": {"kind": "biaxial", "size": 8}}, SceneError, "single, confocal, exhaustive"),
        ({"scan": {"kind": "confocal"}}, SceneError, "an entry 'size'"),
        ({"scan": {"kind": "confocal", "size": 8, "laser": [0.5, 0.5]}}, ArgumentError, "laser has no meaning"),
        ({"time_axis": {"start_opl": 1.0}}, SceneError, "together, or neither"),
        ({"time_axis": {"bin_width_s": 1e-11}}, SceneError, "Did you mean 'bin_width_opl'"),
        ({"time_axis": {"num_bins": 4}, "frequencies": [1.0]}, SceneError, "exclude each other"),
        ({"frequencies": ["low"]}, SceneError, "frequencies: expected a finite number"),
        ({"spp": 0}, SceneError, "spp: expected a whole number of at least 1"),
        ({"bounces": [2.5]}, SceneError, "bounces: .*expected a whole number"),
        ({"seed": -1}, SceneError, "at least 0"),
        ({"sensor": "none.yaml"}, SceneError, "^sensor: no file 'none.yaml'"),
        ({"sensor": DEVICE | {"stages": 3}}, StorageError, "sensor: Device 'd': expected stages as a list, got 3"),
        ({"sensor": 3}, SceneError, "the file of a device"),
        ({"variant": 3}, SceneError, "variant: expected a text"),
    ],
)
def test_what_is_refused(read, entries, error, message):
    with pytest.raises(error, match=message):
        read(**entries)
