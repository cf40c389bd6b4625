"""Hard case: forward mode writes the derivative of every event where that event arrives, not where the path stood when
a parameter was met.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import room
from support.marks import long
from support.media_scenes import camera, film, homogeneous, load
from torchtransient.accuracy import two_sample_z_test

VARIANT = "llvm_ad_mono"


def forward(scene, keys, seed, spp):
    """Derivative of the transient when all ``keys`` grow together, summed over the pixels: (bins,)."""
    params = mi.traverse(scene)
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1.0)
    for key in keys:
        params[key] = type(params[key])(dr.detach(params[key]) + x)
    params.update()
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    _, transient = scene.integrator().render_forward(scene, params, seed=seed, spp=spp)
    for key in keys:
        dr.disable_grad(params[key])
    return np.array(transient, dtype=float).sum((0, 1, 3))


def primal(scene, seed, spp):
    _, transient = scene.integrator().render(scene, seed=seed, spp=spp)
    return np.array(transient, dtype=float).sum((0, 1, 3))


def several(run, scene, *arguments, count=8, spp=4096):
    return np.array([run(scene, *arguments, seed, spp) for seed in range(count)])


def once_scattered(albedo, σ_t):
    """A point light in a fog, seen by scattering once; every bin has its own scattering point."""
    sensor = {"type": "radiancemeter", "origin": [0, 0, 0], "direction": [0.6, 0, 0.8], "film": film(1, 1, bins=40)}
    sensor["medium"] = {"type": "ref", "id": "fog"}
    light = {"type": "point", "position": [0, 0, 1.5], "intensity": 1.0}
    return load({"fog": homogeneous(σ_t, albedo), "light": light}, sensor, max_depth=2)


def test_extinction_of_a_medium():
    """d/dσ of σ exp(-σ t): once-scattered light times (1/σ - t), whatever the scattering point of the bin."""
    derivative = several(forward, once_scattered(0.6, 0.8), ["sensor.medium.sigma_t.value.value"])
    light = several(primal, once_scattered(0.6, 0.8))
    edges = np.arange(41) * 0.1
    # Within a bin the factor is off its value in the middle by half a bin width at most.
    middle = 1 / 0.8 - (edges[1:] + edges[:-1]) / 2
    mid = two_sample_z_test(derivative, light * middle, rounding=0.05 * light.mean(0).max())
    assert mid.passed, str(mid)
    # It changes its sign at the length 1/σ: derivatives that landed at the scattering point would be early.
    late = edges[:-1] > 1 / 0.8 + 0.2
    assert (derivative.mean(0)[late] < 0).sum() > 0.8 * (light.mean(0)[late] > 0).sum()


@pytest.mark.parametrize("scattering", long([True, False], [False]))
def test_every_bin_against_differences(scattering):
    """A room in which all surfaces have one reflectance ρ, with and without a medium: each bin by itself."""
    scene = room(depth=4)
    for name in ("wall", "side"):
        scene[name]["bsdf"] = {"type": "diffuse", "reflectance": 0.5}
    if scattering:
        pose = mi.ScalarTransform4f().translate([0, 0, 1.2]).scale([1, 1, 0.3])
        medium = homogeneous(0.8, 0.9)
        scene["block"] = {"type": "cube", "to_world": pose, "bsdf": {"type": "null"}, "interior": medium}
        scene["integrator"]["type"] = "transient_prbvolpath"
    scene["sensor"]["film"] |= film(2, 2, bins=24, bin_width=0.25, start=6.0)
    scene = mi.load_dict(scene, optimize=False)
    keys = ["wall.bsdf.reflectance.value", "side.bsdf.reflectance.value"]
    derivative = several(forward, scene, keys)
    params, h, sides = mi.traverse(scene), 0.01, []
    for sign in (1, -1):
        for key in keys:
            params[key] = type(params[key])(0.5 + sign * h)
        params.update()
        sides.append(several(primal, scene))
    differences = (sides[0] - sides[1]) / (2 * h)
    result = two_sample_z_test(derivative, differences, rounding=1e-4 * abs(differences).max())
    assert result.passed, str(result)
    lit = (abs(differences.mean(0)) > 1e-3 * abs(differences).max()).sum()
    assert lit >= 3, "one arrival alone would prove nothing"


@pytest.mark.filterwarnings("ignore:the derivative by")  # of edges, which lie outside of the view
@pytest.mark.parametrize("filter", long(["box", "tent", "gaussian"], ["box", "tent"]))
def test_mean_arrival_of_a_moving_wall(filter):
    """Camera and light at z = 4, a wall at z = 0: d (mean arrival) / dz = -2 exactly, in both modes. Guards against the
    silent zero of a box filter, whose bins have a derivative of zero almost everywhere.
    """
    view = camera(fov=0.1)
    lamp = {"type": "point", "position": [0.0, 0.0, 4.0], "intensity": 5.0}
    window = film(1, 1, start=5.513, bins=100, bin_width=0.05) | {"gaussian_stddev": 1.5}
    scene = {"type": "scene", "integrator": {"type": "transient_path", "max_depth": 2}, "wall": {"type": "rectangle"},
             "sensor": view | {"film": window}, "light": lamp}  # fmt: skip
    renderer = tt.TransientRenderer(
        tt.load(scene, variant=VARIANT), ["wall.to_world"], spp=256, boundary=False, temporal_filter=filter
    )
    pose, up = renderer.values["wall.to_world"].detach().clone().requires_grad_(), torch.zeros(4, 4)
    up[2, 3] = 1.0

    def arrival(pose):
        out = renderer({"wall.to_world": pose}, seed=0)
        light = out.transient.sum((0, 2, 3)).double()
        return (light * out.axis.centers_opl).sum() / light.sum()

    if filter == "box":
        with pytest.raises(tt.errors.GradientError, match="tent"):
            arrival(pose).backward()
        return
    found = arrival(pose)
    assert float(found.detach()) == pytest.approx(8.0, abs=0.025)
    # the gaussian is cut at four standard deviations, where it is 3e-4 of its height
    assert float(torch.autograd.grad(found, pose)[0][2, 3]) == pytest.approx(-2, abs=2e-3)
    assert float(torch.func.jvp(arrival, (pose.detach(),), (up,))[1]) == pytest.approx(-2, abs=2e-3)


def test_box_filter_keeps_gradients_of_light():
    """The light is linear in the lamp's intensity, in bins without a slope, too."""
    key, lamp = "light.intensity.value", {"type": "point", "position": [0.0, 0.0, 4.0], "intensity": 5.0}
    integrator, view = {"type": "transient_path", "max_depth": 2}, camera(fov=0.1, start=5.513, bin_width=0.05)
    scene = {"type": "scene", "integrator": integrator, "wall": {"type": "rectangle"}, "sensor": view, "light": lamp}
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), [key], spp=64, temporal_filter="box")
    light = renderer(seed=0).transient.sum()
    (slope,) = torch.autograd.grad(light, renderer.values[key])
    assert light.item() > 0
    assert slope.sum().item() == pytest.approx(light.item() / 5.0, rel=1e-5)
