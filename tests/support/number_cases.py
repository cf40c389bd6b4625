"""Every public function and class that takes numbers, with right arguments: what tests write wrong ones into."""

from __future__ import annotations

import numpy as np
import torch

import torchtransient as tt
from support import stored_samples
from support.fake_recipe import FakeRecipe
from support.loss_cases import CASES as LOSSES
from support.metric_cases import CASES as METRICS
from support.number_case import (
    Case,
    Stream,
    Table,
    capture,
    capture_volume,
    entered,
    folder,
    noisy,
    recipe,
    until,
)
from tools.small_room import make_room
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.errors import TorchTransientError

AXIS, LIGHT = tt.TimeAxis(1.0, 0.05, 8), 0.1 + torch.rand(1, 8, 16, 16, generator=torch.Generator().manual_seed(0))
PICTURE, STOKES = LIGHT[:, :3], torch.tensor([2.0, 0.3, 0.4, 0.5]).view(4, 1, 1, 1, 1).expand(4, 1, 8, 16, 16)
GATE, BAND = tt.Gate.rectangular(1.0, 2.0), tt.FrequencyAxis.uniform(1.0, 0.5, 3)
CHIRPS = tt.Chirps(1e9, 1e-5, 1550e-9)
K = torch.tensor([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]])
MESH = (torch.eye(3), torch.tensor([[0, 1, 2]]))
SPHERE, FOAM = {"type": "sphere"}, (262.0, 0.53, 1.12, 0.0036)


class _Called(Case):
    """The module of a loss, called with tensors: its function checks what it holds."""

    def __init__(self, case, *tensors):
        super().__init__(case.module, **{**case.options, **case.said})
        self.tensors = case.arguments(*tensors)

    def __call__(self, **given):
        return super().__call__(**given)(*self.tensors)


def _of_losses() -> dict[str, Case]:
    """Functions and modules of losses and metrics, by the cases that their own tests have."""
    found = {}
    names = {id(value): name for name, value in vars(tt.losses).items()}
    for case in LOSSES:
        x, y = case.tensors(dtype=torch.float32)
        function = f"losses.{names[id(case.function)]}"
        base = {**case.options, **case.said}
        found.setdefault(function, Case(case.function, *case.arguments(x, y), **base))
        if id(case.module) in names:
            found.setdefault(f"losses.{names[id(case.module)]}", _Called(case, x, y))
    for case in METRICS:
        found.setdefault(f"metrics.{case.function.__name__}", Case(case.function, *case.pair(), **case.options))
    return found


def _scenes() -> dict[str, Case]:
    s = tt.scenes
    names = (
        "furnace integrating_sphere parallel_plates cornell_box nlos_letter nlos_mannequin nlos_room etalon_slab "
        "glass_slab_before_wall light_over_plane moving_wall nlos_corner nlos_plates nlos_z relay_wall"
    )
    found = {f"scenes.{name}": Case(getattr(s, name)) for name in names.split()}
    found["scenes.milk_bottle"] = Case(s.milk_bottle, folder() / "bottle.ply", resolution=8)
    return found


