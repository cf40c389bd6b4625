"""Every sensing module keeps the same promises; a module inherits these tests by one entry."""

from __future__ import annotations

from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch

from support.sensing.all_entries import ENTRIES, each, each_long, each_quick
from support.sensing.contract import HALVES, LOOSE, expected, parts, pickled, through_state_dict
from support.sweeps import together
from torchtransient import sensing
from torchtransient.errors import ShapeError
from torchtransient.sensing import ScoreFunction

EVERY_POLICY = [(e, p) for e in ENTRIES if e.random for p in e.policies]


def named(pair):
    return f"{pair[0].name}, {pair[1]}"


def test_names_are_unique():
    names = [e.name for e in ENTRIES]
    assert len(names) == len(set(names))


@each
def test_batch_invariance(entry):
    module, x = entry.module(), entry.x()
    whole = parts(expected(module, x))
    for i in range(x.shape[0]):
        for of_all, alone in zip(whole, parts(expected(module, x[i])), strict=True):
            torch.testing.assert_close(of_all[i], alone, rtol=1e-10, atol=1e-12)


def test_light_is_given_by_its_name():
    spad, x = sensing.SynchronousSPAD(20), torch.rand(1, 1, 6, 2, 2, generator=torch.Generator().manual_seed(0))
    counts = spad(x=x, generator=torch.Generator().manual_seed(1))
    assert torch.equal(counts, spad(x, torch.Generator().manual_seed(1)))
    assert torch.equal(spad.expected(x=x), spad.expected(x))
    for found in (spad.log_prob(counts, x=x), spad.log_prob(x=x, measurement=counts)):
        assert torch.equal(found, spad.log_prob(counts, x))


@each
@together("what", ["no transient", "output"])
def test_what_a_film_does_not_measure_is_refused(entry, what):
    """`out.transient` of a gated film is None; the output itself is for chains."""
    module = entry.module()
    output = SimpleNamespace(transient=None, gated=entry.x(), gates=(1, 2), axis=None)
    given = None if what == "no transient" else output
    for name in ("forward", "expected", "sample"):
        if hasattr(module, name):
            with pytest.raises(ShapeError, match=r"gated|gates|Give its tensor"):
                getattr(module, name)(given)


@each
def test_dtype_and_device_are_kept(entry):
    reference = parts(expected(entry.module(), entry.x()))
    for dtype in entry.dtypes:
        found = parts(expected(entry.module(dtype), entry.x(dtype)))
        for value, exact in zip(found, reference, strict=True):
            assert value.device == exact.device
            assert value.dtype == (dtype.to_complex() if exact.is_complex() else dtype)
            error = (value.to(exact.dtype) - exact).abs().max()
            assert error <= LOOSE[dtype] * (exact.abs().max() + 1e-12)


@pytest.mark.slow
@each
@together("dtype", HALVES)
def test_half_precision_is_measured_in_single(entry, dtype):
    """The mean and every draw of it: of the same numbers in float32, to the bit; the gradient goes back in halves."""
    x = entry.x(dtype)[:1]
    for policy in entry.policies if entry.random else [None]:
        module = entry.module(torch.float32, **({"grad": policy} if policy else {}))

        def measured(light, module=module):
            with ScoreFunction():
                return [v.detach() for v in parts(module(light, generator=torch.Generator().manual_seed(2)))]

        for found, wanted in zip(measured(x), measured(x.float()), strict=True):
            assert found.dtype == (torch.complex64 if wanted.is_complex() else torch.float32)
            assert torch.equal(found, wanted)
    leaf = x.clone().requires_grad_()
    mean = parts(expected(entry.module(torch.float32), leaf))[0]
    assert torch.equal(mean.detach(), parts(expected(entry.module(torch.float32), x.float()))[0].detach())
    (gradient,) = torch.autograd.grad(mean.sum(), leaf)
    assert gradient.dtype == dtype


@each
def test_buffers_move_with_the_module(entry):
    module = entry.module().to("meta")
    assert all(t.is_meta for t in [*module.parameters(), *module.buffers()])


