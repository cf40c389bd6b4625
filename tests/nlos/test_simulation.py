"""Simulated captures: against closed forms, whole and in parts, of hidden things and of complete scenes, in files."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long, long_rows
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ArgumentError, PhysicsWarning, SceneError, StorageError, TorchTransientError

VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.9, 0.02, 100)
FREQUENCIES = [0.0, 0.5, 2.0]
WALL = tt.nlos.Wall.plane(2.0, 1.6, albedo=0.9)
pytestmark = pytest.mark.usefixtures("no_leftovers")


def scan(kind="confocal", size=(3, 2), **settings):
    if kind == "exhaustive":
        settings.setdefault("laser_grid", (2, 1))
    return tt.nlos.Scan.grid(WALL, size, kind=kind, **settings)


def same(a, b):
    """To the rounding of sums that threads add to in the order they come."""
    torch.testing.assert_close(a, b, rtol=0, atol=1e-6 * float(b.abs().max()))


def simulated(hidden=None, of=None, **settings):
    settings = {"time_axis": AXIS, "spp": 64, "progress": False} | settings
    if "frequencies" in settings:
        settings.pop("time_axis")
    return tt.nlos.simulate(tt.scenes.nlos_z() if hidden is None else hidden, of or scan(), **settings)


def measured(capture):
    return capture.transient if capture.transient is not None else capture.phasor


def complete(kind="confocal", **settings):
    """The scene of a capture, with a film of its own."""
    description = tt.nlos.capture_scene(tt.scenes.nlos_z(), scan(kind, **settings))
    film = description["wall"]["sensor"]["film"]
    film |= {"start_opl": AXIS.start_opl, "bin_width_opl": AXIS.bin_width_opl, "temporal_bins": AXIS.num_bins}
    return description


# ------------------------------------------------------------------------------------------------------- closed forms


def test_a_plane_in_closed_form():
    """All light of a plane without end is rho_wall^2 rho / (3 pi^2 z^2); beyond 6 m there are 2e-5 of it."""
    plane = {"type": "rectangle", "to_world": tt.scenes.transforms.translate([0, 0, 1.0])
             @ tt.scenes.transforms.rotate([0, 1, 0], 180) @ tt.scenes.transforms.scale([6, 6, 1]),
             "bsdf": {"type": "diffuse", "reflectance": 0.7}}  # fmt: skip
    runs = [simulated(plane, spp=2**13, seed=seed).steady.flatten() for seed in range(6)]
    found = torch.stack(runs).double()
    exact = 0.9**2 * 0.7 / (3 * math.pi**2)
    means = found.mean(1) / exact
    assert abs(float(means.mean()) - 1) < 4 * float(means.std()) / len(means) ** 0.5 < 0.04


# --------------------------------------------------------------------------------------------------------- in parts


@pytest.mark.parametrize(
    ("film", "kind"),
    long_rows([({}, "confocal"), ({"frequencies": FREQUENCIES}, "exhaustive")], [({}, "confocal")]),
)
def test_parts_in_a_file_and_without(tmp_path, kind, film):
    path = tmp_path / "a.part"
    kept = simulated(of=scan(kind), part=path, tiles=4, **film)
    without = simulated(of=scan(kind), tiles=4, **film)
    whole = simulated(of=scan(kind), **film)
    same(measured(kept), measured(without))
    assert os.listdir(tmp_path) == []
    assert (kept.axis, kept.frequencies, kept.scan, kept.channels) == (
        whole.axis, whole.frequencies, whole.scan, whole.channels,
    )  # fmt: skip
    assert measured(kept).shape == measured(whole).shape == (1, 3 if film else 100, *whole.scan.shape)
    assert (kept.steady is None) == (whole.steady is None) == (kind == "exhaustive")
    if whole.steady is not None:
        assert kept.steady.shape == whole.steady.shape
    assert kept.metadata["parts"] == 3 and whole.metadata["parts"] == 1


@pytest.mark.slow
def test_parts_and_the_whole_have_the_same_mean():
    """Point by point: points of parts are the points that they stand for."""
    runs = {
        tiles: torch.stack([simulated(tiles=tiles, spp=512, seed=seed).steady[0] for seed in range(8)]).double()
        for tiles in (1, 4)
    }
    a, b = runs.values()
    error = ((a.var(0) + b.var(0)) / 8).sqrt()
    assert float(((a.mean(0) - b.mean(0)).abs() / error).max()) < 5
    assert float((error / a.mean(0)).max()) < 0.05
    assert float(a.mean(0).max() / a.mean(0).min()) > 1.05  # points differ


@pytest.fixture
def renders(monkeypatch):
    """(samples, seed, result) of each render; ``renders.stop_at``: number of the one before which a user interrupts."""

    class Renders(list):
        stop_at = None

    found, real = Renders(), tt.TransientRenderer.forward

    def forward(self, values=None, *, seed=None, spp=None, **more):
        if len(found) == found.stop_at:
            raise KeyboardInterrupt
        out = real(self, values, seed=seed, spp=spp, **more)
        found.append((spp, seed, out))
        return out

    monkeypatch.setattr(tt.TransientRenderer, "forward", forward)
    return found


@pytest.mark.parametrize(
    ("stops_at", "of"), long_rows([(1, "a complete scene"), (3, "hidden things")], [(1, "a complete scene")])
)
def test_a_simulation_that_was_stopped_goes_on(tmp_path, renders, of, stops_at):
    settings = {"part": tmp_path / "a.part", "tiles": 4, "progress": False, "spp": 10, "seed": 3}
    given = (complete(),) if of == "a complete scene" else (tt.scenes.nlos_z(), scan(size=(4, 2)))
    settings |= {} if of == "a complete scene" else {"time_axis": AXIS}
    expected = tt.nlos.simulate(*given, **(settings | {"part": None}))
    renders.clear()
    renders.stop_at = stops_at
    with pytest.raises(KeyboardInterrupt):
        tt.nlos.simulate(*given, **settings)
    assert len(renders) == stops_at
    renders.stop_at = None
    capture = tt.nlos.simulate(*given, **settings)
    assert len(renders) == 4
    same(capture.transient, expected.transient)
    same(capture.steady, expected.steady)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("tiles", [1, 2])
def test_a_finished_part_file_is_the_capture(tmp_path, renders, tiles):
    settings = {"part": tmp_path / "a.part", "keep_part": True, "tiles": tiles}
    first = simulated(**settings)
    assert (tmp_path / "a.part").exists()
    renders.stop_at = len(renders)
    again = simulated(**settings, progress=True)
    assert torch.equal(first.transient, again.transient) and again.metadata["seconds"] == first.metadata["seconds"]


@pytest.mark.slow
def test_other_settings_are_another_simulation(tmp_path):
    settings = {"part": tmp_path / "a.part", "keep_part": True, "tiles": 2}
    simulated(**settings)
    for changed in (
        {"seed": 1}, {"spp": 65}, {"tiles": 3}, {"time_axis": tt.TimeAxis(1.9, 0.02, 101)}, {"bounces": (3, 4)},
        {"energy": 2.0}, {"of": scan(size=(2, 3))}, {"hidden": tt.scenes.nlos_z(depth=1.1)},
        {"variant": "llvm_ad_rgb"}, {"frequencies": [0.0, 1.0]},
    ):  # fmt: skip
        with pytest.raises(StorageError, match="belongs to another simulation"):
            simulated(**(settings | changed))
    assert (tmp_path / "a.part").exists()


def test_points_that_carry_gradients_are_simulated_without():
    plain = scan()
    points = plain.sensor_points.clone().requires_grad_()
    carrying = replace(plain, sensor_points=points, laser_points=points)
    for settings in ({}, {"tiles": 2}):
        with no_gradient_is_lost():
            found = simulated(of=carrying, **settings)
        expected = simulated(of=plain, **settings)
        assert found.axis == expected.axis and found.scan == plain
        assert not found.scan.sensor_points.requires_grad and not found.transient.requires_grad
        same(found.transient, expected.transient)
    assert points.grad is None


# ---------------------------------------------------------------------------------------------------- sensors, files


def test_a_sensor_sees_the_whole_capture():
    class Twice(torch.nn.Module):
        def forward(self, transient, generator=None):
            assert transient.shape[-3:] == (AXIS.num_bins, 2, 3)
            return 2 * transient + torch.rand((), generator=generator)

    def seen(**settings):
        return simulated(sensor=Twice(), generator=torch.Generator().manual_seed(1), **settings).transient

    offset = torch.rand((), generator=torch.Generator().manual_seed(1))
    for settings in ({}, {"tiles": 2}):
        same(seen(**settings), 2 * simulated(**settings).transient + offset)


def test_devices_are_sensors():
    """As files name them: built for the capture's own bins."""
    stage = {"kind": "ImpulseResponse", "response": {"kind": "GaussianResponse", "fwhm_s": 2e-10}, "axis": "@axis"}
    device = tt.sensing.Device("d", description="a detector", sources=("assumed: all",), stages=(stage,))
    chain, plain = device.sensor(AXIS), simulated()
    expected = chain(plain.transient)
    for settings in ({}, {"tiles": 2}):
        bare = simulated(**settings)
        seen = simulated(sensor=device, **settings)
        torch.testing.assert_close(seen.transient, chain(bare.transient))
        assert seen.axis == AXIS and not torch.equal(seen.transient, bare.transient)
    renderer = tt.nlos.CaptureRenderer(
        tt.scenes.nlos_z(), scan(), time_axis=AXIS, spp=64, sensor=device, variant="llvm_ad_mono"
    )
    torch.testing.assert_close(renderer(seed=0).transient.detach(), expected)
    with pytest.raises(ArgumentError, match="takes transients"):
        simulated(sensor=device, frequencies=FREQUENCIES)
    with pytest.raises(ArgumentError, match="takes transients"):
        tt.nlos.CaptureRenderer(tt.scenes.nlos_z(), scan(), frequencies=[1.0], sensor=device)


