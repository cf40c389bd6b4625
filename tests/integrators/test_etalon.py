"""Optical path lengths through glass: slabs met at an angle, gaps, and connections through rough interfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from support.dielectric_reference import fresnel_reflectance, rough_dielectric
from torchtransient.accuracy import z_test

VARIANT = "llvm_ad_mono"
RUNS = 8
BIN = 0.02
SLOW = pytest.mark.slow


def camera(origin, target, bins, start, temporal_filter="box"):
    up = [0, 1, 0] if abs(origin[0] - target[0]) + abs(origin[2] - target[2]) > 0 else [0, 0, 1]
    return {
        "type": "perspective",
        "fov": 0.02,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, up),
        "film": {
            "type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "temporal_bins": bins,
            "bin_width_opl": BIN, "start_opl": start, "temporal_filter": temporal_filter,
        },
        "sampler": {"type": "independent", "sample_count": 4096},
    }  # fmt: skip


def transients(scene, **kwargs):
    return np.array(
        [np.array(scene.integrator().render(scene, seed=k, **kwargs)[1]).mean(-1).ravel() for k in range(RUNS)]
    )


def emitting_plane(z, facing):
    turn = mi.ScalarTransform4f() if facing > 0 else mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, z]) @ turn @ mi.ScalarTransform4f().scale(200),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": 2.0},
    }


def interface_pair(bsdf, thickness):
    """Two infinite planes that bound the slab ``-thickness < z < 0``, normals pointing out of it."""
    T = mi.ScalarTransform4f
    return {
        "front": {"type": "rectangle", "to_world": T().scale(200), "bsdf": bsdf},
        "back": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -thickness]).rotate([0, 1, 0], 180).scale(200),
            "bsdf": bsdf,
        },
    }


def check_orders(measured, start, orders):
    """Every order's energy in the bin of its arrival and its neighbours, and nothing anywhere else."""
    expected, groups = [], np.zeros(measured.shape[1], dtype=int)
    for number, (opl, energy) in enumerate(orders, 1):
        k = int((opl - start) / BIN)
        assert np.all(groups[k - 1 : k + 2] == 0), "orders of this scene overlap: choose another bin width"
        groups[k - 1 : k + 2] = number
        expected.append(energy)
    got = np.stack([measured[:, groups == g].sum(1) for g in range(len(orders) + 1)], 1)
    assert np.all(got[:, 0] < 1e-6)
    result = z_test(got[:, 1:], np.array(expected), rounding=2e-5)
    assert result.passed, str(result)


SLABS = {"glass": (1.5, 1.0, 0.0), "glass, oblique": (1.5, 1.0, 40.0), "a gap": (1.0, 1.5, 30.0)}


@pytest.mark.parametrize(
    ("slab", "side", "plugin"),
    [
        ("a gap", "transmitted", "dielectric"), pytest.param("glass", "transmitted", "diff_dielectric", marks=SLOW),
        pytest.param("glass, oblique", "reflected", "diff_dielectric", marks=SLOW),
    ],
)  # fmt: skip
def test_slab(plugin, side, slab):
    """Slab of glass in air, and the gap of air in glass, at normal and oblique incidence.

    Lengths count relative to the medium of the camera: light in the gap is 1.5 times as fast.
    """
    thickness, above, below = 0.51, 2.0, 1.0
    n_in, n_out, angle_deg = SLABS[slab]
    eta, theta = n_in / n_out, np.radians(angle_deg)
    cos_i = np.cos(theta)
    cos_t = np.sqrt(1 - (np.sin(theta) / eta) ** 2)
    r = fresnel_reflectance(torch.tensor(cos_i, dtype=torch.float64), torch.tensor(eta, dtype=torch.float64)).item()
    crossing = eta * thickness / cos_t

    origin = [above * np.tan(theta) + 3, 0.1, above]
    if side == "transmitted":
        light, air = emitting_plane(-thickness - below, 1), (above + below) / cos_i
        orders = [(air + (2 * m + 1) * crossing, 2 * (1 - r) ** 2 * r ** (2 * m)) for m in range(4)]
    else:
        light, air = emitting_plane(above + below, -1), (2 * above + below) / cos_i
        orders = [(air, 2 * r)] + [(air + 2 * m * crossing, 2 * (1 - r) ** 2 * r ** (2 * m - 1)) for m in range(1, 4)]
    orders = [(opl, energy) for opl, energy in orders if energy > 2e-4]

    bins, start = 400, 2.5
    bsdf = {"type": plugin, "int_ior": n_in, "ext_ior": n_out}
    scene = mi.load_dict({
        "type": "scene", "light": light, **interface_pair(bsdf, thickness),
        "sensor": camera(origin, [3, 0.1, 0], bins, start),
        "integrator": {"type": "transient_path", "max_depth": 7, "rr_depth": 1000},
    })  # fmt: skip
    measured = transients(scene)
    window = max(int((opl - start) / BIN) for opl, _ in orders) + 2
    check_orders(measured[:, :window], start, orders)


