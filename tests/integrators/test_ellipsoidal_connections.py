"""`connections="ellipsoidal"`: the light of ordinary connections, with less noise in gates and narrow windows."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long, long_rows
from torchtransient.accuracy import two_sample_z_test
from torchtransient.errors import SceneError
from torchtransient.scenes import look_at, rotate, scale, translate

VARIANT = "llvm_ad_rgb"
COLOUR = "red.reflectance.value"
DIFFUSE = {"type": "diffuse", "reflectance": 0.8}
GATES = "rectangular 4.4 4.5; gaussian 6.0 0.1; rectangular 7.2 7.3; rectangular 8.5 8.7"


def room(size=16, gates=GATES, **settings):
    """The Cornell box behind gates."""
    scene = tt.scenes.cornell_box(resolution=size)
    box = {"type": "box"}
    scene["sensor"]["film"] = {"type": "gated_hdr_film", "width": size, "height": size, "rfilter": box, "gates": gates}
    scene["integrator"] = {**scene["integrator"], **settings}
    return scene


def box_of(bsdf):
    scene = room()
    scene["large-box"] = {**scene["large-box"], "bsdf": bsdf}
    return scene


def with_object(**described):
    return room() | described


def histogram(**film):
    scene = room()
    scene["sensor"]["film"] = tt.scenes.cornell_box(resolution=16, num_bins=8)["sensor"]["film"]
    scene["sensor"]["film"] |= {"start_opl": 6.5, "bin_width_opl": 0.05, "temporal_bins": 8, "steady": False} | film
    return scene


def fog(**settings):
    """The Cornell box full of fog."""
    scene = room()
    medium = {"type": "homogeneous", "sigma_t": 0.5, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}} | settings
    scene["fog"] = {"type": "cube", "to_world": scale(0.999), "bsdf": {"type": "null"}, "interior": medium}
    scene["integrator"]["type"] = "transient_prbvolpath"
    return scene


def low_fog():
    """Thick fog that does not reach the lamp."""
    scene = fog(sigma_t=1.5)
    scene["fog"]["to_world"] = translate([0, -0.35, 0]) @ scale([0.98, 0.64, 0.98])
    return scene


def heterogeneous():
    grid = (0.2 + np.random.default_rng(0).random((4, 4, 4, 1))).astype(np.float32)
    density = {"type": "gridvolume", "data": grid, "to_world": translate([-1, -1, -1]) @ scale(2.0)}
    return fog(type="heterogeneous", albedo=0.8, sigma_t=density, scale=0.7)


def lamps():
    """Lamps of five kinds, of which only the rectangle is drawn by its arrivals."""
    turned = translate([-0.6, 0.2, -0.6]) @ rotate([1, 1, 0], 30) @ scale(0.1)
    picture = {"type": "bitmap", "raw": True, "data": np.random.default_rng(1).random((4, 4, 3)).astype(np.float32)}
    return with_object(
        cube={"type": "cube", "to_world": turned, "emitter": {"type": "area", "radiance": 5.0}},
        ball={"type": "sphere", "radius": 0.1, "center": [0.5, 0.4, 0], "emitter": {"type": "area", "radiance": 5.0}},
        bulb={"type": "point", "position": [0, 0, 0.5], "intensity": 0.5},
        screen={
            "type": "rectangle", "to_world": translate([0, 0, -0.99]) @ scale(0.2),
            "emitter": {"type": "area", "radiance": picture},
        },
    )  # fmt: skip


def many_triangles():
    """A mesh of more faces than are looked through."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.3, 0.3, 9)] * 2, indexing="ij"), -1).reshape(-1, 2)
    vertices = np.column_stack([grid[:, 0], 0.1 * np.cos(9 * grid[:, 0]) * np.cos(7 * grid[:, 1]) - 0.2, grid[:, 1]])
    corner = [9 * i + j for i in range(8) for j in range(8)]
    faces = np.array([f for a in corner for f in ((a, a + 1, a + 9), (a + 9, a + 1, a + 10))])
    bsdf = {"type": "twosided", "nested": DIFFUSE}
    return with_object(cloth={"type": "mesh_arrays", "vertices": vertices, "faces": faces, "bsdf": bsdf})


def far_away(by=60.0):
    """The box far from the origin, where rays start millimetres off surfaces."""
    scene = room(gates="gaussian 6.0 0.1; rectangular 7.2 7.3; rectangular 8.5 8.7")
    for name, node in scene.items():
        if isinstance(node, dict) and "to_world" in node:
            scene[name] = node | {"to_world": translate([by, 0, 0]) @ node["to_world"]}
    return scene


