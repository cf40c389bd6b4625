"""Every loss of what a renderer returns, and two renders of one scene in one call for `two_render_loss`."""

from __future__ import annotations

import functools
import inspect

import pytest
import torch

import torchtransient as tt
from support.loss_cases import CASES
from tools.small_room import VARIANT, make_room
from torchtransient import losses

GREY = "wall.bsdf.reflectance.value"
BAND = tt.FrequencyAxis.uniform(0.2, 0.2, 5)
PLANES = torch.rand(24, 6, generator=torch.Generator().manual_seed(5))


@pytest.fixture(scope="module")
def scene():
    return tt.load(make_room(), variant=VARIANT)


@pytest.fixture(scope="module")
def renderer(scene):
    return tt.TransientRenderer(scene, parameters=[GREY], spp=2)


@pytest.fixture(scope="module")
def shared(renderer):
    """A render that its parameter has a gradient of, and one of another seed as target."""
    return renderer(seed=1), renderer(seed=2).detach()


@pytest.fixture(scope="module")
def phasors(scene):
    renderer = tt.TransientRenderer(scene, parameters=[GREY], spp=2, frequencies=BAND)
    return renderer, renderer(seed=1), renderer(seed=2).detach()


def operator(volume):
    return torch.einsum("tz,...zyx->...tyx", PLANES, volume)


# Options that results know: of two tensors they have to be given.
KNOWN = {"bin_width_opl": 0.25, "axis": tt.TimeAxis(6.0, 0.25, 24)}


def taken_by(loss):
    """The kind of result that a loss takes first, as its signature says: `Light`, `Volume`, ..."""
    return next(iter(inspect.signature(loss).parameters.values())).annotation


def histograms():
    """What compares histograms, by the first case of the list: (options, what tensors are given beside them)."""
    found = {}
    for case in CASES:
        if taken_by(case.function) in ("Light", "Transient", "Binned") and case.function not in (*OTHER, *found):
            options = {**case.options, **case.of_renders}
            known = {name: KNOWN[name] for name in options.keys() & KNOWN.keys()}
            found[case.function] = ({name: value for name, value in options.items() if name not in KNOWN}, known)
    return found


OTHER = (losses.two_render_loss, losses.measurement_consistency, losses.phasor_loss, losses.ssim_loss)
HISTOGRAMS = histograms()
by_name = pytest.mark.parametrize("loss", HISTOGRAMS, ids=lambda loss: loss.__name__)


def slope_of(value, renderer):
    (slope,) = torch.autograd.grad(value, renderer.values[GREY], retain_graph=True)
    assert bool(torch.isfinite(slope)) and float(slope) != 0
    return slope


def test_every_loss_says_what_it_takes():
    """Histograms are here; depth maps and hidden volumes are nothing that a renderer returns."""
    others = {case.function for case in CASES} - set(HISTOGRAMS)
    assert set(OTHER) <= others and len(HISTOGRAMS) > 10
    assert {taken_by(loss) for loss in others - set(OTHER)} <= {"Volume", "DepthMap"}


@pytest.mark.slow
@by_name
def test_of_two_renders(loss, renderer, shared):
    """The number of their tensors, and a gradient that goes back through the renderer."""
    out, target = shared
    options, known = HISTOGRAMS[loss]
    found = loss(out, target, **options)
    wanted = loss(out.transient, target.transient, **options, **known)
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    slope_of(found, renderer)
    # Compared where the renderer takes it up: behind it the order of the additions changes from run to run.
    of_found, of_wanted = (torch.autograd.grad(v, out.transient, retain_graph=True) for v in (found, wanted))
    torch.testing.assert_close(of_found, of_wanted, rtol=0, atol=0)
    for pair in ((out, target.transient), (out.transient, target)):
        torch.testing.assert_close(loss(*pair, **options), wanted, rtol=0, atol=0)


def test_of_pictures_volumes_and_a_second_render(renderer, shared):
    out, target = shared
    found = losses.ssim_loss(out, target, window=3)
    torch.testing.assert_close(found, losses.ssim_loss(out.steady, target.steady, window=3), rtol=0, atol=0)
    slope_of(found, renderer)
    volume = torch.rand(3, 6, 3, 4)
    found = losses.measurement_consistency(volume, target, operator)
    torch.testing.assert_close(found, losses.measurement_consistency(volume, target.transient, operator))
    slope_of(losses.measurement_consistency(volume, out, operator), renderer)
    second = renderer(seed=3)
    found = losses.two_render_loss(out, second, target)
    torch.testing.assert_close(found, losses.two_render_loss(out.transient, second.transient, target.transient))
    slope_of(found, renderer)


