"""What every operator between volumes and captures owes: an exact adjoint, derivatives in both modes, batches, places
of its voxels, captures as data, typed errors.
"""

import copy
import inspect
import math
import pickle
from dataclasses import replace
from functools import partial

import pytest
import torch

import torchtransient as tt
from support import grid_operators, scan_operators
from support.sweeps import together
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import (
    FK,
    LCT,
    Backprojection,
    DiffusionDeconvolution,
    DirectionalLCT,
    LinearOperator,
    MidpointFK,
    transient_operator,
)

ON_GRIDS, ANYWHERE = grid_operators.operators(), scan_operators.operators()
OPERATORS = ON_GRIDS | ANYWHERE
every = together("name", OPERATORS)
# Scans of pairs, lists and first and last legs take the code of single and confocal ones.
SOME = [name for name in OPERATORS if not any(word in name for word in ("legs", "exhaustive", "lists", "finer"))]
some = together("name", SOME)
on_grids = together("name", ON_GRIDS)
with_pictures = together("name", [name for name in OPERATORS if hasattr(OPERATORS[name], "reconstruct")])


def drawn(shape, real, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64 if real else torch.complex128)


def volume_of(operator, *lead, seed=0):
    return drawn((*lead, *operator.volume_shape), operator.real_volume, seed)


def data_of(operator, *lead, seed=1):
    return drawn((*lead, *operator.data_shape), operator.real_data, seed)


def product(a, b):
    """Re <a, b>."""
    return (a.conj() * b).sum().real


def as_real(function):
    """A function whose complex results are pairs of reals: random checks of derivatives want those."""
    return lambda x: torch.view_as_real(y) if (y := function(x)).is_complex() else y


def test_nothing_is_left_out():
    classes = [kind for kind in vars(tt.reconstruction).values() if inspect.isclass(kind)]
    kinds = {kind for kind in classes if issubclass(kind, LinearOperator)}
    assert kinds - {LinearOperator} <= {type(operator) for operator in OPERATORS.values()}


@every
def test_adjoint_is_exact(name):
    operator = OPERATORS[name]
    x, y = volume_of(operator, 2, 3), data_of(operator, 2, 3)
    forward, backward = product(operator(x), y), product(x, operator.adjoint(y))
    scale = operator(x).norm() * y.norm()
    assert scale > 0
    assert abs(forward - backward) < 1e-13 * scale
    assert abs(forward - backward) < 1e-10 * abs(forward)


def with_operand(name, way):
    """A method of an operator, what it takes, and the method of small operands: inverses are steep, and rounding stays
    below the checks' tolerance.
    """
    operator = OPERATORS[name]
    function = getattr(operator, way)
    x = (volume_of if way == "forward" else data_of)(operator)
    scale = 1 / float(function(x).abs().max())
    return operator, function, x, as_real(lambda v: function(scale * v))


@some
@together("way", ["forward", "adjoint"])
def test_derivatives_in_both_modes(name, way):
    operator, function, x, scaled = with_operand(name, way)
    assert torch.autograd.gradcheck(
        scaled, x.clone().requires_grad_(), check_forward_ad=True, fast_mode=True, check_undefined_grad=False
    )
    direction = (volume_of if way == "forward" else data_of)(operator, seed=5)
    value, tangent = torch.func.jvp(function, (x,), (direction,))
    torch.testing.assert_close(value, function(x), rtol=0, atol=0)
    torch.testing.assert_close(tangent, function(direction), rtol=0, atol=0)


@pytest.mark.parametrize("name", ["fk", "inverse of lct", "phasor field, single"])
def test_derivatives_of_second_order_of_some(name):
    _, _, x, scaled = with_operand(name, "forward")
    assert torch.autograd.gradgradcheck(scaled, x.clone().requires_grad_(), fast_mode=True)


@some
def test_batches_and_channels_are_items_on_their_own(name):
    operator = OPERATORS[name]
    # Grids take items one at a time; the others may add up in another order.
    close = {"rtol": 0, "atol": 0} if name in ON_GRIDS else {"rtol": 1e-12, "atol": 1e-12}
    for function, x in ((operator, volume_of(operator, 2, 3)), (operator.adjoint, data_of(operator, 2, 3))):
        together = function(x)
        assert together.shape[:2] == (2, 3)
        torch.testing.assert_close(function(x[1, 2]), together[1, 2], **close)
        torch.testing.assert_close(torch.vmap(function)(x), together, **close)
        torch.testing.assert_close(torch.vmap(function, in_dims=1, out_dims=1)(x), together, **close)


@on_grids
def test_pieces_do_not_show(name, monkeypatch):
    operator = OPERATORS[name]
    x, y = volume_of(operator), data_of(operator)
    whole = operator(x), operator.adjoint(y)
    for elements in (1, 400, 1 << 30):
        monkeypatch.setattr(transient_operator, "CPU_CHUNK", elements)
        for found, expected in zip((operator(x), operator.adjoint(y)), whole, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12 * float(expected.abs().max()))