def glossy_mask():
    """A part of the walls is a mirror almost, which paths see alone."""
    gloss = {"type": "mask", "opacity": 0.5, "nested": {"type": "roughconductor", "alpha": 0.03}}
    return room() | {"back": room()["back"] | {"bsdf": gloss}}


def rug():
    """Parallel faces a millimetre apart."""
    pose = translate([0, -0.9985, 0]) @ scale([0.9, 0.0005, 0.9])
    return with_object(rug={"type": "cube", "to_world": pose, "bsdf": DIFFUSE})


SCENES = {
    "pulse": lambda: histogram(pulse="gaussian", pulse_fwhm_opl=0.1),
    "mirror": lambda: box_of({"type": "conductor", "material": "none"}),
    "metal": lambda: box_of({"type": "roughconductor", "alpha": 0.3}),
    "mask": lambda: box_of({"type": "mask", "opacity": 0.5, "nested": DIFFUSE}),
    "lamps": lamps,
    "many triangles": many_triangles,
    "sky": lambda: with_object(sky={"type": "constant", "radiance": 0.3}),
    "hidden lamp": lambda: room(hide_emitters=True),
    "unwarped": lambda: room(gates="rectangular 1.5 1.6; rectangular 4.5 4.7", camera_unwarp=True),
    "rug": rug,
    "far away": far_away,
    "glossy mask": glossy_mask,
    "fog": fog,
    "low fog": low_fog,
    "heterogeneous": heterogeneous,
}


def renderer(scene, connections="ellipsoidal", variant=VARIANT, spp=64, **settings):
    described = scene["integrator"] | {"connections": connections}
    loaded = tt.load(scene | {"integrator": described}, variant=variant)
    return tt.TransientRenderer(loaded, spp=spp, physics="ignore", **settings)


def measured(out):
    return (out.transient if out.gated is None else out.gated).double()


def runs(one, count, seed=0):
    """Sums over 8 x 8 pixels of (C, T, H, W)."""
    with torch.no_grad():
        cubes = torch.stack([measured(one(seed=seed + k)) for k in range(count)])
    return cubes.unfold(3, 8, 8).unfold(4, 8, 8).sum((-1, -2)).numpy()


@pytest.mark.parametrize("name", long(SCENES, [], ["heterogeneous", "low fog"]))
def test_it_is_the_light_of_ordinary_connections(name):
    scene = SCENES[name]()
    plain, ellipsoidal = runs(renderer(scene, "ordinary", spp=256), 24), runs(renderer(scene, spp=128), 24, 5000)
    result = two_sample_z_test(plain, ellipsoidal, rounding=1e-6)
    assert result.passed, str(result)
    # of their sum: channels share their paths, and chi squared asks for independent entries
    result = two_sample_z_test(plain.sum(1), ellipsoidal.sum(1), rounding=1e-6)
    assert result.chi2_z < 4.5, str(result)


@pytest.mark.slow
def test_wavelengths():
    variant = "llvm_ad_spectral"
    with mi.variant_context(variant):
        plain, ellipsoidal = (
            runs(renderer(room(), kind, variant), 16, seed) for kind, seed in (("ordinary", 0), ("ellipsoidal", 5000))
        )
    assert two_sample_z_test(plain, ellipsoidal, rounding=1e-6).passed


def corner():
    """A floor that a camera looks at in one point, a wall and a small lamp, which the point sees before the window."""
    film = room(1, "rectangular 4.9 5.3")["sensor"]["film"]
    lamp = translate([0, 1.5, 0]) @ rotate([1, 0, 0], 90) @ scale(0.1)
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 3},
        "sensor": {
            "type": "perspective", "fov": 0.02, "to_world": look_at([0, 0.5, 2], [0, 0, 0]), "film": film,
            "sampler": {"type": "independent"},
        },
        "floor": {
            "type": "rectangle", "to_world": rotate([1, 0, 0], -90), "bsdf": {"type": "diffuse", "reflectance": 0.5},
        },
        "wall": {
            "type": "rectangle", "to_world": translate([1, 1, 0]) @ rotate([0, 1, 0], -90),
            "bsdf": {"type": "diffuse", "reflectance": 0.8},
        },
        "lamp": {
            "type": "rectangle", "to_world": lamp, "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": 10.0},
        },
    }  # fmt: skip