class Across(torch.nn.Module):
    """Adds up along the rows of a film, and keeps its shape."""

    def forward(self, transient):
        self.shape = tuple(transient.shape)
        return transient.cumsum(-1)


def test_every_pair_is_a_pixel_of_a_sensor():
    """Ten spots in a column, twelve sensor points in a row."""
    of, sensor = scan("exhaustive", (4, 3), laser_grid=(2, 5)), Across()
    found, light = (simulated(of=of, sensor=given).transient for given in (sensor, None))
    assert sensor.shape == (1, 100, 10, 12) and found.shape == light.shape
    same(found.flatten(-2), light.flatten(-2).cumsum(-1))


@pytest.mark.parametrize("kind", long(["confocal", "exhaustive"], ["exhaustive"]))
def test_captures_come_back_from_files(tmp_path, kind):
    capture = simulated(of=scan(kind, first_and_last_leg=True), seed=1)
    for layout in ("torchtransient", "tal"):
        back = tt.nlos.Capture.read(capture.write(tmp_path / f"{layout}.h5", layout))
        assert back == capture and back.metadata == capture.metadata
    back = tt.nlos.Capture.read(capture.write(tmp_path / "zaragoza.h5", "zaragoza"))
    assert torch.equal(back.transient, capture.transient)
    for name in ("sensor_points", "laser_points", "sensor_normals", "sensor_origin", "laser_origin", "legs"):
        assert torch.equal(getattr(back.scan, name), getattr(capture.scan, name))


