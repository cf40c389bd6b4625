"""Scans of pairs: a laser spot of its own for each sensor point, simulated, reconstructed and refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import torchtransient as tt
from tools.point_captures import point_capture
from torchtransient.errors import ArgumentError, SceneError, ShapeError

N = tt.nlos
VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(0.8, 0.08, 64)
WALL = N.Wall.plane(1.6, 1.6, albedo=0.8)
ORIGINS = {"sensor_origin": (0.0, 0.1, 0.3), "laser_origin": (0.1, 0.0, 0.4)}
# Plates of which the front one hides the back one from some of the points.
HIDDEN = tt.scenes.nlos_plates(size=0.4, gap=0.3, depth=0.6)


def drawn(count, seed):
    generator = torch.Generator().manual_seed(seed)
    points = 1.4 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.7
    return torch.nn.functional.pad(points, (0, 1))


def scan(kind="pairs", count=4, **settings):
    settings = {"wall": WALL, "first_and_last_leg": True, **ORIGINS} | settings
    return N.Scan.points(drawn(count, 0), kind=kind, laser_points=drawn(count, 1), **settings)


def simulated(of, **settings):
    settings = {"time_axis": AXIS, "spp": 1024, "progress": False, "variant": VARIANT} | settings
    return N.simulate(HIDDEN, of, **settings)


def test_what_a_scan_of_pairs_is():
    found = scan()
    assert found.shape == (4,) and found.pairs == 4 and "a spot each" in repr(found)
    torch.testing.assert_close(found.legs, found.laser_legs + found.sensor_legs)
    # Of a box that is one point both ends are its lengths.
    place = torch.tensor([0.1, 0.2, 0.7], dtype=torch.float64)
    lengths = found.legs + sum((points - place).norm(dim=-1) for points in (found.sensor_points, found.laser_points))
    axis = found.default_axis([place.tolist()] * 2, 0.01)
    for spare in (float(lengths.min()) - axis.start_opl, axis.end_opl - float(lengths.max())):
        assert -1e-9 < spare < 0.01 + 1e-9
    with pytest.raises(ShapeError, match=r"expected laser_points \(4, 3\)"):
        replace(found, laser_points=found.laser_points[:3], laser_normals=None)
    with pytest.raises(ArgumentError, match=r"Scan\.points"):
        N.Scan.grid(WALL, 2, kind="pairs")


@pytest.mark.parametrize("third_bounce", ["shared", pytest.param("paths", marks=pytest.mark.slow)])
def test_pairs_are_the_diagonal_of_all_pairs(third_bounce):
    """Within five standard errors of the mean of eight seeds, in total and in first moment, light of three bounces from
    shared samples and from paths; that of four is from paths.
    """
    scene = N.capture_scene(HIDDEN, scan(), bounces=(3, 4))
    scene["integrator"]["third_bounce"] = third_bounce
    film = {"start_opl": AXIS.start_opl, "bin_width_opl": AXIS.bin_width_opl, "temporal_bins": AXIS.num_bins}
    scene["wall"]["sensor"]["film"] |= film
    loaded = tt.load(scene, variant=VARIANT)
    pairs = torch.stack([N.simulate(loaded, spp=1024, seed=s, progress=False).transient[0, :, 0] for s in range(8)])
    every = [simulated(scan("exhaustive"), bounces=(3, 4), seed=20 + seed).transient[0] for seed in range(8)]
    diagonal = torch.stack(every).diagonal(dim1=-2, dim2=-1)
    for weight in (torch.ones(64), AXIS.centers_opl.float()):
        a, b = ((weight[:, None] * runs).sum(1) for runs in (pairs, diagonal))
        off, error = (a.mean(0) - b.mean(0)).abs(), ((a.var(0) + b.var(0)) / 8).sqrt()
        assert (off < 5 * error).all() and (error < 0.05 * b.mean(0)).all() and (b.mean(0) > 0).all()


@pytest.mark.slow
def test_parts_and_complete_scenes_have_the_pairs_of_the_whole():
    whole = simulated(scan(), seed=3)
    parts = simulated(scan(), seed=3, tiles=2, spp=4096)
    assert parts.scan == whole.scan
    torch.testing.assert_close(parts.total(), whole.total(), rtol=0.1, atol=0)
    scene = N.capture_scene(HIDDEN, scan())
    film = {"start_opl": AXIS.start_opl, "bin_width_opl": AXIS.bin_width_opl, "temporal_bins": AXIS.num_bins}
    scene["wall"]["sensor"]["film"] |= film
    read = N.simulate(scene, spp=1024, seed=3, progress=False, variant=VARIANT)
    assert read.scan.kind == "pairs"
    torch.testing.assert_close(read.scan.laser_points[0], whole.scan.laser_points, rtol=0, atol=1e-5)
    torch.testing.assert_close(read.total()[0, 0], whole.total()[0], rtol=1e-4, atol=0)


def test_scenes_without_a_spot_for_each_point():
    for change in ({"laser_points": drawn(3, 1)}, {}):
        scene = N.capture_scene(HIDDEN, scan())
        sensor = scene["wall"]["sensor"]
        sensor.pop("laser_points")
        sensor |= {name: value.numpy() for name, value in change.items()}
        with pytest.raises(SceneError, match="a laser spot for each"):
            tt.render(tt.load(scene, variant=VARIANT), spp=1)


@pytest.mark.slow
def test_derivatives_by_the_place_of_what_is_hidden():
    """The mean length of all light against central differences, where nothing hides anything."""
    letter = tt.scenes.nlos_letter("L", size=0.5, depth=0.6)
    renderer = N.CaptureRenderer(letter, scan(), ["letter.vertex_positions"], time_axis=AXIS, spp=4096, variant=VARIANT)
    start = renderer.renderer.values["letter.vertex_positions"].detach()
    centers = AXIS.centers_opl.float()[:, None]

    def length(shift):
        moved = start + shift * torch.tensor([0.0, 0.0, 1.0])
        light = renderer({"letter.vertex_positions": moved}, seed=1).transient[0]
        return (light * centers).sum() / light.sum()

    shift = torch.zeros((), requires_grad=True)
    (slope,) = torch.autograd.grad(length(shift), shift)
    with torch.no_grad():
        step = 0.02
        expected = (length(torch.tensor(step)) - length(torch.tensor(-step))) / (2 * step)
    assert float(slope) == pytest.approx(float(expected), rel=0.02)


def test_backprojection_finds_a_point_and_transforms_name_it():
    point, count = (0.1, -0.2, 0.5), 60
    measured = point_capture(scan(count=count), [point], time_axis=tt.TimeAxis(0.9, 0.02, 160))
    box = N.VoxelGrid.bounds([[-0.45, -0.45, 0.3], [0.45, 0.45, 0.7]], (19, 19, 9))
    volume = N.reconstruct(measured, grid=box, progress=False)
    assert volume.method == "fbp" and "pairs" in volume.metadata["reason"]
    brightest = box.points.reshape(-1, 3)[volume.values.flatten().argmax()]
    # Half a voxel along each axis.
    assert ((brightest - torch.tensor(point)).abs() <= 0.026).all()
    for method in ("fk", "phasor"):
        with pytest.raises(ArgumentError, match=r"not pairs\. Take one of bp, fbp"):
            N.reconstruct(measured, method)
    without = replace(measured.scan, first_and_last_leg=False)
    of = {"time_axis": measured.axis}
    field = lambda: N.PhasorField(without, box, pulse=N.PhasorFilter(0.1), **of)  # noqa: E731
    for make in (lambda: N.FK(without, **of), lambda: N.MidpointFK(without, **of), field):
        with pytest.raises(ShapeError, match="FilteredBackprojection"):
            make()
