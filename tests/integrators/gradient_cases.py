"""Scenes with one scalar unknown each, for the matrix of gradient tests.

A case builds a scene and says how the unknown enters the scene's parameters. ``support`` is what the README's table
prints: ``correct`` or ``biased where silhouettes move``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Case:
    """One unknown: ``scene()`` is a Mitsuba dictionary, ``apply(params, x)`` writes the attached unknown into it."""

    name: str
    row: str
    scene: Callable[[], dict[str, Any]]
    apply: Callable[[Any, Any], None]
    value: float
    step: float
    variant: str = "llvm_ad_mono"
    spp: int = 1024
    seeds: int = 6
    fd_spp: int = 1024
    support: str = "correct"
    tags: tuple[str, ...] = field(default=())


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


def set_color(key):
    def apply(params, x):
        params[key] = type(params[key])(x)

    return apply


def move(key, direction):
    """Translate a shape, light or sensor by ``x * direction``."""

    def apply(params, x):
        offset = mi.AffineTransform4f().translate(mi.Vector3f(*direction) * x)
        params[key] = offset @ mi.AffineTransform4f(params[key])

    return apply


def rotate(key, axis):
    def apply(params, x):
        params[key] = mi.AffineTransform4f(params[key]) @ mi.AffineTransform4f().rotate(mi.Vector3f(*axis), x)

    return apply


def stretch(key):
    def apply(params, x):
        params[key] = mi.AffineTransform4f(params[key]) @ mi.AffineTransform4f().scale(mi.Vector3f(x))

    return apply


def move_vertices(key, direction):
    def apply(params, x):
        p = dr.unravel(mi.Point3f, params[key])
        params[key] = dr.ravel(p + mi.Vector3f(*direction) * x)

    return apply


def move_point(key, direction):
    def apply(params, x):
        params[key] = mi.Point3f(params[key]) + mi.Vector3f(*direction) * x

    return apply


def scale_texture(key):
    def apply(params, x):
        t = params[key]
        ramp = np.linspace(0.0, 1.0, int(np.prod(t.shape)), dtype=np.float32)
        params[key] = mi.TensorXf(t.array + mi.Float(ramp) * x, t.shape)

    return apply


def texture():
    rng = np.random.default_rng(3)
    data = mi.TensorXf(rng.uniform(0.2, 0.7, (4, 4, 1)).astype(np.float32))
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear"}}


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


def blend():
    """Diffuse and rough metal, mixed."""
    parts = {"a": {"type": "diffuse", "reflectance": 0.5}, "b": {"type": "roughconductor", "alpha": 0.3}}
    return {"type": "blendbsdf", "weight": 0.4, **parts}


def picture_sky():
    """An environment map with a gradient in it."""
    data = np.linspace(0.5, 1.5, 8 * 16, dtype=np.float32).reshape(8, 16, 1)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(data, 3, axis=2))}


def projector():
    """A projector beside the camera, aimed at the wall."""
    pose = transform().look_at([0.5, 0, 4], [0, 0, 0], [0, 1, 0])
    return {"type": "projector", "irradiance": 2.0, "fov": 40.0, "to_world": pose, "scale": 1.0}


def angular_light():
    """An area light that emits into a cone with a soft rim."""
    lamp = area_light()
    lamp["emitter"] = {"type": "angulararea", "radiance": 9.0, "cutoff_angle": 60.0, "beam_width": 5.0}
    return lamp


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


CASES = [
    Case("diffuse_albedo", "diffuse albedo", room, set_color("side.bsdf.reflectance.value"), 0.8, 0.02),
    Case(
        "zero_albedo",
        "diffuse albedo",
        lambda: room(side_reflectance=0.0),
        set_color("side.bsdf.reflectance.value"),
        0.0,
        0.02,
    ),
    Case(
        "texture",
        "textured albedo",
        lambda: room(bsdf=texture()),
        scale_texture("wall.bsdf.reflectance.data"),
        0.0,
        0.05,
    ),
    Case("point_intensity", "emitter radiance or intensity", room, set_color("light.intensity.value"), 10.0, 0.5),
    Case(
        "area_radiance",
        "emitter radiance or intensity",
        lambda: room(light=area_light()),
        set_color("light.emitter.radiance.value"),
        9.0,
        0.5,
    ),
    Case(
        "roughness",
        "roughness (rough conductor)",
        lambda: room(bsdf={"type": "roughconductor", "alpha": 0.3, "distribution": "ggx"}, light=area_light()),
        set_color("wall.bsdf.alpha.value"),
        0.3,
        0.01,
        spp=4096,
        fd_spp=4096,
    ),
    Case("wall_distance", "shape to_world", room, move("wall.to_world", (0, 0, 1)), 0.0, 2e-3, spp=2048, fd_spp=2048),
    Case("wall_tilt", "shape to_world", room, rotate("wall.to_world", (0, 1, 0)), 0.0, 0.1, spp=4096, fd_spp=32768),
    Case(
        "side_moves",
        "shape to_world, silhouette seen from a vertex",
        room,
        move("side.to_world", (-1, 0, 0.4)),
        0.0,
        2e-2,
        spp=4096,
        fd_spp=16384,
        support="biased where silhouettes move",
    ),
    Case(
        "mesh_vertices",
        "mesh vertex positions",
        lambda: room(
            wall2={
                "type": "cube",
                "to_world": transform().translate([0, 0, -0.5]).scale([2, 2, 0.52]),
                "bsdf": {"type": "diffuse", "reflectance": 0.4},
            }
        ),
        move_vertices("wall2.vertex_positions", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=2048,
    ),
    Case("point_position", "point and spot light position", room, move_point("light.position", (0, 0.3, 1)), 0.0, 4e-3),
    Case(
        "spot_position",
        "point and spot light position",
        lambda: room(
            light={
                "type": "spot",
                "intensity": 10.0,
                "cutoff_angle": 30.0,
                "beam_width": 5.0,
                "to_world": transform().look_at([0.5, 0, 4], [0.2, 0, 0], [0, 1, 0]),
            }
        ),
        move("light.to_world", (0.3, 0, 1)),
        0.0,
        4e-3,
    ),
    Case(
        "area_light_moves",
        "area light shape",
        lambda: room(light=area_light(), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "area_light_scales",
        "area light shape",
        lambda: room(light=area_light(), side_reflectance=0.2),
        stretch("light.to_world"),
        1.0,
        0.01,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "sphere_light_moves",
        "area light shape",
        lambda: room(light=area_light("sphere", 0.15), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "wall_near_sphere_light",
        "shape to_world",
        lambda: room(light=area_light("sphere", 0.15), side_reflectance=0.2),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "sensor_translation",
        "sensor pose",
        lambda: room(sensor=camera(near=1.0)),
        move("sensor.to_world", (0.5, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "sensor_rotation",
        "sensor pose",
        lambda: room(sensor=camera(near=1.0)),
        rotate("sensor.to_world", (0, 1, 0)),
        0.0,
        0.1,
        spp=2048,
        fd_spp=16384,
    ),
    Case(
        "sensor_fov",
        "sensor pose",
        lambda: room(sensor=camera(near=1.0)),
        set_color("sensor.x_fov"),
        10.0,
        0.05,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "smooth_glass_index",
        "dielectric index, smooth",
        lambda: glass_slab({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
        set_color("slab.bsdf.eta"),
        1.5,
        4e-3,
        spp=8192,
        fd_spp=8192,
    ),
    Case(
        "rough_glass_index",
        "dielectric index, rough",
        lambda: glass_slab({"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.2}),
        set_color("slab.bsdf.eta"),
        1.5,
        4e-3,
        spp=16384,
        fd_spp=16384,
    ),
    Case(
        "glass_moves",
        "shape to_world behind or of glass",
        lambda: glass_slab({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        4e-3,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "wall_under_sky",
        "shape to_world",
        lambda: room(light={"type": "constant", "radiance": 1.0}, sensor=camera(start=2.0)),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        4e-3,
        spp=8192,
        fd_spp=8192,
    ),
    Case(
        "wall_in_sunlight",
        "shape to_world",
        lambda: room(
            light={"type": "directional", "direction": [-0.3, 0.1, -1.0], "irradiance": 3.0}, sensor=camera(start=4.0)
        ),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "mirror_reflectance",
        "specular reflectance (delta lobe)",
        lambda: mirror_room(),
        set_color("wall.bsdf.specular_reflectance.value"),
        0.9,
        0.05,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "mirror_moves",
        "mirror: to_world",
        lambda: mirror_room(),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "mirror_tilts",
        "mirror: to_world",
        lambda: mirror_room(),
        rotate("wall.to_world", (0, 1, 0)),
        0.0,
        0.05,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "rough_mirror_moves",
        "shape to_world",
        lambda: mirror_room({"type": "roughconductor", "alpha": 0.2, "distribution": "ggx"}),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        4e-3,
        spp=32768,
        fd_spp=32768,
    ),
    Case(
        "plastic_alpha",
        "roughness (rough plastic)",
        lambda: room(bsdf={"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": 0.3}, light=area_light()),
        set_color("wall.bsdf.alpha"),
        0.3,
        0.01,
        spp=4096,
        fd_spp=4096,
        support="biased: Mitsuba's transmittance table is not differentiated",
    ),
    Case(
        "principled_roughness",
        "roughness (principled)",
        lambda: room(
            bsdf={"type": "principled", "roughness": 0.5, "base_color": {"type": "rgb", "value": 0.5}, "specular": 0.7},
            light=area_light(),
        ),
        set_color("wall.bsdf.roughness.value"),
        0.5,
        0.02,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "plastic_moves",
        "shape to_world",
        lambda: room(bsdf={"type": "plastic", "diffuse_reflectance": 0.4}, light=area_light()),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        4e-3,
        spp=4096,
        fd_spp=16384,
    ),
    Case(
        "thin_glass_tilts",
        "shape to_world",
        lambda: glass_slab({"type": "thindielectric", "int_ior": 1.5}, "rectangle"),
        rotate("slab.to_world", (0, 1, 0)),
        0.0,
        0.5,
        spp=8192,
        fd_spp=65536,
    ),
    Case(
        "mask_opacity",
        "mask opacity",
        lambda: room(
            screen={
                "type": "rectangle",
                "to_world": transform().translate([0, 0, 0.5]).scale(2),
                "bsdf": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse", "reflectance": 0.5}},
            }
        ),
        set_color("screen.bsdf.opacity.value"),
        0.4,
        0.02,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "sky_radiance",
        "environment radiance",
        lambda: room(light={"type": "constant", "radiance": 1.0}, sensor=camera(start=2.0)),
        set_color("light.radiance.value"),
        1.0,
        0.05,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "ball_moves",
        "shape to_world",
        lambda: room(
            ball={
                "type": "sphere",
                "center": [0, 0, -2.0],
                "radius": 2.2,
                "bsdf": {"type": "diffuse", "reflectance": 0.5},
            }
        ),
        move("ball.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "blend_weight",
        "blend weight",
        lambda: room(bsdf=blend()),
        set_color("wall.bsdf.weight.value"),
        0.4,
        0.02,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "conductor_eta",
        "complex index of a conductor",
        lambda: mirror_room({"type": "conductor", "eta": 0.5, "k": 2.0}),
        set_color("wall.bsdf.eta.value"),
        0.5,
        0.02,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "sky_texture",
        "environment radiance",
        lambda: room(light=picture_sky(), sensor=camera(start=2.0)),
        scale_texture("light.data"),
        0.0,
        0.05,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "projector_scale",
        "emitter radiance or intensity",
        lambda: room(light=projector()),
        set_color("light.scale"),
        1.0,
        0.05,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "cube_light_moves",
        "area light shape",
        lambda: room(light=area_light("cube", 0.12), side_reflectance=0.2),
        move_vertices("light.vertex_positions", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
        fd_spp=8192,
    ),
    Case(
        "angular_light_radiance",
        "emitter radiance or intensity",
        lambda: room(light=angular_light()),
        set_color("light.emitter.radiance.value"),
        9.0,
        0.5,
        spp=2048,
        fd_spp=2048,
    ),
    Case(
        "angular_light_moves",
        "area light shape",
        lambda: room(light=angular_light(), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "instance_moves",
        "shape to_world",
        lambda: instances({"type": "diffuse", "reflectance": 0.5}),
        move("copy.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=4096,
    ),
    Case(
        "glass_in_a_group",
        "dielectric index, smooth",
        lambda: instances({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
        set_color("group.plate.bsdf.eta"),
        1.5,
        4e-3,
        spp=8192,
        fd_spp=8192,
    ),
    Case(
        "disk_light_moves",
        "area light shape",
        lambda: room(light=area_light("disk", 0.3), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
        fd_spp=4096,
    ),
    Case(
        "cylinder_moves",
        "shape to_world",
        lambda: room(pipe={"type": "cylinder", "p0": [0, -2, -1.8], "p1": [0, 2, -1.8], "radius": 2.0}),
        move("pipe.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=4096,
    ),
    Case(
        "thin_lens_moves",
        "sensor pose",
        lambda: room(sensor={**camera(near=0.5), "type": "thinlens", "aperture_radius": 0.02, "focus_distance": 4.0}),
        move("sensor.to_world", (0.5, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=4096,
    ),
    Case(
        "wall_rgb",
        "shape to_world",
        room,
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        "llvm_ad_rgb",
        2048,
        fd_spp=2048,
    ),
    Case(
        "wall_spectral",
        "shape to_world",
        room,
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        "llvm_ad_spectral",
        2048,
        fd_spp=2048,
    ),
    Case(
        "albedo_spectral",
        "diffuse albedo",
        room,
        set_color("side.bsdf.reflectance.value"),
        0.8,
        0.02,
        "llvm_ad_spectral",
    ),
]


def weights(scene_film):
    """Loss weights, of the shape that lies behind a pixel.

    Of a histogram the sine of three times the optical path length at each bin's centre, in polarized variants with
    factors that differ between the Stokes components and let the polarization count; of phasors and gates a
    pattern in which no two entries weigh the same.
    """
    if scene_film.measures != "transient":
        shape = scene_film.cube_shape()[2:]
        number = np.arange(int(np.prod(shape)))
        return (np.cos(1.7 * number + 0.4) / (1 + 0.3 * number)).reshape(shape)
    centers = scene_film.start_opl + (np.arange(scene_film.temporal_bins) + 0.5) * scene_film.bin_width_opl
    components = np.repeat([0.2, 1.0, -0.7, 1.3], scene_film.channel_count() // 4) if mi.is_polarized else np.ones(1)
    return np.sin(3 * centers)[:, None] * components


class Changes(dict):
    """Collects what a case writes, on top of the parameters' first values."""

    def __init__(self, base):
        super().__init__()
        self.base = base

    def __missing__(self, key):
        return self.base[key]