# -------------------------------------------------------------------------------------------------- complete scenes


@pytest.mark.parametrize("kind", long(["single", "exhaustive"], ["single"]))
def test_a_complete_scene_is_its_scan(kind):
    """The scene that a capture is made of, handed over as it is: the same numbers, and the scan read off it."""
    capture = tt.nlos.simulate(complete(kind), spp=64, progress=False)
    expected = simulated(of=scan(kind))
    same(capture.transient, expected.transient)
    found, wanted = capture.scan, expected.scan
    assert (found.kind, found.shape, found.first_and_last_leg) == (wanted.kind, wanted.shape, False)
    for name in ("sensor_points", "laser_points", "sensor_normals", "laser_normals", "sensor_origin", "laser_origin"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=0, atol=1e-6)
    assert found.wall is None and capture.metadata["spp"] == 64


def test_samples_of_passes_add_up(renders):
    """10 samples in 4 passes of 3, 3, 2, 2, each with a seed of its own: the mean of all of them."""
    capture = tt.nlos.simulate(complete(), spp=10, tiles=4, progress=False)
    shares, seeds, found = zip(*renders, strict=True)
    assert shares == (3, 3, 2, 2) and len(set(seeds)) == 4
    mean = sum(share * run.transient.double() for share, run in zip(shares, found, strict=True)) / 10
    torch.testing.assert_close(capture.transient.double(), mean, rtol=1e-6, atol=1e-12)


def test_names_of_files_are_scenes(tmp_path):
    with pytest.raises(TorchTransientError, match=r"none\.xml"):
        tt.nlos.simulate(str(tmp_path / "none.xml"), progress=False)


