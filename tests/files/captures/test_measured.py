"""Measured captures of others: units, positions, and where each number goes."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from torchtransient.errors import StorageError
from torchtransient.files import read_capture
from torchtransient.reconstruction import PlanarScan
from torchtransient.units import SPEED_OF_LIGHT

MEASURED = Path(__file__).with_name("measured")
SCAN, TRACK, DIRECT = (MEASURED / f"{name}.mat" for name in ("cdt_letter_s", "keyhole_k_scan", "keyhole_k_direct"))


def raw(path, name):
    with h5py.File(path) as file:
        return file[name][()]


def test_a_scan_through_foam():
    capture = read_capture(SCAN, wall_size=0.6)
    assert capture.axis.bin_width_opl == 16e-12 * SPEED_OF_LIGHT and capture.axis.start_opl == 0
    assert capture.transient.shape == (1, 512, 32, 32) and capture.transient.dtype == torch.float32
    np.testing.assert_array_equal(capture.transient[0], raw(SCAN, "meas").transpose(2, 1, 0))
    points, pitch = capture.scan.sensor_points, 0.6 / 32
    np.testing.assert_allclose(PlanarScan.of_scan(capture.scan, "test").pitch[::-1], (pitch, pitch), rtol=1e-12)
    np.testing.assert_allclose(points[0, 0], [-0.3 + pitch / 2, -0.3 + pitch / 2, 0], atol=1e-15)
    np.testing.assert_allclose(points[3, 5] - points[0, 0], [5 * pitch, 3 * pitch, 0], atol=1e-15)
    assert capture.scan.kind == "confocal" and not capture.scan.first_and_last_leg
    assumed = capture.metadata["assumed"]
    assert assumed["bin_width_s"] == 16e-12 and assumed["start_s"] == 0.0
    assert assumed["sensor_origin"] == capture.scan.sensor_origin.tolist()
    wide = read_capture(SCAN, wall_size=(0.6, 0.7)).scan
    np.testing.assert_allclose(PlanarScan.of_scan(wide, "test").pitch[::-1], np.array([0.6, 0.7]) / 32, rtol=1e-12)
    with pytest.raises(StorageError, match=r"does not say wall_size. Give wall_size="):
        read_capture(SCAN)


@pytest.mark.slow
def test_a_track_seen_through_a_keyhole():
    """The direct light says when the wall is lit; the letter is 0.6 to 0.8 m away, so that its light comes later."""
    direct = read_capture(DIRECT)
    assert direct.transient.shape == (1, 65536, 1) and direct.transient.dtype == torch.int64
    zero = direct.peak_time()[0].item() / SPEED_OF_LIGHT
    assert zero == pytest.approx(635 * 16e-12, abs=16e-12)
    capture = read_capture(TRACK, start_s=-zero)
    assert capture.axis.bin_width_opl == 16e-12 * SPEED_OF_LIGHT
    assert capture.axis.start_opl == pytest.approx(-zero * SPEED_OF_LIGHT, rel=1e-15)
    np.testing.assert_array_equal(capture.transient[0].T, raw(TRACK, "data"))
    x, z = raw(TRACK, "xpos").ravel(), raw(TRACK, "zpos").ravel()
    np.testing.assert_array_equal(capture.scan.sensor_points, np.stack([-x, 0 * x, z], 1))
    assert (x.min(), x.max(), z.min(), z.max()) == (0.0, 1.0, 0.0, 0.15)
    assert capture.metadata["xpos"] == x.tolist() and capture.metadata["zpos"] == z.tolist()
    # Beyond the direct light, the strongest is that of the letter, after twice its distance.
    centers, counts = capture.axis.centers_opl, capture.transient[0].sum(1)
    late = (centers > 1.0) & (centers < 2.5)
    assert 1.1 < centers[late][counts[late].argmax()].item() < 2.0


@pytest.mark.parametrize(("path", "name", "said"), [(SCAN, "meas", {"wall_size": 0.6}), (TRACK, "data", {})])
def test_numbers_are_read_once(path, name, said):
    """No copy beside the one that the tensor rests on: what else is taken is a small part of it."""
    expected = raw(path, name).nbytes
    tracemalloc.start()
    try:
        capture = read_capture(path, **said)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert capture.transient.untyped_storage().nbytes() == expected
    assert peak < 1.2 * expected