def _tensors() -> dict[str, Case]:
    """Of the rooms of axes, losses, metrics, parametrizations, geometry and Stokes vectors."""
    loss, metric, p, g, stokes = tt.losses, tt.metrics, tt.parametrize, tt.geometry, tt.stokes
    x = torch.tensor([0.2, 0.3, 0.5])
    bound = {"margin": 0.01}
    return {
        "TimeAxis": Case(tt.TimeAxis, start_opl=1.0, bin_width_opl=0.5, num_bins=3),
        "TimeAxis.from_seconds": Case(tt.TimeAxis.from_seconds, start_s=1e-9, bin_width_s=1e-10, num_bins=3),
        "TimeAxis.bin_index": Case(AXIS.bin_index, opl=1.2),
        "RateAxis": Case(tt.RateAxis, start=-2.0, bin_width=0.5, num_bins=3),
        "Chirps": Case(tt.Chirps, bandwidth_hz=1e9, duration_s=1e-5, wavelength_m=1e-6),
        "Chirps.longer": Case(CHIRPS.longer, times=3.0),
        "Chirps.time_axis": Case(CHIRPS.time_axis, range_m=(0.0, 9.0), speed_m_s=(-1.0, 1.0), bins_per_line=3),
        "FrequencyAxis": Case(tt.FrequencyAxis, frequencies=1.0, start_opl=1.0),
        "FrequencyAxis.uniform": Case(tt.FrequencyAxis.uniform, first=1.0, step=0.5, count=3, start_opl=1.0),
        "FrequencyAxis.from_hertz": Case(tt.FrequencyAxis.from_hertz, frequencies_hz=1e8, start_opl=1.0),
        "Gate": Case(tt.Gate, "gaussian", start_opl=1.0, end_opl=2.0),
        "Gate.rectangular": Case(tt.Gate.rectangular, start_opl=1.0, end_opl=2.0),
        "Gate.gaussian": Case(tt.Gate.gaussian, center_opl=1.0, fwhm_opl=0.5),
        "Gate.rectangular_s": Case(tt.Gate.rectangular_s, start_s=1e-9, end_s=2e-9),
        "Gate.gaussian_s": Case(tt.Gate.gaussian_s, center_s=1e-9, fwhm_s=5e-10),
        "Gate.shifted": Case(GATE.shifted, opl=1.0),
        "Gate.sequence": Case(GATE.sequence, step_opl=0.5, count=3),
        "Exposure": Case(tt.Exposure, duration_s=1e-3, beat_hz=1e3, poses=3),
        "RollingShutter": Case(tt.RollingShutter, row_s=1e-5, poses=3),
        "PhaseSteps": Case(tt.PhaseSteps, number=4, period_s=1e-3),
        "Pulse": Case(tt.Pulse, "gaussian", width_opl=0.5, center_opl=0.1),
        "Pulse.gaussian": Case(tt.Pulse.gaussian, fwhm_opl=0.5, center_opl=0.1),
        "Pulse.rectangular": Case(tt.Pulse.rectangular, width_opl=0.5, center_opl=0.1),
        "Pulse.gaussian_s": Case(tt.Pulse.gaussian_s, fwhm_s=1e-9, center_s=1e-10),
        "Pulse.rectangular_s": Case(tt.Pulse.rectangular_s, width_s=1e-9, center_s=1e-10),
        "Pulse.tabulated": Case(tt.Pulse.tabulated, [0.0, 1.0, 2.0], [0.0, 1.0, 0.0], center_opl=1.0),
        "Pulse.tabulated_s": Case(tt.Pulse.tabulated_s, [0.0, 1e-9, 2e-9], [0.0, 1.0, 0.0], center_s=1e-9),
        "Pulse.shifted": Case(tt.Pulse.gaussian(0.5).shifted, opl=1.0),
        "pulses.cumulative_of_sum": Case(tt.pulses.cumulative_of_sum, [tt.Pulse.gaussian(0.5)], step=0.01),
        "units.near_seconds": Case(tt.units.near_seconds, name="x", where="here", time_s=1e-9, limit_s=0.01),
        "geometry.ray_directions": Case(g.ray_directions, K, size=(4, 5)),
        "geometry.intrinsics": Case(g.intrinsics, fov_deg=40.0, size=(4, 5), crop_offset=(1, 1)),
        "geometry.pinhole_camera": Case(g.pinhole_camera, K, torch.eye(4), size=(4, 5)),
        "geometry.distance_from_opl": Case(g.distance_from_opl, LIGHT, index=1.5),
        "geometry.opl_from_distance": Case(g.opl_from_distance, LIGHT, index=1.5),
        "losses.armed_periods": Case(loss.armed_periods, LIGHT, periods=3, dead_bins=2.0),
        "losses.anscombe": Case(loss.anscombe, LIGHT, read_noise=0.5),
        "losses.relative_floor": Case(loss.relative_floor, LIGHT, share=0.1, dim=1),
        "losses.SampleSchedule": Case(loss.SampleSchedule, first=3, last=8, steps=20, hold=0.5),
        "losses.SampleSchedule.needed": Case(loss.SampleSchedule.needed, spp=3, bias=0.1, allowed=0.05),
        "losses.surface_distance": Case(loss.surface_distance, *MESH, *MESH, cells=3),
        "losses.transient_phasors": Case(loss.transient_phasors, LIGHT, axis=AXIS, frequencies=BAND, dim=1),
        "metrics.wrapped_difference": Case(metric.wrapped_difference, x, x + 1, period=3.0),
        "metrics.front_depth": Case(metric.front_depth, LIGHT, torch.arange(1.0, 9.0), threshold=0.1),
        "metrics.localization_rmse": Case(metric.localization_rmse, capture_volume(), MESH[0], radius_m=1.0),
        "parametrize.Bounded": Case(p.Bounded, low=0.0, high=1.0, **bound),
        **{
            f"parametrize.{name}": Case(getattr(p, name), **bound)
            for name in ("Albedo", "Anisotropy", "IndexOfRefraction", "PrincipledRoughness", "Roughness", "Simplex")
        },
        "parametrize.bounded_inverse": Case(p.bounded_inverse, x, low=0.0, high=1.0, **bound),
        "parametrize.AxisAnglePose": Case(p.AxisAnglePose, length_scale=2.0),
        "parametrize.SE3Pose": Case(p.SE3Pose, length_scale=2.0),
        "parametrize.Positive": Case(p.Positive, low=0.1, scale=2.0),
        "parametrize.positive": Case(p.positive, x, low=0.1, scale=2.0),
        "parametrize.positive_inverse": Case(p.positive_inverse, x, low=0.1, scale=2.0),
        "parametrize.simplex": Case(p.simplex, x, dim=0),
        "parametrize.simplex_inverse": Case(p.simplex_inverse, x, dim=0, margin=0.01),
        "parametrize.PositiveSpectrum": Case(p.PositiveSpectrum, [400.0, 500, 600, 700], coefficients=4, scale=2.0),
        "parametrize.ReflectanceSpectrum": Case(p.ReflectanceSpectrum, [400.0, 500, 600, 700], coefficients=4, **bound),
        "parametrize.spline_basis": Case(p.spline_basis, [400.0, 500, 600, 700], coefficients=4),
        **{
            f"stokes.{name}": Case(getattr(stokes, name), STOKES, dim=0, floor=0.1)
            for name in (
                "degree_of_polarization",
                "degree_of_linear_polarization",
                "degree_of_circular_polarization",
                "angle_of_linear_polarization",
                "normalized_components",
            )
        },
        "stokes.rotate_frame": Case(stokes.rotate_frame, STOKES, angle=0.3, dim=0),
        "stokes.apply_mueller": Case(stokes.apply_mueller, torch.eye(4), STOKES, dim=0),
        "stokes.rotator": Case(stokes.rotator, angle=0.3),
        "stokes.linear_polarizer": Case(stokes.linear_polarizer, angle=0.3, extinction=0.1),
        "stokes.linear_retarder": Case(stokes.linear_retarder, angle=0.3, delay=0.1),
    }


