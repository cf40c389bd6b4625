"""Examples that fit a scene or a sensor: each by one small run, and what they compute by closed forms."""

from __future__ import annotations

import math
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
import torch
from torch.nn import functional

import torchtransient as tt
from support.examples import FOLDER, example, measured_data, small_run
from torchtransient import sensing


@pytest.fixture(autouse=True)
def one_thread():
    with tt.threads(1):
        yield


# ------------------------------------------------------------------------------------------------ surfaces and poses


@pytest.mark.slow
def test_fit_albedo(tmp_path):
    mi.set_variant("llvm_ad_rgb")  # the example's own: with another one active, every step would switch to and fro
    fit = small_run("fit_albedo", tmp_path, "--steps", 14, "--spp", 16, "--resolution", 16)
    before, after = (albedos - fit.truth for albedos in (fit.albedos[0], fit.albedos[-1]))
    assert float(after.abs().mean()) < 0.4 * float(before.abs().mean())


@pytest.mark.slow
def test_fit_wall(tmp_path):
    mi.set_variant("llvm_ad_mono")
    fit = small_run("fit_wall", tmp_path, "--steps", 60, "--target-spp", 1024)
    assert fit.distance_errors[0] == pytest.approx(0.3)
    assert fit.distance_errors[-1] < 0.005
    assert fit.tilt_errors[-1] < 0.25


