"""Polarization against optics: Fresnel, Brewster, total reflection, Malus, wave plates, a slab order by order."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
import torch

from torchtransient import plugins
from torchtransient import stokes as st
from torchtransient.accuracy import two_sample_z_test, z_test
from torchtransient.testing.closed_forms import fresnel_reflectances

RUNS, BIN, INDEX = 8, 0.02, 1.5
# Products of some ten numbers in single precision, of light of power one
ROUNDING = 3e-6
SLOW = pytest.mark.slow


@pytest.fixture(autouse=True, scope="module")
def variant():
    mi.set_variant("llvm_ad_mono_polarized")
    plugins.sync()


def pose():
    return mi.ScalarTransform4f()


def camera(origin, target, start, bins, up=(0, 1, 0)):
    film = {
        "type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "temporal_bins": bins,
        "bin_width_opl": BIN, "start_opl": start,
    }  # fmt: skip
    view = pose().look_at(origin, target, list(up))
    return {"type": "perspective", "fov": 1e-4, "to_world": view, "film": film}


def scene_of(sensor, depth, **parts):
    integrator = {"type": "transient_path", "max_depth": depth, "rr_depth": 1000}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **parts})


def stokes_in_time(scene, spp=1, seed=0):
    """(4, T)"""
    transient = np.array(scene.integrator().render(scene, seed=seed, spp=spp)[1], dtype=np.float64)
    return transient.reshape(-1, 4).T


def lamp(origin, towards):
    """A black square that emits radiance one towards a point."""
    return {
        "type": "rectangle",
        "to_world": pose().look_at(list(origin), list(towards), [0, 1, 0.01]) @ pose().scale(0.05),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": 1.0},
    }


def mirror_at(angle_deg, bsdf, roll_deg=0.0, above=2.0):
    """A camera that sees a lamp by way of a plane at the given angle of incidence, all in the plane y = 0.

    Light arrives after 2 + 1 metres, whatever the angle. ``above`` tells the side of the plane; ``roll_deg`` turns the
    camera clockwise as it looks.
    """
    theta, side = math.radians(angle_deg), math.copysign(1, above)
    origin = np.array([-2 * math.sin(theta), 0, 2 * side * math.cos(theta)])
    place = np.array([math.sin(theta), 0, side * math.cos(theta)])
    d = -origin / 2
    right = np.cross(d, [0, 1, 0])
    up = math.cos(math.radians(roll_deg)) * np.array([0, 1, 0]) + math.sin(math.radians(roll_deg)) * right
    plane = {"type": "rectangle", "to_world": pose().scale(5), "bsdf": bsdf}
    sensor = camera(list(origin), [0, 0, 0], 2.0, 100, up)
    return sensor, {"plane": plane, "lamp": lamp(place, [0, 0, 0])}


def glass(plugin="dielectric"):
    return {"type": plugin, "int_ior": INDEX, "ext_ior": 1.0}


def check_arrival(measured, expected, opl, start=2.0, tolerance=ROUNDING):
    """All light in the bin of ``opl``, with the Stokes vector ``expected``."""
    k = int((opl - start) / BIN)
    np.testing.assert_allclose(measured[:, k - 1 : k + 1].sum(1), expected, atol=tolerance)
    rest = np.delete(measured, [k - 1, k], axis=1)
    np.testing.assert_allclose(rest, 0, atol=tolerance)


# ---------------------------------------------------------------------------------------------------- interfaces


BREWSTER = math.degrees(math.atan(INDEX))


@pytest.mark.parametrize(
    ("angle_deg", "roll_deg", "plugin"),
    [
        (BREWSTER, 25.0, "diff_dielectric"), pytest.param(5.0, 90.0, "dielectric", marks=SLOW),
        pytest.param(75.0, 0.0, "diff_dielectric", marks=SLOW),
    ],
)  # fmt: skip
def test_reflection_from_glass(plugin, angle_deg, roll_deg):
    """The Stokes vector of a reflection of unpolarized light: (Rs + Rp, Rs - Rp, 0, 0) / 2 across the plane of
    incidence, which lies horizontally here. Completely polarized at Brewster's angle, with a power of 0.14793 / 2.

    A lobe is chosen with the probability of its power: every path carries all of it, at a chance of R.
    """
    sensor, parts = mirror_at(angle_deg, glass(plugin), roll_deg)
    scene = scene_of(sensor, 3, **parts)
    r_s, r_p = fresnel_reflectances(INDEX, angle_deg)
    # Across the plane of incidence is upright in the picture of a camera that is not rolled.
    upright = torch.tensor([0.5 * (r_s + r_p), 0.5 * (r_p - r_s), 0, 0], dtype=torch.float64)
    expected = st.rotate_frame(upright, -math.radians(roll_deg), 0).numpy()
    runs = np.stack([stokes_in_time(scene, 4096, seed) for seed in range(RUNS)])
    assert np.all(runs[:, :, 51:] == 0) and np.all(runs[:, :, :49] == 0)
    measured = runs.sum(2)
    result = z_test(measured, expected, rounding=ROUNDING)
    assert result.passed, str(result)
    # The ratios have no noise: all paths carry the same state.
    ratio = measured.sum(0) / measured.sum(0)[0]
    np.testing.assert_allclose(ratio, expected / expected[0], atol=3e-5)
    if angle_deg == math.degrees(math.atan(INDEX)):
        assert r_s == pytest.approx(0.14793, abs=1e-5)
        dop = float(st.degree_of_polarization(torch.from_numpy(measured.sum(0)), 0))
        assert dop == pytest.approx(1.0, abs=1e-5)


def test_reflection_from_metal():
    """Complex amplitudes of Born and Wolf 14.2 for unpolarized light."""
    eta, k, angle_deg = 0.2, 3.4, 60.0
    sensor, parts = mirror_at(angle_deg, {"type": "conductor", "eta": eta, "k": k})
    n, c = complex(eta, k), math.cos(math.radians(angle_deg))
    cos_t = np.sqrt(1 - (math.sin(math.radians(angle_deg)) / n) ** 2)
    r_s, r_p = abs((c - n * cos_t) / (c + n * cos_t)) ** 2, abs((n * c - cos_t) / (n * c + cos_t)) ** 2
    measured = stokes_in_time(scene_of(sensor, 3, **parts))
    check_arrival(measured, [0.5 * (r_s + r_p), 0.5 * (r_p - r_s), 0, 0], 3.0)


@pytest.mark.parametrize(
    ("plugin", "angle_deg", "sign"), [("diff_dielectric", 51.671, -1), pytest.param("dielectric", 43.0, 1, marks=SLOW)]
)
def test_retardance_of_total_reflection(plugin, angle_deg, sign):
    """tan(delta / 2) = cos(theta) sqrt(sin(theta)^2 - 1 / n^2) / sin(theta)^2; largest at 51.67 degrees: 45.24.

    Camera, lamp and polarizer are in glass, below the plane. The polarizer stands at 45 degrees to the plane of
    incidence.
    """
    sensor, parts = mirror_at(angle_deg, glass(plugin), above=-2.0)
    sensor["film"]["start_opl"] = 3 * INDEX - 1  # light arrives after 3 m of glass
    theta = math.radians(angle_deg)
    halfway = [0.5 * math.sin(theta), 0, -0.5 * math.cos(theta)]
    filter_pose = pose().look_at(halfway, [0, 0, 0], [0, 1, 0])
    polarizer = {"type": "rectangle", "to_world": filter_pose, "bsdf": {"type": "polarizer", "theta": 45.0 * sign}}
    measured = stokes_in_time(scene_of(sensor, 4, polarizer=polarizer, **parts))
    s0, s1, s2, s3 = measured.sum(1)
    assert measured[0, 49:51].sum() == pytest.approx(s0, abs=ROUNDING)
    sine = math.sin(theta)
    delta = 2 * math.atan(math.cos(theta) * math.sqrt(sine**2 - 1 / INDEX**2) / sine**2)
    if angle_deg == 51.671:
        assert math.degrees(delta) == pytest.approx(45.24, abs=0.005)
    assert s0 == pytest.approx(0.5, abs=ROUNDING)
    assert s1 == pytest.approx(0, abs=ROUNDING)
    # Close to the critical angle the root of a small difference carries the rounding of its terms.
    assert math.atan2(abs(s3), abs(s2)) == pytest.approx(delta, abs=2e-5)
    assert math.hypot(s2, s3) == pytest.approx(0.5, abs=ROUNDING)
    # The component in the plane of incidence runs ahead (Mitsuba's documentation, after D. Clarke's Stellar
    # Polarimetry): the hand follows the side on which the polarizer stands.
    assert math.copysign(1, s3) == sign == -math.copysign(1, s2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "metal",
    [
        {"type": "conductor", "eta": 0.2, "k": 3.4},
        {"type": "roughconductor", "eta": 0.2, "k": 3.4, "alpha": 0.2},
    ],
)
def test_both_sides_of_a_two_sided_metal_are_alike(metal):
    """Seen from behind, Mitsuba's ``twosided`` gives matrices between the wrong frames; circular light betrays it."""
    results = []
    for bsdf, turn_deg in ((metal, 0), ({"type": "twosided", "nested": metal}, 180)):
        sensor, parts = mirror_at(60.0, bsdf, 20.0)
        parts["plane"]["to_world"] = pose().rotate([1, 0.3, 0], turn_deg).scale(5)
        place = [0.5 * math.sin(math.radians(60.0)), 0, 0.5 * math.cos(math.radians(60.0))]
        filter_pose = pose().look_at(place, [0, 0, 0], [0, 1, 0])
        parts["filter"] = {"type": "rectangle", "to_world": filter_pose, "bsdf": {"type": "polarizer", "theta": 30.0}}
        parts["lamp"]["to_world"] = parts["lamp"]["to_world"] @ pose().scale(20)
        scene = scene_of(sensor, 4, **parts)
        results.append(np.stack([stokes_in_time(scene, 64, seed).sum(1) for seed in range(RUNS)]))
    front, back = results
    assert np.abs(front.mean(0)).min() > 1e-3
    result = two_sample_z_test(front, back, rounding=1e-5)
    assert result.passed, str(result)
    if metal["type"] != "roughconductor":
        np.testing.assert_allclose(front, back, atol=ROUNDING)