def _scans() -> dict[str, Case]:
    """Of captures and reconstruction."""
    n, r = tt.nlos, tt.reconstruction
    wall, axis = n.Wall.plane(2.0, 2.0), capture().axis
    grid = n.VoxelGrid.before(capture().scan, [0.8, 0.9, 1.0], size=3)
    planes = n.VoxelGrid.before(capture().scan, [0.8, 0.9, 1.0])
    without, pairs = (tt.nlos.subtract_legs(capture(kind)) for kind in ("confocal", "exhaustive"))
    exhaustive = capture("exhaustive")
    planar = {
        "first": torch.zeros(3),
        "along_x": torch.tensor([1.0, 0, 0]),
        "along_y": torch.tensor([0.0, 1, 0]),
        "normal": torch.tensor([0.0, 0, 1]),
        "size": (3, 3),
        "pitch": (0.1, 0.1),
    }
    scan, light = capture().scan, torch.rand(1, 32, 4, 4)
    laplacian, band = r.LaplacianFilter(), r.PhasorFilter(wavelength=1.0)
    volume = torch.rand(1, 3, 3, 3)
    single = capture("single")
    return {
        "nlos.Capture.single": Case(exhaustive.single, laser=(1, 1)),
        "nlos.Capture.crop": Case(capture().crop, start_opl=2.4, end_opl=4.0),
        "nlos.Scan.grid": Case(n.Scan.grid, wall, size=3, kind="exhaustive", laser_grid=3),
        "nlos.Scan.single": Case(exhaustive.scan.single, laser=(1, 1)),
        "nlos.Scan.default_axis": Case(scan.default_axis, [[0, 0, 0.5], [1, 1, 1]], bin_width_opl=0.01),
        "nlos.Wall.grid": Case(wall.grid, size=3),
        "nlos.Wall.plane": Case(n.Wall.plane, width=2.0, height=2.0, albedo=0.5),
        "nlos.Wall.mesh": Case(n.Wall.mesh, *MESH, albedo=0.5),
        "nlos.capture_scene": Case(n.capture_scene, SPHERE, n.Scan.grid(wall, 3, kind="confocal"), bounces=(3,)),
        "nlos.sum_bins": Case(n.sum_bins, capture(), number=3),
        "nlos.default_grid": Case(n.default_grid, capture(), size=3, planes=3, extent=1.0),
        "nlos.without_slab": Case(n.without_slab, capture(), thickness=0.02, snr=10.0),
        "nlos.backproject": Case(n.backproject, single, grid, falloff=1.0),
        "nlos.filtered_backproject": Case(n.filtered_backproject, single, grid, filter=laplacian, falloff=1.0),
        "nlos.phasor_image": Case(n.phasor_image, single, planes, pulse=band, falloff=1.0),
        "nlos.depth_map": Case(n.depth_map, volume, grid, threshold=0.1),
        "nlos.soft_depth": Case(n.soft_depth, volume, grid, sharpness=2.0),
        "nlos.stabilized_root": Case(n.stabilized_root, light, floor=0.25),
        "nlos.StabilizedRoot": Case(n.StabilizedRoot, floor=0.25),
        "nlos.FK": Case(n.FK, without.scan, time_axis=without.axis, floor=0.1, taps=4),
        "nlos.MidpointFK": Case(n.MidpointFK, pairs.scan, time_axis=pairs.axis, floor=0.1, taps=4),
        "nlos.LCT": Case(n.LCT, without.scan, time_axis=without.axis, snr=10.0, v_bins=8),
        "nlos.DirectionalLCT": Case(n.DirectionalLCT, without.scan, time_axis=without.axis, snr=10.0, v_bins=8),
        "nlos.DiffusionDeconvolution": Case(
            n.DiffusionDeconvolution, without.scan, time_axis=without.axis, passes=2, properties=FOAM
        ),
        "nlos.LaplacianFilter": Case(n.LaplacianFilter, sigma=1.0),
        "nlos.PhasorFilter": Case(n.PhasorFilter, wavelength=1.0, cycles=4.0),
        "nlos.VoxelGrid": Case(r.VoxelGrid, torch.tensor([0.5, 0.6]), **planar),
        "nlos.VoxelGrid.before": Case(r.VoxelGrid.before, scan, [0.8, 0.9], size=3, extent=1.0),
        "nlos.VoxelGrid.bounds": Case(r.VoxelGrid.bounds, [[0, 0, 0.5], [1, 1, 1]], size=3),
        "nlos.Backprojection": Case(r.Backprojection, scan, grid, time_axis=axis, falloff=1.0),
        "nlos.FilteredBackprojection": Case(
            r.FilteredBackprojection, scan, grid, time_axis=axis, filter=laplacian, falloff=1.0
        ),
        "nlos.PhasorField": Case(r.PhasorField, scan, planes, time_axis=axis, pulse=band, falloff=1.0),
    }


