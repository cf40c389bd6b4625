"""What a simulation renders in which order, what it keeps and tells of it; and which scenes and variants it takes."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ArgumentError, SceneError, TorchTransientError
from torchtransient.nlos import work

N = tt.nlos
VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.9, 0.02, 100)
WALL = N.Wall.plane(2.0, 1.6, albedo=0.9)
Z = tt.scenes.nlos_z()
pytestmark = pytest.mark.usefixtures("no_leftovers")


def scan(size=(3, 2), **settings):
    return N.Scan.grid(WALL, size, kind="confocal", **settings)


def simulated(of=None, **settings):
    return N.simulate(Z, of or scan(), **{"time_axis": AXIS, "spp": 8, "progress": False} | settings)


def complete(**changed):
    description = N.capture_scene(Z, scan())
    film = description["wall"]["sensor"]["film"]
    film |= {"start_opl": AXIS.start_opl, "bin_width_opl": AXIS.bin_width_opl, "temporal_bins": AXIS.num_bins}
    return description | changed


# --------------------------------------------------------------------------------------------------------------- parts


def test_points_that_carry_gradients_are_simulated_without():
    plain = scan()
    points = plain.sensor_points.clone().requires_grad_()
    carrying = replace(plain, sensor_points=points, laser_points=points)
    for settings in ({}, {"tiles": 2}):
        with no_gradient_is_lost():
            found = simulated(carrying, **settings)
        expected = simulated(plain, **settings)
        assert found.axis == expected.axis and found.scan == plain
        assert not found.scan.sensor_points.requires_grad and not found.transient.requires_grad
        torch.testing.assert_close(found.transient, expected.transient, rtol=1e-5, atol=1e-9)
    assert points.grad is None


def test_a_part_file_of_one_part(tmp_path, monkeypatch, capsys):
    """Kept as those of many are; what is finished is not timed again."""
    path = tmp_path / "a.part"
    first = simulated(part=path, tiles=1, keep_part=True, progress=True)
    assert path.exists() and "about" in capsys.readouterr().err
    monkeypatch.setattr(work.HiddenWork, "render", None)
    again = simulated(part=path, tiles=1, keep_part=True, progress=True)
    told = capsys.readouterr().err
    assert torch.equal(first.transient, again.transient) and "samples a point" in told and "about" not in told


# ------------------------------------------------------------------------------------------------- scenes and variants


def test_an_active_polarized_variant_stays():
    with mi.variant_context("llvm_ad_mono_polarized"):
        found = work.choose_variant(None, None)
    assert found.name == "llvm_ad_mono_polarized" and "active" in found.why


def test_names_of_files_are_scenes(tmp_path):
    for given in (str(tmp_path / "none.xml"), tmp_path / "none.xml"):
        with pytest.raises(TorchTransientError, match=r"none\.xml") as caught:
            N.simulate(given, progress=False)
        assert "expected scan= beside" not in str(caught.value)


def test_a_shape_that_shines_is_no_laser():
    lamp = {"type": "rectangle", "to_world": tt.scenes.transforms.translate([0, 0, 4.0]),
            "emitter": {"type": "area", "radiance": 1.0}}  # fmt: skip
    scene = {name: node for name, node in complete(lamp=lamp).items() if name != "laser"}
    for given, words in ((scene, "AreaLight"), (complete(laser={"type": "constant"}), "ConstantBackgroundEmitter")):
        with pytest.raises(SceneError, match=f"expected a laser whose beam falls on a spot, got the emitter {words}"):
            N.simulate(given, spp=4, progress=False)


@pytest.mark.parametrize("kind", ["exhaustive", "confocal"])
def test_spots_around_the_axis_of_a_laser(kind):
    """A grid of 2 x 1 spots over an angle whose tangent is 1/4 on either side, on a wall half a metre away."""
    of = N.Scan.grid(WALL, (3, 2), kind=kind, **({"laser_grid": (2, 1)} if kind == "exhaustive" else {}))
    description = N.capture_scene(Z, of)
    sensor = description["wall"]["sensor"]
    sensor.pop("laser_points", None)
    del sensor["laser_origin"]
    description["integrator"] |= {"force_equal_illumination_scanning": False,
                                  "illumination_scan_fov": 2 * float(np.degrees(np.arctan(0.25)))}  # fmt: skip
    if kind == "confocal":
        sensor["sensor_origin"] = [0.0, 0.0, 0.5]
    look = mi.ScalarTransform4f().look_at([0, 0, 0.5], [0, 0, 0], [0, 1, 0])
    description["laser"] |= {"to_world": look}
    scene = tt.load(description, variant=VARIANT)
    found = work.scan_of_scene(scene.built(tt.scene.edits.BuildOptions(transient=True)).scene)
    assert found.kind == kind and found.laser_origin.tolist() == [0.0, 0.0, 0.5]
    if kind == "confocal":  # whose laser goes along, whatever the integrator says
        assert torch.equal(found.laser_points, found.sensor_points)
        return
    assert found.laser_points.shape == (1, 2, 3)
    torch.testing.assert_close(found.laser_points[0, :, 0].sort().values, torch.tensor([-0.0625, 0.0625]).double(),
                               rtol=0, atol=1e-6)  # fmt: skip


@pytest.mark.slow
def test_forecasts_know_of_the_light():
    """Which bounces, and which energy."""
    found = N.forecast(Z, scan(), time_axis=AXIS, spp=4, bounces=(3, 4), energy={"type": "rgb", "value": [1, 0.5, 0.2]})
    assert "light of 4 bounces" in found.light and found.variant.startswith("llvm_ad_rgb, colour")
    with pytest.raises(ArgumentError, match="bounces has no effect"):
        N.forecast(complete(), bounces=(3,))