@pytest.mark.slow
def test_of_phasor_films(phasors):
    renderer, out, target = phasors
    for loss in (losses.phasor_loss, losses.squared_loss, functools.partial(losses.phasor_loss, phase_only=True)):
        found = loss(out, target)
        torch.testing.assert_close(found, loss(out.phasor, target.phasor), rtol=0, atol=0)
        slope_of(found, renderer)


def test_of_a_simulated_capture(renderer):
    """A `Capture` as measurement, on an axis that its simulation gave it; renders lie on another one."""
    axis = tt.TimeAxis(1.2, 0.08, 16)
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), (3, 3), kind="confocal")
    plate = {"type": "rectangle", "to_world": torch.diag(torch.tensor([0.4, 0.4, 1.0, 1.0])).numpy()}
    plate["to_world"][2, 3] = 0.8
    plate["bsdf"] = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    capture = tt.nlos.simulate({"plate": plate}, scan, time_axis=axis, spp=16, bounces=(3,), seed=0)
    assert float(capture.transient.sum()) > 0
    twice = capture.map(lambda t: 2 * t)
    for loss in (losses.cumulative_loss, losses.squared_loss, losses.wasserstein_loss):
        known = {} if loss is losses.squared_loss else {"bin_width_opl": 0.08}
        found = loss(twice, capture)
        torch.testing.assert_close(found, loss(twice.transient, capture.transient, **known), rtol=0, atol=0)
    with pytest.raises(tt.errors.UnitError, match="on one axis"):
        losses.squared_loss(renderer(seed=1), capture)


# ------------------------------------------------------------------------------------------- two renders in one call


def in_one_call(renderer, x, target, seeds):
    out = renderer({GREY: torch.stack([x, x])}, seed=seeds).transient
    return losses.two_render_loss(out[0], out[1], target, reduction="sum")


@pytest.mark.slow
def test_two_seeds_in_one_call_are_two_calls(renderer, shared):
    target = shared[1].transient
    x = torch.tensor(0.45, requires_grad=True)
    value = in_one_call(renderer, x, target, (11, 12))
    (slope,) = torch.autograd.grad(value, x)
    first, second = (renderer({GREY: x}, seed=seed) for seed in (11, 12))
    assert not torch.equal(first.transient, second.transient)
    apart = losses.two_render_loss(first, second, target, reduction="sum")
    torch.testing.assert_close(value, apart, rtol=0, atol=0)
    torch.testing.assert_close(slope, torch.autograd.grad(apart, x)[0])


@pytest.fixture(scope="module")
def converged(scene):
    """(light, its derivative by the wall's albedo) of 0.45, of 50,000 samples a pixel: the noise of two over 150."""
    renderer = tt.TransientRenderer(scene, parameters=[GREY], spp=10_000)
    found = [
        torch.func.jvp(lambda x, n=n: renderer({GREY: x}, seed=n).transient, (torch.tensor(0.45),), (torch.ones(()),))
        for n in range(100, 105)
    ]
    return tuple(torch.stack(each).double().mean(0) for each in zip(*found, strict=True))


PAIRS = 100


@pytest.fixture(scope="module")
def draws(renderer, converged):
    """Values and slopes of pairs of renders, (2, PAIRS), of two seeds and of one seed twice; and what they should be.

    The target is half as bright again as the light of 0.45.
    """
    light, derivative = converged
    target, found = 1.5 * light, []
    for second in (PAIRS, 0):
        seeds = [n + late for n in range(1000, 1000 + PAIRS) for late in (0, second)]
        x = torch.full((2 * PAIRS,), 0.45).requires_grad_()
        out = renderer({GREY: x}, seed=seeds).transient.unflatten(0, (PAIRS, 2))
        values = torch.stack([losses.two_render_loss(*pair, target.float(), reduction="sum") for pair in out])
        (slopes,) = torch.autograd.grad(values.sum(), x)
        found.append(torch.stack([values.detach(), slopes.reshape(PAIRS, 2).sum(1)]).double())
    wanted = torch.stack([(light - target).square().sum(), (2 * (light - target) * derivative).sum()])
    return *found, wanted


def deviations(draws, wanted):
    """Of the mean from what it should be, in standard errors."""
    return (draws.mean(1) - wanted) / (draws.std(1) / draws.shape[1] ** 0.5)


@pytest.mark.slow
def test_two_seeds_are_the_squared_error_of_a_render_without_noise(draws):
    """Value and gradient, within four standard errors; one seed twice has the variance of the render on top."""
    two, one, wanted = draws
    assert bool((deviations(two, wanted).abs() < 4).all())
    # what is claimed can be told from what is not: the spread is far below the bias of one seed
    assert float(deviations(one, wanted)[0]) > 8
