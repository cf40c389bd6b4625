"""Derivatives of captures: forward mode, reverse mode and finite differences agree."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long_rows
from support.moved_captures import MovedCapture, move, turn
from support.nlos_scenes import film, plane, scan_scene, side, transform
from torchtransient.errors import TorchTransientWarning

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.usefixtures("no_leftovers")


def add(start, θ):
    return start + θ


def capture_of(description, key, change):
    """Of a loss that every case changes by more than the rounding of its differences."""
    return MovedCapture(description, key, change, wave=lambda i: np.sin(3 + 0.15 * i))


CASES = {
    "depth": ("a.to_world", lambda: move(0, 0, 1), 4e-3),
    "sideways": ("a.to_world", lambda: move(1, 0, 0), 4e-3),
    "turns": ("a.to_world", lambda: turn((0.1, 0.05, 1.0)), 8e-3),
    "albedo": ("a.bsdf.reflectance.value", lambda: add, 0.02),
    "albedo of the wall": ("wall.bsdf.reflectance.value", lambda: add, 0.02),
    "the wall": ("wall.to_world", lambda: move(0, 0, 1), 4e-3),
    "energy": ("laser.energy.value", lambda: add, 0.02),
    "sensor": ("wall.sensor.sensor_origin", lambda: move(1, 0, 0), 4e-3),
}
SMOOTH = {"start": 1.0, "width": 0.05, "bins": 100, "temporal_filter": "tent"}


def plate(**changes):
    return {"a": plane(1.0, 0.6, 0.1, 0.05, **changes)}


def check(capture, h, seeds, spp, most_error, slack=0.0):
    """Both modes are one derivative, which is that of differences within four standard errors."""
    reverse = np.array([capture.reverse(seed, spp) for seed in range(seeds)])
    assert capture.forward(0, spp) == pytest.approx(reverse[0], rel=1e-3)
    differences = np.array([capture.difference(h, 20 + seed, spp) for seed in range(seeds)])
    error = np.sqrt((reverse.var(ddof=1) + differences.var(ddof=1)) / seeds)
    assert abs(reverse.mean() - differences.mean()) < 4 * error + slack * abs(reverse.mean())
    assert error < most_error * abs(reverse.mean())


# Both kinds by turns.
ROWS = [(case, ("confocal", "single")[n % 2]) for n, case in enumerate(CASES)]


@pytest.mark.parametrize(("case", "kind"), long_rows(ROWS, ROWS[:2]))
def test_shared_samples(case, kind):
    """Within 0.1 % of finite differences where nothing hides the body and its outline moves; modes agree."""
    key, change, h = CASES[case]
    capture = capture_of(scan_scene(plate(), kind, film(3, **SMOOTH)), key, change())
    spp = 2**16
    reverse = capture.reverse(0, spp)
    assert capture.forward(0, spp) == pytest.approx(reverse, rel=1e-4, abs=1e-7)
    difference = np.mean([capture.difference(h, seed, spp) for seed in range(3)])
    scale = abs(capture.loss(0.0, 0, spp))
    # Moved sensors shift the rounding of their rays, and a bin of an arrival with it.
    assert reverse == pytest.approx(difference, rel=1e-3, abs=(2e-4 if case == "sensor" else 2e-5) * scale)
    if case == "sensor":  # what moves the sensor alone moves nothing: its points are those of the wall
        assert abs(reverse) < 1e-6 * scale
    else:
        assert abs(reverse) > 1e-3 * scale


@pytest.mark.slow
def test_pose_of_the_laser():
    """It moves the spot of a single capture, and the first leg of any."""
    scene = scan_scene(plate(), "single", film(3, **SMOOTH), account_first_and_last_bounces=True)
    capture = capture_of(scene, "laser.to_world", move(1, 0, 0))
    spp = 2**14
    reverse = capture.reverse(0, spp)
    assert capture.forward(0, spp) == pytest.approx(reverse, rel=1e-4)
    assert reverse == pytest.approx(np.mean([capture.difference(4e-3, seed, spp) for seed in range(3)]), rel=2e-3)
    assert abs(reverse) > 1e-3 * abs(capture.loss(0.0, 0, spp))


@pytest.mark.slow
def test_a_wall_moves_behind_points_that_are_given():
    """The sensor is the wall's, but its rays go to the points and stay."""
    scene = scan_scene(plate(), "single", film(2, **SMOOTH), third_bounce="paths")
    grid = np.float32([[x, y, 0] for y in (-0.2, 0.2) for x in (-0.2, 0.2)])
    scene["wall"]["sensor"] |= {"points": mi.TensorXf(grid)}
    capture = capture_of(scene, "wall.to_world", move(0, 0, 1))
    check(capture, 4e-3, 4, 2**14, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "kind"), [("sideways", "single"), ("albedo of the wall", "single"),
                                            ("the wall", "exhaustive")])  # fmt: skip
