"""Captures: layouts, parts of exhaustive ones, what is computed of them, and records as torch knows them."""

import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils import _pytree

from support.sweeps import together
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.errors import ArgumentError, SceneError, ShapeError, StorageError, UnitError

WALL = Wall.plane(2.0, 1.6)
AXIS = TimeAxis(1.0, 0.1, 8)
LIST = torch.tensor([[0.1, 0.2, 0.0], [0.3, -0.4, 0.0], [-0.6, 0.7, 0.0]])
ORIGIN = (0.0, 0.0, 1.0)
SCANS = {
    "single": Scan.grid(WALL, (4, 3), kind="single"),
    "confocal": Scan.grid(WALL, (4, 3), kind="confocal"),
    "exhaustive": Scan.grid(WALL, (4, 3), kind="exhaustive"),
    "list": Scan.points(LIST, kind="confocal", sensor_origin=ORIGIN, laser_origin=ORIGIN),
    "lists": Scan.points(LIST, kind="exhaustive", laser_points=LIST, sensor_origin=ORIGIN, laser_origin=ORIGIN),
}


def capture(name, channels=2, **changes):
    scan = SCANS[name]
    generator = torch.Generator().manual_seed(1)
    transient = torch.rand(channels, AXIS.num_bins, *scan.shape, generator=generator)
    return Capture(**{"transient": transient, "axis": AXIS, "scan": scan, **changes})


def test_the_diagonal_is_confocal():
    made = capture("exhaustive", steady=torch.rand(2, *SCANS["exhaustive"].shape))
    batch = Capture.stack([made, made.map(lambda t: t + 1)])
    for given in (made, batch):
        diagonal = given.confocal()
        assert diagonal.scan.kind == "confocal" and diagonal.scan.shape == diagonal.transient.shape[-2:]
        for name in ("transient", "steady"):
            whole = getattr(given, name)
            expected = torch.stack([whole[..., r, c, r, c] for r in range(3) for c in range(4)], -1)
            assert torch.equal(getattr(diagonal, name).flatten(-2), expected)
    lists = capture("lists")
    expected = torch.stack([lists.transient[..., k, k] for k in range(3)], -1)
    assert torch.equal(lists.confocal().transient, expected)


def test_one_spot_of_an_exhaustive_capture():
    made = capture("exhaustive", steady=torch.rand(2, 3, 4, 3, 4))
    one = made.single((2, -1))
    assert one.scan.kind == "single" and torch.equal(one.scan.laser_points, made.scan.laser_points[2, 3])
    assert torch.equal(one.transient, made.transient[:, :, 2, 3])
    assert torch.equal(one.steady, made.steady[:, 2, 3])
    assert torch.equal(capture("lists").single(1).transient, capture("lists").transient[:, :, 1])
    batch = Capture.stack([made, made.map(lambda t: t + 1)])
    assert torch.equal(batch.single((1, 2)).transient, batch.transient[:, :, :, 1, 2])
    with pytest.raises(SceneError):
        capture("single").single(0)
    with pytest.raises(SceneError):
        capture("single").confocal()


def test_peak_time():
    made = capture("single", channels=3)
    transient = torch.zeros(3, 8, 3, 4)
    transient[0, 5, 1, 2], transient[1, 4, 1, 2], transient[2, 4, 1, 2] = 1.0, 0.6, 0.6
    peaks = Capture(transient, AXIS, made.scan).peak_time()
    assert peaks.shape == (3, 4) and peaks.dtype == torch.float64
    assert float(peaks[1, 2]) == pytest.approx(1.45)
    assert int(peaks.isnan().sum()) == 11


def test_channels_are_a_tuple_of_names():
    """Files of others could not be read."""
    for channels in (["red"], "red", (1,)):
        with pytest.raises(ArgumentError, match="tuple of names"):
            replace(capture("single"), channels=channels)