def test_a_corner_by_quadrature():
    """One wall between the point and the lamp: the integral over both, of what arrives while the gate is open."""
    middles = (np.arange(400) + 0.5) / 200 - 1
    y, z = np.meshgrid(middles + 1, middles, indexing="ij")
    expected = 0.0
    for a in (np.arange(6) + 0.5) / 30 - 0.1:
        for b in (np.arange(6) + 0.5) / 30 - 0.1:
            r2, R2 = 1 + y**2 + z**2, (1 - a) ** 2 + (1.5 - y) ** 2 + (z - b) ** 2
            cosines = y / np.sqrt(r2) / np.sqrt(r2) * ((1 - a) / np.sqrt(R2)) * np.maximum(1.5 - y, 0) / np.sqrt(R2)
            opl = math.sqrt(4.25) + np.sqrt(r2) + np.sqrt(R2)
            expected += np.sum(cosines / (r2 * R2) * ((opl >= 4.9) & (opl < 5.3)))
    expected *= (2 / 400) ** 2 * (0.2 / 6) ** 2 * 10.0 * (0.5 / math.pi) * (0.8 / math.pi)
    with torch.no_grad():
        one = renderer(corner(), spp=4096, variant="llvm_ad_mono")
        found = np.array([one(seed=seed).gated.double().sum().item() for seed in range(16)])
    error = found.std(ddof=1) / 4
    assert error < 2e-3 * expected
    # The quadrature itself is good to 1e-3: squares of 5 mm are cut by the ends of the gate.
    assert abs(found.mean() - expected) < 4 * error + 1e-3 * expected


@pytest.mark.parametrize(
    ("scene", "gate", "gain"),
    long_rows([(room, "8.5 8.6", 10), (low_fog, "8.5 8.6", 5)], [(room, "8.5 8.6", 10)]),
)
def test_narrow_gates_have_less_noise(scene, gate, gain):
    variance = {}
    for kind in ("ordinary", "ellipsoidal"):
        gated = scene()
        gated["sensor"]["film"] |= {"gates": f"rectangular {gate}"}
        with torch.no_grad():
            one = renderer(gated, kind)
            variance[kind] = torch.stack([measured(one(seed=k)) for k in range(16)]).var(0).mean().item()
    assert variance["ellipsoidal"] < variance["ordinary"] / gain


def test_derivatives_are_those_of_ordinary_connections():
    gradients = []
    for kind in ("ordinary", "ellipsoidal"):
        one = renderer(room(), kind, parameters=[COLOUR], spp=16)
        one(seed=1).gated.sum().backward()
        gradients.append(one.values[COLOUR].grad)
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("key", "freeze"), [("back.to_world", True), ("light.to_world", False)])
def test_walls_and_lights_that_move(key, freeze):
    """Faces follow the scene from call to call, there and back, and stay where it stays."""
    one, first = (renderer(room(), parameters=[key], spp=16, freeze=freeze) for _ in range(2))
    start = one.values[key].detach().clone()
    with torch.no_grad():
        for seed, step in enumerate((0.0, 0.1, 0.1, 0.2, 0.0)):
            pose = start.clone()
            pose[:3, 3] -= step * torch.tensor([0.0, 0.5, -1.0])
            out = one({key: pose}, seed=seed)
            expected = renderer(room(), parameters={key: pose}, spp=16)(seed=seed) if step else first(seed=seed)
            torch.testing.assert_close(out.gated, expected.gated, rtol=2e-5, atol=2e-5)


def without_lamp():
    scene = room()
    del scene["light"]["emitter"]
    return scene | {"bulb": {"type": "point", "position": [0, 0, 0.5], "intensity": 1.0}}


@pytest.mark.parametrize(
    "scene, variant, words",
    [
        (lambda: histogram(steady=True), VARIANT, "steady=False"),
        (lambda: box_of({"type": "roughdielectric", "alpha": 0.3}), VARIANT, "refracts"),
        (without_lamp, VARIANT, "area light"),
        (room, "llvm_ad_mono_polarized", "polarized"),
        (lambda: room(type="transient_path_reuse"), VARIANT, "connections='ordinary'"),
    ],
)
def test_what_it_cannot_do_is_refused(scene, variant, words):
    with mi.variant_context(variant), pytest.raises(SceneError, match=words):
        renderer(scene(), variant=variant)(seed=0)


