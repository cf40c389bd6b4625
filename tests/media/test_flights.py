"""Single flights through media and the depth of straight legs, by closed forms in double precision."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.media_scenes import rgb, volume
from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.transport import free_flight as free_flight
from torchtransient.plugins.transport import free_flight as optical_depth
from torchtransient.plugins.transport import scene_contents as media_contents
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_rgb"
RATES = np.array([0.5, 1.25, 2.0])
DOWN = np.array([0.0, 0.0, -1.0])


def settings(**changes):
    """Of homogeneous media that no boundary is open to."""
    return Local(**({"homogeneous": True, "heterogeneous": False, "rate_floor": None, "open_boundaries": False,
                     "geometry": False, "extinction_changes": True, "surfaces": None} | changes))  # fmt: skip


def fog(rates=tuple(RATES)):
    return mi.load_dict({"type": "homogeneous", "sigma_t": rgb(*(float(x) / 4 for x in rates)), "scale": 4.0})


@functools.cache
def kept(kind, *arguments):
    """One medium of a kind: a pointer does not keep what it points to."""
    return {"fog": fog, "cloud": cloud}[kind](*arguments)


def cloud():
    """A density of 0.7 in the cube from -1 to 1, sampled at a rate of 1.75."""
    density = volume(np.full((2, 2, 2), 0.7)) | {"max_value": 1.75}
    return mi.load_dict({"type": "heterogeneous", "sigma_t": density, "albedo": 0.5})


def downwards(x=(0.0,), z=3.0):
    d = mi.Vector3f(0, 0, mi.Float([-1.0] * len(x)))
    return mi.Ray3f(mi.Point3f(mi.Float(list(x)), 0.1, z), d, 0.25, [])


def numbers(*drawn):
    """A generator of these numbers, one after the other."""
    left = [mi.Float(list(each)) for each in drawn]
    return Local(next_float32=lambda: left.pop(0))


def spectrum(lanes):
    return mi.UnpolarizedSpectrum(np.array(lanes, dtype=np.float32).T)


# ------------------------------------------------------------------------------------------------------------- pieces


def test_channels_are_drawn_by_the_light_they_carry():
    """Alike where there is none."""
    p = free_flight.channel_probabilities(spectrum([[2, 1, 5], [0, 0, 0]]))
    np.testing.assert_allclose(np.array(p).T, [[0.25, 0.125, 0.625], [1 / 3] * 3], rtol=1e-6)
    u = mi.Float([0, 0.49, 0.5, 0.74, 0.75, 0.99])
    value = free_flight.value_of_channel(mi.UnpolarizedSpectrum(3, 5, 7), mi.UnpolarizedSpectrum(0.5, 0.25, 0.25), u)
    assert np.array(value).tolist() == [3, 3, 5, 5, 7, 7]


def test_nothing_is_attenuated_where_there_is_nothing():
    """However long the way is."""
    found = free_flight.attenuation(mi.Float([0, 2, 3]), mi.Float([np.inf, 0.25, 0]))
    np.testing.assert_allclose(np.array(found), [1, np.exp(-0.5), 1], rtol=1e-6)


def test_the_point_of_a_collision():
    medium, ray = kept("fog"), downwards((0.5, 1.5))
    mei = free_flight.medium_interaction(ray, mi.MediumPtr(medium), mi.Float([2, 5]))
    np.testing.assert_allclose(np.array(mei.p), [[0.5, 1.5], [0.1, 0.1], [1, -2]], rtol=1e-6)
    assert np.array(mei.t).tolist() == [2, 5] and mei.time[0] == 0.25
    np.testing.assert_array_equal(np.array(mei.wi)[:, 0], -DOWN)
    np.testing.assert_array_equal(np.array(mei.sh_frame.n)[:, 0], -DOWN)
    assert int(dr.reinterpret_array(mi.UInt32, mei.medium)[0]) == registry_number(medium)


def drawn_from(given, lanes, stream):
    rng = free_flight.generator([mi.Float(x) for x in given], lanes, stream)
    return np.array([np.array(rng.next_float32()) for _ in range(4)])


@pytest.mark.slow
def test_numbers_of_a_line_are_its_own():
    """The same for the same arguments, in every version; others for other lanes, numbers, orders and kinds of lines."""
    lanes = dr.arange(mi.UInt32, 4000)
    one = drawn_from((0.25, 0.75), lanes, free_flight.WALK)
    np.testing.assert_array_equal(drawn_from((0.25, 0.75), lanes, free_flight.WALK), one)
    others = [drawn_from((0.25, 0.5), lanes, free_flight.WALK), drawn_from((0.5, 0.75), lanes, free_flight.WALK),
              drawn_from((0.75, 0.25), lanes, free_flight.WALK), drawn_from((0.25,), lanes, free_flight.WALK),
              drawn_from((0.25, 0.75), lanes, free_flight.SHADOW), np.roll(one, 1, 1), np.roll(one, 1, 0)]  # fmt: skip
    for other in others:
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.05  # 6 / 16000 ** 0.5
    assert abs(one.mean() - 0.5) < 0.015 and one.min() >= 0 and one.max() < 1
    np.testing.assert_array_equal(one[:2, [0, 7]], PINNED)


PINNED = np.array(
    [[0.037224769592285156, 0.20259547233581543], [0.4493851661682129, 0.1536637544631958]], dtype=np.float32
)


# ------------------------------------------------------------------------------------------------------------- flights


@pytest.mark.parametrize("floor", [None, 1.0])
def test_a_flight_through_fog(floor):
    """By the rate of one channel; the weight is the transmittance over the mean of the densities of all. Under a least
    rate they are those of the larger rates.
    """
    u, pick = np.array([0.3, 0.3, 0.6, 0.95, 0.3]), np.array([0.1, 0.3, 0.3, 0.9, 0.1])
    end = np.array([5.0, 5.0, 0.5, 1.5, 5.0])
    carried = np.array([[2, 1, 5], [2, 1, 5], [2, 1, 5], [0, 0, 0], [2, 1, 5.0]])
    inside = np.array([True, True, True, True, False])
    media = settings(rate_floor=None if floor is None else mi.Float(floor))
    collides, real, t, factor = free_flight.tentative_flight(
        media, mi.MediumPtr(kept("fog")), downwards([0.0] * 5), mi.Float(0.25), mi.Float(end), spectrum(carried),
        mi.Float(u), numbers(pick), mi.Bool(inside),
    )  # fmt: skip
    rates = RATES if floor is None else np.maximum(RATES, floor)
    p = np.where(carried.sum(1)[:, None] > 0, carried / np.maximum(carried.sum(1), 1e-9)[:, None], 1 / 3)
    channel = (pick[:, None] >= p.cumsum(1)).sum(1)
    flight = -np.log(1 - u) / rates[channel]
    hits = inside & (0.25 + flight < end)
    assert hits.tolist() == [True, True, False, False, False]
    assert np.array(collides).tolist() == hits.tolist() and np.array(real).all()
    np.testing.assert_allclose(np.array(t)[:4], (0.25 + flight)[:4], rtol=1e-5)
    stretch = np.where(hits, flight, end - 0.25)[:, None]
    density = np.where(hits[:, None], rates, 1) * np.exp(-rates * stretch)
    expected = np.where(inside[:, None], np.exp(-RATES * stretch) / (p * density).sum(1)[:, None], 1)
    np.testing.assert_allclose(np.array(factor).T, expected, rtol=1e-4)


def test_a_flight_of_no_length_ends_nowhere():
    """Where there is no stretch to collide in, the number zero is no collision."""
    media, end = settings(), mi.Float([0.25, 0.5])
    collides, _, t, factor = free_flight.tentative_flight(
        media, mi.MediumPtr(kept("fog")), downwards([0.0] * 2), mi.Float(0.25), end, spectrum([[1, 1, 1.0]] * 2),
        mi.Float(0), numbers([0.5] * 2), mi.Bool(True),
    )  # fmt: skip
    assert np.array(collides).tolist() == [False, True] and t[1] == 0.25
    np.testing.assert_allclose(np.array(factor).T, [[1] * 3, [3 / RATES.sum()] * 3], rtol=1e-6)


def test_where_a_cloud_can_have_density():
    """In its grid, ahead of where the flight is and before its end."""
    x, t, end = [0.5, 0.5, 0.5, 0.5, 9.0, 0.5], [0, 2.5, 0, 5, 1, 0], [10, 10, 2.25, 10, 10, 1.0]
    inside = mi.Bool([True] * 5 + [False])
    found = free_flight.stretch_inside(
        settings(heterogeneous=True), mi.MediumPtr(kept("cloud")), downwards(x), mi.Float(t), mi.Float(end), inside
    )
    begin, until = (np.array(each) for each in found)
    np.testing.assert_allclose(begin[:5], [2, 2.5, 2, 5, 1], rtol=1e-5)
    np.testing.assert_allclose(until[:5], [4, 4, 2.25, 5, 1], rtol=1e-5)
    assert begin[5] == 0
    plain = free_flight.stretch_inside(settings(), None, None, 1.0, 2.0, True)
    assert plain == (1.0, 2.0)


@pytest.mark.parametrize("floor", [None, 3.5])
def test_a_flight_through_a_cloud(floor):
    """Collisions are real by the share of the density; then they weigh one over it, otherwise what is left of the
    sampled rate over its share. Under a least rate a share of a quarter of it is real.
    """
    u, pick = np.array([0.5, 0.5, 0.9995, 0.5]), np.array([0.1, 0.9, 0.1, 0.1])
    inside = np.array([True, True, True, False])
    media = settings(homogeneous=False, heterogeneous=True, rate_floor=None if floor is None else mi.Float(floor))
    collides, real, t, factor = free_flight.tentative_flight(
        media, mi.MediumPtr(kept("cloud")), downwards([0.5] * 4), mi.Float(0), mi.Float(10),
        spectrum([[1, 1, 1.0]] * 4), mi.Float(u), numbers([0.5] * 4, pick), mi.Bool(inside),
    )  # fmt: skip
    rate = 1.75 if floor is None else floor
    chance = 0.4 if floor is None else 0.25
    flight = -np.log(1 - u) / rate
    hits = inside & (flight < 2)
    assert hits.tolist() == [True, True, False, False] and np.array(collides).tolist() == hits.tolist()
    assert np.array(real)[:2].tolist() == [True, False]
    np.testing.assert_allclose(np.array(t)[:3], 2 + flight[:3], rtol=1e-5)
    weight = np.where(pick < chance, 1 / (rate * chance), (rate - 0.7) / (rate * (1 - chance)))
    np.testing.assert_allclose(np.array(factor)[0], np.where(hits, weight, 1), rtol=1e-4)


def test_fog_and_clouds_in_one_scene():
    """Each in its own way: a flight through fog is real and analytic, whatever the number that tells in clouds."""
    media = mi.MediumPtr([kept("fog", (0.7,) * 3), kept("cloud")])
    both = settings(heterogeneous=True)
    _, real, _, factor = free_flight.tentative_flight(
        both, media, downwards([0.5, 0.5], z=0.9), mi.Float(0), mi.Float(1.5), spectrum([[1, 1, 1.0]] * 2),
        mi.Float(0.3), numbers([0.5, 0.5], [0.9, 0.9]), mi.Bool(True),
    )  # fmt: skip
    assert np.array(real).tolist() == [True, False]
    np.testing.assert_allclose(np.array(factor)[0], [1 / 0.7, 1], rtol=1e-4)
    step = free_flight.ratio_tracking_step(
        both, media, downwards([0.5, 0.5], z=0.9), mi.Float(0), mi.Float(1.5), numbers([0.3, 0.3]), mi.Bool(True)
    )
    collides, t, factor = (np.array(each) for each in step)
    assert collides.tolist() == [False, True] and t[1] == pytest.approx(-np.log(0.7) / 1.75, rel=1e-5)
    np.testing.assert_allclose(factor[0], [np.exp(-0.7 * 1.5), 1 - 0.7 / 1.75], rtol=1e-4)


def test_a_step_of_a_shadow_ray():
    """All of a homogeneous stretch; nothing outside of media."""
    t, end, inside = mi.Float(0.5), mi.Float([2.0, 2.0]), mi.Bool([True, False])
    collides, _, factor = free_flight.ratio_tracking_step(
        settings(), mi.MediumPtr(kept("fog")), downwards([0.0] * 2), t, end, numbers([0.3] * 2), inside
    )
    assert not np.array(collides).any()
    np.testing.assert_allclose(np.array(factor).T, [np.exp(-1.5 * RATES), [1] * 3], rtol=1e-5)
    # A shadow ray ends before a grid, or collides in it.
    for u, hits in ((0.5, True), (0.999, False)):
        collides, at, factor = free_flight.ratio_tracking_step(
            settings(homogeneous=False, heterogeneous=True), mi.MediumPtr(kept("cloud")), downwards([0.5]), mi.Float(0),
            mi.Float(9.0), numbers([u]), mi.Bool(True),
        )  # fmt: skip
        assert bool(np.array(collides)[0]) == hits and at[0] == pytest.approx(2 - np.log(1 - u) / 1.75, rel=1e-4)
        assert factor[0][0] == pytest.approx(0.6 if hits else 1, rel=1e-4)


def shadow_rays(length):
    ray = downwards([0.0] * len(length))
    ray.maxt = mi.Float(length) * (1 - mi.math.ShadowEpsilon)
    return ray, mi.Float(length), [mi.Float(0.25), mi.Float(0.5)], dr.arange(mi.UInt32, len(length))


def test_shadow_rays_through_a_block_of_fog():
    """Its length within counts; what lies behind their end does not hide it, nor do open boundaries."""
    block = {"type": "cube", "bsdf": {"type": "null"}, "interior": kept("fog")}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3]).scale(5)}
    scene = mi.load_dict({"type": "scene", "block": block, "wall": wall})
    media = media_contents.FlightSettings(media_contents.media_of(scene, None), None, False)
    ray, length, drawn, lanes = shadow_rays([5, 7, 3, 5])
    nowhere, active = dr.zeros(mi.MediumPtr, 4), mi.Bool([True] * 3 + [False])
    T, visible = free_flight.transmittance(scene, media, ray, length, nowhere, drawn, lanes, active)
    assert np.array(visible).tolist() == [True, False, True, False]
    np.testing.assert_allclose(np.array(T).T[[0, 2]], [np.exp(-2 * RATES), np.exp(-RATES)], rtol=1e-4)
    free = downwards([0.0])
    assert free_flight.closed_surface(scene, media, free, mi.Bool(True)).t[0] == pytest.approx(6, rel=1e-5)
    assert free_flight.closed_surface(scene, None, free, mi.Bool(True)).t[0] == pytest.approx(2, rel=1e-5)


def test_shadow_rays_that_need_no_loop():
    """In one medium, outside of it, and to what is hidden."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3]).scale(5)}
    scene = mi.load_dict({"type": "scene", "wall": wall})
    contents = media_contents.MediaContents([kept("fog")], None, False, False, 1.0)
    ray, length, drawn, lanes = shadow_rays([2, 2, 7])
    number = registry_number(kept("fog"))
    medium = dr.reinterpret_array(mi.MediumPtr, mi.UInt32([number, 0, number]))
    media = media_contents.FlightSettings(contents, None, False)
    T, visible = free_flight.transmittance(scene, media, ray, length, medium, drawn, lanes, mi.Bool(True))
    assert np.array(visible).tolist() == [True, True, False]
    np.testing.assert_allclose(np.array(T).T[:2], [np.exp(-2 * RATES), [1] * 3], rtol=1e-5)


