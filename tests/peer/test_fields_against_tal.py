"""Backprojection and phasor fields beside y-tal, in the environment that TORCHTRANSIENT_TAL_PYTHON names."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

from tools.point_captures import point_capture
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.reconstruction import (
    Backprojection,
    ConfocalCamera,
    FilteredBackprojection,
    PhasorField,
    PhasorFilter,
    TransientCamera,
    VoxelGrid,
)

pytestmark = pytest.mark.peer

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
AXIS = TimeAxis(0.0, 0.0384, 128)
POINTS = [(0.1, -0.15, 1.0), (-0.2, 0.1, 0.85)]
DEPTHS = [0.8, 0.85, 0.9, 1.0]
PULSE = PhasorFilter(0.3, 4.0)


@pytest.fixture(scope="module")
def benchmark():
    """The program that hands captures to the peer."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        spec = importlib.util.spec_from_file_location("nlos_fields", BENCHMARKS / "nlos_fields.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(BENCHMARKS))
    return module


@pytest.fixture(scope="module")
def tal(benchmark, tal_python):
    worker = benchmark.Tal(tal_python, 1)
    yield worker
    worker.close()


def capture_of(kind):
    settings = {"exhaustive": {"laser_grid": 3}}.get(kind, {})
    scan = Scan.grid(Wall.plane(1.0, 1.0), (16, 12), kind=kind, **settings)
    return point_capture(scan, POINTS, time_axis=AXIS)


def planes(scan):
    # Pitches of y-tal's planes are those of the sensor points.
    return VoxelGrid.before(scan, DEPTHS)


@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_volumes_are_those_of_the_peer(benchmark, tal, kind):
    # The peer takes the nearest bin, which is off by a quarter of one on average; x and y have different sizes.
    capture = capture_of(kind)
    tal.load(capture)
    light, of = capture.transient[0], {"time_axis": AXIS, "dtype": torch.float64}
    theirs, _ = tal.solve("bp", DEPTHS)
    ours = Backprojection(capture.scan, planes(capture.scan), **of).adjoint(light)
    assert benchmark.correlation(ours, theirs) > 0.999
    theirs, _ = tal.solve("fbp", DEPTHS, wl_mean=PULSE.wavelength, wl_sigma=PULSE.sigma)
    for method in (
        FilteredBackprojection(capture.scan, planes(capture.scan), filter=PULSE, **of),
        PhasorField(capture.scan, planes(capture.scan), pulse=PULSE, **of),
    ):
        assert benchmark.correlation(method.adjoint(light), theirs) > 0.99


@pytest.mark.parametrize("name", ["TRANSIENT", "CONFOCAL_TIME_GATED"])
def test_videos_are_those_of_the_peer(benchmark, tal, name):
    capture = capture_of("single")
    tal.load(capture)
    video, _ = tal.solve("fbp", DEPTHS, camera=name, wl_mean=PULSE.wavelength, wl_sigma=PULSE.sigma)
    moments = [20, 24, 28] if name == "TRANSIENT" else [0, 2, 5]
    camera = {"TRANSIENT": TransientCamera, "CONFOCAL_TIME_GATED": ConfocalCamera}[name]
    of = {"time_axis": AXIS, "pulse": PULSE, "camera": camera([AXIS.bin_width_opl * k for k in moments])}
    operator = PhasorField(capture.scan, planes(capture.scan), dtype=torch.float64, **of)
    for frame, moment in zip(operator.adjoint(capture.transient[0]), moments, strict=True):
        assert benchmark.correlation(frame, video[moment]) > 0.99
