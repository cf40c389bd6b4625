"""Captures from which the first and the last leg are taken."""

import pytest
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import fk, subtract_legs

WALL = Wall.plane(1.0, 0.8)
ORIGINS = {"sensor_origin": (0.2, 0.0, 1.0), "laser_origin": (-0.3, 0.1, 1.2)}
SETTINGS = {
    "confocal": {"kind": "confocal"},
    "single": {"kind": "single", "laser": (0.3, 0.4)},
    "exhaustive": {"kind": "exhaustive", "laser_grid": (2, 3)},
}


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


def test_late_axes_keep_their_start_and_gradients_go_through():
    scan = Scan.grid(WALL, (6, 5), kind="confocal", first_and_last_leg=True, **ORIGINS)
    capture = capture_of(scan, TimeAxis(3.0, 0.02, 80))
    found = subtract_legs(capture)
    assert found.axis.num_bins == 80
    assert found.axis.start_opl == pytest.approx(3.0 - float(scan.legs.min()))
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
    with pytest.raises(ShapeError, match=r"tt\.nlos\.Capture"):
        subtract_legs(None)