# ---------------------------------------------------------------------------------------------------------------- legs


def leg_of(medium, ends, far, x0=((0.0, 0.1, 3.0),)):
    lanes = len(ends)
    x0 = np.broadcast_to(np.array(x0), (lanes, 3))
    v = Local(ray=downwards([0.0] * lanes), numbers=lambda: [mi.Float(0.25), mi.Float(0.5)])
    points = (mi.Point3f(np.array(each, dtype=np.float32).T) for each in (x0, ends))
    return optical_depth.Leg(v, *points, mi.Vector3f(0, 0, -1), mi.Bool(far), medium, optical_depth.CONNECTING)


def test_a_leg_is_straight_between_its_ends():
    """Or without end."""
    leg = leg_of(mi.MediumPtr(kept("fog")), [[0, 0.1, 1], [2, 0.1, 3], [9, 9, 9]], [False, False, True])
    assert np.array(leg.length).tolist() == [2, 2, np.inf]
    np.testing.assert_allclose(np.array(leg.d).T, [DOWN, [1, 0, 0], DOWN], atol=1e-6)
    np.testing.assert_array_equal(np.array(leg.ray.d), np.array(leg.d))
    before = np.array([2, 2, np.inf]) * (1 - mi.math.ShadowEpsilon)
    np.testing.assert_allclose(np.array(leg.ray.maxt), before, rtol=1e-6)
    assert np.array(leg.lanes).tolist() == [0, 1, 2]