def test_phasors():
    axis = FrequencyAxis.uniform(1.0, 0.5, 5)
    phasor = torch.zeros(1, 5, 3, 4, dtype=torch.complex64)
    made = Capture(None, None, SCANS["single"], phasor=phasor, frequencies=axis)
    assert made.to(torch.float64).phasor.dtype == torch.complex128
    for method in ("total", "peak_time"):
        with pytest.raises(ShapeError):
            getattr(made, method)()
    with pytest.raises(ShapeError, match="frequencies="):
        Capture(None, None, SCANS["single"], phasor=phasor)
    with pytest.raises(ShapeError):
        Capture(None, None, SCANS["single"], phasor=phasor.real, frequencies=axis)


@together("given", [
    lambda t: t.numpy(), lambda t: t.double().numpy(), lambda t: t.tolist(), lambda t: t.numpy().astype(">f4"),
    lambda t: np.ascontiguousarray(t.flip(3).numpy())[..., ::-1],
    lambda t: np.frombuffer(t.numpy().tobytes(), np.float32).reshape(t.shape),
])  # fmt: skip
def test_arrays_and_lists_are_measured_too(given):
    expected = capture("single", steady=torch.rand(2, 3, 4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = Capture(given(expected.transient), AXIS, expected.scan, steady=expected.steady.numpy())
    assert torch.equal(made.transient.float(), expected.transient) and torch.equal(made.steady, expected.steady)
    assert made.crop(1.1, 1.3).total().shape == (2, 3, 4)
    axis = FrequencyAxis.uniform(1.0, 0.5, 5)
    phasor = Capture(None, None, SCANS["single"], phasor=np.ones((1, 5, 3, 4), np.complex64), frequencies=axis).phasor
    assert phasor.dtype == torch.complex64 and bool((phasor == 1).all())


def test_captures_are_compared():
    made = capture("single", steady=torch.rand(2, 3, 4), metadata={"seconds": 1.0})
    assert made == pickle.loads(pickle.dumps(made)) == replace(made, metadata={}) and made in [capture("list"), made]
    assert hash(made) == hash(made.clone())
    unlike = [
        made.map(lambda t: t + 1), made.to(torch.float64), replace(made, steady=None), made.crop(1.0, 1.5),
        replace(made, channels=("a", "b")), replace(made, scan=SCANS["confocal"]),
        replace(made, axis=TimeAxis(1.1, 0.1, 8)), made.transient, None,
    ]  # fmt: skip
    assert all(made != other for other in unlike)
    holes = made.map(lambda t: torch.where(t > 0.5, t, torch.nan))
    assert holes == holes.clone() != made


def test_captures_are_records():
    made = capture("confocal", metadata={"n": 1})
    assert pickle.loads(pickle.dumps(made)).scan == made.scan
    double = made.to(torch.float64)
    assert double.transient.dtype == torch.float64 and double.scan is made.scan
    both = Capture.stack([made, made])
    assert both.transient.shape == (2, 2, 8, 3, 4) and both.metadata == {"batch": [{"n": 1}, {"n": 1}]}
    assert both.total().shape == (2, 2, 3, 4) and both.peak_time().shape == (2, 3, 4)
    assert both.crop(1.0, 1.2).transient.shape == (2, 2, 2, 3, 4)
    assert torch.utils.data.default_collate([made, made]).transient.shape == both.transient.shape
    with pytest.raises(ShapeError, match="scan"):
        Capture.stack([made, capture("single")])
    leaves, tree = _pytree.tree_flatten(made)
    again = _pytree.tree_unflatten([2 * leaf for leaf in leaves], tree)
    assert torch.equal(again.transient, 2 * made.transient)
    for anything in (None, 3, np.zeros(2)):
        (leaf,), _ = _pytree.tree_flatten(_pytree.tree_unflatten([anything], tree))
        assert leaf is anything
    grown = made.map(lambda t: t.requires_grad_())
    assert grown.transient.requires_grad and not grown.detach().transient.requires_grad


def test_edges_of_a_crop_are_meant_to_a_millionth_of_a_bin():
    scan = SCANS["single"]
    capture = Capture(torch.arange(8.0)[None, :, None, None].expand(1, 8, 3, 4), TimeAxis(1.0, 0.5, 8), scan)

    def bins(start, end):
        part = capture.crop(start, end)
        assert part.axis.num_bins == part.transient.shape[1]
        return part.transient[0, :, 0, 0].tolist(), part.axis.start_opl

    near, far = 0.9e-6 * 0.5, 1.1e-6 * 0.5
    assert bins(2.0, 3.0) == ([2.0, 3.0], 2.0)
    # An edge is that of a bin, and keeps its digits; beyond, the bin is there in part.
    assert bins(2.0 - near, 3.0 + near) == ([2.0, 3.0], 2.0 - near)
    assert bins(2.0 + near, 3.0 - near) == ([2.0, 3.0], 2.0 + near)
    assert bins(2.0 - far, 3.0 + far) == ([1.0, 2.0, 3.0, 4.0], 1.5)
    assert bins(2.0 + far, 3.0 - far) == ([2.0, 3.0], 2.0)
    assert bins(2.25, 2.26) == ([2.0], 2.0) and bins(-9.0, 1.25) == ([0.0], 1.0) and bins(4.75, 9.0) == ([7.0], 4.5)
    part = capture.crop(1.5, 3.0)
    assert part.transient.data_ptr() == capture.transient[:, 1:].data_ptr() and capture.crop(0, 9).axis == capture.axis
    wrong = ((5.0, 6.0), (0.0, 1.0), (0.0, 1.0 + near), (5.0 - near, 6.0), (2.0, 2.0), (2.0, 1.5), (float("nan"), 2.0))
    for start, end in wrong:
        with pytest.raises(UnitError):
            capture.crop(start, end)


def test_leading_dimensions_are_channels_polarization_and_a_batch():
    scan = SCANS["single"]
    cube = torch.rand(5, 2, 8, 3, 4)
    assert Capture(cube, AXIS, scan).total().shape == (5, 2, 3, 4)
    for shape in ((8, 3, 4), (2, 9, 3, 4), (2, 8, 4, 3), (2, 0, 8, 3, 4), (2, 8, 3, 4, 1)):
        with pytest.raises(ShapeError):
            Capture(torch.zeros(shape), AXIS, scan)
    polarized = Capture(torch.rand(5, 4, 2, 8, 3, 4), AXIS, scan, polarized=True, steady=torch.rand(5, 4, 2, 3, 4))
    # Of the first Stokes component alone, all channels together.
    light = polarized.transient[:, 0].sum(1)
    assert torch.equal(polarized.peak_time(), AXIS.centers_opl[light.argmax(1)])
    for steady in (torch.zeros(5, 3, 2, 3, 4), torch.zeros(2, 3, 4), torch.zeros(5, 4, 2, 4, 3)):
        with pytest.raises(ShapeError):
            replace(polarized, steady=steady)


@together("changes, error", [
    *(({"transient": torch.zeros(shape)}, ShapeError) for shape in ((1, 7, 3, 4), (1, 8, 4, 3), (0, 8, 3, 4))),
    ({"transient": torch.zeros(1, 8, 3, 4, dtype=torch.complex64)}, ShapeError), ({"transient": None}, ShapeError),
    ({"transient": np.ma.masked_array(np.zeros((1, 8, 3, 4)), mask=False)}, ShapeError), ({"axis": None}, ShapeError),
    ({"steady": torch.zeros(2, 4, 3)}, ShapeError), ({"metadata": [1]}, StorageError),
    ({"metadata": {"t": torch.zeros(2)}}, StorageError),
])  # fmt: skip
def test_what_is_no_capture(changes, error):
    with pytest.raises(error):
        replace(capture("single"), **changes)