def _of_a_folder() -> dict[str, Case]:
    """Of a data set of four samples on the disk."""
    d, place = tt.data, stored_samples.folder(folder() / "set", 4)
    stream, dataset, shard = d.TransientStream(place), d.TransientDataset(place), d.Shard(next(place.glob("*.h5")))
    noisy_too = {"transform": noisy}
    return {
        "data.TransientStream": Case(d.TransientStream, place, transform=noisy, seed=3, buffer=3, rank=0, world_size=3),
        "data.TransientStream.set_epoch": Case(stream.set_epoch, epoch=3, batches=3, batch_size=1),
        "data.TransientStream.order": Case(stream.order, epoch=3),
        "data.TransientDataset": Case(d.TransientDataset, place, seed=3, **noisy_too),
        "data.TransientDataset.sample": Case(
            dataset.sample, number=3, epoch=3, errors=(TorchTransientError, IndexError)
        ),
        "data.Shard.read": Case(shard.read, "transient", row=0),
        "data.Shard.values": Case(shard.values, row=0),
    }


DATA = "torchtransient.data"


def _report() -> AccuracyReport:
    choice = Choice("owen", "box")
    points = [CostPoint(choice, "transient", n, 0.1, 1 / n, 0.1 / n, n**-0.5, 0.1, 4) for n in (4, 16, 64)]
    return AccuracyReport(points, "")


