"""Renders of moving scenes against closed forms, and against renders of many instants."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.moving_scenes import (
    BEAT_HZ,
    EXPOSURE_S,
    FREQUENCIES,
    MODULATION_HZ,
    corner,
    moving_scene,
    wall,
    wall_phasor,
)
from support.sweeps import together
from tools.small_room import make_room
from torchtransient.errors import (
    ArgumentError,
    PhysicsError,
    PhysicsWarning,
    ShapeError,
    UnitError,
    UnknownKeyError,
)
from torchtransient.motion import SlowTimes

VARIANT = "llvm_ad_rgb"
HETERODYNE = tt.Exposure(EXPOSURE_S, beat_hz=BEAT_HZ)
TOWARDS = tt.Motion(linear=(0.0, 0.0, -10.0))


def renderer_of(scene, *keys, **settings):
    return tt.TransientRenderer(tt.load(scene, variant=VARIANT), list(keys), **settings)


@pytest.fixture(scope="module")
def facing():
    """A wall two metres before camera and lamp."""
    scene = moving_scene(wall=wall((0, 0, 2), (0, 0, 0)))
    return renderer_of(scene, "wall.to_world", spp=256, frequencies=FREQUENCIES)


def instants(renderer, moving, seed, **settings):
    """The average of 64 instants with the beat, by a quadrature of its own."""
    x, g = np.polynomial.legendre.leggauss(64)
    t = EXPOSURE_S / 2 * x
    frames = tt.over_time(renderer, moving, tt.Frames(t), seed=seed, **settings).phasor.detach().numpy()
    weights = g / 2 * np.exp(2j * np.pi * BEAT_HZ * t)
    return np.tensordot(weights, frames.astype(complex), 1)


def relative(found, truth):
    found = found.detach().numpy() if isinstance(found, torch.Tensor) else found
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


def test_a_wall_that_comes_nearer(facing):
    """Its distance and its brightness change: the second makes 62 % of the beat. What three poses leave is the fourth
    degree in time, (30 mm of a wavelength of 10 m)^3, and rounding of a phasor of 260 times the signal.
    """
    x, g = np.polynomial.legendre.leggauss(200)
    t = EXPOSURE_S / 2 * x
    truth = (g / 2 * wall_phasor(2 - 10 * t) * np.exp(2j * np.pi * BEAT_HZ * t)).sum()
    out = tt.over_time(facing, {"wall": TOWARDS}, HETERODYNE, seed=0)
    assert out.phasor.shape == (3, 1, 1, 1) and out.phasor.dtype == torch.complex64
    assert relative(out.phasor, np.full((3, 1, 1, 1), truth)) < 2e-4
    plain = tt.over_time(facing, {"wall": TOWARDS}, tt.Exposure(EXPOSURE_S), seed=0)
    speed = tt.sensing.heterodyne_speed(out.phasor, plain.phasor, MODULATION_HZ, duration_s=EXPOSURE_S)
    # The curvature of the brightness, 3 (v t / d)^2, has a beat of 3 (v T / d)^2 / (2 pi^2).
    curved = 3 * (10 * EXPOSURE_S / 2) ** 2 / (2 * np.pi**2) / (2 * 10 * MODULATION_HZ * EXPOSURE_S / 299792458)
    torch.testing.assert_close(speed, torch.full_like(speed, 10 * (1 + curved)), rtol=5e-4, atol=0)
    as_bright = (g / 2 * wall_phasor(2 - 10 * t) * (1 - 5 * t) ** 2 * np.exp(2j * np.pi * BEAT_HZ * t)).sum()
    assert abs(as_bright - truth) / abs(truth) == pytest.approx(0.62, abs=0.01)
    steady = (g / 2 * 0.5 / np.pi / (2 - 10 * t) ** 2).sum()
    torch.testing.assert_close(out.steady, torch.full((3, 1, 1), steady), rtol=1e-5, atol=0, check_dtype=False)
    assert relative(instants(facing, {"wall": TOWARDS}, 0), np.full((3, 1, 1, 1), truth)) < 2e-4
    fewer = tt.over_time(facing, {"wall": TOWARDS}, tt.Exposure(EXPOSURE_S, beat_hz=BEAT_HZ, poses=2), seed=0)
    assert 1e-3 < relative(fewer.phasor, truth) < 1e-2


def test_what_moves_without_a_change_has_no_signal(facing):
    """A wall that slides in its own plane: its points move at 10 m/s, the picture does not. And one that stands still,
    for which the exposure is a whole number of beats.
    """
    towards, along = (np.sin(1.0), 0, 2 - np.cos(1.0)), (10 * np.cos(1.0), 0, 10 * np.sin(1.0))
    tilted = renderer_of(moving_scene(wall=wall((0, 0, 2), towards)), "wall.to_world", spp=64, frequencies=FREQUENCIES)
    for renderer, motion in ((tilted, tt.Motion(linear=along)), (facing, tt.Motion())):
        still = renderer(seed=3).phasor.abs()
        # Rounding of positions, 2e-7 of lengths and brightness.
        assert tt.over_time(renderer, {"wall": motion}, HETERODYNE, seed=3).phasor.abs().max() < 1e-6 * still.min()


def test_against_many_instants_in_a_corner():
    """Two bounces, the second wall moves and turns; the same samples, so that the quadrature is compared."""
    scene, motion = corner()
    renderer = renderer_of(scene, "second.to_world", spp=4096, frequencies=FREQUENCIES)
    moving = {"second": tt.Motion(**motion)}
    assert relative(tt.over_time(renderer, moving, HETERODYNE, seed=1).phasor, instants(renderer, moving, 1)) < 2e-3


def test_camera_and_lamp_that_move_together_are_a_world_that_moves():
    """By pose and by position; the same paths, so that rounding alone differs: of phasors 400 times the signal."""
    scene = moving_scene(size=2, fov=10, wall=wall((0, 0, 2), (0.3, 0.1, 0)))
    keys = ("wall.to_world", "sensor.to_world", "lamp.position")
    renderer = renderer_of(scene, *keys, spp=64, frequencies=FREQUENCIES)
    velocity = np.array([3.0, -2.0, 6.0])
    there = {"sensor": tt.Motion(linear=velocity), "lamp": tt.Motion(linear=velocity)}
    found = tt.over_time(renderer, there, HETERODYNE, seed=2).phasor
    truth = tt.over_time(renderer, {"wall": tt.Motion(linear=-velocity)}, HETERODYNE, seed=2).phasor
    assert relative(found, truth.detach().numpy()) < 2e-3


def test_a_rolling_shutter():
    """Rows against a render for each: a wall in 20 ms, of which three poses are a parabola."""
    rows, row_s = 12, 20e-3 / 12
    frequencies = tt.FrequencyAxis.from_hertz([20e6, 100e6])
    scene = moving_scene(size=rows, fov=20, wall=wall((0, 0, 2), (0.5, 0.2, 0), 2.0))
    renderer = renderer_of(scene, "wall.to_world", spp=16, frequencies=frequencies)
    moving, shutter = {"wall": tt.Motion(linear=(2.0, 0.5, -3.0))}, tt.RollingShutter(row_s)
    found = tt.over_time(renderer, moving, shutter, seed=5)
    each = tt.over_time(renderer, moving, tt.Frames(shutter.rows_s(rows)), seed=5)
    number = torch.arange(rows)
    truth = each.phasor[number, ..., number, :].movedim(0, -2).detach().numpy()
    assert found.phasor.shape == truth.shape == (3, 2, rows, rows)
    assert relative(found.phasor, truth) < 1e-3
    assert relative(found.steady, each.steady[number, ..., number, :].movedim(0, -2).detach().numpy()) < 1e-3
    assert relative(renderer(seed=5).phasor, truth) > 1e-2


def test_phase_steps_of_an_itof_camera(facing):
    """Depth that four exposures of a wall in motion read, against the sum of what each sees."""
    camera = tt.sensing.ItofCorrelation(tt.sensing.sine_code(4), MODULATION_HZ, tt.TimeAxis(0.0, 0.2, 40))
    steps = tt.PhaseSteps(4, 2e-3)
    frames = tt.over_time(facing, {"wall": TOWARDS}, steps, seed=0)
    assert frames.phasor.shape == (4, 3, 1, 1, 1)
    taps = steps.taps(camera.expected_from_phasor(frames.phasor, FREQUENCIES, steady=frames.steady))
    z = 2 - 10 * steps.poses_s().numpy()
    quarter = np.exp(2j * np.pi * np.arange(4) / 4)
    truth = (0.5 / np.pi / z**2 + (wall_phasor(z) * quarter).real) / 4
    np.testing.assert_allclose(taps[0, :, 0, 0].detach(), truth, rtol=1e-5)
    still = tt.over_time(facing, {"wall": tt.Motion()}, steps, seed=0)
    one = camera.expected_from_phasor(facing(seed=0).phasor, FREQUENCIES, steady=facing(seed=0).steady)
    assert torch.equal(steps.taps(camera.expected_from_phasor(still.phasor, FREQUENCIES, steady=still.steady)), one)


def test_a_video_of_histograms():
    """Functions of time by key, or one of all; bins, and a value that moves nothing."""
    keys = ("box.to_world", "box.bsdf.reflectance.value")
    renderer = renderer_of(make_room(), *keys, spp=8)
    pose, times = renderer.values[keys[0]].detach(), [-0.01, 0.0, 0.02]
    color = lambda t: torch.stack([0.5 + t, 0.5 - t, 0.5 * torch.ones_like(t)], -1)  # noqa: E731
    box = tt.Motion(linear=(1.0, 0.5, 2.0), angular=(0, 1.0, 0))
    video = tt.over_time(renderer, {"box": box, keys[1]: color}, tt.Frames(times), seed=4)
    assert video.transient.shape == (3, 3, 24, 3, 4) and video.stats.seeds == (4, 4, 4)
    t = torch.tensor(times).double()
    for k in range(3):
        pose_k = (box.matrices(t)[k] @ pose.double()).float()
        # Matrices are rounded as batches are.
        alone = renderer({keys[0]: pose_k, keys[1]: color(t)[k]}, seed=4).transient
        torch.testing.assert_close(video.transient[k], alone, rtol=1e-4, atol=1e-5)
    both = lambda t: {"box": box.matrices(t) @ pose.double(), keys[1]: color(t)}  # noqa: E731
    assert torch.equal(tt.over_time(renderer, both, tt.Frames(times), seed=4).transient, video.transient)
    blurred = tt.over_time(renderer, {keys[1]: color}, tt.Exposure(0.1), seed=4)
    # Light is linear in the albedo but for light that the box scatters twice.
    torch.testing.assert_close(blurred.transient, renderer({keys[1]: [0.5] * 3}, seed=4).transient, rtol=0, atol=1e-4)


def test_vertices_move_as_poses_do():
    mesh = tt.scenes.triangle_mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0.3], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    mesh["to_world"] = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    room = make_room() | {"box": mesh}
    box = tt.Motion(linear=(0.5, 0.0, 20.0), angular=(0.0, 9.0, 3.0), center=(0.2, 0.0, 0.5))
    by_pose, by_vertices = (
        tt.over_time(
            renderer_of(room, key, spp=8, temporal_filter="tent"), {"box": box}, tt.Frames([0.0, 0.02]), seed=1
        ).transient.detach()
        for key in ("box.to_world", "box.vertex_positions")
    )
    torch.testing.assert_close(by_pose, by_vertices, rtol=1e-4, atol=1e-5)
    assert (by_pose[1] - by_pose[0]).abs().max() > 0.1 * by_pose.abs().max()


def test_a_camera_of_ones_own_and_times_with_gradients(facing):
    """The difference of two instants, and its slope by when the second is."""

    class Pair(SlowTimes):
        def __init__(self, later):
            self.later = later

        def poses_s(self, rows):
            return torch.stack([torch.zeros(()), self.later]).double()

        def combine(self, pictures):
            return pictures[1] - pictures[0]

    later = torch.tensor(0.01, requires_grad=True)
    out = tt.over_time(facing, {"wall": TOWARDS}, Pair(later), seed=0)
    z = 2 - 10 * 0.01
    assert relative(out.steady, np.full((3, 1, 1), 0.5 / np.pi * (1 / z**2 - 1 / 4))) < 1e-4
    (slope,) = torch.autograd.grad(out.steady[0, 0, 0], later)
    assert float(slope) == pytest.approx(0.5 / np.pi * 2 * 10 / z**3, rel=1e-3)


WALL = "wall.to_world"


@together(
    "call, error, said",
    [
        (lambda r: tt.over_time(r, {"fan": TOWARDS}, HETERODYNE), UnknownKeyError, r"parameters=\['fan\.to_world'\]"),
        (lambda r: tt.over_time(r, {"wall": TOWARDS, WALL: TOWARDS}, HETERODYNE), ArgumentError, "is moved twice"),
        (lambda r: tt.over_time(r, {"wall": lambda t: torch.eye(4)}, HETERODYNE), ShapeError,
         r"returns \(3, 4, 4\) for 3 times of 'wall.to_world', got \(4, 4\)"),
        (lambda r: tt.over_time(r, {}, HETERODYNE), ArgumentError, "expected something that moves, got nothing"),
        (lambda r: tt.over_time(r, {"wall": TOWARDS}, HETERODYNE, seed=[0, 1, 2]), UnitError, "one whole number"),
        (lambda r: tt.over_time(r, {}, HETERODYNE, values={WALL: torch.eye(4).expand(3, 4, 4)}), ShapeError,
         "without a batch, got one of 3"),
    ],
)  # fmt: skip
def test_what_is_refused(facing, call, error, said):
    with pytest.raises(error, match=said):
        call(facing)


TOO_FAR = {
    "milliseconds for seconds": (TOWARDS, tt.Exposure(1.5), "'wall.to_world' moves by 11.6 m"),
    "a turn": (tt.Motion(angular=(0.0, 0.0, 20.0)), tt.Exposure(1.5), "'wall' turns around 3.7 times"),
    "a function": (
        lambda t: torch.eye(4) + 10 * t[:, None, None] * torch.eye(4).roll(1, 1), tt.Exposure(1.5), "moves by 11.6 m"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TOO_FAR)
def test_motions_further_than_the_scene_is_large(name):
    """1.5 s of 10 m/s between the nodes of three poses, 1.5 sqrt(3 / 5) s apart, in a scene of 3.5 m."""
    how, exposure, said = TOO_FAR[name]
    scene = tt.load(moving_scene(wall=wall((0, 0, 2), (0, 0, 0)), size=4), variant=VARIANT)

    def look(exposure, physics):
        renderer = tt.TransientRenderer(scene, ["wall.to_world"], spp=1, frequencies=FREQUENCIES, physics=physics)
        tt.over_time(renderer, {"wall": how}, exposure, seed=0)

    look(exposure, "ignore")
    look(tt.Exposure(1.5e-3), "error")
    with pytest.raises(PhysicsError, match=said):
        look(exposure, "error")
    with pytest.warns(PhysicsWarning, match=said):
        look(exposure, "warn")


