"""`transient_path_reuse`: the light of `transient_path`, with less noise, whatever scene and film."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test
from torchtransient.errors import SceneError
from torchtransient.scenes import rotate, scale, translate

VARIANT = "llvm_ad_rgb"
PATH, REUSE = "transient_path", "transient_path_reuse"
COLOUR = "red.reflectance.value"


def room(size=16, bins=60, film=None, **settings):
    """The Cornell box, 9 m of path."""
    scene = tt.scenes.cornell_box(resolution=size, num_bins=bins, bin_width_opl=9 / bins)
    scene["integrator"] = {**scene["integrator"], "type": REUSE, **settings}
    scene["sensor"]["film"] |= film or {}
    return scene


def box_of(bsdf):
    scene = room()
    scene["large-box"] = {**scene["large-box"], "bsdf": bsdf}
    return scene


def with_object(**described):
    return room() | described


def gates():
    scene = room()
    box = {"type": "box"}
    doors = "rectangular 6.0 6.4; gaussian 7.0 0.3; rectangular 8 20"
    scene["sensor"]["film"] = {"type": "gated_hdr_film", "width": 16, "height": 16, "rfilter": box, "gates": doors}
    return scene


def ball_of_triangles():
    """A coarse ball with normals at its corners: sides of its triangles and of its shading differ."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 9)[:-1], np.linspace(0, np.pi, 6), indexing="ij")
    n = np.stack([np.cos(u) * np.sin(v), np.cos(v), np.sin(u) * np.sin(v)], -1).reshape(-1, 3)
    faces = []
    for i in range(8):
        for j in range(5):
            a, b = 6 * i + j, 6 * ((i + 1) % 8) + j
            faces += [(a, a + 1, b), (b, a + 1, b + 1)]
    mesh = {"type": "mesh_arrays", "vertices": 0.35 * n + [0.3, -0.4, 0.3], "faces": np.array(faces), "normals": n}
    return with_object(ball={**mesh, "bsdf": {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.7}}})


def instance():
    group = {"type": "shapegroup", "cube": {"type": "cube", "bsdf": DIFFUSE}}
    pose = translate([0.4, 0.3, 0.2]) @ scale(0.15)
    one = {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}, "to_world": pose}
    return with_object(group=group, one=one)


def in_glass():
    """A camera in a ball of glass: all that it sees lies behind a refraction."""
    eye = room()["sensor"]["to_world"][:3, 3].tolist()
    return with_object(bowl={"type": "sphere", "center": eye, "radius": 0.3, "bsdf": {"type": "dielectric"}})


def meter():
    """Pixels that see all directions."""
    film = room()["sensor"]["film"] | {"width": 8, "height": 8}
    sensor = {"type": "irradiancemeter", "film": film, "sampler": {"type": "independent"}}
    pose = translate([0, -0.9, 0.3]) @ rotate([1, 0, 0], -90) @ scale(0.2)
    scene = with_object(plate={"type": "rectangle", "to_world": pose, "bsdf": DIFFUSE, "sensor": sensor})
    del scene["sensor"]
    return scene


def bumps():
    heights = np.random.default_rng(0).random((16, 16, 1)).astype(np.float32)
    texture = {"type": "bitmap", "raw": True, "data": heights}
    return box_of({"type": "bumpmap", "heights": texture, "scale": 0.05, "paint": DIFFUSE})


DIFFUSE = {"type": "diffuse", "reflectance": 0.8}
METAL = {"type": "roughconductor", "alpha": 0.3}
SCENES = {
    "gates": gates,
    "long gaussian": lambda: room(film={"temporal_filter": "gaussian", "gaussian_stddev": 3.0}),
    "pulse": lambda: room(film={"pulse": "gaussian", "pulse_fwhm_opl": 0.5}),
    "window": lambda: room(film={"start_opl": 6.5, "temporal_bins": 10}),
    "lanczos": lambda: room(film={"rfilter": {"type": "lanczos"}}),
    "crop": lambda: room(24, film={"crop_width": 13, "crop_height": 17, "crop_offset_x": 5, "crop_offset_y": 3}),
    "glass": lambda: box_of({"type": "dielectric"}),
    "blend": lambda: box_of({"type": "blendbsdf", "weight": 0.4, "a": DIFFUSE, "b": METAL}),
    "delayed": lambda: box_of({"type": "delayed", "lifetime": 1.0, "nested": DIFFUSE}),
    "ball": ball_of_triangles,
    "bumps": bumps,
    "instance": instance,
    "in glass": in_glass,
    "meter": meter,
    "bulb": lambda: with_object(bulb={"type": "point", "position": [0, 0, 0.5], "intensity": 1.0}),
    "unwarped": lambda: room(camera_unwarp=True),
    "hidden lamp": lambda: room(hide_emitters=True),
    "deep": lambda: room(max_depth=40),
    "small groups": lambda: room(group_size=16, suffixes=4, samples_per_round=8),
}


