"""What every operator between volumes and captures owes: an exact adjoint, derivatives, batches, typed errors."""

import copy
import pickle

import pytest
import torch

from support.scan_operators import operators
from torchtransient.errors import DeviceError, ShapeError

OPERATORS = operators()
NAMES = list(OPERATORS)
pytestmark = pytest.mark.parametrize("name", NAMES)


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

    def real(x):
        y = function(x)
        return torch.view_as_real(y) if y.is_complex() else y

    return real


def test_adjoint_is_exact(name):
    operator = OPERATORS[name]
    x, y = volume_of(operator, 2, 3), data_of(operator, 2, 3)
    forward, backward = product(operator(x), y), product(x, operator.adjoint(y))
    scale = operator(x).norm() * y.norm()
    assert scale > 0
    assert abs(forward - backward) < 1e-13 * scale
    assert abs(forward - backward) < 1e-10 * abs(forward)


@pytest.mark.parametrize("way", ["forward", "adjoint"])
def test_derivatives_of_first_and_second_order_in_both_modes(name, way):
    operator = OPERATORS[name]
    x = (volume_of if way == "forward" else data_of)(operator).requires_grad_()
    function = as_real(getattr(operator, way))
    assert torch.autograd.gradcheck(function, x, check_forward_ad=True, fast_mode=True)
    assert torch.autograd.gradgradcheck(function, x, fast_mode=True)
    _, tangent = torch.func.jvp(getattr(operator, way), (x.detach(),), (x.detach(),))
    torch.testing.assert_close(tangent, getattr(operator, way)(x.detach()), rtol=0, atol=0)


def test_batches_and_channels_are_items_on_their_own(name):
    operator = OPERATORS[name]
    for function, x in ((operator, volume_of(operator, 2, 3)), (operator.adjoint, data_of(operator, 2, 3))):
        together = function(x)
        assert together.shape[:2] == (2, 3)
        torch.testing.assert_close(function(x[1, 2]), together[1, 2], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(torch.vmap(function)(x), together, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(torch.vmap(function, in_dims=1, out_dims=1)(x), together, rtol=1e-12, atol=1e-12)


def test_linear(name):
    operator = OPERATORS[name]
    for function, make in ((operator, volume_of), (operator.adjoint, data_of)):
        a, b = make(operator, seed=2), make(operator, seed=3)
        expected = 2 * function(a) - 3 * function(b)
        torch.testing.assert_close(function(2 * a - 3 * b), expected, rtol=1e-11, atol=1e-11)


def test_single_precision_has_its_digits(name):
    double = OPERATORS[name]
    single = copy.deepcopy(double).float()
    assert single.dtype == torch.float32
    for function, twin, x in (
        (single, double, volume_of(double)),
        (single.adjoint, double.adjoint, data_of(double)),
    ):
        expected = twin(x)
        found = function(x.to(torch.complex64 if x.is_complex() else torch.float32))
        assert found.dtype == (torch.complex64 if expected.is_complex() else torch.float32)
        # Arrivals are exact to some 1e-6 bins of 24, and what they are interpolated between varies by its own size.
        assert (found - expected).norm() < 2e-5 * expected.norm()


def test_back_in_double_precision_all_digits_are_there(name):
    operator = OPERATORS[name]
    again = copy.deepcopy(operator).float().double()
    y = data_of(operator)
    torch.testing.assert_close(again.adjoint(y), operator.adjoint(y), rtol=0, atol=0)


def test_copies_and_pickles_are_the_same_operator(name):
    operator = OPERATORS[name]
    y = data_of(operator)
    for other in (copy.deepcopy(operator), pickle.loads(pickle.dumps(operator))):
        torch.testing.assert_close(other.adjoint(y), operator.adjoint(y), rtol=0, atol=0)
    assert not operator.state_dict()
    assert "voxels" in repr(operator)


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
    with pytest.raises(ShapeError, match="as a tensor"):
        operator(None)
    with pytest.raises(DeviceError, match="expected volume on cpu"):
        operator(volume_of(operator).to("meta"))
    with pytest.raises(ShapeError, match="transient"):
        operator.reconstruct(torch.zeros(2))


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