@pytest.mark.gpu
@each
def test_cuda_gives_the_same(entry):
    x = entry.x()
    reference = parts(expected(entry.module(), x))
    module = entry.module().cuda()
    for value, exact in zip(parts(expected(module, x.cuda())), reference, strict=True):
        assert value.is_cuda
        torch.testing.assert_close(value.cpu(), exact, rtol=1e-9, atol=1e-10)
    with torch.no_grad():
        for value in parts(module(x.cuda(), generator=torch.Generator("cuda").manual_seed(0))):
            assert value.is_cuda


class Mean(torch.nn.Module):
    """The mean of a module as a `forward`, so that its parameters can be handed in."""

    def __init__(self, module):
        super().__init__()
        self.module = module

    def forward(self, x):
        return tuple(p for p in parts(expected(self.module, x)) if p.is_floating_point() or p.is_complex())


def derivatives_are_right(entry):
    """Both modes, in the input and in every learnable parameter."""
    mean, x = Mean(entry.module()), entry.x()[:1].requires_grad_()
    learnable = {name: p.detach().requires_grad_() for name, p in mean.named_parameters() if p.requires_grad}

    def f(x, *values):
        return torch.func.functional_call(mean, dict(zip(learnable, values, strict=True)), (x,))

    inputs = (x, *learnable.values())
    assert torch.autograd.gradcheck(
        f, inputs, atol=1e-6, rtol=1e-4, nondet_tol=1e-12, fast_mode=True, check_forward_ad=True,
        check_undefined_grad=False,
    )  # fmt: skip


@each_quick
def test_gradcheck_of_the_expectation(entry):
    derivatives_are_right(entry)


@pytest.mark.slow
@each_long
def test_gradcheck_of_long_expectations(entry):
    derivatives_are_right(entry)


# quantiles of light leap where there was none
@together("entry", [e for e in ENTRIES if e.name != "EquiDepthHistogram"], lambda entry: entry.name)
def test_derivatives_of_the_expectation_where_there_is_no_light(entry):
    """In dark bins of lit pixels and in a dark pixel, along more light: differences are one-sided, of second order."""
    g = torch.Generator().manual_seed(3)
    x = entry.x()[:1]
    x = torch.where(torch.rand(x.shape, generator=g) < 0.5, 0.0, x)
    x[..., 0, 0] = 0
    mean, along = Mean(entry.module()), torch.rand(x.shape, generator=g, dtype=torch.float64)
    weights = [torch.rand(part.shape, generator=g, dtype=torch.float64) for part in mean(x)]

    def totals(x):
        return torch.stack([(part * w).sum().real for part, w in zip(mean(x), weights, strict=True)])

    found = (torch.autograd.functional.jacobian(totals, x) * along).flatten(1).sum(1)
    step = 1e-5
    here, near, far = (totals(x + k * step * along).detach() for k in (0, 1, 2))
    torch.testing.assert_close(found, (4 * near - far - 3 * here) / (2 * step), rtol=2e-3, atol=1e-5)


# these look at their values
not_transformed = {"FreeRunningSPAD": ("vmap", "grad"), "EquiDepthHistogram": ("vmap",)}


@pytest.mark.slow
@each
def test_functional_transforms(entry):
    """torch.func of the mean: mapped items are those of a batch, gradients those of autograd."""
    module, x = entry.module(), entry.x()
    left_out = not_transformed.get(entry.name, ())
    first = lambda x: parts(expected(module, x))[0]  # noqa: E731
    if "vmap" not in left_out:
        torch.testing.assert_close(torch.func.vmap(first)(x), first(x), rtol=1e-10, atol=1e-12)
    if "grad" not in left_out:
        energy = lambda x: first(x).abs().square().sum()  # noqa: E731
        leaf = x.clone().requires_grad_()
        (wanted,) = torch.autograd.grad(energy(leaf), leaf)
        torch.testing.assert_close(torch.func.grad(energy)(x), wanted, rtol=1e-10, atol=1e-12)