@every
def test_single_precision_has_its_digits(name):
    double = OPERATORS[name]
    single = copy.deepcopy(double).float()
    assert single.dtype == torch.float32
    # Arrivals anywhere are exact to some 1e-6 bins of 24, and what they are interpolated between varies by its own
    # size.
    most = 1e-5 if name in ON_GRIDS else 2e-5
    for function, twin, x in ((single, double, volume_of(double)), (single.adjoint, double.adjoint, data_of(double))):
        expected, found = twin(x), function(x.to(torch.complex64 if x.is_complex() else torch.float32))
        assert found.dtype == (torch.complex64 if expected.is_complex() else torch.float32)
        assert (found - expected).norm() < most * expected.norm()


@every
def test_copies_and_pickles_are_the_same_operator(name):
    operator = OPERATORS[name]
    y = data_of(operator)
    for other in (copy.deepcopy(operator), pickle.loads(pickle.dumps(operator))):
        torch.testing.assert_close(other.adjoint(y), operator.adjoint(y), rtol=0, atol=0)
        torch.testing.assert_close(other.points, operator.points, rtol=0, atol=0)
    assert ("voxels" if "slab" not in name else "bins and points") in repr(operator)


@every
def test_nothing_is_kept_for_the_backward_pass(name):
    operator = OPERATORS[name]
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):
        operator(volume_of(operator).requires_grad_())
        operator.adjoint(data_of(operator).requires_grad_())
    assert not kept


@every
def test_wrong_operands_are_refused(name):
    operator = OPERATORS[name]
    with pytest.raises(ShapeError, match=f"expected {operator.data_name} "):
        operator.adjoint(torch.zeros(3, 3))
    with pytest.raises(ShapeError, match=f"expected {operator.volume_name} "):
        operator(torch.zeros(3))
    with pytest.raises(ShapeError, match="real numbers"):
        operator.adjoint(data_of(operator).to(torch.complex128))
    with pytest.raises(ShapeError, match="empty batch"):
        operator(torch.zeros(0, *operator.volume_shape))


@pytest.mark.slow
@every
def test_works_where_its_tables_are(name):
    # The meta device refuses everything that stays on the CPU.
    operator = copy.deepcopy(OPERATORS[name]).to("meta")
    assert str(operator.device) == "meta" and operator.dtype == torch.float64
    assert operator(volume_of(operator, 2).to("meta")).shape == (2, *operator.data_shape)
    assert operator.adjoint(data_of(operator, 2).to("meta")).shape == (2, *operator.volume_shape)
    if hasattr(operator, "reconstruct"):
        assert operator.reconstruct(data_of(operator, 2).to("meta")).shape == (2, *operator.volume_shape)


