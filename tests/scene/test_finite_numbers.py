"""NaN and infinity anywhere in a scene are found when it is built, by key."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.sweeps import together
from torchtransient import plugins
from torchtransient.errors import SceneError

VARIANT = "llvm_ad_rgb"
NAN, INF = float("nan"), float("inf")


def pixels(value):
    data = np.full((4, 4, 3), 0.5, dtype=np.float32)
    data[1, 2, 0] = value
    return data


def grid(value):
    data = np.full((3, 3, 3, 1), 0.5, dtype=np.float32)
    data[1, 2, 0] = value
    return data


def matrix(value):
    result = np.eye(4)
    result[0, 3] = value
    return result


def scene():
    film = {
        "type": "transient_hdr_film", "width": 2, "height": 2, "temporal_bins": 20, "bin_width_opl": 0.5,
        "rfilter": {"type": "box"},
    }  # fmt: skip
    pose = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]]
    return {
        "type": "scene", "integrator": {"type": "transient_prbvolpath", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 30.0, "near_clip": 0.1, "to_world": np.array(pose), "film": film},
        "lamp": {"type": "point", "position": [0.0, 0.0, 3.0], "intensity": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
        "sky": {"type": "envmap", "bitmap": pixels(0.5)},
        "wall": {
            "type": "rectangle", "to_world": np.eye(4),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": pixels(0.5), "raw": True}},
        },
        "mirror": {"type": "cube", "bsdf": {"type": "roughconductor", "alpha": 0.1}},
        "fog": {
            "type": "sphere", "center": [0, 0, 1.0], "radius": 0.3, "bsdf": {"type": "null"},
            "interior": {
                "type": "heterogeneous", "albedo": {"type": "constvolume", "value": 0.5}, "scale": 1.0,
                "sigma_t": {"type": "gridvolume", "data": grid(0.5)}, "phase": {"type": "hg", "g": 0.3},
            },
        },
    }  # fmt: skip


# where: how to write a number there
PLACES = {
    "lamp.intensity": lambda x: {"type": "rgb", "value": [1.0, x, 3.0]},
    "lamp.position": lambda x: [0.0, x, 3.0],
    "sky.bitmap": pixels,
    "sky.scale": lambda x: x,
    "wall.bsdf.reflectance.bitmap": pixels,
    "wall.to_world": matrix,
    "mirror.bsdf.alpha": lambda x: x,
    "mirror.to_world": matrix,
    "fog.radius": lambda x: x,
    "fog.center": lambda x: [0.0, x, 1.0],
    "fog.interior.sigma_t.data": grid,
    "fog.interior.scale": lambda x: x,
    "fog.interior.albedo.value": lambda x: x,
    "fog.interior.phase.g": lambda x: x,
    "sensor.fov": lambda x: x,
    "sensor.near_clip": lambda x: x,
    "sensor.to_world": matrix,
}


def with_number(place, x):
    result = scene()
    *way, last = place.split(".")
    node = result
    for key in way:
        node = node[key]
    node[last] = PLACES[place](x)
    return result


@together("x", [NAN, -INF])
@together("place", PLACES)
def test_number_of_a_description(place, x):
    broken = tt.load(with_number(place, x), variant=VARIANT)
    with pytest.raises(SceneError, match=f"finite numbers, got NaN or infinity in .*'{place}"):
        tt.TransientRenderer(broken)


def test_picture_in_a_file(tmp_path):
    mi.set_variant(VARIANT)
    path = tmp_path / "picture.exr"
    with tt.threads(2):
        mi.Bitmap(pixels(INF)).write(str(path))
    broken = scene()
    broken["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "filename": str(path), "raw": True}
    with pytest.raises(SceneError, match=r"reflectance.data' \(1 of 48\)"):
        tt.TransientRenderer(tt.load(broken, variant=VARIANT))


def test_grid_in_a_file(tmp_path):
    mi.set_variant(VARIANT)
    path = tmp_path / "grid.vol"
    mi.VolumeGrid(grid(NAN)).write(str(path))
    broken = scene()
    broken["fog"]["interior"]["sigma_t"] = {"type": "gridvolume", "filename": str(path)}
    with pytest.raises(SceneError, match=r"sigma_t.data' \(1 of 27\)"):
        tt.TransientRenderer(tt.load(broken, variant=VARIANT))


def test_first_sight_of_a_scene_of_mitsuba():
    mi.set_variant(VARIANT)
    plugins.sync()
    broken = scene()
    for node in broken.values():
        if isinstance(node, dict) and isinstance(node.get("to_world"), np.ndarray):
            node["to_world"] = mi.ScalarTransform4f(node["to_world"])
    broken["sky"] = {"type": "constant"}
    broken["wall"]["bsdf"]["reflectance"]["bitmap"] = mi.Bitmap(pixels(NAN))
    broken["fog"]["interior"]["sigma_t"]["data"] = mi.TensorXf(grid(0.5))
    loaded = mi.load_dict(broken)
    for used in (loaded.integrator(), mi.load_dict(broken["integrator"])):
        with pytest.raises(SceneError, match=r"finite numbers, got NaN or infinity in .*reflectance.data' \(1 of 48\)"):
            used.render(loaded, spp=1)