def test_the_depth_of_one_stretch():
    """Up to the surface ahead or the leg's end; none without a medium, or without end."""
    pointers = dr.reinterpret_array(mi.UInt32, mi.MediumPtr(kept("fog")))
    medium = dr.reinterpret_array(mi.MediumPtr, pointers * mi.UInt32([1, 1, 1, 0, 1]))
    leg = leg_of(medium, [[0, 0.1, 0.0]] * 5, [False, False, True, False, False])
    pi = dr.zeros(mi.PreliminaryIntersection3f, 5)
    pi.t, pi.valid = mi.Float([2, np.inf, np.inf, 2, 2]), mi.Bool([True, False, False, True, True])
    part = optical_depth.Stretch(None, mi.Float(0.5), pi, medium, mi.Float(0.3))
    active = mi.Bool([True] * 4 + [False])
    depth = optical_depth.optical_depth(settings(), leg, part, leg.x0, leg.x1, active)
    np.testing.assert_allclose(np.array(depth).T, np.outer([1.5, 2.5, 0, 0, 0], RATES), rtol=1e-5)


def test_the_depth_of_a_stretch_in_a_grid():
    """Of the grid alone, at a point that a number chooses: twice as dense below."""
    data = np.zeros((4, 2, 2), dtype=np.float32)
    data[:2], data[2:] = 1.4, 0.7
    density = volume(data) | {"filter_type": "nearest"}
    grid = mi.load_dict({"type": "heterogeneous", "sigma_t": density, "albedo": 0.5})
    medium = mi.MediumPtr(grid)
    leg = leg_of(medium, [[0.5, 0.1, -9.0]] * 4, [False] * 4, [[0.5, 0.1, 3.0]] * 3 + [[9.0, 0.1, 3.0]])
    pi = dr.zeros(mi.PreliminaryIntersection3f, 4)
    pi.t = mi.Float(np.inf)
    part = optical_depth.Stretch(None, mi.Float([0, 0, 3.5, 0]), pi, medium, mi.Float([0.25, 0.75, 0.5, 0.5]))
    media = settings(homogeneous=False, heterogeneous=True)
    depth = optical_depth.optical_depth(media, leg, part, leg.x0, leg.x1, mi.Bool(True))
    np.testing.assert_allclose(np.array(depth)[0][:3], [0.7 * 2, 1.4 * 2, 1.4 * 0.5], rtol=1e-4)