def _runs() -> dict[str, Case]:
    """Of data sets and training."""
    d, t = tt.data, tt.training
    batches, table = t.Batches(4, 2), Table()
    return {
        "accuracy.AccuracyReport.spp_for": Case(_report().spp_for, error=0.1),
        "accuracy.AccuracyReport.recommend": Case(_report().recommend, error=0.3),
        "data.first_return": Case(d.first_return, LIGHT, AXIS, threshold=0.5),
        "data.Augmented": Case(d.Augmented, table, d.Augment(d.Flip()), seed=3),
        "data.Augmented.sample": Case(
            d.Augmented(table, d.Augment(d.Flip()), seed=0).sample,
            number=3,
            epoch=3,
            errors=(TorchTransientError, IndexError),
        ),
        "data.AugmentedStream": Case(d.AugmentedStream, Stream(), d.Augment(d.Flip()), seed=3),
        "data.Crop": Case(d.Crop, size=(3, 3), offset=(1, 1)),
        "data.Flip": Case(d.Flip, p=0.5),
        "data.QuarterTurn": Case(d.QuarterTurn, turns=(1, 3)),
        "data.PixelMap": Case(d.PixelMap, np.eye(3), size=(4, 4), new_size=(4, 4)),
        "data.PixelMap.nearest": Case(d.PixelMap(np.eye(3), (4, 4), (4, 4)).nearest, LIGHT[..., :4, :4], fill=0.5),
        "data.SpatialFilter": Case(d.SpatialFilter, torch.nn.Identity(), images_at_once=3),
        "data.spatial_filter": Case(d.spatial_filter, torch.nn.Identity(), LIGHT, images_at_once=3),
        "data.generate": Case(
            until(f"{DATA}.generation._folder", d.generate), FakeRecipe(), "x", n=3, workers=1, per_shard=3
        ),
        "data.OnlineDataset": Case(
            until(f"{DATA}.online.Producers", d.OnlineDataset),
            FakeRecipe(),
            capacity=8,
            workers=1,
            seed=3,
            warm=3,
            first=3,
        ),
        "data.RecipeDataset": Case(d.RecipeDataset, recipe(), transform=noisy, size=3, first=3, seed=3),
        "data.RecipeDataset.sample": Case(
            d.RecipeDataset(recipe(), 4).sample, number=3, epoch=3, errors=(TorchTransientError, IndexError)
        ),
        "data.Normal": Case(d.Normal, 0.0, 1.0, low=-1.0, high=1.0),
        "data.Turn": Case(d.Turn, [0, 0, 1], low=0.0, high=90.0),
        "data.Choice.share": Case(d.Choice([1.0, 2.0, 3.0, 4.0]).share, number=3),
        "data.Recipe": Case(d.Recipe, make_room(), spp=3, max_depth=3, sensors=0, seed=3, n=3),
        "data.Recipe.sample": Case(recipe().sample, index=3),
        "data.Recipe.draw": Case(recipe().draw, index=3),
        "data.Recipe.cost": Case(recipe().cost, samples=3),
        "data.Recipe.preview": Case(recipe().preview, samples=3),
        "data.ShardWriter": Case(d.ShardWriter, folder() / "rows.h5", rows=3, header={}),
        **_of_a_folder(),
        "training.Batches": Case(t.Batches, size=9, batch_size=3, seed=3, rank=0, world_size=3),
        "training.Batches.places": Case(batches.places, step=3),
        "training.Batches.samples": Case(batches.samples, step=3),
        "training.Batches.epoch": Case(batches.epoch, step=3),
        "training.Batches.loader": Case(batches.loader, table, workers=0),
        "training.save_checkpoint": Case(
            t.save_checkpoint, folder() / "run.pt", {"model": torch.nn.Linear(1, 1)}, step=3
        ),
        "training.ranks": Case(entered(t.ranks), threads=1),
        "threads": Case(until("torchtransient.rendering.threads._set", tt.threads), n=1),
        "data.export_web_dataset": Case(until(f"{DATA}.exports.path_of", d.export_web_dataset), "x", "y"),
        "training.Seeds": Case(t.Seeds, seed=3),
        "training.Seeds.generator": Case(t.Seeds(0).generator, step=3, sample=3),
        "training.Ranks.mean": Case(t.Ranks().mean, value=1.0),
    }