def test_the_wall_fit_cannot_see_brightness():
    mi.set_variant("llvm_ad_mono")
    module = example("fit_wall")
    renderer = module.wall_renderer(0.5, 4)
    pose = module.wall_to_world(torch.tensor(4.1), torch.tensor(3.0))
    transient = renderer({module.KEY: pose}, seed=0, spp=16).transient
    brightness = torch.rand((4, 4), generator=torch.Generator().manual_seed(0)) + 0.1
    measured, dimmed = (module.mean_arrival(cube, renderer.axis) for cube in (transient, transient * brightness))
    torch.testing.assert_close(measured, dimmed, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_fit_glass_index(tmp_path):
    """As a script, which takes no arguments otherwise."""
    picture = tmp_path / "curves.png"
    command = [sys.executable, FOLDER / "fit_glass_index.py", "--smoke", "--spp", "16384", "--output", picture]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    results = dict(re.findall(r"^from the (\w+) image: index ([\d.]+)", done.stdout, re.MULTILINE))
    assert set(results) == {"transient", "steady"}
    # Six steps of at most 0.02 each from 1.2 on. All of them go upwards: at 16,384 samples the derivative of the
    # transient is twice its deviation and more.
    assert 1.25 < float(results["transient"]) <= 1.321
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_block_is_closed_and_seen_from_outside():
    """Each edge belongs to two faces, once in either direction, and the volume has its sign and size."""
    vertices, faces = example("fit_body").block()
    edges = [(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    volume = np.linalg.det(vertices[faces]).sum() / 6
    assert volume == pytest.approx(0.3 * (0.6 * 0.25 + 0.55 * 0.25), rel=1e-9)


def test_starts_and_truths_are_as_far_off_as_said():
    shadow, body, spin = map(example, ("fit_shadow", "fit_body", "fit_spin"))
    assert shadow.errors(shadow.start_of(3)) == pytest.approx((200.0, 5.0), rel=1e-4)
    truth = body.POSE(body.true_numbers(3))
    assert body.errors(body.POSE(torch.zeros(6)), truth) == pytest.approx((100.0, 15.0), rel=1e-4)
    middle, true = spin.values_of(torch.zeros(9)), spin.values_of(spin.true_numbers(3, 0.2))
    axis, speed, millimetres, degrees = spin.errors(middle, true)
    assert axis == pytest.approx(math.degrees(math.asin(0.2)), rel=1e-4)
    # 20 % of the middle's speed is 25 % of 0.8 and 17 % of 1.2 of it.
    assert min(abs(speed - 25), abs(speed - 100 / 6)) < 1e-3
    assert (millimetres, degrees) == pytest.approx((50.0, 10.0), rel=1e-4)


@pytest.mark.slow
def test_a_pose_from_its_shadow(tmp_path):
    (fit,) = small_run("fit_shadow", tmp_path)
    # From 200 mm and 5 degrees; with half of the steps and a seventh of the samples two seeds end at 17 and 11 mm,
    # 1.2 and 0.8 degrees.
    assert fit.millimetres[-1] < 40
    assert fit.degrees[-1] < 2.5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchtransient.errors.GradientWarning")
def test_the_interior_derivative_of_a_shadow_moves_nothing(tmp_path):
    (fit,) = small_run("fit_shadow", tmp_path, "--no-boundary", "--steps", 3)
    assert fit.millimetres[-1] == pytest.approx(fit.millimetres[0], rel=1e-6)
    assert fit.degrees[-1] == pytest.approx(fit.degrees[0], rel=1e-6)


@pytest.mark.slow
def test_a_pose_of_a_concave_body(tmp_path):
    (fit,) = small_run("fit_body", tmp_path)
    # A guess of 11 mm and 8 degrees; with half of the steps and a quarter of the samples, 1.5 mm and 0.2 degrees.
    assert fit.millimetres[-1] < 0.5 * fit.millimetres[0]
    assert fit.degrees[-1] < 0.2 * fit.degrees[0]


@pytest.mark.slow
def test_one_light_is_blind_for_turns_about_the_bisector():
    """As far as the fan is small: a tenth of what other turns do to the spectra. Two lights see each turn."""
    spin = example("fit_spin")
    hub, sensor, light = torch.tensor([[0.0, 0.0, 0.2], [-1.2, 0.0, 2.4], [1.6, 0.6, 2.2]])
    to_sensor, to_light = (functional.normalize(place - hub, dim=0) for place in (sensor, light))
    bisector = functional.normalize(to_sensor + to_light, dim=0)
    across = functional.normalize(torch.linalg.cross(to_sensor, to_light), dim=0)
    seen = {}
    for one_light in (True, False):
        renderer = spin.renderer_of(spin.scene_of(one_light), 64)

        def frame(turn, renderer=renderer):
            with torch.no_grad():
                return renderer(spin.values_of(torch.cat([torch.zeros(6), turn])), seed=1).beats

        still, width = frame(torch.zeros(3)), spin.AXIS.bin_width_opl
        changes = [
            float(tt.losses.wasserstein_loss(frame(0.1 * way), still, width, creation_cost_opl=2.0))
            for way in (bisector, across)
        ]
        seen[one_light] = changes[0] / changes[1]
    assert seen[True] < 0.1  # 0.03
    assert seen[False] > 0.2  # 0.4


@pytest.mark.slow
def test_axis_and_speed_from_one_frame(tmp_path):
    (fit,) = small_run("fit_spin", tmp_path)
    # Guesses of 2.5 to 4 degrees and 3 to 8 %; four seeds end within 0.06 degrees and 0.26 %.
    assert fit.good and fit.errors[-1][0] < 0.3 and fit.errors[-1][1] < 0.8
    for name in ("fit_spin_range_doppler_guess", "fit_spin_range_doppler_found"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.soak
def test_speckle_costs_little(tmp_path):
    """A single look: contrast one in every bin. Ten seeds end within 0.8 degrees and 0.9 %."""
    (fit,) = small_run("fit_spin", tmp_path, "--no-network", "--steps", 100, "--looks", 1)
    assert fit.errors[0][0] > 11
    assert fit.good


# ------------------------------------------------------------------------------------ phases, polarization, materials


def test_a_plane_lies_in_itself():
    phasors = example("fit_phasors")
    distances = phasors.distances_to_wall(phasors.TRUTH, 8)
    torch.testing.assert_close(phasors.plane_through(distances), distances, rtol=1e-5, atol=0)


@pytest.mark.slow
def test_multipath_is_fitted_away(tmp_path):
    ((camera,), (plane,), *fits) = small_run("fit_phasors", tmp_path).values()
    # What is wrong with the depth is no noise (a tenth of it): late light has no mean of zero, and a plane keeps it.
    assert camera > 10
    assert plane == pytest.approx(camera, rel=0.05)
    # The model has the panel: its fit ends at the noise, and after these few steps still far below the detour.
    assert all(fit < 0.4 * camera for (fit,) in fits)


def test_normals_of_a_slope():
    shape = example("shape_from_polarization")
    normals = shape.normals(0.5 * shape.grid()[0])
    expected = torch.tensor([-0.5, 0.0, 1.0]) / math.sqrt(1.25)
    torch.testing.assert_close(normals, expected.expand_as(normals), rtol=0, atol=1e-4)
    height, degrees = shape.errors_of(shape.true_heights() + 1e-3)
    assert height == pytest.approx(1.0, rel=1e-4)
    assert degrees == pytest.approx(0.0, abs=0.05)


@pytest.mark.slow
def test_stokes_components_know_the_normals(tmp_path):
    shape = example("shape_from_polarization")
    with mi.variant_context("llvm_ad_mono_polarized"):  # else each render goes to and fro between it and another test's
        errors = small_run("shape_from_polarization", tmp_path)
    ((alone,), (stokes,), (mosaic,)) = (errors[name] for name in ("S0 alone", "Stokes", "mosaic"))
    # Albedos are free, so S0 has the times alone: a pulse of 15 cm for heights of half a millimetre. S1 and S2 have the
    # normals in a single pixel, with half the light.
    assert stokes[1] < 0.5 * alone[1]
    assert stokes[1] < 0.5 * shape.errors_of(torch.zeros_like(shape.true_heights()))[1]
    # A quarter of the pixels for each direction, and the noise of a chip: still better than all of the light.
    assert mosaic[1] < 0.6 * alone[1]


@pytest.mark.soak
def test_the_transient_tells_what_the_steady_image_does_not(tmp_path):
    (fits,) = small_run("scattering_material", tmp_path)
    # From a start 50 and 150 % off.
    transient, steady, known = (sum(fits[name].errors) for name in ("transient", "steady", "steady, power known"))
    assert transient < 0.6 * steady
    assert known < 0.4 * steady


@pytest.mark.slow
def test_diffusion_theory_is_right_late_and_in_the_dark():
    scene = example("turbid_block")
    coefficients = (200.0, 6.0)
    model = scene.Block(coefficients)
    with torch.no_grad():
        traced = torch.stack([model(seed, 1 << 12)[0, :, 0].double() for seed in range(8)])
    formula = scene.diffused(*torch.tensor(coefficients, dtype=torch.float64))[0, :, 0]
    # From 30 free paths on, four dark pixels in three stretches of time, as shares of their light.
    late = scene.AXIS.centers_opl > 2 * scene.HEIGHT + 30 / coefficients[0]
    tables = [
        torch.stack([part.sum(-2) for part in light[..., late, :4].tensor_split(3, -2)], -2)
        for light in (traced, formula)
    ]
    tables = [table / table.sum((-2, -1), keepdim=True) for table in tables]
    error = tables[0].std(0) / len(traced) ** 0.5
    # Diffusion theory errs by some per cent here, the tracer by its noise.
    assert ((tables[0].mean(0) - tables[1]).abs() < 4 * error + 0.05 * tables[1]).all()
    assert (error < 0.08 * tables[1]).all()


# ----------------------------------------------------------------------------------------------------------- sensors


def irf_and_frames(folder):
    """Two lobes 1.2 ns apart, of 60 ps with a tail of 80 ps, 2e6 counts, turned to begin in its highest bin; and six
    zones with one width of 1 ns and a tail of 0.8 ns.
    """
    edges = torch.arange(401, dtype=torch.float64) * 8e-12
    lobes = [sensing.TailedResponse(60e-12, [80e-12], [0.4], delay_s=d) for d in (0.8e-9, 2.0e-9)]
    mean = 2e6 * (0.7 * lobes[0].mass(edges) + 0.3 * lobes[1].mass(edges)) + 5
    counts = torch.poisson(mean, generator=torch.Generator().manual_seed(0))
    np.save(folder / "irf.npy", counts.roll(-int(counts.argmax())).numpy())
    edges = torch.arange(65, dtype=torch.float64) * 250e-12
    rows = [
        5000 * sensing.TailedResponse(1e-9, [0.8e-9], [1.0], delay_s=(4 + 0.6 * k) * 1e-9).mass(edges) + 3
        for k in range(6)
    ]
    frame = torch.poisson(torch.stack(rows), generator=torch.Generator().manual_seed(1))
    np.savez(folder / "frame.npz", hists=frame.numpy())
    return folder / "irf.npy", folder / "frame.npz"


@pytest.mark.slow
def test_calibration_finds_what_was_put_in(tmp_path, capsys):
    irf, frames = irf_and_frames(tmp_path)
    small_run("calibrate_irf", tmp_path, "--irf", irf, "--frames", frames, "--steps", 160)
    printed = capsys.readouterr().out
    lobes = re.findall(r"lobe at +([\d.]+) ps: share ([\d.]+), width +([\d.]+) ps, tail +([\d.]+) ps", printed)
    (early, share, width, tail), (late, _, _, _) = [[float(x) for x in lobe] for lobe in lobes]
    assert abs(late - early - 1200) < 5 and abs(share - 0.7) < 0.02 and abs(width - 60) < 4 and abs(tail - 80) < 12
    found = re.search(r"width (\d+) ps, tail (\d+) ps, residual ([\d.]+) %", printed)
    width, tail, residual = (float(x) for x in found.groups())
    assert abs(width - 1000) < 100 and abs(tail - 800) < 100 and residual < 6


def pulses(positions):
    """Histograms (N, T) of one normal pulse, as wide as the core of a measured one, at positions in bins."""
    bins = torch.arange(49.0)
    return 1e5 * torch.exp(-0.5 * ((bins - torch.as_tensor(positions)[:, None]) / 1.2) ** 2) + 10.0


def test_a_plane_says_where_the_pulse_left_out_is():
    fit, chip = example("fit_measured_histograms"), example("nine_zones")
    # Directions (x, y, 1) meet the plane z = 17 + 2 x - 3 y at z = 17 / (1 - 2 x + 3 y); lengths in bins.
    x, y = chip.CENTRES.T
    distance = 17.0 * (1 + x**2 + y**2).sqrt() / (1 - (2 * x - 3 * y) / 17.0)
    positions = distance + chip.ZERO - chip.FIRST
    counts = pulses(positions)
    for left in (0, 4, 7):
        predict = fit.shifted(counts, left, [n for n in range(9) if n != left])
        # A mean over five bins leaves out more of the pulse on one side: 0.1 bins where its middle is between two.
        assert fit.peak(predict(0.0)) == pytest.approx(float(positions[left]), abs=0.15)
        assert fit.peak(predict(2.0)) - fit.peak(predict(0.0)) == pytest.approx(2.0, abs=0.15)


def test_the_judge_finds_delay_gain_and_background():
    counts = pulses([20.0])[0]
    judge = example("fit_measured_histograms").judge
    figures, best = judge(lambda delay: 3.0 * pulses([19.0 + delay])[0] + 500.0, counts)
    in_place, wrong, late_ps, own, own_wrong = figures
    assert late_ps == pytest.approx(88.0, rel=0.01)  # one bin
    assert in_place > 100 > 1e-3 > own
    assert wrong > 10 > 0.2 > own_wrong
    assert float(best.sum()) == pytest.approx(float(counts.sum()), rel=1e-3)


FIT, BASELINE = "fit, with what is left over", "neighbours, shifted"


@pytest.mark.soak
def test_a_simulated_chip_is_predicted(tmp_path, monkeypatch):
    monkeypatch.delenv("TORCHTRANSIENT_MEASURED_DATA", raising=False)
    (rows,) = small_run("fit_measured_histograms", tmp_path)
    own = {name: np.mean([row[3] for row in figures]) for name, figures in rows.items()}
    # The counts are of the same model: within 1 of the deviations it must be, where neighbours have another width.
    assert own["fit"] < 0.5 * min(own[BASELINE], own["all eight, shifted"])
    assert own[FIT] < 0.5 * own[BASELINE]


@pytest.mark.measured
def test_measured_zones_are_predicted(tmp_path):
    folder = measured_data()
    counts = example("fit_measured_histograms").measured(folder)
    assert counts.shape == (9, 49)
    # Means of twenty exposures, where single precision tells whole numbers of twentieths.
    few = 20 * counts[counts < 1e5]
    assert float((few - few.round()).abs().max()) <= 20 * 1e5 * 2**-24
    (rows,) = small_run("fit_measured_histograms", tmp_path, "--measured", folder)
    assert all(row[3] < 2 for row in rows[FIT])
