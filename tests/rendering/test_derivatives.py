"""What is replayed for its derivatives: which are asked for, and what becomes of them, of a function in torch."""

from __future__ import annotations

import sys

import pytest
import torch
from torch.autograd import forward_ad

from torchtransient.errors import GradientError, ShapeError
from torchtransient.rendering.autograd import Request, run

# Outputs (2,), (3,) and whole numbers of values (3,), (2,) and whole ones: 3 x 2, no symmetry.
A = torch.tensor([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0]], dtype=torch.float64)


def outputs(x, y, n):
    return A @ x * y, x * x + y.sum() * n[0], n * 3


class Job:
    """Notes what it is asked for, and answers by torch's own derivatives."""

    what = "the function"

    def __init__(self):
        self.asked = []

    def primal(self, tensors):
        self.asked.append("primal")
        return tuple(out.detach().clone() for out in outputs(*tensors))

    def pullback(self, asked, tensors, cotangents):
        self.asked.append(("pullback", asked, len(cotangents)))
        with torch.enable_grad():
            given = [t.detach().clone().requires_grad_(need) for t, need in zip(tensors, asked.needs, strict=True)]
            real = [out for out in outputs(*given) if out.is_floating_point()]
            used = [out for out, is_given in zip(real, asked.has_cotangent, strict=True) if is_given]
            total = sum((out * g).sum() for out, g in zip(used, cotangents, strict=True))
        wanted = [t for t in given if t.requires_grad]
        grads = torch.autograd.grad(total, wanted, allow_unused=True)
        return tuple(torch.zeros_like(t) if g is None else g for g, t in zip(grads, wanted, strict=True))

    def pushforward(self, asked, tensors, tangents):
        self.asked.append(("pushforward", asked, len(tangents)))
        given = iter(tangents)
        along = [next(given) if need else torch.zeros_like(t) for t, need in zip(tensors, asked.needs, strict=True)]
        x, y, n = (t.detach() for t in tensors)
        return A @ along[0] * y + A @ x * along[1], 2 * x * along[0] + along[1].sum() * n[0]


@pytest.fixture
def given():
    x = torch.tensor([0.5, -1.5, 2.0], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([3.0, -0.25], dtype=torch.float64, requires_grad=True)
    return x, y, torch.tensor([2, 5])


COTANGENTS = torch.tensor([2.0, -3.0], dtype=torch.float64), torch.tensor([1.0, 0.5, -4.0], dtype=torch.float64)


def expected(given, *wanted, cotangents=COTANGENTS):
    real = outputs(*given)[:2]
    used = [(out, g) for out, g in zip(real, cotangents, strict=True) if g is not None]
    return torch.autograd.grad(sum((out * g).sum() for out, g in used), wanted, allow_unused=True)


@pytest.mark.parametrize(
    ("first", "second", "needs"),
    [
        (True, True, (True, True)), (True, False, (True, True)), (False, True, (True, True)),
        (True, True, (True, False)), (True, True, (False, True)), (False, True, (False, True)),
    ],
)  # fmt: skip
def test_gradients_of_what_is_asked_for(given, first, second, needs):
    """By the values that need one, through the outputs that have a cotangent; whole numbers have neither."""
    x, y, n = given
    x.requires_grad_(needs[0]), y.requires_grad_(needs[1])
    job = Job()
    found = run(job, x, y, n)
    assert [out.requires_grad for out in found] == [True, True, False] and torch.equal(found[2], n * 3)
    used = [g for g, there in zip(COTANGENTS, (first, second), strict=True) if there]
    outs = [out for out, there in zip(found, (first, second), strict=False) if there]
    wanted = [t for t, need in zip((x, y), needs, strict=True) if need]
    grads = torch.autograd.grad(outs, wanted, used)
    assert job.asked == ["primal", ("pullback", Request((*needs, False), (first, second)), len(used))]
    cotangents = [g if there else None for g, there in zip(COTANGENTS, (first, second), strict=True)]
    for grad, one in zip(grads, expected(given, *wanted, cotangents=cotangents), strict=True):
        torch.testing.assert_close(grad, one)


@pytest.mark.parametrize("along", [(True, True), (True, False), (False, True)])
def test_derivatives_along_tangents(given, along):
    x, y, n = (t.detach() for t in given)
    dx, dy = torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), torch.tensor([0.25, -3.0], dtype=torch.float64)
    job = Job()
    with forward_ad.dual_level():
        a = forward_ad.make_dual(x, dx) if along[0] else x
        b = forward_ad.make_dual(y, dy) if along[1] else y
        found = [forward_ad.unpack_dual(out).tangent for out in run(job, a, b, n)]
    assert job.asked[1:] == [("pushforward", Request((*along, False)), sum(along))]
    _, right = torch.func.jvp(
        lambda x, y: outputs(x, y, n)[:2], (x, y), (dx if along[0] else 0 * dx, dy if along[1] else 0 * dy)
    )
    assert found[2] is None
    for one, other in zip(found[:2], right, strict=True):
        torch.testing.assert_close(one, other)