def renderer(scene, integrator=REUSE, variant=VARIANT, spp=128, **settings):
    described = scene["integrator"] | {"type": integrator}
    if integrator == PATH:
        described = {k: v for k, v in described.items() if k not in ("group_size", "suffixes", "samples_per_round")}
    loaded = tt.load(scene | {"integrator": described}, variant=variant)
    return tt.TransientRenderer(loaded, spp=spp, physics="ignore", **settings)


def measured(out):
    return (out.transient if out.gated is None else out.gated).double()


def blocks(cube):
    """Sums over 4 x 4 pixels x 6 bins of (C, T, H, W)."""
    channels, bins, height, width = cube.shape
    bins, each = (bins // 6, 6) if bins > 20 else (bins, 1)
    cube = cube[:, : bins * each, : height // 4 * 4, : width // 4 * 4]
    return cube.reshape(channels, bins, each, height // 4, 4, width // 4, 4).sum((2, 4, 6)).numpy()


def runs(one, count, seed=0):
    with torch.no_grad():
        return np.stack([blocks(measured(one(seed=seed + k))) for k in range(count)])


def check_same_light(scene, variant=VARIANT):
    with mi.variant_context(variant):
        plain, shared = renderer(scene, PATH, variant), renderer(scene, REUSE, variant)
        plain, shared = runs(plain, 16), runs(shared, 8, 5000)
    result = two_sample_z_test(plain, shared, rounding=1e-5)
    assert result.passed, str(result)
    # of their sum: channels share their paths, and chi squared asks for independent entries
    result = two_sample_z_test(plain.sum(1), shared.sum(1), rounding=1e-5)
    assert result.chi2_z < 4.5, str(result)


@pytest.mark.parametrize("name", long(SCENES, ["blend"], ["long gaussian"]))
def test_it_is_the_light_of_plain_paths(name):
    check_same_light(SCENES[name]())


@pytest.mark.slow
def test_wavelengths():
    check_same_light(room(), "llvm_ad_spectral")


@pytest.mark.soak
def test_means_are_those_of_plain_paths_to_a_thousandth():
    """Energy to 1e-3, Student's t of blocks with mean 0 and deviation 1.

    Blocks share noise, so that the mean of their t is compared with its own scatter between runs: 4 deviations.
    """
    count = 40
    plain, shared = (runs(renderer(room(32), kind, spp=256), count, seed) for kind, seed in ((PATH, 0), (REUSE, 999)))
    ratio = shared.sum() / plain.sum()
    totals = [x.sum((1, 2, 3, 4)) for x in (plain, shared)]
    error = math.sqrt(sum(x.var(ddof=1) / count for x in totals)) / totals[0].mean()
    assert error < 1e-3 and abs(ratio - 1) < 3 * error
    bars = np.sqrt((plain.var(0, ddof=1) + shared.var(0, ddof=1)) / count)
    lit = bars > 0
    t = (shared.mean(0) - plain.mean(0))[lit] / bars[lit]
    assert abs(t.std() - 1) < 0.1
    scatter = [(x[:, lit] / bars[lit]).mean(1).var(ddof=1) / count for x in (plain, shared)]
    assert abs(t.mean()) < 4 * math.sqrt(sum(scatter))


def test_window_and_light_outside_make_up_the_steady_image():
    out = renderer(room(film={"start_opl": 6.5, "temporal_bins": 10}), spp=64)(seed=1)
    inside = out.transient.double().sum() / 3
    total = inside + out.stats.energy_before[0] + out.stats.energy_after[0]
    assert total.item() == pytest.approx(out.steady.double().sum().item() / 3, rel=2e-6)


@pytest.mark.slow
def test_late_light_has_less_noise():
    with torch.no_grad():
        found = {
            kind: torch.stack([measured(one(seed=k)) for k in range(6)])
            for kind, one in ((kind, renderer(room(32), kind, spp=64)) for kind in (PATH, REUSE))
        }
    variance = {kind: cubes.var(0)[:, 30:].mean().item() for kind, cubes in found.items()}
    assert variance[REUSE] < variance[PATH] / 4


def test_calls_are_recorded():
    recorded, traced = (renderer(room(), parameters=[COLOUR], spp=32, freeze=freeze) for freeze in (True, False))
    colours = torch.tensor([[0.9, 0.1, 0.3], [0.2, 0.8, 0.5], [0.5, 0.5, 0.5]])
    with torch.no_grad():
        for seed, colour in enumerate(colours):
            out = recorded({COLOUR: colour}, seed=seed)
            expected = traced({COLOUR: colour}, seed=seed)
            torch.testing.assert_close(out.transient, expected.transient, rtol=2e-5, atol=2e-5)
    assert out.stats.recorded == ("launched",)


def test_a_camera_that_moves():
    """Groups follow what pixels see, in recorded calls too."""
    recorded, fresh = (renderer(room(), parameters=["sensor.to_world"], spp=16) for _ in range(2))
    pose = recorded.values["sensor.to_world"].detach().clone()
    with torch.no_grad():
        for seed in range(4):
            pose[0, 3] += 0.05
            out = recorded({"sensor.to_world": pose}, seed=seed)
        expected = fresh({"sensor.to_world": pose}, seed=3)
    torch.testing.assert_close(out.transient, expected.transient, rtol=2e-5, atol=2e-5)


@pytest.mark.slow
def test_films_of_several_launches():
    """More pixels than one launch has, the last groups not full."""
    small = room(bins=10)
    small["sensor"]["film"] |= {"width": 171, "height": 97}
    plain, shared = renderer(small, PATH, spp=64), renderer(small, spp=16)
    with torch.no_grad():
        expected, got = plain(seed=0), shared(seed=1)
    assert got.transient.sum().item() == pytest.approx(expected.transient.sum().item(), rel=5e-3)
    parts = [torch.stack([part.sum() for part in out.steady.chunk(8, dim=1)]) for out in (got, expected)]
    torch.testing.assert_close(*parts, rtol=0.05, atol=0)


# --------------------------------------------------------------------------------------------------------- derivatives


def test_derivatives_are_those_of_plain_paths():
    """By a colour and by a pose, in both modes, but for edges: their term knows no integrator."""
    weights, pose = torch.linspace(0, 1, 60)[:, None, None], "small-box.to_world"
    found = []
    for kind in (PATH, REUSE):
        scene = room(8, film={"temporal_filter": "tent"})
        one = renderer(scene, kind, spp=16, parameters=[COLOUR, pose], boundary=False)
        (one(seed=2).transient * weights).sum().backward()
        colour = one.values[COLOUR].detach()

        def transient(value, one=one):
            return one({COLOUR: value}, seed=2).transient

        _, tangent = torch.func.jvp(transient, (colour,), (torch.ones_like(colour),))
        found.append((one.values[COLOUR].grad, one.values[pose].grad, tangent))
    for plain, shared, rtol, atol in zip(*found, (1e-5, 1e-4, 1e-5), (1e-6, 1e-4, 1e-6), strict=True):
        torch.testing.assert_close(plain, shared, rtol=rtol, atol=atol)


# -------------------------------------------------------------------------------------------------------------- errors


def phasors():
    scene = room()
    scene["sensor"]["film"] = {"type": "phasor_hdr_film", "width": 4, "height": 4, "frequencies": "0.1, 0.2"}
    return scene


@pytest.mark.parametrize(
    ("make", "variant", "message"),
    [
        (room, "llvm_ad_mono_polarized", "polarized; load the scene in one without, or use transient_path"),
        (lambda: room(max_depth=-1), VARIANT, "no limit.*set it, or use transient_path"),
        (phasors, VARIANT, "expected a film of histograms or gates, got phasor_hdr_film"),
    ],
)
def test_what_is_not_shared_is_refused(make, variant, message):
    with pytest.raises(SceneError, match=message):
        renderer(make(), variant=variant, spp=1)(seed=0)


def test_parameters_are_checked():
    with pytest.raises(SceneError, match="group_size: expected a power of two, got 48"), plugins.plugin_errors():
        mi.load_dict({"type": REUSE, "group_size": 48})


def test_scenes_without_diffuse_surfaces():
    """Nothing is shared: all light is that of paths."""
    scene = {k: v for k, v in box_of(METAL).items() if not (isinstance(v, dict) and v.get("type") == "diffuse")}
    scene = {k: ({**v, "bsdf": METAL} if isinstance(v, dict) and "bsdf" in v else v) for k, v in scene.items()}
    one, other = (renderer(scene, kind, spp=16)(seed=3).transient for kind in (PATH, REUSE))
    torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
