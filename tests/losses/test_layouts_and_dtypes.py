"""Layouts, dtypes, empty batches and levels, over the list of all losses."""

import pytest
import torch

from support.loss_cases import CASES
from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import ShapeError, UnitError

# Likelihoods with the measurement first, as (model, counts) like the others.
NLLS = {
    "poisson_nll": losses.poisson_nll,
    "poisson_nll, constant": lambda x, y, **k: losses.poisson_nll(x, y, constant=True, **k),
    "first_photon_nll": lambda x, y, **k: losses.first_photon_nll(x, y, 10_000, constant=True, **k),
    "first_photon_nll, dead": lambda x, y, **k: losses.first_photon_nll(x, y, 10_000, dead_bins=2.5, **k),
    "free_running_nll": lambda x, y, **k: losses.free_running_nll(x, y, periods=10_000, dead_bins=2.5, **k),
    "read_noise_nll": lambda x, y, **k: losses.read_noise_nll(x, y, 2.0, **k),
}
nlls = pytest.mark.parametrize("loss", NLLS.values(), ids=NLLS.keys())
every = together("case", CASES)


def over(condition):
    return together("case", [case for case in CASES if condition(case)])


def of_time(case):
    return case.dim is not None and case.function is not losses.measurement_consistency


def pair_of(case):
    """Two items of three channels and 8 x 4 x 5 bins, the second item a thousand times darker."""
    x, y = (torch.cat([t, t.flip(-1), t.flip(-2)], 1) for t in case.tensors())
    dark = torch.tensor([1.0, 1e-3], dtype=torch.float64).reshape(2, 1, 1, 1, 1)
    return x * dark, y if case.draw_target is not None else y * dark


# ------------------------------------------------------------------------------------------------------------- layouts


# dim, and the places Y, X as those of another layout
LAYOUTS = {
    "a list": (-2, lambda t: t.flatten(-2)),
    "exhaustive": (-5, lambda t: t.unflatten(-1, (1, 5)).unflatten(-3, (2, 2))),
    "exhaustive list": (-3, lambda t: t),
    "one point": (-1, lambda t: t[..., 0, 0]),
}


@over(of_time)
@together("dim, laid_out", LAYOUTS.values())
def test_every_layout_has_the_numbers_of_images(case, dim, laid_out):
    x, y = pair_of(case)
    if dim == -1:
        x, y = x[..., :1, :1], y[..., :1, :1]
    mask = torch.rand(y.shape, generator=torch.Generator().manual_seed(9)) < 0.6
    given = laid_out(x), laid_out(y), laid_out(mask)
    for reduction in ("none", "mean"):
        wanted = case(x, y, mask, reduction)
        found = case(*given, reduction, dim=dim)
        torch.testing.assert_close(found, laid_out(wanted) if reduction == "none" else wanted)
    torch.testing.assert_close(case(*given, "mean", dim=dim + given[0].ndim), found)
    module = case.module(**case.options, dim=dim)
    torch.testing.assert_close(module(*case.arguments(*given[:2])), case(*given[:2], dim=dim))


def value_or_error(call):
    try:
        return call()
    except ShapeError as error:
        return str(error)


@over(of_time)
def test_another_layout_is_never_taken_for_images(case):
    """Without `dim`: the same number, or an error that asks for it."""
    x, y = pair_of(case)
    for dim, laid_out in LAYOUTS.values():
        a, b = laid_out(x), laid_out(y)
        for part in (slice(None), (slice(None), slice(0, 1)), 0, (0, slice(0, 1))):
            found = value_or_error(lambda pair=(a[part], b[part]): case(*pair))
            if isinstance(found, str):
                assert "dim=" in found
            else:
                torch.testing.assert_close(found, case(a[part], b[part], dim=dim))


@over(of_time)
def test_records_have_bins(case):
    x, y = (t[:, :, :0] for t in case.tensors())
    found = value_or_error(lambda: case(x, y, dim=-3))
    # a loss of each element, of none of them
    assert "one or more bins" in found if isinstance(found, str) else float(found) == 0


# ---------------------------------------------------------------------------------------------------- kinds of numbers


@nlls
@together("dtype, most", [(torch.uint8, 255), (torch.uint64, 1000), (torch.float16, 256), (torch.bool, 1)])
def test_counts_up_to_the_last_of_their_kind(loss, dtype, most):
    """255 + 1 is 0 in uint8: the logarithm of a factorial is not computed there."""
    counts = torch.tensor([0, 1, most, most // 2]).reshape(1, 4, 1, 1).to(dtype)
    model = torch.rand(1, 4, 1, 1, generator=torch.Generator().manual_seed(1))
    found = loss(model, counts)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, loss(model, counts.to(torch.float32)), rtol=0, atol=0)
    torch.testing.assert_close(found, loss(model.double(), counts.to(torch.float64)).float(), rtol=1e-5, atol=1e-5)


# ---------------------------------------------------------------------------------------------------------- of nothing


@every
@together("masked", [False, True])
def test_an_empty_batch_is_zero(case, masked):
    x, y = (t[:0] for t in case.tensors())
    mask = torch.ones(y.shape, dtype=torch.bool) if masked else None
    wanted = [0, *case(*case.tensors(), reduction="none").shape[1:]]
    x = x.clone().requires_grad_()
    for reduction in ("none", "mean", "sum"):
        value = case(x, y, mask, reduction)
        assert list(value.shape) == (wanted if reduction == "none" else [])
        assert bool((value == 0).all())
        (slope,) = torch.autograd.grad(value.sum(), x)
        assert slope.shape == x.shape


# ------------------------------------------------------------------------------------------------- floors and the like
X, Y = (0.1 + torch.rand(2, 1, 8, 4, 5, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
LEVELS = [
    lambda v: losses.log_ratio_loss(X, Y, background=v),
    lambda v: losses.wasserstein_loss(X, Y, 0.1, floor=v),
    lambda v: losses.phasor_loss(X + 0j, Y + 0j, phase_only=True, floor=v),
    lambda v: losses.ssim_loss(X, Y, window=3, value_range=v),
]


@pytest.mark.parametrize("loss", LEVELS)
def test_levels_above_zero(loss):
    """In vmap, too, where values of tensors are not checked."""
    found = torch.vmap(loss)(torch.tensor([0.5, 0.7]))
    torch.testing.assert_close(found, torch.stack([loss(0.5), loss(0.7)]))
    with pytest.raises(UnitError, match="greater than zero"):
        loss(0.0)


@pytest.mark.parametrize("floor", [0.0, torch.zeros(4, 5)], ids=["number", "tensor"])
def test_no_floor_is_one_of_likelihoods(floor):
    for loss in (NLLS["poisson_nll"], NLLS["first_photon_nll"], NLLS["free_running_nll"]):
        assert bool(torch.isfinite(loss(X, Y, floor=floor)))
