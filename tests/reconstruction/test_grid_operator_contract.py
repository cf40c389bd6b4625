"""What every operator of confocal grids owes: an exact adjoint, derivatives in both modes, batches, typed errors."""

import copy
import pickle

import pytest
import torch
from support.grid_operators import operators

from torchtransient.errors import DeviceError, ShapeError, UnitError
from torchtransient.reconstruction import confocal_operator

OPERATORS = operators()
pytestmark = pytest.mark.parametrize("name", OPERATORS)


def drawn(shape, real, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64 if real else torch.complex128)


def volume_of(operator, *lead, seed=0):
    return drawn((*lead, *operator.volume_shape), operator.real_volume, seed)


def data_of(operator, *lead, seed=1):
    return drawn((*lead, *operator.data_shape), operator.real_data, seed)


def product(a, b):
    return (a.conj() * b).sum().real


def as_real(function):
    return lambda x: torch.view_as_real(y) if (y := function(x)).is_complex() else y


def test_adjoint_is_exact(name):
    operator = OPERATORS[name]
    x, y = volume_of(operator, 2, 3), data_of(operator, 2, 3)
    forward, backward = product(operator(x), y), product(x, operator.adjoint(y))
    assert operator(x).norm() > 0
    assert abs(forward - backward) < 1e-10 * abs(forward)


@pytest.mark.parametrize("way", ["forward", "adjoint"])
def test_derivatives_of_first_and_second_order_in_both_modes(name, way):
    operator = OPERATORS[name]
    function = getattr(operator, way)
    x = (volume_of if way == "forward" else data_of)(operator)
    # Inverses are steep: small operands keep rounding below the checks' tolerance.
    scale = 1 / float(function(x).abs().max())
    scaled = as_real(lambda v: function(scale * v))
    assert torch.autograd.gradcheck(scaled, x.clone().requires_grad_(), check_forward_ad=True, fast_mode=True)
    assert torch.autograd.gradgradcheck(scaled, x.clone().requires_grad_(), fast_mode=True)
    _, tangent = torch.func.jvp(function, (x,), (x,))
    torch.testing.assert_close(tangent, function(x), rtol=0, atol=0)


def test_batches_and_channels_are_items_on_their_own(name):
    operator = OPERATORS[name]
    for function, x in ((operator, volume_of(operator, 2, 3)), (operator.adjoint, data_of(operator, 2, 3))):
        together = function(x)
        assert together.shape[:2] == (2, 3)
        torch.testing.assert_close(function(x[1, 2]), together[1, 2], rtol=0, atol=0)
        torch.testing.assert_close(torch.vmap(function)(x), together, rtol=0, atol=0)
        torch.testing.assert_close(torch.vmap(function, in_dims=1, out_dims=1)(x), together, rtol=0, atol=0)


def test_pieces_do_not_show(name, monkeypatch):
    operator = OPERATORS[name]
    x, y = volume_of(operator), data_of(operator)
    whole = operator(x), operator.adjoint(y)
    for elements in (1, 400, 1 << 30):
        monkeypatch.setattr(confocal_operator, "CPU_CHUNK", elements)
        for found, expected in zip((operator(x), operator.adjoint(y)), whole, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12 * float(expected.abs().max()))


def test_single_precision_has_its_digits(name):
    double = OPERATORS[name]
    single = copy.deepcopy(double).float()
    assert single.dtype == torch.float32
    for function, twin, x in ((single, double, volume_of(double)), (single.adjoint, double.adjoint, data_of(double))):
        expected, found = twin(x), function(x.to(torch.complex64 if x.is_complex() else torch.float32))
        assert found.dtype == (torch.complex64 if expected.is_complex() else torch.float32)
        assert (found - expected).norm() < 1e-5 * expected.norm()


def test_back_in_double_precision_all_digits_are_there(name):
    operator = OPERATORS[name]
    again = copy.deepcopy(operator).float().double()
    torch.testing.assert_close(again.adjoint(data_of(operator)), operator.adjoint(data_of(operator)), rtol=0, atol=0)


def test_other_precisions_are_refused(name):
    with pytest.raises(UnitError, match="float32 or torch.float64"):
        copy.deepcopy(OPERATORS[name]).half()


def test_copies_and_pickles_are_the_same_operator(name):
    operator = OPERATORS[name]
    for other in (copy.deepcopy(operator), pickle.loads(pickle.dumps(operator))):
        torch.testing.assert_close(other.adjoint(data_of(operator)), operator.adjoint(data_of(operator)), rtol=0, atol=0)
    assert not operator.state_dict()


def test_nothing_is_kept_for_the_backward_pass(name):
    operator = OPERATORS[name]
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):
        operator(volume_of(operator).requires_grad_())
        operator.adjoint(data_of(operator).requires_grad_())
    assert not kept


def test_wrong_operands_are_refused(name):
    operator = OPERATORS[name]
    with pytest.raises(ShapeError, match="expected data"):
        operator.adjoint(torch.zeros(3, 3))
    with pytest.raises(ShapeError, match="expected volume"):
        operator(torch.zeros(3))
    with pytest.raises(ShapeError, match="real numbers"):
        operator.adjoint(data_of(operator).to(torch.complex128))
    with pytest.raises(DeviceError, match="expected volume on cpu"):
        operator(volume_of(operator).to("meta"))