class Problem:
    """A case, loaded once: the loss, its gradient in reverse and in forward mode."""

    def __init__(self, case: Case):
        self.case = case
        mi.set_variant(case.variant)
        import torchtransient.plugins

        torchtransient.plugins.sync()
        self.scene = mi.load_dict(case.scene(), optimize=False)
        self.film = self.scene.sensors()[0].film()
        self.params = mi.traverse(self.scene)
        changes = Changes({key: self.params[key] for key in list(self.params.keys())})
        case.apply(changes, mi.Float(case.value))
        self.base = {key: dr.copy(self.params[key]) for key in changes}
        # The first look fixes the reference sphere of distant lights.
        self.scene.integrator().facts(self.scene)

    def install(self, x):
        """Write the unknown; ``x`` may be attached."""
        changes = Changes(self.base)
        self.case.apply(changes, x)
        for key, value in changes.items():
            self.params[key] = value
        self.params.update()
        return list(changes)

    def loss(self, x: float, seed: int) -> float:
        self.install(mi.Float(x))
        _, transient = self.scene.integrator().render(self.scene, seed=seed, spp=self.case.fd_spp)
        return float((np.array(transient).sum((0, 1)) * weights(self.film)).sum())

    def reverse(self, seed: int) -> float:
        x = mi.Float(self.case.value)
        dr.enable_grad(x)
        keys = self.install(x)
        g = np.broadcast_to(weights(self.film), self.film.cube_shape()).astype(np.float32)
        self.scene.integrator().render_backward(
            self.scene, self.params, (None, mi.TensorXf(g)), seed=seed, spp=self.case.spp
        )
        for key in keys:
            dr.enqueue(dr.ADMode.Backward, self.params[key])
        dr.traverse(dr.ADMode.Backward)
        return float(dr.grad(x)[0])

    def forward(self, seed: int) -> float:
        x = mi.Float(self.case.value)
        dr.enable_grad(x)
        self.install(x)
        dr.set_grad(x, 1.0)
        _, transient = self.scene.integrator().render_forward(self.scene, self.params, seed=seed, spp=self.case.spp)
        return float((np.array(transient).sum((0, 1)) * weights(self.film)).sum())