def test_derivatives_are_linear_in_what_they_are_taken_along(given):
    """Gradients of gradients by the cotangents alone: the function along tangents."""
    x, y, n = given
    job = Job()
    cotangents = [g.clone().requires_grad_() for g in COTANGENTS]
    grads = torch.autograd.grad(run(job, x, y, n)[:2], (x, y), cotangents, create_graph=True)
    along = torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), torch.tensor([0.25, -3.0], dtype=torch.float64)
    right = torch.func.jvp(lambda x, y: outputs(x, y, n)[:2], (x.detach(), y.detach()), along)[1]
    for number, one in enumerate(right):
        job.asked.clear()
        (found,) = torch.autograd.grad(grads, (cotangents[number],), along, retain_graph=True)
        torch.testing.assert_close(found, one)
        assert job.asked == [("pushforward", Request((True, True, False), (True, True)), 2)]
    (found,) = torch.autograd.grad(grads[1], (cotangents[0],), along[1], retain_graph=True)
    torch.testing.assert_close(found, A @ x.detach() * along[1])
    assert job.asked[-1] == ("pushforward", Request((False, True, False), (True, True)), 1)
    with pytest.raises(GradientError, match=r"second derivatives of the function .* again in reverse mode"):
        torch.autograd.grad(grads[0].sum(), (y,), retain_graph=True)
    with pytest.raises(GradientError, match="again in forward mode"):
        torch.func.jvp(lambda y: torch.func.grad(lambda x: run(job, x, y, n)[0].sum())(x.detach()), (y.detach(),),
                       (along[1],))  # fmt: skip


def test_derivatives_along_tangents_have_gradients_by_the_tangents(given):
    x, y, n = (t.detach() for t in given)
    job = Job()
    dx, dy = torch.zeros(3, dtype=torch.float64, requires_grad=True), torch.ones(2, dtype=torch.float64)

    def along(dx):
        return torch.func.jvp(lambda x, y: run(job, x, y, n)[:2], (x, y), (dx, dy))[1]

    first, second = along(dx)
    (found,) = torch.autograd.grad((first, second), (dx,), COTANGENTS)
    torch.testing.assert_close(found, expected(given, given[0])[0])
    assert job.asked[-1] == ("pullback", Request((True, True, False), (True, True)), 2)
    (found,) = torch.autograd.grad(along(dx)[1], (dx,), COTANGENTS[1])
    torch.testing.assert_close(found, 2 * x * COTANGENTS[1])
    assert job.asked[-1] == ("pullback", Request((True, True, False), (False, True)), 1)


def test_entries_of_a_batch_are_calls_of_their_own(given):
    """Whatever dimension is mapped; what is not is the same in all."""
    x, y, n = (t.detach() for t in given)
    xs = torch.stack([x, 2 * x, -x, x + 1], 1)
    job = Job()
    found = torch.func.vmap(lambda x: run(job, x, y, n), in_dims=1)(xs)
    assert job.asked == ["primal"] * 4
    for number in range(4):
        for one, other in zip(found, outputs(xs[:, number], y, n), strict=True):
            torch.testing.assert_close(one[number], other)
    jacobian = torch.func.jacrev(lambda x: run(job, x, y, n)[0])(x)
    torch.testing.assert_close(jacobian, A * y[:, None])
    torch.testing.assert_close(torch.func.jacfwd(lambda x: run(job, x, y, n)[0])(x), A * y[:, None])
    with pytest.raises(ShapeError, match="the function: expected a batch of at least one entry under torch"):
        torch.func.vmap(lambda x: run(job, x, y, n))(xs[:, :0].T)


class Silent(torch.autograd.Function):
    """A function that has no gradient to give."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, _):
        return None


def test_gradients_that_nobody_gives(given):
    x, y, n = given
    job = Job()
    first, second, _ = run(job, x, y, n)
    (Silent.apply(first).sum() + Silent.apply(second).sum()).backward()
    assert x.grad is None and y.grad is None and job.asked == ["primal"]


def test_nothing_is_run_where_nothing_is_asked_for(given):
    x, y, n = given
    job = Job()
    first, second, third = run(job, x, y, n)
    assert not third.requires_grad
    (first.detach() + second.detach()[:2]).sum()
    assert job.asked == ["primal"]
    with torch.no_grad():
        assert not run(job, x, y, n)[0].requires_grad
    assert not run(job, x.detach(), y.detach(), n)[0].requires_grad


def test_what_cannot_be_traced(given):
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx

    x, y, n = (t.detach() for t in given)
    job = Job()
    for way in (lambda: make_fx(lambda x: run(job, x, y, n)[0])(x), lambda: run(job, FakeTensorMode().from_tensor(x))):
        with pytest.raises(GradientError, match="the function cannot be traced: in the graphs of torch"):
            way()
    assert job.asked == []


def test_tensors_without_memory_are_looked_for_where_torch_has_loaded_them(given, monkeypatch):
    x, y, n = given
    monkeypatch.delitem(sys.modules, "torch._subclasses.fake_tensor", raising=False)
    assert run(Job(), x, y, n)[0].requires_grad