# ------------------------------------------------------------------------------------------------ thin elements


ELEMENTS = {
    "third polarizer between crossed ones": [("polarizer", 0.0), ("polarizer", 30.0), ("polarizer", 90.0)],
    "half-wave plate": [("polarizer", 0.0), ("retarder", 20.0, 180.0), ("polarizer", 50.0)],
    "quarter-wave plate, other hand": [("polarizer", 0.0), ("retarder", -45.0, 90.0)],
    "any plate": [("polarizer", 35.0), ("retarder", -15.0, 37.0)],
    "right circular": [("polarizer", 0.0), ("retarder", 45.0, 90.0), ("circular",)],
}


def in_torch(kind, theta=0.0, delta=0.0):
    """The element by the library's torch functions, in the camera's frame: x to the right, y up.

    Mitsuba's polarizer transmits along (cos, -sin) of its angle in the local frame, its retarder is fast along (cos,
    sin).
    """
    if kind == "polarizer":
        return st.linear_polarizer(torch.tensor(-math.radians(theta), dtype=torch.float64))
    if kind == "retarder":
        return st.linear_retarder(torch.tensor(math.radians(theta), dtype=torch.float64), math.radians(delta))
    return st.circular_polarizer().double()


@pytest.mark.parametrize(
    ("name", "prefix"),
    [
        ("right circular", ""), ("half-wave plate", "diff_"),
        *(pytest.param(name, "diff_", marks=SLOW) for name in ("third polarizer between crossed ones", "any plate")),
        pytest.param("quarter-wave plate, other hand", "", marks=SLOW),
    ],
)  # fmt: skip
def test_chain_of_elements(name, prefix):
    """From the lamp towards the camera; light arrives after 3 metres."""
    state = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    parts = {"lamp": lamp([0, 0, -1], [0, 0, 2])}
    for number, (kind, *angles) in enumerate(ELEMENTS[name]):
        names = dict(zip(("theta", "delta"), angles, strict=False))
        place = pose().translate([0, 0, -0.8 + 0.2 * number]).scale(2)
        parts[f"element_{number}"] = {
            "type": "rectangle", "to_world": place, "bsdf": {"type": prefix + kind, **names},
        }  # fmt: skip
        state = st.apply_mueller(in_torch(kind, *angles), state, 0)
    measured = stokes_in_time(scene_of(camera([0, 0, 2], [0, 0, 0], 2.0, 100), 6, **parts))
    check_arrival(measured, state.numpy(), 3.0)


# --------------------------------------------------------------------------------------------------- depolarizers


