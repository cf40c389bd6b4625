"""Sensors inside of refracting bodies: each length counts with the index of its medium, from the sensor on."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.runs import T
from torchtransient import plugins

N, WATER = 1.5, 1.33
# From the wall (at z = 3) to the lamp, which no glass stands before.
LAMP = (0.5, 0.0, 2.2)
TO_LAMP = math.hypot(0.5, 0.8)
BIN, START = 2e-3, 1.0


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def film(size=1, start=START):
    return {
        "type": "transient_hdr_film", "width": size, "height": 1, "temporal_bins": 5000, "bin_width_opl": BIN,
        "start_opl": start, "rfilter": {"type": "box"},
    }  # fmt: skip


def at(z=0.0, near=0.1, **more):
    """A narrow camera on the axis that looks along it."""
    pose = T().look_at(origin=[0, 0, z], target=[0, 0, z + 1], up=[0, 1, 0])
    return {"type": "perspective", "fov": 0.02, "near_clip": near, "to_world": pose, "film": film(), **more}


def glass(plugin="dielectric", inside=N, outside=1.0, **more):
    return {"type": plugin, "int_ior": inside, "ext_ior": outside, **more}


def ball(radius, bsdf=None, **more):
    return {"type": "sphere", "radius": radius, "bsdf": bsdf or glass(), **more}


def scene(sensor, integrator="transient_path", depth=3, **objects):
    """A wall at z = 3 that a lamp lights; what surrounds the sensor reaches no farther than z = 2."""
    described = {
        "type": "scene", "integrator": {"type": integrator, "max_depth": depth}, "sensor": sensor,
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(2)},
        "lamp": {"type": "point", "position": list(LAMP), "intensity": 10.0}, **objects,
    }  # fmt: skip
    return mi.load_dict(described, optimize=False)


def arrivals(loaded, spp=256):
    """First arrival of each pixel."""
    bins = np.array(loaded.integrator().render(loaded, seed=0, spp=spp)[1], dtype=float)[0, :, :, 0]
    centers = START + (np.arange(bins.shape[-1]) + 0.5) * BIN
    assert (bins.sum(-1) > 0).all()
    return centers[np.argmax(bins > 0, axis=-1)]


def check(loaded, *lengths, spp=256):
    expected = np.array(lengths) + TO_LAMP
    np.testing.assert_allclose(arrivals(loaded, spp), expected, atol=1.5 * BIN)


CUBE = {"type": "cube"}


def in_a_group(bsdf):
    group = {"type": "shapegroup", "part": {**CUBE, "to_world": T().scale(0.5), "bsdf": bsdf}}
    copied = {"type": "instance", "to_world": T().scale(2.0), "group": {"type": "ref", "id": "group"}}
    return {"group": group, "copy": copied}


def flat_heights():
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((2, 2, 1), dtype=np.float32)), "raw": True}


BODIES = {
    "ball": lambda: {"body": ball(1.0)},
    "far away": lambda: {"body": ball(1.0), "other": ball(0.4, center=[5, 0, 0]), "more": ball(0.4, center=[0, 4, 1])},
    "instance": lambda: in_a_group(glass()),
    "masked": lambda: {"body": CUBE | {"bsdf": {"type": "mask", "opacity": 0.9, "nested": glass()}}},
    "bumpy": lambda: {"body": CUBE | {"bsdf": {"type": "bumpmap", "flat": flat_heights(), "nested": glass()}}},
    "turned inside out": lambda: {"body": ball(1.0, glass("dielectric", 1.0, N), flip_normals=True)},
}  # fmt: skip


@pytest.mark.parametrize("body", long(BODIES, ["turned inside out"]))
def test_bodies(body):
    check(scene(at(), depth=4, **BODIES[body]()), N * 1.0 + 2.0)


@pytest.mark.slow
def test_rough_body():
    """Nearly smooth: the first light comes from a point of the wall a little nearer to the lamp."""
    rough = glass("diff_rough_dielectric", alpha=0.005)
    first = arrivals(scene(at(), body=CUBE | {"bsdf": rough}), 4096)[0]
    assert N * 1.0 + 2.0 + TO_LAMP - 0.01 < first < N * 1.0 + 2.0 + TO_LAMP + BIN


@pytest.mark.slow
def test_principled_body():
    bsdf = {"type": "principled", "spec_trans": 1.0, "eta": N, "roughness": 0.05}
    straight = N * 1.0 + math.hypot(0.5, 1.2)  # from the face of the cube to the lamp: it scatters that far
    assert arrivals(scene(at(), body=CUBE | {"bsdf": bsdf}), 1 << 14)[0] == pytest.approx(straight, abs=1.5 * BIN)


def across(size, plugin=None, z=1.0):
    """A surface that ends nothing: what lies below it is known by its normal."""
    pose = T().translate([0, 0, z]).scale(size)
    return {"type": "rectangle", "to_world": pose, "bsdf": plugin or glass(inside=WATER)}


def drop():
    """Of water in glass: its relative index says what lies around it."""
    return {"drop": ball(0.4, glass("dielectric", WATER, N)), "body": ball(1.0)}


def pane():
    """Of two rectangles: outside, the one is entered and the other left."""
    shared = {"type": "ref", "id": "glass"}
    front = across(20.0, shared) | {"to_world": T().translate([0, 0, 1]).rotate([0, 1, 0], 180).scale(20.0)}
    return {"glass": glass() | {"id": "glass"}, "front": front, "back": across(20.0, shared, 1.5)}


BEHIND = {"behind": ball(0.3, glass(), center=[0, 0.05, -1.0])}
# Where the sensor stands, what is around it, the length to the wall.
PLACES = {
    "in a drop": ({}, drop, WATER * 0.4 + N * 0.6 + 2.0),
    "near clip plane in glass": ({"near": 0.9}, lambda: {"body": CUBE | {"bsdf": glass()}}, N * 1.0 + 2.0),
    "between balls": ({}, lambda: BEHIND | {"ahead": ball(0.3, center=[0, 0, 1.0])}, 3.0 + 0.6 * (N - 1)),
    "in a lake": ({"z": -0.5}, lambda: {"lake": across(20.0)}, WATER * 1.5 + 2.0),
    "under a window": ({"z": -0.5}, lambda: {"window": across(0.1)}, WATER * 1.5 + 2.0),
    "in a pane": ({"z": 1.2}, pane, N * 0.3 + 1.5),
}


@pytest.mark.parametrize("place", long(PLACES, ["in a drop", "under a window", "in a pane"]))
def test_places(place):
    where, objects, length = PLACES[place]
    check(scene(at(**where), depth=4, **objects()), length)


# -------------------------------------------------------------------------------------------------- what is remembered


@pytest.mark.slow
def test_sensor_that_moves():
    loaded = scene(at(), depth=4, body=CUBE | {"bsdf": glass()})
    params, inside = mi.traverse(loaded), N * 1.0 + 2.0
    check(loaded, inside)
    for z, length in ((-2.0, 1.0 + N * 2.0 + 2.0), (0.0, inside)):
        params["sensor.to_world"] = mi.Transform4f(at(z)["to_world"].matrix)
        params.update()
        check(loaded, length)


def test_body_that_moves():
    loaded, key = scene(at(), depth=4, **BODIES["instance"]()), "copy.to_world"
    params = mi.traverse(loaded)
    check(loaded, N * 1.0 + 2.0)
    params[key] = mi.Transform4f().translate([0, 5, 0]) @ params[key]
    params.update()
    check(loaded, 3.0)


# ------------------------------------------------------------------------------------------------------------- sensors


def kinds():
    pose = at()["to_world"]
    lens = at(type="thinlens", aperture_radius=1e-4, focus_distance=3.0)
    plane = {"type": "orthographic", "near_clip": 0.1, "to_world": pose @ T().scale([1e-3, 1e-3, 1]), "film": film()}
    return {"thinlens": lens, "orthographic": plane}


@pytest.mark.parametrize("kind", long(["thinlens", "orthographic"], ["orthographic"]))
def test_sensors(kind):
    check(scene(kinds()[kind], body=CUBE | {"bsdf": glass()}), N * 1.0 + 2.0)


def test_each_sensor_of_a_batch():
    inside, outside = at(0.0), at(-2.0)
    for sensor in (inside, outside):
        sensor["film"] = {"type": "hdrfilm", "rfilter": {"type": "box"}}
    batch = {"type": "batch", "film": film(2), "inside": inside, "outside": outside}
    check(scene(batch, depth=4, body=CUBE | {"bsdf": glass()}), N * 1.0 + 2.0, 1.0 + N * 2.0 + 2.0)


@pytest.mark.slow
def test_meter_on_the_outside_of_glass_stands_in_air():
    sphere = ball(1.0, sensor={"type": "irradiancemeter", "film": film()})
    loaded = mi.load_dict({
        "type": "scene", "integrator": {"type": "transient_path", "max_depth": 2}, "ball": sphere,
        "lamp": {"type": "rectangle", "to_world": T().translate([0, 0, 4]).rotate([0, 1, 0], 180).scale(0.05),
                 "emitter": {"type": "area", "radiance": 1.0}},
    }, optimize=False)  # fmt: skip
    assert arrivals(loaded, 1 << 18)[0] == pytest.approx(3.0, abs=2 * BIN)


@pytest.mark.slow
def test_sensor_in_a_medium_in_glass():
    fog = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.5}
    sensor = at() | {"medium": {"type": "ref", "id": "fog"}}
    body = CUBE | {"bsdf": glass(), "interior": {"type": "ref", "id": "fog"}}
    described = {"fog": fog | {"id": "fog"}, "body": body}
    loaded = mi.load_dict({
        "type": "scene", "integrator": {"type": "transient_prbvolpath", "max_depth": 3}, **described, "sensor": sensor,
        "wall": {"type": "rectangle", "to_world": T().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(2)},
        "lamp": {"type": "point", "position": list(LAMP), "intensity": 10.0},
    }, optimize=False)  # fmt: skip
    bins = np.array(loaded.integrator().render(loaded, seed=0, spp=1 << 14)[1], dtype=float)[0, 0, :, 0]
    # The light that was not scattered stands out of that which was.
    assert START + (np.argmax(bins) + 0.5) * BIN == pytest.approx(N + 2.0 + TO_LAMP, abs=1.5 * BIN)


@pytest.mark.parametrize("where", long(["outside", "inside"], ["inside"]))
def test_light_in_glass(where):
    """A lamp in the glass, seen through its face or from within."""
    pose = T().translate([0, 0, 0.5]).rotate([0, 1, 0], 180).scale(0.1)
    lamp = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": 1.0}}
    z, expected = (-2.0, 1.0 + N * 1.5) if where == "outside" else (-0.8, N * 1.3)
    loaded = scene(at(z), body=CUBE | {"bsdf": glass()}, light=lamp)
    assert arrivals(loaded)[0] == pytest.approx(expected, abs=1.5 * BIN)


def test_path_lengths_without_the_leg_to_the_sensor():
    """``camera_unwarp`` leaves the first leg out; the legs behind it keep their index."""
    loaded = scene(at(), body=CUBE | {"bsdf": glass()})
    loaded.integrator().camera_unwarp = True
    np.testing.assert_allclose(arrivals(loaded), 2.0 + TO_LAMP, atol=1.5 * BIN)
