"""`gated_hdr_film`, and histograms without a steady image: weights, adjoint, renders against full ones, torch."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.film_storage import storage
from tools.small_room import GREY, WALL_POSE, make_room
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test
from torchtransient.errors import ArgumentError, GradientError, SceneError

VARIANT = "llvm_ad_rgb"
START = 2.0
SMOOTH = "gaussian 6 0.7; tabulated 5:0 5.3:1 7.5:0.2 8:0; gaussian 11 0.2"
SETS = {
    "one": "rectangular 4 6.5",
    "overlapping": SMOOTH,
    "with gaps": "rectangular 3 3.5; rectangular 9 9.01; gaussian 20 1",
    "a sweep": "; ".join(f"tabulated {k * 0.3}:0 {k * 0.3 + 0.4}:1 {k * 0.3 + 0.8}:0" for k in range(60)),
}


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant(VARIANT)
    plugins.sync()


def make_film(gates, **arguments):
    node = {"type": "gated_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "gates": gates}
    with plugins.plugin_errors():
        return mi.load_dict({**node, "start_opl": START, **arguments})


def arrivals(n=700):
    return np.random.default_rng(4).uniform(-1, 25, n)


def expected(film, x):
    return np.stack([gate.value(x) for gate in film.gates], axis=1)


@pytest.mark.parametrize("name", SETS)
def test_weights_are_those_of_the_gates(name):
    film, x = make_film(SETS[name]), arrivals()
    size = film.entries_per_pixel()
    cube = storage(film, len(x) * size)
    value = [mi.Float(1), mi.Float(2), mi.Float(-1)]
    film.put(0, dr.arange(mi.UInt32, len(x)) * size, mi.Float64(x - START), value, mi.Bool(x < 22))
    got = np.array(cube, dtype=float).reshape(len(x), -1, 3)
    want = expected(film, x) * (x < 22)[:, None]
    np.testing.assert_allclose(got[..., 0], want, atol=1e-4)
    np.testing.assert_allclose(got, got[..., :1] * np.array([1, 2, -1]), atol=1e-6)
    assert want.max() > 0.5


def test_slopes():
    film, x = make_film(SMOOTH), arrivals()
    assert film.has_slope and not make_film(SETS["one"]).has_slope
    g = np.random.default_rng(2).normal(size=(3, 3))
    adjoint, h = (mi.Float(g.ravel()), 3, 1), 1e-3

    def read(shift):
        return film.read(adjoint, mi.UInt32(0), mi.Float64(x - START + shift), mi.Bool(True))

    _, slope = read(0.0)
    difference = (np.array(read(h)[0][1]) - np.array(read(-h)[0][1])) / (2 * h)
    error = np.abs(np.array(slope[1]) - difference)
    # but for the few arrivals at a kink
    assert np.sort(error)[-8] < 0.03 * np.abs(difference).max()
    df, fdtau = np.random.default_rng(3).normal(size=(2, 3, len(x)))
    cube = storage(film, 9)
    lists = [mi.Float(v) for v in df], [mi.Float(v) for v in fdtau]
    film.put_slope(0, mi.UInt32(0), mi.Float64(x - START), *lists, mi.Bool(True))
    A, slope = read(0.0)
    want = sum((np.array(A[c]) * df[c] + np.array(slope[c]) * fdtau[c]).sum() for c in range(3))
    assert (np.array(cube).reshape(3, 3) * g).sum() == pytest.approx(want, rel=1e-4)


def test_a_pulse_opens_a_gate_softly():
    film = make_film("rectangular 6 7", pulse="gaussian", pulse_fwhm_opl=0.2)
    assert film.has_slope
    size = film.entries_per_pixel()
    x = np.array([5.9, 6.0, 6.1, 6.5, 7.0])
    cube = storage(film, len(x) * size)
    film.put(0, dr.arange(mi.UInt32, len(x)) * size, mi.Float64(x - START), [mi.Float(1)] * 3, mi.Bool(True))
    weights = np.array(cube).reshape(len(x), 3)[:, 0]
    # half maximum of the density is at 1.177 standard deviations
    np.testing.assert_allclose(weights, [0.1195, 0.5, 0.8805, 1.0, 0.5], atol=2e-3)


@pytest.mark.parametrize(
    "arguments, message",
    [({"gates": "round 1 2"}, "kind out of"), ({"gates": "rectangular 2 1"}, "start before")],
)
def test_errors(arguments, message):
    with pytest.raises(SceneError, match=message):
        make_film(**arguments)
    with pytest.raises(SceneError, match=r"expected gates, .* got none"), plugins.plugin_errors():
        mi.load_dict({"type": "gated_hdr_film"})


# ------------------------------------------------------------------------------------------------ in renders

GATES = (tt.Gate.gaussian(8.0, 0.2), tt.Gate.tabulated([8.2, 8.3, 9.5], [0, 1, 0]), tt.Gate.rectangular(9.0, 10.0))
FINE = tt.TimeAxis(7.0, 0.005, 700)


def mirrored():
    """The small room with a second wall, so that some light takes a long way."""
    room = make_room()
    room["integrator"]["max_depth"] = 6
    room["integrator"]["rr_depth"] = 100
    room["back"] = {**make_room()["wall"], "to_world": np.diag([-4.0, 4.0, -4.0, 1.0])}
    room["back"]["to_world"][2, 3] = 5.0
    return room


def runs(renderer, count=8):
    outs = [renderer(seed=k) for k in range(count)]
    names = (renderer.film.measures, "steady")
    return [torch.stack([getattr(out, name) for out in outs]).double().numpy() for name in names]


def test_gated_render_is_the_full_one_gated_afterwards():
    scene = tt.load(mirrored(), variant=VARIANT)
    gated, steady = runs(tt.TransientRenderer(scene, gates=GATES, spp=512))
    full, _ = runs(tt.TransientRenderer(scene, time_axis=FINE, spp=512))
    profiles = np.stack([gate.value(FINE.centers_opl) for gate in GATES])
    afterwards = np.einsum("kcthw,gt->kcghw", full, profiles)
    result = two_sample_z_test(gated.mean((-1, -2)), afterwards.mean((-1, -2)), rounding=2e-3 * afterwards.max())
    assert result.passed and gated.shape == (8, 3, 3, 3, 4), str(result)
    assert np.all(gated.mean((0, 1, 3, 4)) > 0)
    np.testing.assert_allclose(steady, gated.sum(2), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [{"temporal_filter": "gaussian"}, {"pulse": tt.Pulse.gaussian(0.8, 0.3)}])
def test_cut_windows_keep_what_is_spread_into_them(spread):
    room = mirrored()
    room["integrator"]["gaussian_stddev"] = 2.0
    settings = {"time_axis": tt.TimeAxis(8.5, 0.1, 8), "spp": 512} | spread
    scene = tt.load(room, variant=VARIANT)
    cut, _ = runs(tt.TransientRenderer(scene, steady=False, **settings))
    full, _ = runs(tt.TransientRenderer(scene, **settings))
    # the same paths, some of them shorter
    np.testing.assert_allclose(cut, full, rtol=1e-4, atol=1e-6 * full.max())
    assert full.mean() > 0


def test_derivatives_through_torch():
    scene = tt.load(make_room(), variant=VARIANT)
    renderer = tt.TransientRenderer(scene, parameters=[GREY], gates=GATES[:2], spp=256, grad_seed="same")
    weights = torch.tensor([1.0, -0.5])

    def loss(value):
        out = renderer({GREY: value}, seed=3)
        return ((out.gated.sum((0, 2, 3)) * weights).sum() + 0.3 * out.steady.sum()).double()

    x = renderer.values[GREY].detach()
    gradient = torch.autograd.functional.jacobian(loss, x)
    tangent = torch.ones_like(x)
    forward = torch.func.jvp(loss, (x,), (tangent,))[1]
    torch.testing.assert_close(forward, (gradient * tangent).sum().double(), rtol=1e-4, atol=0)
    h = 0.02
    difference = (loss(x + h * tangent) - loss(x - h * tangent)) / (2 * h)
    assert float(forward) == pytest.approx(float(difference), rel=0.03)


def test_a_rectangular_gate_has_no_derivative_in_time():
    renderer = tt.TransientRenderer(
        tt.load(make_room(), variant=VARIANT), parameters=[WALL_POSE], gates=[tt.Gate.rectangular(7, 8)], spp=4
    )
    with pytest.raises(GradientError, match=r"rectangular gate.*rise from zero"):
        renderer(seed=0)


def test_arguments():
    scene = tt.load(make_room(), variant=VARIANT)
    with pytest.raises(ArgumentError, match="give one of them"):
        tt.TransientRenderer(scene, gates=GATES, time_axis=FINE)
    with pytest.raises(ArgumentError, match=r"tt\.Gate objects"):
        tt.TransientRenderer(scene, gates=[3.0])
    with pytest.raises(ArgumentError, match="gated film has none"):
        tt.TransientRenderer(scene, gates=GATES, temporal_filter="tent")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["area light", "glass", "sky"])
def test_pruning_leaves_every_counted_event(kind):
    """Paths that cannot reach a light in time end early; what is left is the full render, path by path."""
    room = mirrored()
    if kind == "glass":
        room["box"]["bsdf"] = {"type": "diff_dielectric", "int_ior": 1.2, "ext_ior": 1.5}
    elif kind == "area light":
        pose = np.diag([0.3, 0.3, -0.3, 1.0])
        pose[:3, 3] = -0.5, 0.25, 4.0
        room["light"] = {
            "type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 9}}
        }  # fmt: skip
    else:
        room["light"] = {"type": "constant"}
    scene = tt.load(room, variant=VARIANT)
    axis = tt.TimeAxis(8.5, 0.1, 30) if kind == "sky" else tt.TimeAxis(7.5, 0.1, 15)
    cut, _ = runs(tt.TransientRenderer(scene, time_axis=axis, spp=256, steady=False), 2)
    full, _ = runs(tt.TransientRenderer(scene, time_axis=axis, spp=256), 2)
    np.testing.assert_allclose(cut, full, rtol=1e-4, atol=1e-6 * full.max())
    assert np.count_nonzero(full.sum((0, 1, 3, 4))) > 10


def seen_through(index, around):
    """A lamp seen through a block of another index, 2 m thick and 1 m away: the bins, the third of which is ``around``
    an arrival.
    """
    sensor = {
        "type": "radiancemeter", "origin": [0, 0, 4], "direction": [0, 0, -1],
        "film": {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"},
                 "start_opl": around - 0.125, "temporal_bins": 5, "bin_width_opl": 0.05, "steady": False},
    }  # fmt: skip
    block = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).scale([9, 9, 1])}
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5])}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "transient_path", "max_depth": 3}, "sensor": sensor,
        "block": block | {"bsdf": {"type": "diff_dielectric", "int_ior": index, "ext_ior": 1.0}},
        "lamp": lamp | {"emitter": {"type": "area", "radiance": 2.0}},
    })  # fmt: skip
    _, cube = scene.integrator().render(scene, seed=3, spp=4096)
    return np.array(cube, dtype=float)[0, 0, :, 0]


@pytest.mark.slow
def test_glass_that_light_crosses_sooner_than_the_way_is_long():
    """1 + 2 n + 0.5 m, less than the 3.5 m between camera and lamp: the straight line is no bound where a film without
    a steady image ends the paths that are too long for its window.
    """
    for index in (0.85, 1.1):
        values = seen_through(index, 1.5 + 2 * index)
        through = (1 - ((index - 1) / (index + 1)) ** 2) ** 2
        assert values.sum() == values[2] == pytest.approx(2.0 * through, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("lamp", [None, {"type": "point", "position": [0, 0, 30], "intensity": 1e-6}])
def test_a_sky_over_a_wall(lamp):
    """ρ L of a film without a steady image; and where a lamp that is far from all else has a place, the sky has
    none.
    """
    film_of_one = {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "start_opl": 0.0,
                   "temporal_bins": 60, "bin_width_opl": 0.1, "steady": False}  # fmt: skip
    sensor = {"type": "radiancemeter", "origin": [0, 0, 0.5], "direction": [0, 0, -1], "film": film_of_one}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "transient_path", "max_depth": 2}, "sensor": sensor,
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.4}},
        "sky": {"type": "constant", "radiance": 3.0}, **({"lamp": lamp} if lamp else {}),
    })  # fmt: skip
    totals = [np.array(scene.integrator().render(scene, seed=k, spp=8192)[1]).sum() / 3 for k in range(6)]
    assert np.std(totals) < 0.01 * 1.2
    assert np.mean(totals) == pytest.approx(1.2, rel=0.01)
