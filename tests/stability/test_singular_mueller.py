"""Gradients through matrices that have no inverse: depolarisers, polarizers, absorbers, and frames that coincide."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.problem import Case, Problem
from support.gradient_cases.scenes import film, room, transform
from support.gradient_cases.unknowns import set_color
from support.marks import long
from torchtransient import plugins

VARIANT = "llvm_ad_mono_polarized"


def problem(scene, apply, value, step=0.05, spp=256):
    return Problem(Case("singular", "", scene, apply, value, step, VARIANT, spp=spp, fd_spp=spp))


def check(p, seeds=(1, 2), rel=3e-3, smallest=1e-4):
    """Reverse and forward mode against central differences with Richardson's correction, on the same paths."""
    h, x = p.case.step, p.case.value
    for seed in seeds:
        near, far = ((p.loss(x + s, seed) - p.loss(x - s, seed)) / (2 * s) for s in (h / 2, h))
        expected = (4 * near - far) / 3
        assert abs(expected) > smallest
        assert p.reverse(seed) == pytest.approx(expected, rel=rel)
        assert p.forward(seed) == pytest.approx(expected, rel=rel)


def bench(*elements, lamp_angle=0.0):
    """Thin elements square to the parallel rays of an orthographic camera, before a diffuse wall that a lamp lights.

    Every direction is the normal, every frame coincides with the next one or is turned by the angle of an element.
    """
    scene = room(sensor={
        "type": "orthographic",
        "to_world": transform().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]).scale(0.2),
        "film": film(size=2, start=6.0),
    })  # fmt: skip
    scene["wall"]["to_world"] = transform().scale(3)
    scene["light"]["position"] = [1.5, 0.0, 2.0]
    for number, element in enumerate(elements):
        place = transform().translate([0, 0, 2.0 + 0.5 * number]).scale(0.5)
        scene[f"element_{number}"] = {"type": "rectangle", "to_world": place, "bsdf": element}
    return scene


def polarizer(angle):
    return {"type": "diff_polarizer", "theta": angle}


@pytest.mark.slow
def test_albedo_behind_two_polarizers():
    """Guards against the light beyond a vertex being recovered by an inverse matrix: a diffuse wall forgets the
    polarization and a polarizer half of the light, neither can be undone. At albedo zero nothing is left at all.
    """

    def scene():
        parts = bench(polarizer(10.0), polarizer(50.0))
        parts["wall"]["bsdf"] = {"type": "diffuse", "reflectance": 0.0}
        return parts

    check(problem(scene, set_color("wall.bsdf.reflectance.value"), 0.0))


@pytest.mark.parametrize("angle", long([0.0, 30.0], [30.0]))
def test_angle_of_a_polarizer_in_a_chain(angle):
    """Guards against NaN where two frames coincide (0 degrees, at normal incidence) and against stopping at a
    product that is zero: between crossed polarizers the middle one decides whether there is light.
    """
    scene = lambda: bench(polarizer(0.0), polarizer(angle), polarizer(90.0))  # noqa: E731
    p = problem(scene, set_color("element_1.bsdf.theta.value"), angle, step=2.0)
    if angle == 0.0:
        # The light goes as sin(2 theta)^2: no slope, but a finite number.
        for mode in (p.reverse, p.forward):
            assert mode(1) == pytest.approx(0, abs=2e-6)
    else:
        check(p, smallest=1e-5)


@pytest.mark.slow
def test_delay_of_a_wave_plate():
    delta = 0.0
    plate = {"type": "diff_retarder", "theta": 45.0, "delta": delta}
    scene = lambda: bench(polarizer(0.0), plate)  # noqa: E731
    check(problem(scene, set_color("element_1.bsdf.delta.value"), delta, step=2.0), smallest=1e-5)


def test_interface_matrices_are_finite():
    """Guards against sqrt'(0) at Brewster's angle and at the critical angle, and against 0 / 0 without an interface."""
    mi.set_variant(VARIANT)
    plugins.sync()
    angles = np.radians([0.0, 33.690068, 41.810315, 56.309932, 89.9])
    theta, side, lobe = (x.ravel() for x in np.meshgrid(angles, [1, -1], [1e-6, 1 - 1e-6]))
    for index in (1.0, 1.0 + 1e-6, 1.5):
        bsdf = mi.load_dict({"type": "diff_dielectric", "int_ior": index, "ext_ior": 1.0})
        params = mi.traverse(bsdf)
        # One index a lane: none hides in the sum of the others.
        eta = dr.opaque(mi.Float, index, len(theta))
        wi = mi.Vector3f(np.sin(theta), 0.0 * theta, side * np.cos(theta))
        dr.enable_grad(eta, wi)
        params["eta"] = eta
        params.update()
        si = dr.zeros(mi.SurfaceInteraction3f, len(theta))
        si.wi, si.sh_frame = wi, mi.Frame3f(mi.Normal3f(0, 0, 1))
        _, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(lobe), mi.Point2f(0.5), True)
        total = sum(weight[i, j][0] * (1 + i - 0.3 * j) for i in range(4) for j in range(4))
        dr.backward(total)
        for value in (dr.detach(total), dr.grad(eta), *dr.grad(wi)):
            assert np.array(value).shape == theta.shape and np.isfinite(np.array(value)).all()
