"""The contract of every loss: batches, masks, reductions, precision, derivatives, pickling, errors."""

import copy
import dataclasses
import functools
import inspect
import pickle

import pytest
import torch

from support.loss_cases import CASES, FITS, IDLE, MESHES, OTHERS, WRONG, number_options
from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import ArgumentError, ShapeError, TorchTransientError, UnitError

every = together("case", CASES)


def over(condition):
    return together("case", [case for case in CASES if condition(case)])


def real(x):
    return not x.is_complex()


def gradient(case, x, y, mask=None, **more):
    x = x.detach().clone().requires_grad_()
    case(x, y, mask, "sum", **more).backward()
    return x.grad


def mask_of(y):
    """Of what a mask speaks of: the measurement, or the volume where there is no other."""
    return torch.rand(y.shape, generator=torch.Generator().manual_seed(9)) < 0.6


def public(kind):
    return {thing for name, thing in vars(losses).items() if not name.startswith("_") and kind(thing)}


def test_every_loss_is_in_the_list():
    """Every function of the room is a case or one of the others, which reduce nothing; every module is a case."""
    functions = public(inspect.isfunction)
    reducing = {function for function in functions if "reduction" in inspect.signature(function).parameters}
    assert reducing == {case.function for case in CASES} | set(MESHES)
    assert functions - reducing == set(OTHERS)
    modules = public(lambda thing: inspect.isclass(thing) and issubclass(thing, torch.nn.Module))
    assert modules == {case.module for case in CASES} | set(MESHES.values())