@each
def test_non_contiguous_input(entry):
    module, x = entry.module(), entry.x()
    strided = x.movedim(-3, -1).contiguous().movedim(-1, -3)
    assert not strided.is_contiguous()
    for a, b in zip(parts(expected(module, x)), parts(expected(module, strided)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@each
def test_input_is_left_alone(entry):
    module, x = entry.module(), entry.x()
    before = x.clone()
    module(x, generator=torch.Generator().manual_seed(1))
    assert torch.equal(x, before)


@pytest.mark.slow
@each
def test_copies_give_the_same(entry):
    module, x = entry.module(), entry.x()
    wanted = parts(expected(module, x))
    for copy in (deepcopy(module), pickled(module), through_state_dict(entry, module)):
        for a, b in zip(wanted, parts(expected(copy, x)), strict=True):
            assert torch.equal(a, b)
    assert repr(module)


@pytest.mark.parametrize("entry", [e for e in ENTRIES if e.conserves], ids=lambda e: e.name)
def test_conservation(entry):
    module, x = entry.module(), entry.x()
    torch.testing.assert_close(
        entry.conserves(parts(expected(module, x))[0]), entry.conserves(x), rtol=1e-9, atol=1e-12
    )


@together("entry, policy", [(e, p) for e, p in EVERY_POLICY if p in ("gaussian", "straight_through")], named)
def test_generator_reproduces(entry, policy):
    module, x = entry.module(grad=policy), entry.x()

    def draw(seed):
        with ScoreFunction():
            return parts(module(x, generator=torch.Generator().manual_seed(seed)))

    for a, b, c in zip(draw(5), draw(5), draw(6), strict=True):
        assert torch.equal(a, b)
        assert not torch.equal(a, c)
    with torch.no_grad():
        torch.manual_seed(3)
        first = parts(module(x))
        torch.manual_seed(3)
        assert all(torch.equal(a, b) for a, b in zip(first, parts(module(x)), strict=True))


# a train of detections takes long to draw; files of its own hold its means to events
TRAINS = ("FreeRunningSPAD", "AfterpulsingSPAD-dead-time")


@pytest.mark.parametrize("entry", [e for e in ENTRIES if e.random], ids=lambda e: e.name)
def test_mean_and_dtype_of_samples(entry):
    """The mean of many draws is the expectation, within 5 standard errors everywhere (and rounding)."""
    module, number = entry.module(), 200 if entry.name in TRAINS else 1000
    x = entry.x()[:1]
    g = torch.Generator().manual_seed(11)
    draws = module.sample(x.expand(number, *x.shape[1:]), g)
    exact = parts(expected(module, x))
    for values, mean in zip(parts(draws), exact, strict=True):
        assert values.dtype == mean.dtype
        assert not values.requires_grad
        error = (values.mean(0) - mean[0]).abs()
        standard_error = values.std(0) / number**0.5
        assert bool((error <= 5 * standard_error + 0.004).all())


@together("entry, policy", [(e, p) for e, p in EVERY_POLICY if p in ("gaussian", "score")], named)
def test_gradients_are_finite_at_zero(entry, policy):
    module = entry.module(grad=policy)
    x = torch.zeros(entry.shape, dtype=torch.float64, requires_grad=True)
    with ScoreFunction() as score:
        (y, *_) = parts(module(x, generator=torch.Generator().manual_seed(0)))
        loss = y.square().sum()
    if policy == "score":
        loss = score.surrogate(loss)
    loss.backward()
    assert x.grad is not None and bool(torch.isfinite(x.grad).all())


def test_every_effect_has_an_entry():
    """Every public sensor that is no base of others."""
    bases = {sensing.Sensor, sensing.RandomSensor, sensing.AddedCounts, sensing.MovedCounts}
    public = {c for c in vars(sensing).values() if isinstance(c, type) and issubclass(c, sensing.Sensor)}
    assert public - bases == public & {type(entry.module()) for entry in ENTRIES}
