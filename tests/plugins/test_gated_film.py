"""`gated_hdr_film`, and histograms without a steady image: weights, adjoint, renders against full ones, torch."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.film_storage import storage
from support.marks import long
from tools.small_room import GREY, WALL_POSE, make_room
from torchtransient import plugins
from torchtransient.accuracy import two_sample_z_test
from torchtransient.errors import ArgumentError, GradientError, SceneError
from torchtransient.files import read_result, write_result
from torchtransient.gates import Gate
from torchtransient.plugins.films.block import ArrivalWindow, GappedWindow
from torchtransient.plugins.sampling.lights import LightBox

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


READ = [("overlapping", "film", True), ("with gaps", "channels first", False), ("a sweep", "channels first", True)]


@pytest.mark.parametrize(("name", "layout", "steady"), READ)
def test_read_is_the_transpose_of_put(name, layout, steady):
    film, x = make_film(SETS[name]), arrivals()
    rng, pixels, gates = np.random.default_rng(1), 5, film.gate_count()
    n = len(x)
    pixel, value = rng.integers(0, pixels, n), rng.normal(size=(3, n))
    g, g_steady = rng.normal(size=(pixels, gates, 3)), rng.normal(size=(pixels, 3)) * steady
    active, opl = mi.Bool(rng.random(n) > 0.1), mi.Float64(x - START)
    cube = storage(film, pixels * gates * 3)
    film.put(0, mi.UInt32(pixel) * (gates * 3), opl, [mi.Float(v) for v in value], active)
    if layout == "film":
        adjoint, base = (mi.Float(g.ravel()), 3, 1), mi.UInt32(pixel) * (gates * 3)
    else:
        adjoint, base = (mi.Float(g.transpose(2, 1, 0).ravel()), pixels, gates * pixels), mi.UInt32(pixel)
    A, _ = film.read(adjoint, base, opl, active, [mi.Float(g_steady[pixel, c]) for c in range(3)] if steady else None)
    dr.eval(cube, A)  # in one kernel
    stored = np.array(cube, dtype=float).reshape(g.shape)
    total = (stored * (g + g_steady[:, None])).sum()
    read = sum((np.array(A[c], dtype=float) * value[c] * np.array(active)).sum() for c in range(3))
    assert abs(total - read) < 2e-6 * np.abs(stored * g).sum()


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


def test_gates_see_nothing_before_and_behind_them():
    """From its start on, until before its end; nor what never arrives. No gate is asked where none is open."""
    ramp = Gate.tabulated([3.0, 5.0, 9.0], [2.0, 4.0, 8.0])
    from torchtransient.plugins.films.gated import GateTable

    table = GateTable([ramp, Gate.rectangular(12.0, 13.0)], 1.0)
    at = np.array([3.0, np.nextafter(3.0, 0), 4.0, 7.0, np.nextafter(9.0, 0), 9.0, np.inf, -np.inf])
    value, slope = table.value(mi.UInt32(0), mi.Float64(at - 1.0), mi.Bool([True] * 8))
    np.testing.assert_allclose(np.array(value), [2, 0, 3, 6, 8, 0, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(np.array(slope), [1, 0, 1, 1, 1, 0, 0, 0], rtol=1e-5)
    value, slope = table.value(mi.UInt32(0), mi.Float64(4.0), mi.Bool([True, False]))
    assert (list(np.array(value)), list(np.array(slope))) == ([4, 0], [1, 0])
    asked = np.array([2.9, 3.0, 6.0, 12.5, np.nextafter(13.0, 0), 13.0, np.inf])
    low, high = (np.array(part) for part in table.candidates(mi.Float64(asked - 1.0), mi.Bool(True)))
    np.testing.assert_array_equal(high - low, [0, 1, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(low[[1, 2, 3, 4]], [0, 0, 1, 1])
    low, high = table.candidates(mi.Float64(5.0), mi.Bool([True, False]))
    assert list(np.array(high)) == [1, 0]
    assert table.open_cells[[0, 2000, -1]].tolist() == [1, 1, 1] and not table.open_cells[2500:3600].any()


def test_windows_count_from_their_start_until_before_their_end():
    """With gaps, cells of equal length count or not."""
    at = np.array([1.9999, 2.0, 3.4999, 3.5, 4.9999, 5.0, 6.4999, 6.5, 7.0, 7.9999, 8.0, np.inf])
    window = ArrivalWindow(2, 8)
    assert np.array(window.counts(mi.Float64(at))).tolist() == [False] + [True] * 9 + [False] * 2
    assert np.array(window.over(mi.Float64(at))).tolist() == [False] * 10 + [True] * 2
    gapped = GappedWindow(2, 8, [1, 0, 0, 1])
    expected = [False, True, True] + [False] * 4 + [True] * 3 + [False] * 2
    assert np.array(gapped.counts(mi.Float64(at))).tolist() == expected
    assert np.array(gapped.over(mi.Float64(at))).tolist() == [False] * 10 + [True] * 2


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


def test_gates_are_needed():
    with pytest.raises(SceneError, match="expected gates"), plugins.plugin_errors():
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
def test_a_histogram_without_steady_image():
    scene = tt.load(mirrored(), variant=VARIANT)
    axis = tt.TimeAxis(8.0, 0.1, 12)
    cut, steady = runs(tt.TransientRenderer(scene, time_axis=axis, spp=512, steady=False))
    full, complete = runs(tt.TransientRenderer(scene, time_axis=axis, spp=512))
    # the same paths, some of them shorter
    np.testing.assert_allclose(cut, full, rtol=1e-4, atol=1e-6 * full.max())
    assert full.mean() > 0
    np.testing.assert_allclose(steady, cut.sum(2), rtol=1e-5)
    # there is light that the window misses, and the cut render does not speak of it
    assert complete.mean() > 1.05 * steady.mean()


@pytest.mark.slow
@pytest.mark.parametrize("name, stddev", [("tent", 0.5), ("gaussian", 2.0)])
def test_cut_windows_keep_what_filters_spread_into_them(name, stddev):
    room = mirrored()
    room["integrator"]["gaussian_stddev"] = stddev
    scene = tt.load(room, variant=VARIANT)
    axis = tt.TimeAxis(8.0, 0.1, 12)
    settings = {"time_axis": axis, "spp": 512, "temporal_filter": name}
    cut, _ = runs(tt.TransientRenderer(scene, steady=False, **settings))
    full, _ = runs(tt.TransientRenderer(scene, **settings))
    # the same paths, some of them shorter
    np.testing.assert_allclose(cut, full, rtol=1e-4, atol=1e-6 * full.max())
    assert full.mean() > 0


@pytest.mark.slow
def test_cut_windows_with_a_pulse():
    scene = tt.load(mirrored(), variant=VARIANT)
    settings = {"time_axis": tt.TimeAxis(8.5, 0.1, 8), "spp": 512, "pulse": tt.Pulse.gaussian(0.8, 0.3)}
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


def test_output_and_file(tmp_path):
    scene = tt.load(make_room(), variant=VARIANT)
    renderer = tt.TransientRenderer(scene, gates=GATES, spp=4)
    out = renderer(seed=0)
    assert out.axis is None and out.phasor is None and out.transient is None and out.gates == GATES
    assert out.gated.shape == (3, 3, 3, 4) and "gates=3" in repr(renderer)
    assert out.stats.energy_before == out.stats.energy_after == (0.0,)
    for name in ("a.h5", "a.npz"):
        back = read_result(write_result(tmp_path / name, out))
        assert back.gates == GATES and back.axis is None and torch.equal(back.gated, out.gated)
        assert back.transient is None and back.phasor is None


def test_arguments():
    scene = tt.load(make_room(), variant=VARIANT)
    with pytest.raises(ArgumentError, match="give one of them"):
        tt.TransientRenderer(scene, gates=GATES, time_axis=FINE)
    with pytest.raises(ArgumentError, match=r"tt\.Gate objects"):
        tt.TransientRenderer(scene, gates=[3.0])
    with pytest.raises(SceneError, match=r"does not read .steady."):
        tt.TransientRenderer(scene, gates=GATES, steady=False)
    with pytest.raises(ArgumentError, match="gated film has none"):
        tt.TransientRenderer(scene, gates=GATES, temporal_filter="tent")
    pulsed = tt.load({**make_room(), "sensor": {**make_room()["sensor"], "film": _pulsed()}}, variant=VARIANT)
    with pytest.raises(SceneError, match="would lose"):
        tt.TransientRenderer(pulsed, frequencies=[1.0])
    assert tt.TransientRenderer(pulsed, gates=GATES, spp=1)(seed=0).gates == GATES


def _pulsed():
    return {**make_room()["sensor"]["film"], "pulse": "gaussian", "pulse_fwhm_opl": 0.2}


@pytest.mark.slow
@pytest.mark.parametrize("kind", long(["area light", "glass", "sky"], ["area light"]))
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


def seen_through(index, steady, around):
    """A lamp seen through a block of another index, 2 m thick and 1 m away: the bins, the third of which is ``around``
    an arrival.
    """
    sensor = {
        "type": "radiancemeter", "origin": [0, 0, 4], "direction": [0, 0, -1],
        "film": {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"},
                 "start_opl": around - 0.125, "temporal_bins": 5, "bin_width_opl": 0.05, "steady": steady},
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
@pytest.mark.parametrize("steady", long([False, True], [False]))
def test_glass_that_light_crosses_sooner_than_the_way_is_long(steady):
    """1 + 2 n + 0.5 m, less than the 3.5 m between camera and lamp: the straight line is no bound where a film without
    a steady image ends the paths that are too long for its window.
    """
    for index in (0.85, 1.1):
        values = seen_through(index, steady, 1.5 + 2 * index)
        through = (1 - ((index - 1) / (index + 1)) ** 2) ** 2
        assert values.sum() == values[2] == pytest.approx(2.0 * through, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("steady", long([False, True], [False]))
@pytest.mark.parametrize("lamp", [None, {"type": "point", "position": [0, 0, 30], "intensity": 1e-6}])
def test_a_sky_over_a_wall(steady, lamp):
    """ρ L, whatever the film keeps beside its bins; and where a lamp that is far from all else has a place, the sky has
    none.
    """
    film_of_one = {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}, "start_opl": 0.0,
                   "temporal_bins": 60, "bin_width_opl": 0.1, "steady": steady}  # fmt: skip
    sensor = {"type": "radiancemeter", "origin": [0, 0, 0.5], "direction": [0, 0, -1], "film": film_of_one}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "transient_path", "max_depth": 2}, "sensor": sensor,
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.4}},
        "sky": {"type": "constant", "radiance": 3.0}, **({"lamp": lamp} if lamp else {}),
    })  # fmt: skip
    totals = [np.array(scene.integrator().render(scene, seed=k, spp=8192)[1]).sum() / 3 for k in range(6)]
    assert np.std(totals) < 0.01 * 1.2
    assert np.mean(totals) == pytest.approx(1.2, rel=0.01)


def test_light_box():
    with mi.variant_context(VARIANT):
        plugins.sync()
        lamp = {"type": "sphere", "center": [0, 0, 3], "radius": 0.5, "emitter": {"type": "area"}}
        scene = mi.load_dict({"type": "scene", "lamp": lamp, "spot": {"type": "point", "position": [2, 0, 3]}})
        p = mi.Point3f([0, 1, -1, 4], [0, 0, 0, 4], [0, 3, 3, 3])
        box = LightBox.from_scene(scene, [])
        np.testing.assert_allclose(box.distance(p), [2.5, 0, 0.5, np.hypot(2, 3.5)], rtol=2e-5)
        glass = mi.load_dict({"type": "dielectric"})
        assert LightBox.from_scene(scene, [glass]) is None
        assert LightBox.from_scene(mi.load_dict({"type": "scene", "sky": {"type": "constant"}}), []) is None
        lit = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "lamp": lamp})
        assert LightBox.from_scene(lit, []) is None
        sun = {"type": "directional", "direction": [0, 0, -1]}
        assert LightBox.from_scene(mi.load_dict({"type": "scene", "sun": sun, "lamp": lamp}), []) is None
