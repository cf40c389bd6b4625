"""Operators as modules of torch: states, copies, parameters, precision without tables, default devices."""

import copy
import io
from dataclasses import replace

import pytest
import torch
from torch import nn

from support import grid_operators, scan_operators
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import (
    FK,
    LCT,
    Backprojection,
    DiffusionDeconvolution,
    DirectionalLCT,
    FilteredBackprojection,
    LaplacianFilter,
    MidpointFK,
    PhasorField,
    PhasorFilter,
    VoxelGrid,
)

OPERATORS = grid_operators.operators() | scan_operators.operators()
every = pytest.mark.parametrize("name", OPERATORS)
AXIS, CONFOCAL, SINGLE = grid_operators.AXIS, grid_operators.SCAN, grid_operators.SINGLE
MOVED = Scan.grid(grid_operators.WALL, (5, 6), kind="confocal").detach()
MOVED = replace(MOVED, sensor_points=MOVED.sensor_points * 1.001, laser_points=MOVED.laser_points * 1.001)
GRID = VoxelGrid.before(SINGLE, (0.1, 0.2))
PULSE = PhasorFilter(0.2, 3.0)


def fbp(**options):
    return FilteredBackprojection(SINGLE, GRID, time_axis=AXIS, **{"filter": PULSE, **options})


def field(**options):
    return PhasorField(SINGLE, GRID, time_axis=AXIS, **{"pulse": PULSE, **options})


OTHERS = {
    "axis": (lambda: FK(CONFOCAL, time_axis=AXIS), lambda: FK(CONFOCAL, time_axis=replace(AXIS, start_opl=0.12))),
    "scan": (lambda: FK(CONFOCAL, time_axis=AXIS), lambda: FK(MOVED, time_axis=AXIS)),
    "hidden side": (
        lambda: FK(CONFOCAL, time_axis=AXIS),
        lambda: FK(replace(FK(CONFOCAL, time_axis=AXIS).wall, normal=-CONFOCAL.sensor_normals[0, 0]), time_axis=AXIS),
    ),
    "class": (lambda: FK(CONFOCAL, time_axis=AXIS), lambda: LCT(CONFOCAL, time_axis=AXIS)),
    "floor": (lambda: FK(CONFOCAL, time_axis=AXIS), lambda: FK(CONFOCAL, time_axis=AXIS, floor=0.25)),
    "snr": (lambda: LCT(CONFOCAL, time_axis=AXIS), lambda: LCT(CONFOCAL, time_axis=AXIS, snr=20)),
    "v_bins": (
        lambda: DirectionalLCT(CONFOCAL, time_axis=AXIS),
        lambda: DirectionalLCT(CONFOCAL, time_axis=AXIS, v_bins=20),
    ),
    "points": (
        lambda: Backprojection(SINGLE, GRID.points, time_axis=AXIS),
        lambda: Backprojection(SINGLE, GRID.points.flip(0), time_axis=AXIS),
    ),
    "filter": (fbp, lambda: fbp(filter=LaplacianFilter())),
    "pulse": (field, lambda: field(pulse=PhasorFilter(0.21, 3.0))),
}  # fmt: skip


@every
def test_states_hold_no_tables_and_load_into_the_same_operator(name):
    operator = OPERATORS[name]
    model = nn.Sequential(nn.Linear(2, 2), copy.deepcopy(operator).float())
    file = io.BytesIO()
    torch.save(model.state_dict(), file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    assert all(key.endswith("_extra_state") or key.startswith("0.") for key in state)
    assert sum(tensor.numel() for tensor in state.values()) < 1 << 14
    # Another precision is the same operator.
    assert not any(nn.Sequential(nn.Linear(2, 2), copy.deepcopy(operator)).load_state_dict(state))
    without = {key: value for key, value in state.items() if key.startswith("0.")}
    missing, unexpected = model.load_state_dict(without, strict=False)
    assert missing and not unexpected


@pytest.mark.parametrize("name", OTHERS)
def test_states_of_other_operators_are_refused(name):
    one, other = (make() for make in OTHERS[name])
    copy.deepcopy(one).load_state_dict(one.state_dict())
    for strict in (True, False):
        # An operator in place of one of another kind may lack children, of which torch says so itself.
        with pytest.raises(ShapeError, match="expected the state of an operator like this one"):
            nn.ModuleList([other]).load_state_dict(nn.ModuleList([one]).state_dict(), strict=strict)


def test_scans_that_a_file_rounds_are_the_same():
    scan = CONFOCAL.detach()
    rounded = {name: getattr(scan, name).float().double() for name in ("sensor_points", "laser_points")}
    for kind in (FK, LCT, DiffusionDeconvolution):
        kind(replace(scan, **rounded), time_axis=AXIS).load_state_dict(kind(scan, time_axis=AXIS).state_dict())


# ----------------------------------------------------------------------------------- parameters, operators of one's own


# --------------------------------------------------------------------------------------------------- time zero, devices


@pytest.mark.parametrize("target", ["diffuse", "retroreflective"])
def test_light_before_time_zero_is_refused_alike(target):
    early = replace(AXIS, start_opl=-0.1)
    for kind, scan in ((FK, CONFOCAL), (LCT, CONFOCAL), (DirectionalLCT, CONFOCAL), (MidpointFK, SINGLE)):
        with pytest.raises(UnitError, match=f"{kind.__name__}: expected a time axis from zero on"):
            kind(scan, time_axis=early, target=target)
        made = [kind(scan, time_axis=replace(AXIS, start_opl=t), target=target) for t in (0.0, -1e-17)]
        light = torch.rand(made[0].data_shape)
        assert made[0].depths[0] > 0
        torch.testing.assert_close(made[1].reconstruct(light), made[0].reconstruct(light), rtol=1e-4, atol=0)
    slab = DiffusionDeconvolution(CONFOCAL, time_axis=early)
    assert slab.reconstruct(torch.rand(slab.data_shape)).isfinite().all()


def test_default_devices_of_torch_do_not_matter():
    def made():
        found = grid_operators.operators() | scan_operators.operators()
        wall = torch.zeros(2, 3, device="cpu")
        box = VoxelGrid.bounds(torch.stack([wall[0], wall[0] + 1]), 3)
        return found, box.points, [op.adjoint(data[name]) for name, op in found.items()], found["fk"].float().double()

    data = {name: torch.ones(operator.data_shape, dtype=torch.float64) for name, operator in OPERATORS.items()}
    data = {name: y if OPERATORS[name].real_data else y.to(torch.complex128) for name, y in data.items()}
    expected = made()
    torch.set_default_device("meta")
    try:
        found = made()
    finally:
        torch.set_default_device(None)
    torch.testing.assert_close(found[1:3], expected[1:3], rtol=0, atol=0)
    torch.testing.assert_close(found[3].weights, expected[3].weights, rtol=0, atol=0)
    capture = Capture(data["fk"][None], AXIS, CONFOCAL)
    with torch.device("meta"):
        assert OPERATORS["fk"].reconstruct(capture).device.type == "cpu"
        assert TimeAxis(0.0, 0.1, 3).centers_opl.device.type == "cpu"