@pytest.mark.parametrize("forward", [False, True])
def test_derivatives_of_the_transmittance_of_a_leg(forward):
    """Minus its length by the rate, and minus the rate along it by its ends: in both modes, of active lanes."""
    medium = fog()
    params = mi.traverse(medium)
    key = next(key for key in params.properties if "sigma_t" in key)
    rate, x0, x1 = (type(x)(x) for x in (params[key], mi.Point3f(0, 0.1, 3), mi.Point3f([0, 0, 0], 0.1, [1, 0.5, 0])))
    dr.enable_grad(rate, x0, x1)
    params[key] = rate
    params.update()
    leg = leg_of(mi.MediumPtr(medium), [[0, 0.1, 1], [0, 0.1, 0.5], [0, 0.1, 0]], [False] * 3)
    active = mi.Bool([True, True, False])
    one = optical_depth.with_log_slope(None, settings(geometry=True), leg, x0, x1, rate, active)
    np.testing.assert_array_equal(np.array(one), 1)
    lengths = np.array([2, 2.5, 0])
    if forward:
        moves = (mi.Color3f(0.25, 0.5, 0.75), mi.Vector3f(0, 0, 0.25), mi.Vector3f(5, 7, mi.Float([0.5, 1, 2])))
        for value, tangent in zip((rate, x0, x1), moves, strict=True):
            dr.set_grad(value, tangent)
        dr.enqueue(dr.ADMode.Forward, rate, x0, x1)
        dr.traverse(dr.ADMode.Forward)
        longer = np.array([0.25 - 0.5, 0.25 - 1, 0])
        expected = -(np.outer(lengths, [1, 2, 3]) + np.outer(longer, RATES))
        np.testing.assert_allclose(np.array(dr.grad(one)).T, expected, rtol=1e-4, atol=1e-5)
        return
    g = np.array([[1, 2, 3], [5, 7, 11], [13, 17, 19.0]])
    dr.backward(dr.sum(dr.sum(one * spectrum(g))))
    np.testing.assert_allclose(np.array(dr.grad(rate)).ravel(), -4 * (lengths[:, None] * g).sum(0), rtol=1e-4)
    along = (g @ RATES) * [1, 1, 0]
    np.testing.assert_allclose(np.array(dr.grad(x1))[2], along, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.array(dr.grad(x0)).ravel(), [0, 0, -along.sum()], rtol=1e-4, atol=1e-4)