# -------------------------------------------------------------------------------- connections through rough interfaces

ROUGH = {
    "roughdielectric": {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3, "distribution": "ggx"},
    "diff_rough_dielectric": {
        "type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3, "distribution": "ggx",
    },
    "half covered": {
        "type": "mask", "opacity": 0.5,
        "nested": {
            "type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3, "distribution": "ggx",
        },
    },
}  # fmt: skip


def lamp_behind_interface(bsdf, camera_z, lamp, temporal_filter="box"):
    """A single rough interface at z = 0 (inside below), camera on one side, point light on the other."""
    return mi.load_dict({
        "type": "scene",
        "interface": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20), "bsdf": bsdf},
        "lamp": {"type": "point", "position": list(lamp), "intensity": 3.0},
        "sensor": camera([0.05, 0.02, camera_z], [0.05, 0.02, 0], 300, 2.0, temporal_filter),
        "integrator": {"type": "transient_path", "max_depth": 2},
    })  # fmt: skip


def radiance_through(camera_z, lamp, eta, alpha=0.3):
    """Radiance towards the camera from the lamp through the interface, and the optical path length."""
    one = torch.ones(1, dtype=torch.float64)
    to_lamp = torch.tensor([[lamp[0] - 0.05, lamp[1] - 0.02, lamp[2]]], dtype=torch.float64)
    distance = to_lamp.norm()
    wi = torch.tensor([[0.0, 0.0, np.sign(camera_z)]], dtype=torch.float64)
    value, _ = rough_dielectric(wi, to_lamp / distance, eta * one, alpha * one, alpha * one, True)
    # The inside of the interface lies at z < 0: there stands either the lamp or the camera.
    before, behind = (1, eta) if camera_z > 0 else (eta, 1)
    return 3.0 * value[0] / distance**2, abs(camera_z) * before + behind * distance


ABOVE, BELOW = (3.0, (0.4, 0.1, -2.0)), (-3.0, (0.3, -0.2, 2.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "places"), [("roughdielectric", BELOW), ("diff_rough_dielectric", ABOVE), ("half covered", ABOVE)]
)
def test_connection_through_a_rough_interface(kind, places):
    """Guards against counting the connection with the index of the camera's side: 3 m of air and 2 m of glass are 6 m,
    3 m of glass around the camera and 2 m of air 6.5 m.

    mitransient puts this light at 5 m.
    """
    camera_z, lamp = places
    scene = lamp_behind_interface(ROUGH[kind], camera_z, lamp)
    radiance, opl = (x.item() for x in radiance_through(camera_z, lamp, torch.tensor(1.5, dtype=torch.float64)))
    if kind == "half covered":
        radiance *= 0.5
    measured = transients(scene).mean(0)
    k = int((opl - 2.0) / BIN)
    assert measured.sum() == pytest.approx(radiance, rel=2e-3)
    assert measured[k - 1 : k + 2].sum() == pytest.approx(measured.sum(), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("places", "key"), [(BELOW, "eta"), (ABOVE, "alpha")])
