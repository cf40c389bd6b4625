"""An operator that is written as docs/contributing.md says: nothing else is needed."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

import torchtransient as tt
from torchtransient.errors import GradientError, ShapeError, UnitError
from torchtransient.reconstruction.transient_operator import ScanOperator, TransientOperator, reconstructed

AXIS = tt.TimeAxis(0.0, 0.05, 16)
SCAN = tt.nlos.Scan.grid(tt.nlos.Wall.plane(0.4, 0.3), (4, 3), kind="confocal")
GRID = tt.nlos.VoxelGrid.before(SCAN, [0.1, 0.2])


class EveryBin(ScanOperator):
    """A voxel is seen by every point in every bin, times a gain."""

    def __init__(self, scan, points, *, time_axis, gain=2.0, dtype=torch.float32):
        super().__init__(scan, points, time_axis=time_axis, dtype=dtype)
        self.level = gain
        self._set_tables()

    def tables(self):
        return {"gain": torch.tensor(self.level, dtype=torch.float64)}

    def map_(self, x):
        total = self.gain * x.sum((-3, -2, -1))
        return total[..., None, None, None].expand(*total.shape, *self.data_shape).clone()

    def adjoint_(self, y):
        total = self.gain * y.sum((-3, -2, -1))
        return total[..., None, None, None].expand(*total.shape, *self.volume_shape).clone()

    def reconstruct(self, transient):
        return self.adjoint(self.transients(transient))


def test_it_is_whole():
    operator = EveryBin(SCAN, GRID, time_axis=AXIS, dtype=torch.float64)
    x, y = torch.rand(2, *operator.volume_shape).double(), torch.rand(2, *operator.data_shape).double()
    torch.testing.assert_close((operator(x) * y).sum(), (x * operator.adjoint(y)).sum())
    assert torch.autograd.gradcheck(operator, x.requires_grad_(), check_forward_ad=True, fast_mode=True)
    assert operator.points.shape == (*GRID.shape, 3) and torch.equal(operator.depths, GRID.depths)
    assert copy.deepcopy(operator).float().dtype == torch.float32 and "voxels" in repr(operator)
    capture = tt.nlos.Capture(y[:1].detach(), AXIS, SCAN)
    expected = operator.reconstruct(capture)
    assert torch.equal(reconstructed(capture, EveryBin, GRID, who="every_bin"), expected)
    with pytest.raises(ShapeError, match="EveryBin: expected volume"):
        operator(y)
    with pytest.raises(UnitError, match="EveryBin: expected points within the record"):
        EveryBin(SCAN, GRID.at_depths([100.0]), time_axis=AXIS)


class Doubled(TransientOperator):
    """Twice a transient, without tables and voxels."""

    def __init__(self, scan, *, time_axis, dtype=torch.float32):
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        self.weight = 2.0
        self.volume_shape = self.data_shape = (time_axis.num_bins, *scan.shape)

    def map_(self, x):
        return self.weight * x

    adjoint_ = map_


def test_operators_without_tables_and_voxels():
    with pytest.raises(TypeError, match="abstract"):
        TransientOperator(SCAN, time_axis=AXIS, dtype=torch.float32)
    single = Doubled(SCAN, time_axis=AXIS)
    assert single.grid is None and single.depths is None
    x = torch.rand(single.volume_shape, dtype=torch.float64)
    assert single(x).dtype == torch.float32
    double = single.double()
    assert double.dtype == torch.float64 and torch.equal(double(x), 2 * x)
    assert double.to("meta").float().dtype == torch.float32
    with pytest.raises(UnitError, match=r"float32 or torch\.float64"):
        double.half()
    with pytest.raises(NotImplementedError):
        single.reconstruct(x)


@pytest.mark.parametrize("kind", [nn.Parameter, lambda t: t.requires_grad_()])
def test_parameters_of_a_class_would_get_no_gradient(kind):
    operator = Doubled(SCAN, time_axis=AXIS)
    x = torch.rand(operator.volume_shape)
    table = kind(torch.ones(()))
    del operator.weight
    if isinstance(table, nn.Parameter):
        operator.weight = table
    else:
        operator.register_buffer("weight", table)
    for function in (operator, operator.adjoint):
        with pytest.raises(GradientError, match="weight"):
            function(x)
    operator.weight.requires_grad_(False)
    assert torch.equal(operator(x), x)