def test_general_paths(case, kind):
    key, change, h = CASES[case]
    scene = scan_scene(plate(), kind, film(2 if kind == "exhaustive" else 3, kind=kind, **SMOOTH), third_bounce="paths")
    check(capture_of(scene, key, change()), h, 16, 2**12, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["a.to_world", "b.bsdf.reflectance.value"])
def test_late_light(key):
    """Light of four and five bounces, which a second plate sends to the first one."""
    change, h = (add, 0.02) if key.endswith("value") else (move(1, 0, 0), 3e-2)
    scene = scan_scene(plate() | {"b": side()}, "confocal", film(2, **SMOOTH), max_depth=5, min_bounces=4)
    check(capture_of(scene, key, change), h, 8, 2**15, 0.05)


FILMS = [("phasors", "confocal"), ("gates", "single"), ("gaussian", "exhaustive"), ("no steady image", "confocal")]


@pytest.mark.parametrize(("name", "kind"), long_rows(FILMS, FILMS[:2]))
def test_films(name, kind):
    """Every film and every type of capture has derivatives in both modes."""
    changes = {
        "phasors": {"type": "phasor_hdr_film", "frequencies": "0.4, 0.9, 1.6", "start_opl": 1.0},
        "gates": {"type": "gated_hdr_film", "gates": "gaussian 2.2 0.3; gaussian 2.6 0.5"},
        "gaussian": {**film(**SMOOTH), "temporal_filter": "gaussian"},
        "no steady image": {**film(**SMOOTH), "steady": False},
    }[name]
    points = 2 if kind == "exhaustive" else 3
    size = {k: v for k, v in film(points, kind=kind).items() if not k.startswith(("temporal", "bin", "start", "type"))}
    capture = capture_of(scan_scene(plate(), kind, changes | size), "a.to_world", move(0, 0, 1))
    # Across a gate of 0.3 m a longer step would be seen: (2 h)^2 / sigma^2 / 6 of the slope.
    check(capture, 4e-3, 4, 2**12, 0.15, slack=2e-3)


def bitmap(values=((0.2, 0.9, 0.3), (0.5, 0.4, 0.8))):
    data = mi.Bitmap(np.array(values, dtype=np.float32)[..., None])
    return {"type": "bitmap", "bitmap": data, "raw": True, "wrap_mode": "clamp"}


@pytest.mark.parametrize(("key", "by_caller"), [("a.bsdf.reflectance.data", True),
                                                ("wall.bsdf.reflectance.data", False)])  # fmt: skip
def test_tangents_arrive_whoever_brings_them(key, by_caller):
    """Set on a value of the scene itself or on what it comes from, propagated by the caller or not."""
    hidden = plate()
    hidden["a"]["bsdf"] = {"type": "diffuse", "reflectance": bitmap()}
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": bitmap()}}
    capture = MovedCapture(
        scan_scene(hidden, "single", film(3, **SMOOTH), wall=wall), key, lambda start, θ: start * (1 + θ)
    )
    expected = capture.reverse(0, 2**10)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    dr.set_grad(θ, 1.0)
    capture.install(θ)
    if by_caller:
        dr.enqueue(dr.ADMode.Forward, θ)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    forward = capture.weighed(capture.scene.integrator().render_forward(capture.scene, capture.parameters, spp=2**10))
    assert forward == pytest.approx(expected, rel=1e-4)
    assert abs(forward) > 0


def test_mirrored_shapes_move_as_others_do():
    """Their geometric normals point behind."""
    hidden = plate()
    hidden["a"]["to_world"] = transform().translate([0.1, 0.05, 1.0]).rotate([0, 1, 0], 160).scale([-0.3, 0.3, 1])
    scene = scan_scene(hidden, "single", film(3, **SMOOTH))
    check(capture_of(scene, "a.to_world", turn((0.1, 0.05, 1.0))), 8e-3, 6, 2**13, 0.05, slack=1e-3)


def test_tangents_that_a_traversal_has_cleared_are_said():
    capture = MovedCapture(scan_scene(plate(), "single", film(3, **SMOOTH)), "a.bsdf.reflectance.value", add)
    θ = mi.Float(0)
    dr.enable_grad(θ)
    capture.install(θ)
    with pytest.warns(TorchTransientWarning, match="no tangent has come"):
        capture.scene.integrator().render_forward(capture.scene, capture.parameters, spp=16)
    with warnings.catch_warnings():
        warnings.simplefilter("error", TorchTransientWarning)
        assert capture.forward(0, 16) != 0
