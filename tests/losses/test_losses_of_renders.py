"""Losses of what a renderer returns, and two renders of one scene in one call for `two_render_loss`."""

import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT, make_room
from torchtransient import losses

GREY = "wall.bsdf.reflectance.value"
AXIS, BAND = tt.TimeAxis(6.0, 0.25, 24), tt.FrequencyAxis.uniform(0.2, 0.2, 5)
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


def operator(volume):
    return torch.einsum("tz,...zyx->...tyx", PLANES, volume)


def slope_of(value, renderer):
    (slope,) = torch.autograd.grad(value, renderer.values[GREY], retain_graph=True)
    assert bool(torch.isfinite(slope)) and float(slope) != 0


@pytest.mark.parametrize(
    ("loss", "options", "known"),
    [
        (losses.squared_loss, {}, {}),
        (losses.wasserstein_loss, {}, {"bin_width_opl": AXIS.bin_width_opl}),
        (losses.transient_phasor_loss, {"frequencies": BAND}, {"axis": AXIS}),
    ],
)
def test_of_two_renders(loss, options, known, renderer, shared):
    """The number of their tensors, and a gradient that goes back through the renderer."""
    out, target = shared
    found = loss(out, target, **options)
    wanted = loss(out.transient, target.transient, **options, **known)
    torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    slope_of(found, renderer)
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
    second = renderer(seed=3)
    found = losses.two_render_loss(out, second, target)
    torch.testing.assert_close(found, losses.two_render_loss(out.transient, second.transient, target.transient))
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
    found = losses.cumulative_loss(twice, capture)
    torch.testing.assert_close(found, losses.cumulative_loss(twice.transient, capture.transient, 0.08))
    with pytest.raises(tt.errors.UnitError, match="on one axis"):
        losses.squared_loss(renderer(seed=1), capture)


@pytest.mark.slow
def test_two_seeds_in_one_call_are_two_calls(renderer, shared):
    target = shared[1].transient
    x = torch.tensor(0.45, requires_grad=True)
    out = renderer({GREY: torch.stack([x, x])}, seed=(11, 12)).transient
    value = losses.two_render_loss(out[0], out[1], target, reduction="sum")
    (slope,) = torch.autograd.grad(value, x)
    first, second = (renderer({GREY: x}, seed=seed) for seed in (11, 12))
    assert not torch.equal(first.transient, second.transient)
    apart = losses.two_render_loss(first, second, target, reduction="sum")
    torch.testing.assert_close(value, apart, rtol=0, atol=0)
    torch.testing.assert_close(slope, torch.autograd.grad(apart, x)[0])