def test_transmittances_that_nothing_changes():
    assert optical_depth.with_log_slope(None, settings(extinction_changes=False), None, None, None, None, None) == 1


@pytest.mark.parametrize(("geometry", "forward"), [(True, False), (True, True)])
def test_derivatives_of_a_leg_through_two_blocks(geometry, forward):
    """Minus the length within each by its own rate, whatever lies between; of its ends, the one in a medium counts."""
    blocks = {}
    for name, z, rates in (("a", 0, (0.5, 1.25, 2.0)), ("b", -3, (0.7, 0.3, 1.1))):
        medium = {"type": "homogeneous", "sigma_t": rgb(*(x / 4 for x in rates)), "scale": 4.0}
        pose = mi.ScalarTransform4f().translate([0, 0, z])
        blocks[name] = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium, "to_world": pose}
    scene = mi.load_dict({"type": "scene", **blocks}, optimize=False)
    params = mi.traverse(scene)
    keys = [next(key for key in params.properties if key.startswith(name) and "sigma_t" in key) for name in "ab"]
    x0, x1 = mi.Point3f(0, 0.1, 3), mi.Point3f(0, 0.1, mi.Float([-2.5, -2.25, 0.5, -2.5]))
    rates = [type(params[key])(params[key]) for key in keys]
    dr.enable_grad(x0, x1, *rates)
    for key, rate in zip(keys, rates, strict=True):
        params[key] = rate
    params.update()
    contents = media_contents.media_of(scene, None)
    media = media_contents.FlightSettings(contents, Local(geometry=geometry, extinction=True), False)
    ends = np.array(dr.detach(x1)).T
    leg = leg_of(dr.zeros(mi.MediumPtr, 4), ends, [False] * 4)
    active = mi.Bool([True] * 3 + [False])
    one = optical_depth.with_log_slope(scene, media, leg, x0, x1, rates[0], active)
    np.testing.assert_array_equal(np.array(one), 1)
    lengths = np.array([[2, 2, 0.5, 0], [0.5, 0.25, 0, 0]])
    last = np.array([[0.7, 0.3, 1.1]] * 2 + [[0.5, 1.25, 2.0], [0, 0, 0]]) * geometry
    if forward:
        moves = mi.Color3f(1, 2, 3) / 16, mi.Color3f(3, 5, 7) / 4, mi.Vector3f(0, 0, 11), mi.Vector3f(5, 7, 0.25)
        for value, tangent in zip((*rates, x0, x1), moves, strict=True):
            dr.set_grad(value, tangent)
        dr.enqueue(dr.ADMode.Forward, *rates, x0, x1)
        dr.traverse(dr.ADMode.Forward)
        expected = -np.outer(lengths[0], [0.25, 0.5, 0.75]) - np.outer(lengths[1], [3, 5, 7]) + 0.25 * last
        np.testing.assert_allclose(np.array(dr.grad(one)).T, expected, rtol=1e-3, atol=1e-4)
        return
    g = np.array([[1, 2, 3], [5, 7, 11], [13, 17, 19], [23, 29, 31.0]])
    dr.backward(dr.sum(dr.sum(one * spectrum(g))))
    for rate, length in zip(rates, lengths, strict=True):
        np.testing.assert_allclose(np.array(dr.grad(rate)).ravel(), -4 * length @ g, rtol=1e-3)
    np.testing.assert_allclose(np.array(dr.grad(x1))[2], (g * last).sum(1), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(np.array(dr.grad(x0))[2], 0, atol=1e-2)