@pytest.mark.slow
@some
def test_autocast_does_not_reach_in(name):
    operator = copy.deepcopy(OPERATORS[name]).float()
    for function, make in ((operator, volume_of), (operator.adjoint, data_of)):
        x = make(operator, 2).requires_grad_()
        (slope,) = torch.autograd.grad(function(x).abs().sum(), x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = function(x)
            torch.testing.assert_close(found, function(x.detach()), rtol=0, atol=0)
        torch.testing.assert_close(found, function(x), rtol=0, atol=0)
        (other,) = torch.autograd.grad(found.abs().sum(), x)
        torch.testing.assert_close(other, slope, rtol=0, atol=0)


@some
def test_operands_of_other_kinds_are_converted(name):
    operator = copy.deepcopy(OPERATORS[name]).float()
    for function, make in ((operator, volume_of), (operator.adjoint, data_of)):
        whole = (8 * make(operator).real.abs()).round()
        found = function(whole.to(torch.int16))
        torch.testing.assert_close(found, function(whole.float()), rtol=0, atol=0)
        assert found.dtype in (torch.float32, torch.complex64)


@pytest.mark.parametrize("name", [name for name in OPERATORS if name.startswith("inverse")])
def test_inverses_are_operators_of_their_own(name):
    operator = copy.deepcopy(OPERATORS[name].operator)
    inverse = operator.inverse
    y = data_of(operator)
    expected = inverse(y)
    operator.float()
    assert inverse.dtype == torch.float64
    torch.testing.assert_close(inverse(y), expected, rtol=0, atol=0)
    inverse.float()
    operator.double()
    assert operator.dtype == torch.float64 and inverse.dtype == torch.float32
    assert inverse(y).dtype == inverse.adjoint(inverse(y)).dtype == torch.float32
    torch.testing.assert_close(operator.inverse(y), expected, rtol=0, atol=0)
    # No copies of tables until then.
    held = {table.data_ptr() for table in operator.buffers()}
    assert {table.data_ptr() for table in operator.inverse.buffers()} == held


# ----------------------------------------------------------------------------------------- places, captures, arguments


@every
def test_voxels_have_places(name):
    operator = OPERATORS[name]
    points = operator.points
    assert points.dtype == torch.float64 and points.shape[-1] == 3 and str(points.device) == "cpu"
    # Those of the result of an inverse.
    volume = operator.data_shape if operator.data_name == "volume" else operator.volume_shape
    assert volume[len(volume) - points.ndim + 1 :] == points.shape[:-1]
    assert isinstance(operator.axis, TimeAxis)
    if operator.grid is None:
        assert operator.depths is None
        return
    torch.testing.assert_close(operator.grid.points, points, rtol=0, atol=0)
    assert operator.depths.shape == (points.shape[0],) and operator.depths.dtype == torch.float64
    from_wall = (points - points[:1]).norm(dim=-1)
    torch.testing.assert_close(from_wall, (operator.depths - operator.depths[0])[:, None, None].expand_as(from_wall))


@with_pictures
def test_pictures_are_real_and_differentiable(name):
    operator = OPERATORS[name]
    y = data_of(operator).requires_grad_()
    picture = operator.reconstruct(y)
    assert picture.shape == operator.volume_shape
    assert not picture.is_complex()
    (gradient,) = torch.autograd.grad(picture.square().sum(), y)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().max() > 0
    zero = torch.zeros_like(y, requires_grad=True)
    (gradient,) = torch.autograd.grad(operator.reconstruct(zero).sum(), zero)
    assert torch.isfinite(gradient).all()
    with pytest.raises(ShapeError, match="expected transient"):
        operator.reconstruct(torch.zeros(2))


@with_pictures
def test_captures_are_taken_as_their_transients(name):
    operator = OPERATORS[name]
    light = data_of(operator, 2)
    expected = operator.reconstruct(light)
    for scan in (operator.scan, copy.deepcopy(operator.scan)):
        found = operator.reconstruct(Capture(light, operator.axis, scan))
        torch.testing.assert_close(found, expected, rtol=0, atol=0)


@with_pictures
def test_captures_of_something_else_are_refused(name):
    operator = OPERATORS[name]
    light, scan = data_of(operator, 2), operator.scan
    later = replace(operator.axis, start_opl=operator.axis.start_opl + 0.01)
    moved = replace(scan, sensor_points=scan.sensor_points + 0.01, laser_points=scan.laser_points + 0.01)
    for other, words in (
        (Capture(light, later, scan), "as the operator has"),
        (Capture(light, operator.axis, moved), "own scan"),
        (Capture(light, operator.axis, replace(scan, first_and_last_leg=not scan.first_and_last_leg)), "leg"),
        (Capture(light[:1].expand(4, 2, *operator.data_shape), operator.axis, scan, polarized=True), "Stokes"),
    ):
        with pytest.raises(ShapeError, match=words):
            operator.reconstruct(other)


@pytest.mark.parametrize("name", ["fk", "midpoint fk", "backprojection"])
def test_what_the_caller_does_to_its_points_later_does_not_matter(name):
    # Points that are not leaves of a graph: they are copied, and operators are.
    zero, of = torch.zeros((), dtype=torch.float64, requires_grad=True), {"time_axis": grid_operators.AXIS}
    kind = "single" if name == "midpoint fk" else "confocal"
    scan = Scan.grid(grid_operators.WALL, (4, 3), kind=kind).detach()
    points = scan.sensor_points + zero
    scan = replace(scan, sensor_points=points, laser_points=points if kind == "confocal" else scan.laser_points + zero)
    hidden = torch.tensor([[0.0, 0.01, 0.2], [0.02, 0.0, 0.3]], dtype=torch.float64)
    made = {"fk": FK, "midpoint fk": MidpointFK, "backprojection": partial(Backprojection, points=hidden)}
    operator = made[name](scan, dtype=torch.float64, **of)
    y, places = data_of(operator), operator.points.clone()
    expected = operator.adjoint(y)
    hidden += 0.3
    with torch.no_grad():
        scan.sensor_points.mul_(1.3)
    again = copy.deepcopy(operator).float().double()
    torch.testing.assert_close(again.adjoint(y), expected, rtol=0, atol=0)
    for one in (again, operator):
        torch.testing.assert_close(one.points, places, rtol=0, atol=0)


@pytest.mark.parametrize("kind", [LCT, DirectionalLCT, DiffusionDeconvolution])
def test_ratios_that_single_precision_cannot_hold(kind):
    of = {"time_axis": grid_operators.AXIS}
    for snr in (1e-20, 1e20):
        operator = kind(grid_operators.SCAN, snr=snr, **of)
        assert operator.reconstruct(torch.ones(operator.data_shape)).isfinite().all()
    for snr in (1e-60, 1e60, 0.0, math.inf, None):
        with pytest.raises(UnitError, match="snr"):
            kind(grid_operators.SCAN, snr=snr, **of)