@pytest.mark.parametrize("call", OTHERS.values(), ids=[function.__name__ for function in OTHERS])
def test_the_others(call):
    """Precision, autocast, derivatives."""
    x = 0.1 + torch.rand(1, 8, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    wanted = call(x)
    assert wanted.dtype.to_real() == torch.float64
    single = call(x.float())
    torch.testing.assert_close(single.to(wanted.dtype), wanted, rtol=1e-5, atol=1e-5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        torch.testing.assert_close(call(x.float()), single, rtol=0, atol=0)
    leaf = x.clone().requires_grad_()
    if call is losses.relative_floor:  # a scale goes in without gradient
        assert not call(leaf).requires_grad
    else:
        assert call(leaf).requires_grad and torch.autograd.gradcheck(call, leaf, fast_mode=True)
    assert call(x.to("meta")).device.type == "meta"


@every
def test_modules_hold_the_options_of_functions(case):
    x, y = case.tensors()
    mask = mask_of(y)
    torch.testing.assert_close(case.as_module(x, y, mask, "sum"), case(x, y, mask, "sum"), rtol=0, atol=0)
    module = case.module(**case.options)
    again = pickle.loads(pickle.dumps(module))
    arguments = case.arguments(x, y)
    for other in (again, copy.deepcopy(module)):
        torch.testing.assert_close(other(*arguments), case(x, y), rtol=0, atol=0)
    assert module.state_dict() == {}
    assert all(getattr(module, name) is value for name, value in case.options.items())
    with pytest.raises(TypeError):
        case.module(redution="sum")


def test_tensors_move_with_their_module():
    module = losses.PoissonNLL(floor=torch.tensor(0.5)).to("meta")
    assert module.floor.device.type == "meta" and module.double().floor.dtype == torch.float64


class Halved(losses.PoissonNLL):
    """A subclass of a user, with a constructor and a forward of its own."""

    def __init__(self, weight):
        super().__init__(constant=True)
        self.weight = weight

    def forward(self, input, target, mask=None):
        return self.weight * super().forward(input, target, mask)


def test_modules_have_subclasses():
    x, y = torch.full((1, 4, 2, 2), 2.0), torch.ones(1, 4, 2, 2)
    module = pickle.loads(pickle.dumps(Halved(0.5)))
    torch.testing.assert_close(module(x, y), 0.5 * losses.poisson_nll(x, y, constant=True))
    assert "constant=True" in repr(module)


@every
def test_items_of_a_batch_do_not_see_each_other(case):
    x, y = case.tensors()
    y = y * torch.tensor([1.0, 3.0], dtype=x.real.dtype).reshape(2, *[1] * (y.ndim - 1))
    whole = case(x, y, reduction="none")
    for i in range(2):
        torch.testing.assert_close(whole[i], case(x[i], y[i], reduction="none"))
    more = case(x[None].expand(3, *x.shape), y[None].expand(3, *y.shape), reduction="none", **case.said)
    torch.testing.assert_close(more[2], whole)


@every
def test_reductions(case):
    x, y = case.tensors()
    each = case(x, y, reduction="none")
    assert real(each) and each.dtype == torch.float64
    torch.testing.assert_close(case(x, y), (case(x[0], y[0]) + case(x[1], y[1])) / 2)
    if case.function is not losses.projection_ssim_loss:  # a mean of three views of different sizes
        torch.testing.assert_close(case(x, y, reduction="sum"), each.sum())
        torch.testing.assert_close(case(x, y), each.mean())
    mask = torch.ones_like(y, dtype=torch.bool)
    torch.testing.assert_close(case(x, y, mask, "none"), each)
    torch.testing.assert_close(case(x, y, mask), case(x, y))


@over(lambda case: case.crop is not None)
def test_a_mask_is_a_restriction(case):
    x, y = case.tensors()
    mask = torch.zeros_like(y, dtype=torch.bool)
    mask[case.crop] = True
    inside = case(x[case.crop], y[case.crop], reduction="none")
    torch.testing.assert_close(case(x, y, mask, "sum"), inside.sum())
    torch.testing.assert_close(case(x, y, mask), inside.mean())
    # likewise for a mask that broadcasts
    narrow = torch.zeros(y.shape[-2:], dtype=torch.bool)
    narrow[1:3, 1:4] = True
    crop = (..., slice(1, 3), slice(1, 4))
    if case.options.get("dead_bins") is None:
        torch.testing.assert_close(case(x, y, narrow), case(x[crop], y[crop]))


@every
def test_what_does_not_count_may_be_anything(case):
    x, y = case.tensors()
    mask = mask_of(y)
    mask[..., 2, 3] = False  # a dead pixel: no bin of it counts
    reference, slope = case(x, y, mask), gradient(case, x, y, mask)
    for rubbish in (float("nan"), float("inf"), -1e6):
        other, volume = y.clone(), x.clone()
        other[..., 2, 3] = rubbish
        if not case.pair or x.shape == y.shape:
            volume[..., 2, 3] = rubbish
        torch.testing.assert_close(case(volume, other, mask), reference, rtol=0, atol=0)
        torch.testing.assert_close(gradient(case, volume, other, mask), slope, rtol=0, atol=0)
    assert bool(torch.isfinite(slope).all()) and bool((slope[..., 2, 3] == 0).all())


@every
@together("reduction", ["mean", "sum", "none"])
def test_nothing_counts(case, reduction):
    x, y = case.tensors()
    mask = torch.zeros_like(y, dtype=torch.bool)
    assert bool((case(x, y, mask, reduction) == 0).all())
    assert bool((gradient(case, x, y, mask) == 0).all())


@over(lambda case: case.symmetric and case.pair)
def test_symmetric(case):
    x, y = case.tensors()
    torch.testing.assert_close(case(x, y, reduction="none"), case(y, x, reduction="none"))
    torch.testing.assert_close(case(x, y, mask_of(y)), case(y, x, mask_of(y)))


@over(lambda case: case.zero_at_equality)
def test_zero_at_equality_alone(case):
    x, y = case.tensors()
    same = case(x, x, reduction="none")
    torch.testing.assert_close(same, torch.zeros_like(same), rtol=0, atol=1e-14)
    assert bool((case(x, y, reduction="none") > 0).all())


@over(lambda case: not case.floors_detached)
def test_gradcheck(case):
    x, y = case.tensors()
    mask = mask_of(y)
    x, y = x[:1].clone().requires_grad_(), y[:1]
    assert torch.autograd.gradcheck(lambda x: case(x, y, mask[:1], "none"), x, fast_mode=True)
    if case.pair and case.draw_target is None:
        y = y.clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda x, y: case(x, y, None, "none"), (x, y), fast_mode=True)


@over(lambda case: case.floors_detached)
def test_the_gradient_is_that_of_a_fixed_scale(case):
    """The direction that changes no scale: two bins of one record trade light."""
    x, y = case.tensors()
    step = torch.zeros_like(x)
    step[0, 0, 1, 2, ...], step[0, 0, 3, 2, ...] = 1e-6, -1e-6
    found = float((gradient(case, x, y) * step).sum())
    wanted = float((case(x + step, y, reduction="sum") - case(x - step, y, reduction="sum")) / 2)
    assert found == pytest.approx(wanted, rel=1e-4)


@over(lambda case: case.draw_target is None and "value_range" not in case.options)
def test_six_decades_of_light_at_any_level(case):
    x, y = case.tensors(dtype=torch.float32)
    generator = torch.Generator().manual_seed(3)
    x = x * 10 ** (6 * torch.rand(x.shape, generator=generator))
    y = y * 10 ** (6 * torch.rand(y.shape, generator=generator))
    for level in (1e-12, 1e-6, 1.0, 1e6):
        assert bool(torch.isfinite(case(level * x, level * y))), level
        assert bool(torch.isfinite(gradient(case, level * x, level * y)).all()), level


@every
def test_a_single_bin(case):
    x, y = case.tensors()
    if case.function in (losses.transient_phasor_loss, losses.measurement_consistency):
        x, y = x[..., :1, :1], y[..., :1, :1]  # the axis and the operator say how many bins there are
    elif x.ndim == 5 and case.crop is not None:
        x, y = x[..., :1, :1, :1], y[..., :1, :1, :1]
    elif case.crop is not None:
        x, y = x[..., :1, :1], y[..., :1, :1]
    assert bool(torch.isfinite(case(x, y, **case.said)))
    assert bool(torch.isfinite(gradient(case, x, y, **case.said)).all())


@over(lambda case: real(case.tensors()[0]) and case.function is not losses.measurement_consistency)
@together("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_autocast_and_half_precision(case, dtype):
    """Values and gradients are those of single precision; the operator of a measurement is the user's."""
    x, y = (t.to(dtype) for t in case.tensors())
    wanted, slope = case(x.float(), y.float()), gradient(case, x, y)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, narrowed = case(x, y), gradient(case, x, y)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)
    assert bool(torch.isfinite(slope).all())
    torch.testing.assert_close(narrowed, slope, rtol=0, atol=0)


@over(lambda case: case.mapped)
def test_transforms_of_functions(case):
    x, y = case.tensors()
    mask = mask_of(y)
    each = torch.vmap(lambda x, y, m: case(x, y, m))(x, y, mask)
    wanted = torch.stack([case(x[i], y[i], mask[i]) for i in range(2)])
    torch.testing.assert_close(each, wanted)
    torch.testing.assert_close(torch.vmap(lambda x, y: case(x, y))(x, y).mean(), case(x, y))
    if real(x):
        slopes = torch.vmap(torch.func.grad(lambda x, y: case(x, y, reduction="sum")))(x, y)
        torch.testing.assert_close(slopes, gradient(case, x, y))
        direction = torch.ones_like(x)
        _, tangent = torch.func.jvp(lambda x: case(x, y, reduction="sum"), (x,), (direction,))
        torch.testing.assert_close(tangent, gradient(case, x, y).sum())


@over(lambda case: case.mapped and "SSIM" not in case.name)  # kornia turns autocast off, which this device has not
def test_no_tensor_stays_on_the_cpu(case):
    """Tensors without memory are on another device, too: one of the CPU among them is an error."""
    x, y = (t.to("meta") for t in case.tensors())
    x.requires_grad_()
    value = case(x, y, mask_of(torch.empty(y.shape)).to("meta"))
    value.backward()
    assert value.device.type == x.grad.device.type == "meta"


@over(lambda case: real(case.tensors()[0]) and case.pair)
def test_whole_numbers_as_targets(case):
    """Counts as detectors give them, beside a network's half precision: 70,000 is no number of float16."""
    x, y = case.tensors(dtype=torch.float32)
    whole = (70_000 * y if case.draw_target is None else y).to(torch.int64)
    torch.testing.assert_close(case(x, whole), case(x, whole.float()), rtol=0, atol=0)
    # an operator of half precision has its rounding, 2^-11, in the residual
    rtol = 2**-10 if case.function is losses.measurement_consistency else 0
    torch.testing.assert_close(case(x.half(), whole), case(x.half().float(), whole.float()), rtol=rtol, atol=0)


@pytest.mark.gpu
@every
def test_on_the_device_of_the_tensors(case):
    x, y = (t.to("cuda") for t in case.tensors())
    mask = mask_of(y).cuda()
    found = case.module(**case.options).cuda()(*case.arguments(x, y), mask=mask)
    assert found.device.type == "cuda"
    torch.testing.assert_close(found.cpu(), case(x.cpu(), y.cpu(), mask.cpu()))


@pytest.mark.parametrize(
    "cases", [pytest.param(CASES[::4], marks=pytest.mark.slow), pytest.param(CASES, marks=pytest.mark.soak)], ids=len
)
def test_compiled(cases):
    for case in cases:
        check_compiled(case)


def check_compiled(case):
    """Values and gradients; likelihoods break the graph where they look at their values, others where they ask what
    compares for its arguments.
    """
    x, y = case.tensors()
    torch.compiler.reset()
    leaf, mask = x.clone().requires_grad_(), mask_of(y)
    module = case.module(**case.options, reduction="sum")
    whole = case.draw_target is None and case.function not in (losses.measurement_consistency, losses.multiscale_loss)
    compiled = torch.compile(module, backend="aot_eager", fullgraph=whole)
    found = compiled(*case.arguments(leaf, y), mask=mask)
    torch.testing.assert_close(found, case(x, y, mask, "sum"))
    found.backward()
    torch.testing.assert_close(leaf.grad, gradient(case, x, y, mask))
    if case.function is not losses.read_noise_nll and case.draw_target is not None:
        with pytest.raises(UnitError, match="expected rates"):
            compiled(*case.arguments(-x, y))


@every
def test_what_would_be_wrong_in_silence_is_an_error(case):
    """Shapes that broadcast, weights in the place of a mask, imaginary parts, a reduction by another name."""
    x, y = case.tensors()
    with pytest.raises(ArgumentError, match="reduction"):
        case(x, y, reduction="median")
    with pytest.raises(UnitError, match="mask of truth values"):
        case(x, y, torch.ones_like(y))
    with pytest.raises(ShapeError, match="mask that broadcasts"):
        case(x, y, torch.ones(3, *y.shape, dtype=torch.bool))
    if case.pair:
        with pytest.raises(ShapeError, match="shape"):
            case(x, y[..., :1])
    if real(x) and case.pair and case.function not in COMPLEX_TOO:
        with pytest.raises(UnitError, match="real"):
            case(x, y + 1j)


COMPLEX_TOO = (losses.squared_loss, losses.two_render_loss, losses.measurement_consistency)


@every
def test_numbers_that_make_a_plausible_loss_are_an_error(case):
    """Of every option of the signature, where it has a part."""
    x, y = case.tensors()
    for name in number_options(case.module):
        if (case.name, name) in IDLE:
            continue
        for wrong in WRONG.get(name, (-1.0, float("nan"))):
            with pytest.raises(TorchTransientError, match="expected"):
                dataclasses.replace(case, options={**case.options, name: wrong})(x, y)


@every
def test_an_option_with_a_gradient_has_it_or_is_refused(case):
    """Never a number in silence, whose derivative is nothing. A dead pixel, which a mask leaves out, has no part."""
    x, y = case.tensors()
    mask, spoiled = mask_of(y), y.clone()
    mask[..., 2, 3], spoiled[..., 2, 3] = False, float("nan")
    for option in number_options(case.module):
        number = FITS.get((case.name, option), FITS.get(option, case.options.get(option)))
        if (case.name, option) in IDLE:
            continue
        assert number is not None, f"{case}: give its case a {option}, or FITS in tests/support/loss_cases.py"
        leaf = torch.tensor(number, dtype=torch.float64, requires_grad=True)

        def value(given, target=y, mask=None, option=option):
            given = given if given.ndim == 0 else tuple(given)
            return dataclasses.replace(case, options={**case.options, option: given})(x, target, mask, reduction="sum")

        refused = ""
        try:
            value(leaf)
        except TorchTransientError as error:
            refused = str(error)
        if refused:
            assert "without a gradient" in refused
            value(leaf.detach())
            continue
        assert torch.autograd.gradcheck(value, leaf, fast_mode=True), option
        assert torch.autograd.gradcheck(lambda v, seen=value: seen(v, spoiled, mask), leaf, fast_mode=True), option


def test_options_with_a_tangent_of_forward_mode():
    x, y = (1 + torch.rand(4, 4, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    calls = (
        lambda v: losses.scale_invariant_depth_loss(x, y, balance=v),
        lambda v: losses.total_variation(x[None], spacing=(1.0, v, 1.0)),
    )
    for call in calls:
        with pytest.raises(TorchTransientError, match="without a gradient"):
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
