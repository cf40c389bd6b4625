"""Mitsuba's own users: ``mi.render``, Dr.Jit's derivatives, ``mi.ad.Adam`` and ``dr.wrap`` with these integrators and
films. Every statement of docs/mitsuba.md about them is a test here.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from support.mitsuba_room import as_mitsuba
from tools.small_room import COLOUR, GREY, make_room
from tools.small_room import VARIANT as VARIANT

FILM = {"width": 4, "height": 3, "rfilter": {"type": "box"}}
POSITION = "light.position"


def load(*, film=None, box=True):
    """A room of one's own and its parameters: derivatives are attached to them."""
    room = make_room()
    room["sensor"]["film"] |= {"temporal_filter": "tent"}
    if film is not None:
        room["sensor"]["film"] = FILM | film
    if not box:
        del room["box"]
    scene = mi.load_dict(as_mitsuba(room))
    return scene, mi.traverse(scene)


@pytest.fixture(scope="module")
def room():
    return load()


@pytest.fixture(scope="module")
def wall():
    """Without silhouettes, so that finite differences see the same derivative."""
    return load(box=False)


def put(params, key, value):
    params[key] = value
    params.update()


def test_a_render_is_a_steady_image_and_what_the_film_measures(room):
    scene, params = room
    steady, transient = mi.render(scene, params, spp=4, seed=1)
    assert (steady.shape, transient.shape) == ((3, 4, 3), (3, 4, 24, 3))
    np.testing.assert_allclose(np.array(transient).sum(2), np.array(steady), rtol=1e-5)
    again = mi.render(scene, spp=4, seed=1)[1]
    assert np.array_equal(np.array(again), np.array(transient))
    assert not np.array_equal(np.array(mi.render(scene, spp=4, seed=2)[1]), np.array(transient))


def test_a_film_of_phasors():
    phasors = {"type": "phasor_hdr_film", "wl_mean": 1.0, "wl_sigma": 0.3, "temporal_bins": 24, "bin_width_opl": 0.25}
    scene, params = load(film=phasors)
    steady, found = mi.render(scene, params, spp=4, seed=1)
    assert steady.shape == (3, 4, 3) and found.shape[:2] == (3, 4) and found.shape[-1] == 6


def test_another_integrator_of_the_call(room):
    scene, params = room
    direct = mi.load_dict({"type": "transient_path", "max_depth": 2})
    one = mi.render(scene, params, integrator=direct, spp=4, seed=1)[1]
    all_ = mi.render(scene, params, spp=4, seed=1)[1]
    assert 0 < np.array(one).sum() < np.array(all_).sum()


def arrival(scene, params, seed, **more):
    """The mean arrival time, in bins, weighed by light: a loss that knows when light comes."""
    transient = mi.render(scene, params, spp=256, seed=seed, **more)[1]
    times = mi.TensorXf(np.broadcast_to(np.arange(24.0)[:, None], transient.shape).astype(np.float32))
    return dr.sum(transient * times, axis=None) / dr.sum(transient, axis=None)


def test_reverse_mode_through_the_time_of_flight(wall):
    scene, params = wall
    start = mi.Point3f(params[POSITION])
    params[POSITION] = start
    dr.enable_grad(params[POSITION])
    params.update()
    dr.backward(arrival(scene, params, 1))
    found = dr.grad(params[POSITION]).z[0]
    sides = []
    for step in (0.05, -0.05):
        put(params, POSITION, mi.Point3f(start.x, start.y, start.z + step))
        sides.append(float(np.array(arrival(scene, params, 1)).item()))
    put(params, POSITION, dr.detach(start))
    # Four bins for a metre: the light is 4 m before the wall.
    assert found == pytest.approx((sides[0] - sides[1]) / 0.1, rel=0.02)
    assert found == pytest.approx(4.0, rel=0.2)


def test_forward_mode_equals_reverse_mode(room):
    scene, params = room
    start = mi.Color3f(params[COLOUR])
    share = mi.Float(1.0)
    dr.enable_grad(share)
    put(params, COLOUR, start * share)
    steady, transient = mi.render(scene, params, spp=16, seed=1)
    total = dr.sum(transient * transient, axis=None) + dr.sum(steady, axis=None)
    dr.forward(share, flags=dr.ADFlag.ClearVertices)
    along = dr.grad(total).array[0]
    put(params, COLOUR, start * share)
    steady, transient = mi.render(scene, params, spp=16, seed=1)
    dr.set_grad(share, 0)
    dr.backward(dr.sum(transient * transient, axis=None) + dr.sum(steady, axis=None))
    against = dr.grad(share)[0]
    put(params, COLOUR, dr.detach(start))
    assert along > 0
    assert against == pytest.approx(along, rel=1e-4)


@pytest.mark.slow
def test_the_loop_of_an_optimizer(room):
    scene, params = room
    target = mi.render(scene, spp=64, seed=9)[1]
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer[GREY] = mi.Float(0.3)
    for step in range(15):
        params.update(optimizer)
        transient = mi.render(scene, params, spp=4, seed=step)[1]
        dr.backward(dr.mean(dr.square(transient - target), axis=None))
        optimizer.step()
    found = float(optimizer[GREY][0])
    put(params, GREY, mi.Float(0.5))
    assert found == pytest.approx(0.5, abs=0.05)


def test_inside_of_dr_wrap(room):
    """One call and one backward are right; what is not: tests/rendering/test_wrap.py."""
    scene, params = room

    @dr.wrap(source="torch", target="drjit")
    def render(x, seed):
        put(params, COLOUR, dr.unravel(mi.Color3f, x.array))
        return mi.render(scene, params, spp=64, seed=seed)[1]

    x = torch.tensor([0.8, 0.5, 0.2], requires_grad=True)
    loss = render(x, 1).sum()
    loss.backward()
    # The light is a parabola of the colour: central differences have no error of their own, but for noise.
    for n in range(3):
        step = torch.eye(3)[n] * 0.1
        with torch.no_grad():
            slope = (render(x + step, 1).sum() - render(x - step, 1).sum()) / 0.2
        assert float(x.grad[n]) == pytest.approx(float(slope), rel=0.03)
    put(params, COLOUR, mi.Color3f(0.8, 0.5, 0.2))
