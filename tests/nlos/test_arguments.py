"""Whatever is handed to a public function of captures and hidden scenes, what comes out is an error of this library."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient import scenes
from torchtransient.errors import TorchTransientError

VARIANT = "llvm_ad_mono"
WRONG = (
    None, "x", b"x", True, [], [1], (1, 2, 3, 4), {}, {"a": 1}, math.nan, math.inf, -1, 0, 1.5, 2**33, 10**400,
    -(10**400), 1j, np.zeros((2, 2)), np.full(3, math.nan), torch.tensor([1.0, 2.0]), [[1, 2], [3]], [None] * 3,
    ["a", "b", "c"], object(), lambda: 0,
)  # fmt: skip
VERTICES, FACES = np.array([[0, 0, 1.0], [1, 0, 1], [0, 1, 1]]), [[0, 2, 1]]
WALL = tt.nlos.Wall.plane()
ORIGIN = [0.0, 0.0, 1.0]
PAIRS = tt.nlos.Scan.grid(WALL, 2, kind="exhaustive")
POINTS = tt.nlos.Scan.grid(WALL, 2, kind="confocal")
AXIS = tt.TimeAxis(1.9, 0.05, 20)
CAPTURE = tt.nlos.Capture(torch.zeros(1, 20, 2, 2, 2, 2), AXIS, PAIRS)
HIDDEN = scenes.nlos_z()
MESH = {"vertices": VERTICES, "faces": FACES}
OF_POINTS = {"sensor_points": [[0, 0, 0.0]], "sensor_origin": ORIGIN, "laser_origin": ORIGIN, "wall": WALL}
BARE = {"kind": "confocal", "sensor_points": [[0, 0, 0.0]], "laser_points": [[0, 0, 0.0]]}
BARE |= {"sensor_origin": ORIGIN, "laser_origin": ORIGIN}
# Of each function: what is right, and which arguments are taken in turn. Those of `simulate` and `CaptureRenderer` that
# are looked at before anything is built.
FUNCTIONS = {
    "triangle_mesh": (scenes.triangle_mesh, MESH, "vertices faces reflectance to_world"),
    "relay_wall": (scenes.relay_wall, {}, "width height albedo"),
    "nlos_z": (scenes.nlos_z, {}, "size depth albedo thickness"),
    "nlos_letter": (scenes.nlos_letter, {}, "letter size depth albedo thickness subdivide"),
    "nlos_plates": (scenes.nlos_plates, {}, "size depth gap albedo second_size"),
    "nlos_corner": (scenes.nlos_corner, {}, "size depth albedo"),
    "nlos_mannequin": (scenes.nlos_mannequin, {"level": 0}, "depth height albedo level x"),
    "nlos_room": (scenes.nlos_room, {"level": 0}, "width height depth albedo person level"),
    "bounds": (scenes.bounds, {}, "shapes"),
    "Wall.plane": (tt.nlos.Wall.plane, {}, "width height center normal up albedo"),
    "Wall.mesh": (tt.nlos.Wall.mesh, MESH, "vertices faces up albedo"),
    "Wall.of": (tt.nlos.Wall.of, {}, "description"),
    "Wall.of, its type": (lambda value: tt.nlos.Wall.of({"type": value}), {}, "value"),
    "Wall.of, its place": (lambda value: tt.nlos.Wall.of({"type": "rectangle", "to_world": value}), {}, "value"),
    "Wall.at": (WALL.at, {"u": 0.5, "v": 0.5}, "u v"),
    "Wall.grid": (WALL.grid, {"size": 2}, "size extent cell_centers"),
    "Scan.grid": (
        tt.nlos.Scan.grid, {"wall": WALL, "size": 2, "kind": "single"},
        "wall size kind laser sensor_origin laser_origin laser_grid cell_centers extent first_and_last_leg",
    ),
    "Scan.grid of pairs": (tt.nlos.Scan.grid, {"wall": WALL, "size": 2, "kind": "exhaustive"}, "laser_grid"),
    "Scan.points": (
        tt.nlos.Scan.points, {"kind": "confocal", **OF_POINTS},
        "sensor_points kind wall laser_points sensor_origin laser_origin normals first_and_last_leg",
    ),
    "Scan.points, its spot": (
        tt.nlos.Scan.points, {"kind": "single", "laser_points": [0, 0, 0.0], **OF_POINTS}, "laser_points",
    ),
    "Scan": (
        tt.nlos.Scan, BARE, "kind sensor_points laser_points sensor_origin laser_origin sensor_normals laser_normals "
        "first_and_last_leg wall",
    ),
    "Scan.single": (PAIRS.single, {}, "laser"),
    "Scan.default_axis": (
        POINTS.default_axis, {"hidden_bounds": scenes.bounds(HIDDEN), "bin_width_opl": 0.1},
        "hidden_bounds bin_width_opl",
    ),
    "Capture": (
        tt.nlos.Capture, {"transient": CAPTURE.transient, "axis": AXIS, "scan": PAIRS},
        "transient axis scan metadata phasor frequencies steady channels polarized",
    ),
    "Capture.crop": (CAPTURE.crop, {"start_opl": 2.0, "end_opl": 2.5}, "start_opl end_opl"),
    "Capture.single": (CAPTURE.single, {}, "laser"),
    "capture_scene": (tt.nlos.capture_scene, {"hidden": HIDDEN, "scan": POINTS}, "hidden scan bounces energy"),
    "read_setup": (tt.nlos.read_setup, {}, "path"),
    "read_capture": (tt.nlos.read_capture, {}, "path"),
    "write_capture": (tt.nlos.write_capture, {"path": "no_folder/a.npz", "capture": CAPTURE}, "path capture metadata"),
    "simulate": (
        tt.nlos.simulate, {"hidden": (), "scan": POINTS, "time_axis": AXIS, "progress": False},
        "hidden scan spp bounces energy sensor seed tiles part generator",
    ),
    "forecast": (tt.nlos.forecast, {"hidden": (), "scan": POINTS}, "hidden scan spp bounces energy seed tiles part"),
    "CaptureRenderer": (
        tt.nlos.CaptureRenderer, {"hidden": (), "scan": POINTS}, "hidden scan parameters bounces energy sensor spp",
    ),
}  # fmt: skip
CASES = [(name, argument) for name, (_, _, arguments) in FUNCTIONS.items() for argument in arguments.split()]


@together("name, argument", CASES)
def test_only_errors_of_this_library(name, argument):
    function, right, _ = FUNCTIONS[name]
    messages = []
    for value in WRONG:
        try:
            function(**right | {argument: value})
        except TorchTransientError as error:
            messages.append(str(error))
    assert len(messages) >= 10
    assert all(len(message) > 20 and "Traceback" not in message for message in messages)


@pytest.mark.parametrize("values", [None, [1], "x", 3, torch.tensor([1.0]), {1: 2}])
def test_values_that_are_none(values):
    renderer = tt.nlos.CaptureRenderer(HIDDEN, POINTS, ["letter.bsdf.reflectance.value"], time_axis=AXIS, spp=2)
    if values is None:
        assert renderer(values, seed=0).transient.shape == (1, 20, 2, 2)
        return
    with pytest.raises(TorchTransientError, match=r"expected keys of scene\.parameters"):
        renderer(values, seed=0)


def test_albedos_are_those_of_walls_and_meshes():
    """One number of any library, or three in a list, a tuple or an array."""
    for given in (0.5, np.float32(0.5), torch.tensor(0.5), 1, 0):
        wall, mesh = tt.nlos.Wall.plane(albedo=given).shape, scenes.triangle_mesh(VERTICES, FACES, reflectance=given)
        assert wall["bsdf"] == mesh["bsdf"] == {"type": "diffuse", "reflectance": float(given)}
    for three in ([0.25, 0.5, 1], (0.25, 0.5, 1.0), np.array([0.25, 0.5, 1.0]), torch.tensor([0.25, 0.5, 1.0])):
        wall, mesh = tt.nlos.Wall.plane(albedo=three).shape, scenes.triangle_mesh(VERTICES, FACES, reflectance=three)
        assert wall["bsdf"] == mesh["bsdf"]
        assert mesh["bsdf"]["reflectance"] == {"type": "rgb", "value": [0.25, 0.5, 1.0]}