def test_gradient_through_a_rough_interface(places, key):
    """Index and roughness from the time of flight: d/dx of sum_b t_b I_b = f tau has the parts f' tau and f tau'."""
    camera_z, lamp = places
    scene = lamp_behind_interface(ROUGH["diff_rough_dielectric"], camera_z, lamp, "tent")
    params = mi.traverse(scene)
    name = "interface.bsdf.eta" if key == "eta" else "interface.bsdf.alpha.value"
    dr.enable_grad(params[name])
    params.update()
    eta, alpha = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (1.5, 0.3))
    f, tau = radiance_through(camera_z, lamp, eta, alpha)
    (expected,) = torch.autograd.grad(f * tau, eta if key == "eta" else alpha)

    times = 2.0 + BIN * (np.arange(300) + 0.5)
    adjoint = mi.TensorXf(times.astype(np.float32), (1, 1, 300, 1))
    scene.integrator().render_backward(scene, params, (None, adjoint), spp=4096)
    assert dr.grad(params[name])[0] == pytest.approx(expected.item(), rel=5e-3)


@pytest.mark.parametrize(
    ("angle_deg", "side"), [(40.0, "reflected"), pytest.param(0.0, "transmitted", marks=SLOW)]
)
def test_gradient_of_a_slab_in_its_index(side, angle_deg):
    """Through Fresnel's weight, the refracted direction and the path length, orders m = 0 to 3 of the slab together."""
    thickness, above, below, orders = 0.51, 2.0, 1.0, 4
    theta = np.radians(angle_deg)
    eta = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    cos_i = torch.tensor(np.cos(theta), dtype=torch.float64)
    r = fresnel_reflectance(cos_i, eta)
    crossing = eta * thickness / torch.sqrt(1 - (np.sin(theta) / eta) ** 2)
    if side == "transmitted":
        light, air = emitting_plane(-thickness - below, 1), (above + below) / cos_i
        terms = [((1 - r) ** 2 * r ** (2 * m), air + (2 * m + 1) * crossing) for m in range(orders)]
        max_depth = 2 * orders + 1
    else:
        light, air = emitting_plane(above + below, -1), (2 * above + below) / cos_i
        terms = [(r, air)] + [((1 - r) ** 2 * r ** (2 * m - 1), air + 2 * m * crossing) for m in range(1, orders)]
        max_depth = 2 * orders
    loss = sum(2 * f * tau for f, tau in terms)
    (expected,) = torch.autograd.grad(loss, eta)

    bins, start = 700, 2.5
    scene = mi.load_dict({
        "type": "scene", "light": light,
        **interface_pair({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}, thickness),
        "sensor": camera([above * np.tan(theta) + 3, 0.1, above], [3, 0.1, 0], bins, start, "tent"),
        "integrator": {"type": "transient_path", "max_depth": max_depth, "rr_depth": 1000},
    })  # fmt: skip
    params = mi.traverse(scene)
    etas = [k for k, _ in params if k.endswith("eta")]
    for k in etas:
        dr.enable_grad(params[k])
    params.update()
    times = start + BIN * (np.arange(bins) + 0.5)
    adjoint = mi.TensorXf(times.astype(np.float32), (1, 1, bins, 1))
    gradients = []
    for seed in range(RUNS):
        for k in etas:
            dr.clear_grad(params[k])
        scene.integrator().render_backward(scene, params, (None, adjoint), seed=seed)
        gradients.append(sum(dr.grad(params[k])[0] for k in etas))
    result = z_test(np.array(gradients)[:, None], np.array([expected.item()]), rounding=1e-4 * abs(expected.item()))
    assert result.passed, str(result)
    assert np.std(gradients) / np.sqrt(RUNS) < 0.05 * abs(expected.item())
