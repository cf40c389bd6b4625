"""Moving edges with all sensors, films, lights, media, normals: derivatives against finite differences, both modes."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.gradient_cases.problem import Case, Problem
from support.gradient_cases.scenes import transform
from support.gradient_cases.unknowns import move, move_vertices

SIZE = 8
ACROSS = (1, 0.3, 0)
GRAY = {"type": "twosided", "b": {"type": "diffuse", "reflectance": 0.6}}


def film(width=SIZE, height=SIZE, **more):
    return {"type": "transient_hdr_film", "temporal_bins": 160, "start_opl": 3.0, "bin_width_opl": 0.04,
            "temporal_filter": "tent", "width": width, "height": height, "rfilter": {"type": "box"}} | more  # fmt: skip


def pose(origin=(0, 0, 4), target=(0, 0, 0)):
    return transform().look_at(origin=list(origin), target=list(target), up=[0, 1, 0])


def camera(origin=(0, 0, 4), fov=40, type="perspective", on=None, **more):
    return {"type": type, "fov": fov, "near_clip": 0.01, "to_world": pose(origin), "film": on or film(), **more}


def lens(origin=(0, 0, 4)):
    return camera(origin, type="thinlens", aperture_radius=0.12, focus_distance=2.6)


def orthographic():
    wide = pose().scale([1.2, 1.2, 1])
    return {"type": "orthographic", "near_clip": 0.01, "to_world": wide, "film": film()}


def batch(kind):
    return {"type": "batch", "film": film(2 * SIZE), "a": kind(), "b": kind((1.0, 0.3, 4))}


def shifted():
    return camera(principal_point_offset_x=0.15, principal_point_offset_y=-0.1)


def cropped(rfilter):
    crop = {f"crop_{name}": value for name, value in (("offset_x", 5), ("offset_y", 5), ("width", 4), ("height", 4))}
    return camera(on=film(16, 16, rfilter={"type": rfilter}, **crop))


def line():
    way = {"origin": [0.9, 0.1, 3.9], "direction": [-0.55, 0, -3.9]}
    return {"type": "radiancemeter", **way, "film": film(1, 1)}


def rectangle(at, size, turn=0, roll=0, bsdf=GRAY, **more):
    to_world = transform().translate(list(at)).rotate([0, 1, 0], turn).rotate([0, 0, 1], roll).scale(size)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf, **more}


def lamp(radiance=20.0, at=(0.6, 0.4, 2.8), turn=180, size=0.3):
    return rectangle(at, size, turn, emitter={"type": "area", "radiance": radiance})


def point(at=(1.6, 0.7, 3.0)):
    return {"type": "point", "position": list(at), "intensity": 10.0}


def scene_of(depth, sensor=None, light=None, integrator="transient_path", wall=GRAY, **parts):
    """A wall before a sensor."""
    return {
        "type": "scene", "integrator": {"type": integrator, "max_depth": depth, "rr_depth": 100},
        "sensor": sensor or camera(), "light": light or lamp(), "wall": rectangle((0, 0, 0), 3, bsdf=wall), **parts,
    }  # fmt: skip


def plate(depth=2, sensor=None, light=None, integrator="transient_path", **more):
    """A plate in view."""
    body = rectangle((-0.2, 0.1, 1.2), [0.5, 0.35, 1], 25, 20)
    return scene_of(depth, sensor, light, integrator, body=body | more.pop("body", {}), **more)


def shadow(depth=2, sensor=None, light=None, wall=GRAY, **more):
    """The shadow of a plate out of view."""
    body = rectangle((0.9, 0.35, 1.6), [0.25, 0.3, 1], 20, 15)
    return scene_of(depth, sensor or camera(fov=22), light or point(), wall=wall, body=body, **more)


def smooth_ball(around=12, rings=6):
    """A coarse ball with normals at its vertices."""
    turn, tilt = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(0, np.pi, rings + 1)[1:-1])
    n = np.stack([np.cos(turn) * np.sin(tilt), np.sin(turn) * np.sin(tilt), np.cos(tilt)], -1).reshape(-1, 3)
    n = np.concatenate([n, [[0, 0, 1], [0, 0, -1]]])
    i, j = np.meshgrid(np.arange(around), np.arange(rings - 2))
    a, b = (j * around + i).ravel(), (j * around + (i + 1) % around).ravel()
    k, last = np.arange(around), (rings - 2) * around
    top = np.stack([0 * k + len(n) - 2, k, (k + 1) % around], 1)
    bottom = np.stack([0 * k + len(n) - 1, last + (k + 1) % around, last + k], 1)
    sides = [np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)]
    faces = np.concatenate([*sides, top, bottom])
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(GRAY)
    made = mi.Mesh("body", len(n), len(faces), props=props, has_vertex_normals=True)
    values = mi.traverse(made)
    values["vertex_positions"] = mi.Float(np.float32(0.5 * n + [-0.2, 0.1, 1.0]).ravel())
    values["vertex_normals"], values["faces"] = mi.Float(np.float32(n).ravel()), mi.UInt32(np.uint32(faces).ravel())
    values.update()
    return made


def normal_map():
    v, u = np.mgrid[0:16, 0:16] / 16
    image = np.stack([0.5 + 0.3 * np.sin(6.28 * u), 0.5 + 0.3 * np.cos(6.28 * v), 0.9 + 0 * u], -1).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}
    inner = {"type": "normalmap", "normalmap": texture, "b": {"type": "diffuse", "reflectance": 0.6}}
    return {"type": "twosided", "b": inner}


def cloud(at, size):
    medium = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.5, "sample_emitters": True}
    to_world = transform().translate(list(at)).rotate([0, 1, 0], 25).scale(size)
    return {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium}


def metered():
    """An irradiance meter on a disk before a plate."""
    scene = plate()
    del scene["sensor"]
    sensor = {"type": "irradiancemeter", "film": film(1, 1)}
    scene["meter"] = {"type": "disk", "to_world": pose((0.3, 0.1, 3.2)).scale(0.2), "bsdf": GRAY, "sensor": sensor}
    return scene


def near_lamp():
    return scene_of(2, light=lamp(5.0, (0.2, 0.1, 0.1)))


PLATE, HIGHER = move("body.to_world", ACROSS), move("body.to_world", (1, 0.2, 0))
CASES = [
    Case("two lenses", "", lambda: shadow(sensor=batch(lens)), HIGHER, 0, 0.004),
    Case("shifted principal point", "", lambda: shadow(sensor=shifted()), HIGHER, 0, 0.004),
    Case("crop, gaussian filter", "", lambda: plate(sensor=cropped("gaussian")), PLATE, 0, 0.004),
    Case("radiance meter", "", lambda: shadow(3, line(), lamp(30.0, (1.6, 0.7, 3.0), 205, 0.6)), HIGHER, 0, 0.004,
         spp=1 << 15, fd_spp=1 << 17),
    Case("irradiance meter moves", "", metered, move("meter.to_world", (1, 0.2, 0.3)), 0, 0.004,
         spp=1 << 17, fd_spp=1 << 19),
    Case("lamp near a wall", "", near_lamp, move("wall.to_world", (0.3, 0.1, 1)), 0, 0.001, spp=2048, fd_spp=8192),
    Case("normal map", "", lambda: shadow(wall=normal_map()), HIGHER, 0, 0.004),
    Case("coarse ball with smooth normals", "", lambda: scene_of(2, body=smooth_ball()),
         move_vertices("body.vertex_positions", ACROSS), 0, 0.001),
    Case("plate in a cloud", "",
         lambda: plate(3, integrator="transient_prbvolpath", cloud=cloud((-0.2, 0.1, 1.2), 0.8)), PLATE, 0, 0.004),
    Case("cloud moves", "", lambda: scene_of(3, light=point((0.8, 0.5, 3.0)), integrator="transient_prbvolpath",
                                             cloud=cloud((-0.2, 0.1, 1.2), 0.5)),
         move_vertices("cloud.vertex_positions", ACROSS), 0, 0.002),
    Case("phasors", "", lambda: plate(3, camera(on={
        "type": "phasor_hdr_film", "frequency_first": 0.3, "frequency_step": 0.2, "frequency_count": 4,
        "start_opl": 3.0, "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}})), PLATE, 0, 0.004),
]  # fmt: skip


def mean_and_error(values):
    values = np.array(values)
    return values.mean(), values.std(ddof=1) / np.sqrt(len(values))


# Clouds take as long as all others together.
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=pytest.mark.soak if "cloud" in case.name else pytest.mark.slow)
        for case in CASES
    ],
)
def test_derivatives_are_those_of_finite_differences(case):
    """Within four standard errors, and forward mode is reverse mode at each seed."""
    problem = Problem(replace(case, fd_spp=case.fd_spp if case.fd_spp != case.spp else 4 * case.spp))
    reverse = [problem.reverse(seed) for seed in range(6)]
    assert problem.forward(0) == pytest.approx(reverse[0], rel=2e-3, abs=1e-4 * max(map(abs, reverse)))
    (found, error), (expected, other) = (
        mean_and_error(v) for v in (reverse, [problem.difference(seed) for seed in range(6)])
    )
    assert abs(found - expected) < 4 * np.hypot(error, other), (found, error, expected, other)
    # It is a test of something.
    assert np.hypot(error, other) < 0.15 * max(abs(expected), abs(found))


def missing(scene, key="body.to_world", variant="llvm_ad_rgb"):
    """What the table of parameters says is lacking, in words."""
    return tt.load(scene, variant=variant).parameters()[key].edges_missing


def test_what_is_lacking_is_named():
    """Sensors that no path of a light finds, lights that a line cannot be connected to, faces that turn away."""
    mi.set_variant("llvm_ad_rgb")
    far = {"type": "distant", "direction": [0.1, 0, -1], "film": film(1, 1)}
    assert "the sensor" in " ".join(missing(plate(sensor=far)))
    assert "shadows" in " ".join(missing(shadow(sensor=line())))
    parallel = plate(sensor=orthographic())
    for scene in (plate(), plate(sensor=batch(lens)), shadow(sensor=line(), light=lamp()), parallel):
        assert missing(scene) == ()
    # A sun in view has a rim.
    for up, named in ((-0.2, True), (0.9, False)):
        light = {"type": "sunsky", "sun_direction": [0.1, up, -1.0], "to_world": transform().rotate([1, 0, 0], 180)}
        assert ("rim of the sun" in " ".join(missing(plate(light=light), "light.sun_direction"))) == named
    # Open boundaries of media are passed.
    assert missing(plate(integrator="transient_prbvolpath", cloud=cloud((0, 0, 2), 0.4))) == ()


def test_what_mirrors_and_glass_lack_is_named_once():
    """Edges in plane ones are followed where a camera sees them; nothing of curved ones, nor before other sensors."""
    mi.set_variant("llvm_ad_mono")
    pane = {"type": "dielectric"}
    mirror = {"type": "rectangle", "to_world": transform().translate([0, 0, 3]), "bsdf": {"type": "conductor"}}
    ball = {"type": "sphere", "center": [1, 0, 1], "radius": 0.2, "bsdf": GRAY}
    foggy = {"integrator": "transient_prbvolpath", "cloud": cloud((0, 0, 2), 0.4)}
    for more, lacks in (
        ({"mirror": mirror}, None),
        ({"mirror": mirror, "sensor": batch(camera)}, None),
        ({"mirror": mirror, "sensor": orthographic()}, "in mirrors"),
        ({"mirror": mirror} | foggy, "in mirrors"),
        ({"mirror": ball | {"bsdf": pane}}, "through smooth glass"),
        ({"mirror": mirror | {"bsdf": pane}, "ball": ball}, "outlines of 'ball' are seen through smooth glass"),
    ):
        said = missing(plate(**more), variant="llvm_ad_mono")
        assert len(said) == (lacks is not None)
        assert all("'mirror'" in words and lacks in words for words in said)
