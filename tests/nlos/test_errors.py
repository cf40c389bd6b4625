"""Captures that cannot be made, through every door: what was expected, what came, what to do."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import (
    ArgumentError,
    SceneError,
    TorchTransientError,
    UnitError,
)

VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.9, 0.02, 100)
WALL = tt.nlos.Wall.plane(2.0, 1.6, albedo=0.7)
Z = tt.scenes.nlos_z()
ASIDE = {"sensor_origin": [-0.5, 0.0, 0.25], "laser_origin": [-0.5, 0.0, 0.25]}


def scan(kind="confocal", size=(3, 2), **settings):
    return tt.nlos.Scan.grid(settings.pop("wall", WALL), size, kind=kind, **settings)


def complete(kind="confocal", hidden=None, meter=None, integrator=None, without=()):
    """A complete scene of a capture, with what is changed of it."""
    settings = {"laser_grid": (2, 1)} if kind == "exhaustive" else {}
    described = tt.nlos.capture_scene(Z if hidden is None else hidden, scan(kind, **settings))
    sensor = described["wall"]["sensor"]
    sensor["film"] |= {"start_opl": AXIS.start_opl, "bin_width_opl": AXIS.bin_width_opl, "temporal_bins": 100}
    sensor |= meter or {}
    described["integrator"] |= integrator or {}
    return {name: node for name, node in described.items() if name not in without}


def simulate(hidden=None, of=None, **settings):
    settings = {"time_axis": AXIS, "spp": 4, "progress": False} | settings
    return tt.nlos.simulate(Z if hidden is None else hidden, of or scan(), **settings)


def renderer(hidden=None, of=None, **settings):
    settings = {"time_axis": AXIS, "spp": 4} | settings
    seed = settings.pop("seed", 0)
    return tt.nlos.CaptureRenderer(Z if hidden is None else hidden, of or scan(), **settings)(seed=seed)


def scene(*given, seed=0, **changed):
    return tt.nlos.simulate(complete(*given, **changed), spp=4, progress=False, seed=seed)


def plate(z, **settings):
    to_world = np.diag([0.3, 0.3, 1.0, 1.0])
    to_world[2, 3] = z
    return {"plate": {"type": "rectangle", "to_world": to_world, **settings}}


def broken_mesh():
    mesh = dict(tt.scenes.triangle_mesh([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 2, 1]]))
    return {"letter": mesh | {"vertices": np.array([[0, 0, 1], [1, 0, np.nan], [0, 1, 1]])}}


def shining():
    hidden = copy.deepcopy(Z)
    hidden["letter"]["emitter"] = {"type": "area", "radiance": 1.0}
    return hidden


def off_the_wall():
    listed = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.1]])
    on = tt.nlos.Scan.points(listed[:1], kind="confocal", wall=WALL, **ASIDE)
    # Of points whose normals are not known, nobody has looked whether they lie on the wall.
    return tt.nlos.Scan(
        "confocal", listed, listed, sensor_origin=on.sensor_origin, laser_origin=on.laser_origin, wall=on.wall
    )


TWOSIDED = {"bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
HIDES = r"4 of 6 sensor points are not what the sensor looks at.*meets 'plate' 0.275 m away.*stands between"
SHINES = r"'letter.emitter' \(area\) emits light; expected shapes alone.*Leave it out"
NAN = r"expected finite numbers, got NaN or infinity in 'letter.vertices' \(1 of 9\)"
BEHIND = r"expected something before the wall.*got nothing there.*turn the wall"
NOTHING = "expected at least one shape beside the wall, got none"
BACK = r"rays end on the back of 'wall'.*Move sensor_origin or laser_origin"
MESH = (np.ones((3, 3)), np.array([[0, 1, 2]]))

CASES = {
    # points and origins
    "points off the wall: simulate": (lambda: simulate(of=off_the_wall()), SceneError, r"1 of 2 sensor points.*Move"),
    "points off the wall: scan": (
        lambda: tt.nlos.Scan.points([[0, 0, 0.1]], kind="confocal", wall=WALL, **ASIDE), SceneError,
        r"expected points on the wall, got 1 of 1 elsewhere.*Wall.at",
    ),
    "points off the wall: scene": (
        lambda: scene(meter={"points": np.array([[5.0, 0, 0]] * 6)}), SceneError, "6 of 6 sensor points.*meets nothing",
    ),
    "a laser that misses: scene": (
        lambda: scene("single", meter={"laser_points": np.array([[3.0, 0, 0]])}), SceneError,
        r"1 of the laser's 1 beams meet nothing.*Aim the laser at the relay wall",
    ),
    "too many spots: scene": (
        lambda: scene("single", meter={"laser_points": np.zeros((2, 3))}), SceneError, "a single capture has one laser",
    ),
    "a sensor behind the wall: scene": (lambda: scene(meter={"sensor_origin": [0, 0, -1.0]}), SceneError, BACK),
    "a grid of one point": (lambda: scan("exhaustive", size=1), SceneError, "grid of one point.*Give kind='single'"),
    "a scan without a wall": (
        lambda: simulate(of=tt.nlos.Scan.points([[0, 0, 0]], kind="confocal", **ASIDE)), SceneError, "knows its wall",
    ),
    # hidden things
    "nothing hidden: simulate": (lambda: simulate({}), SceneError, "expected at least one shape, got an empty"),
    "no shape among them": (lambda: simulate({"paint": {"type": "diffuse"}}), SceneError, NOTHING),
    "in the sensor's way: simulate": (lambda: simulate(plate(0.1)), SceneError, HIDES),
    "in the sensor's way: scene": (lambda: scene(hidden=plate(0.1, **TWOSIDED)), SceneError, HIDES),
    "behind the wall: simulate": (lambda: simulate(plate(-1.0)), SceneError, BEHIND),
    "vertices that are no number: simulate": (lambda: simulate(broken_mesh()), SceneError, NAN),
    "no area": (lambda: simulate(MESH), SceneError, r"shapes with an area.*got 'hidden' \(0 m\^2\)"),
    "lengths of stars": (lambda: simulate((1e30 * MESH[0], MESH[1])), UnitError, "hidden: expected vertices in finite"),
    "areas beyond numbers": (
        lambda: simulate({"far": {"type": "mesh_arrays", "vertices": 1e30 * np.eye(3), "faces": [[0, 1, 2]]}}),
        SceneError, "shapes of finite area, got 'far'",
    ),
    "hidden light: simulate": (lambda: simulate(shining()), SceneError, SHINES),
    "hidden light: scene": (
        lambda: tt.nlos.simulate(complete() | shining(), spp=4, progress=False), SceneError,
        r"expected one emitter, the laser.*got 2 \('laser', 'emitter'\)",
    ),
    "a name of the capture": (lambda: simulate({"wall": Z["letter"]}), SceneError, "names wall belong to the capture"),
    # light and work
    "bounces of a scene": (
        lambda: tt.nlos.simulate(complete(), bounces=(3,), progress=False), ArgumentError,
            "max_depth and filter_bounces",
    ),
    "bounces that the depth leaves out": (
        lambda: scene(integrator={"filter_bounces": 4, "min_bounces": 0}), SceneError, "Set max_depth to at least 4",
    ),
    "a negative seed: forecast": (
        lambda: tt.nlos.forecast(Z, scan(), time_axis=AXIS, seed=-1), ArgumentError, "seed: expected a whole number",
    ),
    "a depth of a layer": (lambda: renderer(max_depth=5), ArgumentError, "max_depth: bounces= says"),
    "samples of 33 bits: simulate": (lambda: simulate(spp=2**32), UnitError, "spp: expected at most 4294967295"),
    "no tiles": (lambda: simulate(tiles=0), ArgumentError, "tiles: expected a whole number of at least 1"),
    # what is no capture
    "no scan": (lambda: tt.nlos.simulate(Z), ArgumentError, r"expected scan= beside hidden shapes.*got letter and"),
    "a mesh and no scan": (lambda: tt.nlos.simulate(([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 1, 2]])), ArgumentError,
        "expected scan= beside a mesh"),
    "a scene and a scan": (lambda: simulate(tt.load(complete())), ArgumentError,
        "Leave scan out to simulate the scene"),
    "a scene without a laser": (lambda: scene(without=("laser",)), SceneError, "expected one emitter, the laser"),
    "another integrator": (
        lambda: tt.nlos.simulate(tt.scenes.cornell_box()), SceneError, "expected a scene with the integrator",
    ),
}  # fmt: skip


@pytest.mark.slow
@together("case", CASES)
def test_what_cannot_be_captured(case):
    made, kind, message = CASES[case]
    with pytest.raises(TorchTransientError, match=message) as caught:
        made()
    assert isinstance(caught.value, kind)
    assert "Traceback" not in str(caught.value)


@pytest.mark.slow
def test_one_point_is_a_scan():
    """As a grid, a list, and with its own laser."""
    for of in (scan(size=1), scan("single", size=1, laser=(0.3, 0.3)), scan("exhaustive", size=1, laser_grid=(2, 2))):
        assert float(simulate(of=of, spp=64).transient.sum()) > 0
