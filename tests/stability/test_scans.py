"""Hard cases of captures: scenes of every size, times far from the origin, first arrivals, corners."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.nlos_scenes import captures, film, plane, scan_scene, transform

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.usefixtures("no_leftovers")


def far_scene(scale, how):
    """The same capture in another unit of length: everything is ``scale`` times larger."""
    small = scan_scene({"a": plane(1.0, 0.5, 0.1, 0.05)}, "single", third_bounce=how)
    larger = transform().scale(scale)
    for name in ("a", "wall"):
        small[name]["to_world"] = larger @ small[name]["to_world"]
    origin = [scale * x for x in (-0.5, 0.0, 0.25)]
    spot = [scale * x for x in (-0.2, 0.1, 0.0)]
    small["laser"]["to_world"] = transform().look_at(origin, spot, [0, 1, 0])
    axis = {"start": 1.6 * scale, "width": 0.02 * scale, "bins": 150}
    small["wall"]["sensor"] |= {"sensor_origin": origin, "film": film(2, **axis)}
    return small


@pytest.mark.parametrize(("how", "scale"), [("shared", 1e-3), ("paths", 1e3)])
def test_scenes_of_every_size(how, scale):
    """From a millimetre to a kilometre: the same bins, and a brightness that falls with the area.

    Rays of general paths start 9e-5 m (1 + largest coordinate) beside a surface, as all of Mitsuba's. Light that leaves
    there is nearer to what it falls on: 1.3e-4 brighter at a metre, 2.5e-3 at 5 cm. Not for scenes of millimetres.
    """
    offset = 8.94e-5 * (1 + scale / 2) / (0.9 * scale) if how == "paths" and scale < 1 else 0
    here = captures(far_scene(1.0, how), 2**12, 1)[0]
    there = captures(far_scene(scale, how), 2**12, 1)[0] * scale**2
    assert there.sum() == pytest.approx(here.sum(), rel=1e-3 + 2 * offset)
    # A point may fall on the other side of the edge of a bin.
    assert np.abs(there - here).sum() < 0.02 * here.sum()


@pytest.mark.parametrize("how", long(["shared", "paths"], ["paths"]))
def test_time_far_from_the_origin(how):
    """With a laser and a sensor a kilometre away bins of 2 mm keep their place: lengths are doubles."""
    axis = {"width": 2e-3, "bins": 800}
    runs = []
    for distance in (1.0, 1000.0):
        scene = scan_scene({"a": plane(1.0, 0.1)}, "single", account_first_and_last_bounces=True, third_bounce=how)
        origin = np.array([-0.6, 0.0, 0.8]) * distance
        spot = np.array([-0.2, 0.1, 0.0])
        scene["laser"]["to_world"] = transform().look_at(list(origin), list(spot), [0, 1, 0])
        legs = np.linalg.norm(origin - spot) + np.linalg.norm(origin)
        scene["wall"]["sensor"] |= {"sensor_origin": list(origin), "film": film(1, start=float(legs + 1.9), **axis)}
        run = captures(scene, 2**12, 1)[0].reshape(-1)
        runs.append((run.sum(), np.arange(800) @ run / run.sum()))
    # Single precision of a kilometre is 6e-5 m: 0.03 bins for each leg, and as much for the place of the spot.
    assert runs[1][0] == pytest.approx(runs[0][0], rel=1e-3)
    assert abs(runs[1][1] - runs[0][1]) < 0.2


@pytest.mark.slow
def test_many_small_terms():
    """2^22 samples of one point lose no mass against 2^12: beyond 2^16 sums are kept in doubles."""
    few = captures(scan_scene({"a": plane()}, film=film(1)), 2**12, 4)
    many = captures(scan_scene({"a": plane()}, film=film(1)), 2**22, 1)
    assert many.sum() == pytest.approx(few.sum() / 4, rel=2e-4)


@pytest.mark.slow
def test_the_first_arrival_moves():
    """The edge of the first arrival moves with a plate's depth: through a tent its derivative is that of finite
    differences, bin by bin.
    """
    axis = {"start": 1.9, "width": 0.02, "bins": 40, "temporal_filter": "tent"}
    scene = mi.load_dict(scan_scene({"a": plane(1.0, 0.3)}, film=film(1, **axis), third_bounce="shared"))
    parameters = mi.traverse(scene)
    start = mi.Transform4f(parameters["a.to_world"])

    def install(θ):
        parameters["a.to_world"] = mi.Transform4f().translate(mi.Vector3f(0, 0, 1) * θ) @ start
        parameters.update()

    θ = mi.Float(0)
    dr.enable_grad(θ)
    install(θ)
    dr.set_grad(θ, 1.0)
    spp = 2**18
    _, slope = scene.integrator().render_forward(scene, parameters, seed=0, spp=spp)
    slope, h = np.array(slope, dtype=np.float64).reshape(-1), 1e-3
    ends = []
    for sign in (1, -1):
        install(mi.Float(sign * h))
        with dr.suspend_grad():
            ends.append(np.array(scene.integrator().render(scene, seed=0, spp=spp)[1], dtype=np.float64).reshape(-1))
    difference = (ends[0] - ends[1]) / (2 * h)
    assert np.abs(difference).max() > 0
    # A kink of the tent within the step changes a difference by a part h / width of the slope.
    assert np.abs(slope - difference).max() < 0.06 * np.abs(difference).max()
    assert np.abs(slope - difference).sum() < 0.03 * np.abs(difference).sum()


@pytest.mark.slow
def test_corners_and_edges_on():
    """Plates that touch the wall or stand edge-on give finite values and derivatives."""
    edge_on = {"type": "rectangle", "to_world": transform().translate([0.3, 0, 0.5]).rotate([0, 1, 0], -90).scale(0.5)}
    for hidden in ({"a": edge_on}, {"a": plane(1e-6, 0.2)}):
        scene = mi.load_dict(scan_scene(hidden, film=film(2, start=0.0, bins=200, temporal_filter="tent")))
        _, cube = scene.integrator().render(scene, seed=0, spp=4096)
        assert np.isfinite(np.array(cube)).all()
        parameters = mi.traverse(scene)
        place = mi.Transform4f(parameters["a.to_world"])
        dr.enable_grad(place.matrix)
        parameters["a.to_world"] = place
        parameters.update()
        ones = mi.TensorXf(np.ones(np.array(cube).shape, dtype=np.float32))
        scene.integrator().render_backward(scene, parameters, (None, ones), seed=1, spp=4096)
        assert np.isfinite(np.array(dr.grad(place.matrix))).all()
