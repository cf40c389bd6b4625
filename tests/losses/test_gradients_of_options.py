"""Options of every loss that are tensors with a gradient: it goes through, or is refused."""

from __future__ import annotations

import functools

import pytest
import torch

from support.loss_cases import CASES, FITS, IDLE, number_options
from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import TorchTransientError


def plain(function):
    """Of losses that are no case: the arguments that are not options."""
    x = 0.1 + torch.rand(1, 8, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    faces = torch.tensor([[0, 1, 2], [0, 1, 3]])
    corners = x[0, :4, 0, :3]
    return {losses.surface_distance: (corners, faces, 2 * corners, faces)}.get(function, (x,))


def calls():
    """(options that are numbers, those that are held, a call with more of them)."""
    for case in CASES:
        x, y = case.tensors()
        more = functools.partial(case.function, *case.arguments(x, y))
        yield case.name, number_options(case.module), case.options, more
    for function in (losses.anscombe, losses.relative_floor, losses.surface_distance):
        yield function.__name__, number_options(function), {}, functools.partial(function, *plain(function))


CALLS = {name: call for name, *call in calls()}


def refused(call):
    """What a typed error says."""
    try:
        call()
    except TorchTransientError as error:
        return str(error)
    return None


@together("name", CALLS)
def test_an_option_with_a_gradient_has_it_or_is_refused(name):
    """Never a number in silence, whose derivative is nothing."""
    numbers, options, call = CALLS[name]
    for option in numbers:
        if (name, option) in IDLE:
            continue
        number = FITS.get(option, options.get(option))
        assert number is not None, f"{name}: give its case in tests/support/loss_cases.py a {option}, or FITS there"
        leaf = torch.tensor(number, dtype=torch.float64, requires_grad=True)

        def value(x, option=option):
            return call(**{**options, option: x if x.ndim == 0 else tuple(x)}).sum()

        said = refused(functools.partial(value, leaf))
        if said is not None:
            assert "without gradient" in said
            value(leaf.detach())
        else:
            assert torch.autograd.gradcheck(value, leaf, fast_mode=True), option


def test_forward_mode_is_refused_as_well():
    x, y = (1 + torch.rand(4, 4, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    calls = (
        lambda v: losses.scale_invariant_depth_loss(x, y, balance=v),
        lambda v: losses.total_variation(x[None], spacing=(1.0, v, 1.0)),
    )
    for call in calls:
        with pytest.raises(TorchTransientError, match="without gradient"):
            torch.func.jvp(call, (torch.tensor(0.5),), (torch.tensor(1.0),))
    _, slope = torch.func.jvp(lambda v: losses.anscombe(x, v).sum(), (torch.tensor(0.5),), (torch.tensor(1.0),))
    torch.testing.assert_close(slope, (1 / (x + 3 / 8 + 0.25).sqrt()).sum())


def test_levels_that_are_fitted():
    """Read noise of a root, and the floor of each scale."""
    x, y = (torch.rand(1, 6, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    leaf = torch.full((2, 2), 0.7, dtype=torch.float64, requires_grad=True)
    levels = (
        lambda v: losses.root_loss(x, y, root=functools.partial(losses.anscombe, read_noise=v)),
        lambda v: losses.multiscale_loss(x, y, functools.partial(losses.poisson_nll, floor=v)),
        lambda v: losses.multiscale_loss(x, y, functools.partial(losses.log_ratio_loss, background=v)),
    )
    for level in levels:
        assert torch.autograd.gradcheck(level, leaf, fast_mode=True)