def _pictures() -> dict[str, Case]:
    """Of pictures and videos."""
    v = tt.vis
    phasor = torch.complex(PICTURE, PICTURE)[:, :, :8, :8]
    video = folder() / "v.gif"
    transient, steady = LIGHT[..., :4, :4], LIGHT[:, 0, :4, :4]
    rates = LIGHT[..., :4, :4].expand(4, 8, 4, 4).unsqueeze(0)
    frames = v.frames(transient, axis=AXIS)
    monitor = v.FitMonitor({"a": torch.ones(2)}, live=False)
    return {
        "vis.FitMonitor": Case(
            v.FitMonitor, {"a": torch.ones(2)}, target=LIGHT, pixels=[(1, 1)], truth={"a": [0.5, 0.6]}, every=3
        ),
        "vis.FitMonitor.step": Case(monitor.step, loss=1.0, step=3),
        "vis.plot_overview": Case(v.plot_overview, transient, steady, AXIS, path=folder() / "o.png", pixel=(1, 1)),
        "vis.phasor_picture": Case(v.phasor_picture, phasor, frequencies=BAND, which=(1,), percentile=90.0),
        "vis.phasor_video": Case(v.phasor_video, phasor, video, which=1, steps=3, fps=10.0, frequencies=BAND, scale=1),
        "vis.polarization_picture": Case(v.polarization_picture, STOKES, frame=3, floor=0.1),
        "vis.transients_grid": Case(v.transients_grid, capture("exhaustive"), rows=2, columns=2, laser=(1, 1)),
        "vis.frame_grid": Case(v.frame_grid, transient, bins=(1, 3), count=3, columns=3, exposure=1.0),
        "vis.histogram": Case(v.histogram, transient, pixels=[(1, 1)]),
        "vis.streak": Case(v.streak, transient, exposure=1.0),
        "vis.frames": Case(v.frames, transient, exposure=1.0, scale=1, every=3),
        "vis.write_video": Case(v.write_video, video, list(frames), count=8, fps=10.0),
        "vis.view": Case(v.view, transient, max_megabytes=3.0, samples=2),
        "vis.video": Case(v.video, transient, video, fps=10.0),
        "vis.Frames": Case(v.Frames, make=len, count=3),
        "vis.peak_time_picture": Case(v.peak_time_picture, transient, axis=AXIS, limits=(1.0, 2.0)),
        "vis.rainbow": Case(v.rainbow, transient, axis=AXIS, exposure=1.0, period_opl=1.0),
        "vis.gradient_picture": Case(v.gradient_picture, steady, percentile=90.0, limit=1.0),
        "vis.exposure_of": Case(v.exposure_of, steady, quantile=0.9),
        "vis.tone_map": Case(v.tone_map, steady, exposure=1.0, gamma=2.0, stops=5.0),
        "vis.range_doppler": Case(
            v.range_doppler, rates, axis=AXIS, rate_axis=tt.RateAxis(-1.0, 0.5, 4), pixel=(1, 1), decades=3.0
        ),
        "vis.volume_views": Case(v.volume_views, torch.rand(4, 4, 4), gamma=2.0),
    }


