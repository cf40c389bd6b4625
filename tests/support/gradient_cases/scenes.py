"""The scenes of gradient cases: a wall before the camera, lit from beside it, and what replaces or joins the wall."""

from __future__ import annotations

import mitsuba as mi


def transform():
    """Mitsuba's scalar affine transform of the active variant."""
    return mi.ScalarTransform4f()


def film(start=6.0, bins=200, width=0.02, size=4, filter="tent"):
    """A small film with a slope in time."""
    return {
        "type": "transient_hdr_film",
        "temporal_bins": bins,
        "start_opl": start,
        "bin_width_opl": width,
        "temporal_filter": filter,
        "width": size,
        "height": size,
        "rfilter": {"type": "box"},
    }


def camera(fov=10.0, origin=(0, 0, 4), target=(0, 0, 0), near=0.01, **film_arguments):
    """Perspective camera looking at the wall."""
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": near,
        "to_world": transform().look_at(origin=list(origin), target=list(target), up=[0, 1, 0]),
        "film": film(**film_arguments),
    }


def room(bsdf=None, light=None, depth=5, sensor=None, side_reflectance=0.8, **extra):
    """A wall at z = 0 before the camera, a panel at its side, a point light beside the camera."""
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": depth, "rr_depth": 100},
        "sensor": sensor or camera(),
        "light": light or {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": 10.0},
        "side": {
            "type": "rectangle",
            "to_world": transform().translate([1.6, 0, 1.2]).rotate([0, 1, 0], -60).scale(0.4),
            "bsdf": {"type": "diffuse", "reflectance": side_reflectance},
        },
        "wall": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 0]),
            "bsdf": bsdf or {"type": "diffuse", "reflectance": 0.5},
        },
        **extra,
    }


def area_light(shape="rectangle", size=0.3):
    t = transform().translate([0.6, 0.2, 2.5]).rotate([0, 1, 0], 200)
    if shape == "sphere":
        return {
            "type": "sphere",
            "center": [0.6, 0.2, 2.5],
            "radius": size,
            "emitter": {"type": "area", "radiance": 9.0},
        }
    return {"type": shape, "to_world": t.scale(size), "emitter": {"type": "area", "radiance": 9.0}}


def glass_slab(bsdf, shape="cube"):
    """A slab tilted against the camera's rays, in front of the wall; the light stands beside it."""
    wide = room(
        sensor=camera(fov=6.0), light={"type": "point", "position": [1.8, 0.0, 2.0], "intensity": 10.0}, depth=5
    )
    wide["wall"]["to_world"] = transform().scale(3)
    del wide["side"]
    wide["slab"] = {
        "type": shape,
        "to_world": transform().translate([0, 0, 2.4]).rotate([0, 1, 0], 35).scale([0.8, 0.8, 0.25]),
        "bsdf": bsdf,
    }
    return wide


def instances(bsdf):
    """A plate that is an instance of a group, in front of the wall and tilted against the camera."""
    tilted = transform().translate([0, 0, 1.4]).rotate([0, 1, 0], 25).scale([0.8, 0.8, 0.2])
    plate = {"type": "cube", "to_world": tilted, "bsdf": bsdf}
    scene = room(
        light={"type": "point", "position": [1.9, 0.0, 2.0], "intensity": 10.0}, sensor=camera(fov=6.0, start=3.0)
    )
    del scene["side"]
    scene["wall"]["to_world"] = transform().scale(3)
    group = {"type": "shapegroup", "plate": plate}
    return {
        **scene,
        "group": group,
        "copy": {"type": "instance", "to_world": transform(), "group": {"type": "ref", "id": "group"}},
    }


def mirror_room(bsdf=None):
    """A large diffuse wall seen in a mirror; light and camera stand before both."""
    scene = room(
        bsdf or {"type": "conductor", "material": "none", "specular_reflectance": 0.9},
        sensor=camera(fov=8.0, origin=(0.3, 0, 3), start=11.0),
    )
    scene["side"]["to_world"] = transform().translate([0, 0, 5]).rotate([0, 1, 0], 180).scale(6)
    scene["light"]["position"] = [0.5, 0.3, 1.0]
    return scene
