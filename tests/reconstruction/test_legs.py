"""Captures from which the first and the last leg are taken."""

import pytest
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import ShapeError, UnitError
from torchtransient.nlos import fk, subtract_legs

WALL = Wall.plane(1.0, 0.8)
ORIGINS = {"sensor_origin": (0.2, 0.0, 1.0), "laser_origin": (-0.3, 0.1, 1.2)}
SETTINGS = {"confocal": {"kind": "confocal"}, "exhaustive": {"kind": "exhaustive", "laser_grid": (2, 3)}}


def capture_of(scan, axis, point=(0.1, 0.0, 0.7)):
    """A point's pulses, with the legs where the scan counts them."""
    point = torch.tensor(point, dtype=torch.float64)
    near, far = ((p - point).norm(dim=-1) for p in (scan.laser_points, scan.sensor_points))
    if scan.kind == "exhaustive":
        near = near.reshape(*near.shape, 1, 1)
    length = near + far + (scan.legs if scan.first_and_last_leg else 0)
    edges = axis.edges_opl.reshape(-1, *(1,) * length.ndim)
    return Capture(torch.special.ndtr((edges - length) / 0.1).diff(dim=0)[None], axis, scan)


@pytest.mark.parametrize("name", SETTINGS)
def test_is_the_capture_that_counts_no_legs(name):
    counted = Scan.grid(WALL, (6, 5), first_and_last_leg=True, **ORIGINS, **SETTINGS[name])
    plain = Scan.grid(WALL, (6, 5), **ORIGINS, **SETTINGS[name])
    found = subtract_legs(capture_of(counted, TimeAxis(1.5, 0.02, 250)))
    assert not found.scan.first_and_last_leg and found.scan == plain
    assert 0 <= found.axis.start_opl < 0.02 and found.axis.bin_width_opl == 0.02
    expected = capture_of(plain, found.axis)
    assert float(expected.transient.sum()) == pytest.approx(plain.pairs, rel=1e-3)
    # Linear interpolation of a pulse of 5 bins: h^2 / 8 of its second derivative.
    error = (found.transient - expected.transient).abs().max() / expected.transient.max()
    assert float(error) < 0.04 / 8 * 1.2
    torch.testing.assert_close(found.transient.sum(1), expected.transient.sum(1), rtol=1e-3, atol=0)


def test_gradients_go_through():
    scan = Scan.grid(WALL, (6, 5), kind="confocal", first_and_last_leg=True, **ORIGINS)
    capture = capture_of(scan, TimeAxis(3.0, 0.02, 80))
    light = capture.transient.clone().requires_grad_()
    volume = fk(subtract_legs(Capture(light, capture.axis, scan)), floor=0.25)
    (gradient,) = torch.autograd.grad(volume.sum(), light)
    assert torch.isfinite(gradient).all() and gradient.abs().max() > 0


def test_without_legs_it_is_the_same_capture():
    capture = capture_of(Scan.grid(WALL, 4, kind="confocal"), TimeAxis(0.0, 0.1, 40))
    assert subtract_legs(capture) is capture


def test_what_it_cannot_take_is_refused():
    scan = Scan.grid(WALL, (6, 5), kind="confocal", first_and_last_leg=True, **ORIGINS)
    with pytest.raises(UnitError, match="Does its time axis count the legs"):
        subtract_legs(capture_of(scan, TimeAxis(0.0, 0.1, 12)))
    phasor, frequencies = torch.zeros(1, 2, 5, 6, dtype=torch.complex64), FrequencyAxis((1.0, 2.0))
    with pytest.raises(ShapeError, match="phasors alone"):
        subtract_legs(Capture(None, None, scan, phasor=phasor, frequencies=frequencies))
    both = Capture(torch.zeros(1, 40, 5, 6), TimeAxis(2.0, 0.1, 40), scan, phasor=phasor, frequencies=frequencies)
    with pytest.raises(ShapeError, match="transient alone"):
        subtract_legs(both)


def of_legs(spots, sensors, axis, light):
    """A single or exhaustive capture on a line whose points have legs of as many metres; one channel."""
    kind = "exhaustive" if len(spots) > 1 else "single"
    lasers = torch.tensor([[0.0, 0.0, float(s)] for s in spots], dtype=torch.float64)
    points = torch.tensor([[0.0, float(s), 0.0] for s in sensors], dtype=torch.float64)
    scan = Scan.points(
        points, kind=kind, laser_points=lasers if kind == "exhaustive" else lasers[0], sensor_origin=(0, 0, 0),
        laser_origin=(0, 0, 0), first_and_last_leg=True,
    )  # fmt: skip
    return Capture(light.reshape(1, axis.num_bins, *scan.shape), axis, scan)


@pytest.mark.parametrize("start, first, kept", [
    # Bins of half a metre, the shortest legs of a metre: a record from zero on loses two bins; one from 0.75 m on its
    # first bin, which began before time zero.
    (0.0, 0.0, 6), (2.5, 1.5, 8), (0.75, 0.25, 7),
])  # fmt: skip
def test_legs_of_whole_bins_move_histograms_by_bins(start, first, kept):
    axis = TimeAxis(start, 0.5, 8)
    light = torch.arange(1.0, 17.0, dtype=torch.float64).reshape(8, 2) ** 2
    # Legs of 1 m and 1.5 m.
    found = subtract_legs(of_legs([0.75], [0.25, 0.75], axis, light))
    assert found.axis == TimeAxis(first, 0.5, kept)
    expected = torch.zeros(kept, 2, dtype=torch.float64)
    expected[:, 0] = light[8 - kept :, 0]
    # A bin more: what would come from behind the record is zero.
    expected[:-1, 1] = light[9 - kept :, 1]
    assert torch.equal(found.transient[0], expected)


def test_legs_of_every_pair_of_an_exhaustive_scan():
    axis = TimeAxis(1.0, 0.5, 5)
    light = torch.rand(5, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = subtract_legs(of_legs([0.25, 0.75], [0.75, 1.25, 2.25], axis, light)).transient[0]
    for spot, sensor in ((a, b) for a in range(2) for b in range(3)):
        later = spot + (0, 1, 3)[sensor]
        expected = torch.cat([light[later:, spot, sensor], torch.zeros(later, dtype=torch.float64)])
        torch.testing.assert_close(found[:, spot, sensor], expected, rtol=0, atol=1e-12)


def test_batches_and_channels_are_moved_alike():
    axis = TimeAxis(1.0, 0.5, 6)
    light = torch.rand(3, 2, 6, 1, 2, dtype=torch.float32, generator=torch.Generator().manual_seed(0))
    scan = of_legs([0.75], [0.25, 0.375], axis, light[0, 0]).scan
    found = subtract_legs(Capture(light.reshape(3, 2, 6, 2), axis, scan)).transient
    assert found.dtype == torch.float32
    one = subtract_legs(Capture(light[2, 1].reshape(1, 6, 2), axis, scan)).transient[0]
    torch.testing.assert_close(found[2, 1], one, rtol=0, atol=0)
    counts = (8 * light).to(torch.int32).reshape(3, 2, 6, 2)
    assert subtract_legs(Capture(counts, axis, scan)).transient.dtype == torch.float32