CASES: dict[str, Case] = {**_of_losses(), **_scenes(), **_tensors(), **_scans(), **_runs(), **_pictures()}

# What takes longer than a few milliseconds a call.
SLOW = {name for name in CASES if name.startswith("vis.")} | {
    "data.Recipe.cost",
    "data.Recipe.preview",
    "data.Recipe.sample",
    "data.Recipe.draw",
    "data.RecipeDataset.sample",
    "metrics.localization_rmse",
    "scenes.milk_bottle",
    "scenes.nlos_mannequin",
    "scenes.nlos_room",
    "data.TransientStream",
    "data.TransientDataset",
    "nlos.DiffusionDeconvolution",
    "nlos.MidpointFK",
    "nlos.without_slab",
    "nlos.LCT",
    "nlos.DirectionalLCT",
    "metrics.ssim",
    "geometry.pinhole_camera",
    "losses.ssim_loss",
    "losses.projection_ssim_loss",
    "metrics.transient_ssim",
}
# Arguments that are not in CASES, as patterns of name(argument), and why.
LEFT = {
    r"(RenderStats(\.of_job)?|RenderOutput|Plan|Overview|ToleranceResult)\(.*\)": "results",
    r"accuracy\.(SamplesNeeded|GradientEstimate|Recommendation)\(.*\)": "results",
    r"(data\.(Generated|Sample|Shard)|training\.(Checkpoint|Ranks))\(.*\)": "results",
    r"(data|nlos)\..*\.draw\(size\)": "what augmentation gives its operations",
    r"nlos\.(Laplacian|Phasor)Filter\.\w+\(.*\)": "what reconstruction gives its filters",
    r"nlos\.PlanarScan\(.*\)": "what is found of a scan",
    r"(TransientRenderer|plan|render|over_time|cost_of_accuracy)\b.*": "rendering/test_whole_numbers.py",
    r"\w+\.\w+_s\(rows\)": "the height of the film, which tt.over_time gives",
    r"accuracy\.gradient_errors\b.*": "accuracy/test_gradient_errors.py",
    r"(Gate|Pulse)\((opl|values)\)": "rows of a table, which `tabulated` checks",
    r"nlos\.(CaptureRenderer|simulate|forecast)\b.*": "nlos/test_arguments.py",
    r"nlos\.read_capture\(.*\)": "files/captures",
    r"data\.scene_labels\(.*\)": "rendering/test_labels.py",
    r"data\.ShardWriter\.(put|fail)\(.*\)": "what tt.data.generate gives",
    r"training\.worker_init\(worker\)|vis\.Frames\(make\)": "given by torch; no number",
    r"accuracy\.(two_sample_)?z_test\(.*\)": "accuracy/test_statistics.py",
    r"scenes\.(translate|scale|rotate|look_at)\(.*\)": "scenes/test_transforms.py",
    r"sensing\..*": "sensing/test_given.py and the tests of each sensor",
}