def test_a_shape_that_shines_is_no_laser():
    lamp = {"type": "rectangle", "to_world": tt.scenes.transforms.translate([0, 0, 4.0]),
            "emitter": {"type": "area", "radiance": 1.0}}  # fmt: skip
    scene = {name: node for name, node in complete().items() if name != "laser"} | {"lamp": lamp}
    for given, words in ((scene, "AreaLight"), (complete() | {"laser": {"type": "constant"}}, "ConstantBackground")):
        with pytest.raises(SceneError, match=f"expected a laser whose beam falls on a spot, got the emitter {words}"):
            tt.nlos.simulate(given, spp=4, progress=False)


@pytest.mark.parametrize("kind", ["exhaustive", "confocal"])
def test_spots_around_the_axis_of_a_laser(kind):
    """A grid of 2 x 1 spots over an angle whose tangent is 1/4 on either side, on a wall half a metre away."""
    description = complete(kind)
    sensor = description["wall"]["sensor"]
    sensor.pop("laser_points", None)
    del sensor["laser_origin"]
    description["integrator"] |= {"force_equal_illumination_scanning": False,
                                  "illumination_scan_fov": 2 * float(np.degrees(np.arctan(0.25)))}  # fmt: skip
    if kind == "confocal":
        sensor["sensor_origin"] = [0.0, 0.0, 0.5]
    description["laser"] |= {"to_world": mi.ScalarTransform4f().look_at([0, 0, 0.5], [0, 0, 0], [0, 1, 0])}
    found = tt.nlos.simulate(description, spp=1, progress=False).scan
    assert found.kind == kind and found.laser_origin.tolist() == [0.0, 0.0, 0.5]
    if kind == "confocal":  # whose laser goes along, whatever the integrator says
        assert torch.equal(found.laser_points, found.sensor_points)
        return
    torch.testing.assert_close(found.laser_points[0, :, 0].sort().values, torch.tensor([-0.0625, 0.0625]).double(),
                               rtol=0, atol=1e-6)  # fmt: skip


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_a_camera_sees_points_of_the_wall(slope):
    """Pixel centres of a perspective sensor; those that look past the wall are put on the plane of the nearest one, of
    a wall whose right half, x > 0, leans towards the camera.
    """
    description = complete("single")
    meter = description["wall"].pop("sensor")
    corners = [[x, y, slope * max(x, 0)] for x in (-1, 0, 1) for y in (-0.8, 0.8)]
    description["wall"] = tt.nlos.Wall.mesh(corners, [[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]]).shape
    look = mi.ScalarTransform4f().look_at([0, 0, 0.8], [0, 0, 0], [0, 1, 0])
    film, fov = meter["film"] | {"width": 8, "height": 4}, math.degrees(2 * math.atan(2 / 0.8))
    description["camera"] = {"type": "perspective", "fov": fov, "fov_axis": "x", "to_world": look, "film": film}
    description["laser"] |= {"to_world": mi.ScalarTransform4f().look_at([0, 0, 0.8], [-0.3, 0.1, 0], [0, 1, 0])}
    with pytest.warns(tt.errors.TorchTransientWarning, match="16 of the sensor's 32 rays look past the wall"):
        capture = tt.nlos.simulate(description, spp=4, progress=False)
    points = capture.scan.sensor_points
    x, y = 2 * ((torch.arange(8) + 0.5) / 4 - 1), 2 * (0.5 - (torch.arange(4) + 0.5) / 4)
    flat = torch.stack([x[None, :].expand(4, 8), y[:, None].expand(4, 8), torch.zeros(4, 8)], -1).double()
    camera = torch.tensor([0.0, 0.0, 0.8]).double()
    way = 0.8 / (0.8 + slope * flat[..., :1].clamp_min(0))
    expected = camera + way * (flat - camera)
    torch.testing.assert_close(points, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(capture.scan.laser_points, torch.tensor([-0.3, 0.1, 0.0]).double(), rtol=0, atol=1e-5)
    past = (points[..., 0].abs() > 1) | (points[..., 1].abs() > 0.8)
    assert int(past.sum()) == 16
    if not slope:  # of pixels without any part on the wall
        assert bool((capture.transient.sum((0, 1))[past] == 0).all())


OLDER = """<scene version="3.3.0">
  <default name="place" value="deep"/>
  <integrator type="transient_nlos_path">
    <integer name="block_size" value="1"/><integer name="max_depth" value="-1"/>
    <integer name="filter_depth" value="-1"/><boolean name="discard_direct_paths" value="false"/>
    <boolean name="nlos_laser_sampling" value="true"/><boolean name="nlos_hidden_geometry_sampling" value="true"/>
    <boolean name="nlos_hidden_geometry_sampling_includes_relay_wall" value="false"/>
    <string name="temporal_filter" value="box"/>
  </integrator>
  <emitter type="projector"><rgb name="irradiance" value="1.0, 1.0, 1.0"/><float name="fov" value="0.2"/></emitter>
  {hidden}
  <shape type="rectangle" id="relay_wall">
    <sensor type="nlos_capture_meter">
      <sampler type="independent"><integer name="sample_count" value="32"/><integer name="seed" value="0"/></sampler>
      <boolean name="confocal" value="false"/><boolean name="account_first_and_last_bounces" value="false"/>
      <point name="sensor_origin" x="-0.5" y="0.0" z="0.25"/><point name="laser_origin" x="-0.5" y="0.0" z="0.25"/>
      <point name="laser_lookat_pixel" x="6" y="1" z="0"/>
      <film type="transient_hdr_film">
        <integer name="width" value="8"/><integer name="height" value="4"/><integer name="temporal_bins" value="200"/>
        <float name="bin_width_opl" value="0.02"/><float name="start_opl" value="1.85"/><rfilter type="box"/>
      </film>
    </sensor>
  </shape>
</scene>"""
PLATE = """<shape type="rectangle"><transform name="to_world">
  <scale value="0.4"/><rotate y="1" angle="180"/><translate z="1"/></transform></shape>"""
MESH = """<shape type="obj"><string name="filename" value="{}"/>
  <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""


@pytest.mark.slow
def test_an_older_scene_of_mitransient(tmp_path):
    """As its examples are written: the spot at a place of the film, a projector, properties that say nothing."""
    (tmp_path / "older.xml").write_text(OLDER.format(hidden=PLATE))
    capture = tt.nlos.simulate(tmp_path / "older.xml", progress=False)
    assert capture.transient.shape == (1, 200, 4, 8) and float(capture.transient.sum()) > 0
    assert capture.metadata["spp"] == 32 and capture.metadata["variant"] == "llvm_ad_mono"
    found = capture.scan
    torch.testing.assert_close(found.laser_points, torch.tensor([0.5, -0.5, 0.0]).double(), rtol=0, atol=1e-6)
    torch.testing.assert_close(found.sensor_points[0, 0], torch.tensor([-0.875, -0.75, 0]).double(), rtol=0, atol=1e-6)
    assert found.laser_origin.tolist() == found.sensor_origin.tolist() == [-0.5, 0.0, 0.25]


@pytest.mark.slow
@pytest.mark.parametrize("route", ["in a folder by a parameter", "in an included file"])
def test_a_mesh_that_changed_is_another_simulation(tmp_path, route):
    """Wherever a complete scene names its file."""
    (tmp_path / "deep").mkdir()
    mesh = tmp_path / ("deep/a.obj" if "folder" in route else "a.obj")
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{MESH.format("a.obj")}</scene>')
    named = MESH.format("$place/a.obj") if "folder" in route else '<include filename="more.xml"/>'
    (tmp_path / "scene.xml").write_text(OLDER.format(hidden=named))

    def capture(z):
        mesh.write_text(f"v -0.4 -0.4 {z}\nv -0.4 0.4 {z}\nv 0.4 0.4 {z}\nf 1 2 3\n")
        settings = {"part": tmp_path / "a.part", "tiles": 2, "keep_part": True, "progress": False}
        return tt.nlos.simulate(tt.load(tmp_path / "scene.xml"), **settings).transient

    first = capture(1)
    assert float(first.sum()) > 0 and bool((capture(1) == first).all())
    with pytest.raises(StorageError, match="belongs to another simulation"):
        capture(1.05)


# ---------------------------------------------------------------------------------------------- variants, forecasts


@pytest.mark.slow
def test_the_cheapest_variant():
    grey = simulated()
    assert grey.channels == ("L",) and grey.metadata["variant"] == "llvm_ad_mono"
    assert "every spectrum is grey" in grey.metadata["variant_reason"]
    for settings in (
        {"hidden": tt.scenes.nlos_z(albedo=(0.1, 0.5, 0.9))},
        {"energy": {"type": "rgb", "value": [1.0, 0.5, 0.2]}},
        {"of": tt.nlos.Scan.grid(tt.nlos.Wall.plane(albedo=(0.1, 0.5, 0.9)), (3, 2), kind="confocal")},
    ):
        capture = simulated(**settings)
        assert capture.channels == ("R", "G", "B") and "colour" in capture.metadata["variant_reason"]
    assert simulated(variant="llvm_ad_rgb").channels == ("R", "G", "B")
    assert mi.variant() == VARIANT


@pytest.mark.slow
def test_the_light_is_explained():
    def light(**settings):
        return simulated(spp=4, **settings).metadata["light"]

    assert light() == "light of three bounces from hidden samples that all scanned points share; no later light"
    assert light(bounces=(3, 4, 5)).endswith("; light of 4 to 5 bounces from chains that they share")
    assert light(bounces="all").endswith("from chains that they share; light of 8 and more bounces from paths")
    with pytest.warns(PhysicsWarning, match="bounces= that no light takes"):  # flat, before a flat wall
        assert light(bounces=(4,)).startswith("light of three bounces is not asked for; light of 4 bounces from chains")
    metal = tt.scenes.nlos_z()
    metal["letter"]["bsdf"] = {"type": "roughconductor", "alpha": 0.3}
    assert "from paths, since not all surfaces are diffuse" in light(hidden=metal)
    assert "polarization" in light(variant="llvm_ad_mono_polarized")
    bent = [[-1, -1, 0.1], [0, -1, 0], [1, -1, 0.1], [-1, 1, 0.1], [0, 1, 0], [1, 1, 0.1]]
    wall = tt.nlos.Wall.mesh(bent, [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])
    curved = tt.nlos.Scan.grid(wall, (3, 2), kind="confocal", sensor_origin=[0, 0, 0.5], laser_origin=[0, 0, 0.5])
    assert "from paths, since the wall is not flat" in light(of=curved)


def test_a_forecast_is_what_comes(capsys):
    forecast = tt.nlos.forecast(tt.scenes.nlos_z(), scan(), time_axis=AXIS, spp=64)
    capture = simulated(progress=True)
    assert forecast.shape == tuple(capture.transient.shape)
    assert forecast.bytes == capture.transient.numel() * 4 and forecast.seconds >= 0
    told, lines = capsys.readouterr().err, str(forecast).splitlines()
    assert lines[0] == repr(scan()) and lines[1].startswith("1 x 100 x 2 x 3: 2.344 KiB, about ")
    assert lines[1].endswith("64 samples a point") and lines[2].startswith("variant: llvm_ad_mono, every spectrum")
    assert lines[3] == f"light: {capture.metadata['light']}" and "1 x 100 x 2 x 3: 2.344 KiB, about" in told
    phasors = tt.nlos.forecast(tt.scenes.nlos_z(), scan(), frequencies=FREQUENCIES, spp=1)
    assert phasors.shape == (1, 3, 2, 3) and phasors.bytes == 18 * 8


@pytest.mark.slow
def test_polarized_captures_have_their_shapes():
    """In the active variant, where it is polarized."""
    settings = {"spp": 8}
    mi.set_variant("llvm_ad_mono_polarized")
    forecast = tt.nlos.forecast(tt.scenes.nlos_z(), scan(), time_axis=AXIS, **settings)
    whole, parts = simulated(**settings), simulated(tiles=3, **settings)
    assert forecast.shape == tuple(whole.transient.shape) == tuple(parts.transient.shape) == (4, 1, 100, 2, 3)
    assert whole.metadata["variant_reason"].startswith("the active one")
    assert whole.polarized and parts.polarized and parts.steady.shape == (4, 1, 2, 3)


def test_a_capture_that_does_not_fit():
    axis = tt.TimeAxis(0.0, 1e-3, 100_000)
    large = tt.nlos.Scan.grid(WALL, (100, 100), kind="exhaustive")
    with pytest.raises(StorageError, match=r"would take .* TiB \(1 x 100000 x 100 x 100 x 100 x 100.*Use fewer bins"):
        simulated(of=large, time_axis=axis)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["single", "exhaustive"])
def test_points_on_the_edges_of_the_wall(kind):
    """They stand where rays in single precision meet it."""
    for center in ((0.0, 0.0, 0.0), (30.0, -20.0, 5.0)):
        wall = tt.nlos.Wall.plane(1.7, 0.83, center=center, normal=(0.3, 0.2, 1.0))
        spot = {"laser": (0.0, 1.0)} if kind == "single" else {}
        on_edges = tt.nlos.Scan.grid(wall, (3, 2), kind=kind, cell_centers=False, **spot)
        before = [c + 0.6 * n for c, n in zip(center, wall.normal, strict=True)]
        ball = {"type": "sphere", "center": before, "radius": 0.2}
        capture = tt.nlos.simulate({"ball": ball}, on_edges, spp=256, progress=False)
        assert bool((capture.total() > 0).all())
