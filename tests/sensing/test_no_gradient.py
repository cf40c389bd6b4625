"""What has no gradient: draws, choices of a bin, plain numbers. And that nothing else loses its own on the way."""

from __future__ import annotations

import contextlib
import warnings

import pytest
import torch

from support.marks import long
from support.sensing.all_entries import each
from support.sensing.contract import parts
from torchtransient import TimeAxis, sensing
from torchtransient.sensing import straight_through

PS = 1e-12
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 12)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def light(seed=0, high=0.5, dtype=torch.float64):
    return (high * torch.rand(1, 12, 2, 3, generator=generator(seed), dtype=dtype)).requires_grad_()


def counts_of(mean, seed=0):
    return torch.poisson(torch.full((1, 12, 2, 3), mean, dtype=torch.float64), generator=generator(seed))


# --------------------------------------------------------------------------------------------------- plain numbers


@contextlib.contextmanager
def nothing_with_a_gradient_as_a_number():
    """torch's warning of a tensor that requires a gradient and is made a plain number, as an error, each time."""
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="Converting a tensor with requires_grad=True")
            yield
    finally:
        torch.set_warn_always(False)


@pytest.mark.slow
@each
def test_sensors_make_no_number_of_what_has_a_gradient(entry):
    """torch warns of it, once in a process; and draws have no gradient, whoever asks for them."""
    x = entry.x(torch.float32)[:1].requires_grad_()
    with nothing_with_a_gradient_as_a_number():
        # the mean and its variance, and what is drawn
        for policy in {"gaussian", "score"}.intersection(entry.policies) if entry.random else [None]:
            module = entry.module(torch.float32, **({"grad": policy} if policy else {}))
            with sensing.ScoreFunction():
                module(x, generator=generator())
        if entry.random:
            assert not any(value.requires_grad for value in parts(module.sample(x, generator())))


def learnt_afterpulses(probability=0.05, tau_s=300 * PS, **keywords):
    return sensing.Afterpulsing(probability, tau_s, 150 * PS, axis=AXIS, learnable=True, **keywords)


CHAINS = {
    "free running": lambda: [
        sensing.FreeRunningSPAD(50, 150 * PS, axis=AXIS, learnable=True),
        sensing.DetectionJitter(sensing.UniformResponse(70 * PS, learnable=True), AXIS),
        learnt_afterpulses(),
    ],
    "carriers of a cycle": lambda: [
        sensing.AfterpulsingSPAD(
            sensing.SynchronousSPAD(50, dead_time_s=150 * PS, axis=AXIS),
            learnt_afterpulses([0.05, 0.02], [3e-10, 2e-9]),
        )
    ],
    "first photons, carriers": lambda: [
        sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(50, axis=AXIS), learnt_afterpulses())
    ],
    "free running, carriers": lambda: [
        sensing.AfterpulsingSPAD(
            sensing.FreeRunningSPAD(50, 150 * PS, axis=AXIS, learnable=True),
            learnt_afterpulses(counted_from="avalanche"),
        )
    ],
}


@pytest.mark.parametrize("name", long(CHAINS, ["free running", "carriers of a cycle"]))
def test_chains_make_no_number_of_what_is_learnt(name):
    x = light(high=0.2).detach()[..., :1, :2].requires_grad_()
    with nothing_with_a_gradient_as_a_number():
        chain = sensing.Compose(CHAINS[name]())
        mean = chain.expected(x)
        # Bins that count differently: a delay does not change the sum of squares of what runs round, to first order.
        weight = torch.rand(mean.shape, generator=generator(3), dtype=mean.dtype)
        slopes = torch.autograd.grad((weight * mean).sum(), [x, *chain.parameters()], allow_unused=True)
        chain.sample(x, generator())
    assert all(s is not None and bool(s.isfinite().all()) and bool((s != 0).any()) for s in slopes)


# ----------------------------------------------------------------------------------------------------------- draws


def test_straight_through_has_the_gradient_of_the_mean_alone():
    sample, mean = (torch.tensor([2.0, 5.0], requires_grad=True) for _ in range(2))
    y = straight_through(3 * sample, 7 * mean)
    assert torch.equal(y, 3 * sample)
    slopes = torch.autograd.grad(y.sum(), [sample, mean], allow_unused=True)
    assert slopes[0] is None and slopes[1].tolist() == [7.0, 7.0]


def test_a_baseline_has_no_gradient():
    """It is subtracted in front of the score; what it depends on learns nothing by it."""
    x, level = torch.full((5, 1, 4, 1, 1), 2.0, requires_grad=True), torch.tensor(3.0, requires_grad=True)
    with sensing.ScoreFunction() as score:
        losses = sensing.ShotNoise(grad="score")(x, generator=generator()).sum((1, 2, 3, 4)).square()
    for baseline in (level, 2 * level):
        total = score.surrogate(losses, baseline=baseline).sum()
        slopes = torch.autograd.grad(total, [x, level], allow_unused=True, retain_graph=True)
        assert slopes[1] is None
        numbers = torch.autograd.grad(score.surrogate(losses, float(baseline.detach())).sum(), x, retain_graph=True)
        assert torch.equal(slopes[0], numbers[0])


# ------------------------------------------------------------------------------------ what a likelihood is asked for


def test_a_detection_takes_its_cycle_from_later_bins():
    """By a first photon in bin k, log p changes by log(1 - exp(-r_k)), and by r of this and each later bin."""
    r = light().detach()[..., :1, :1]
    n = counts_of(1.0)[..., :1, :1].requires_grad_()
    (slope,) = torch.autograd.grad(sensing.first_photon_log_prob(n, r, 100, constant=False).sum(), n)
    torch.testing.assert_close(slope, torch.log(-torch.expm1(-r)) + r.flip(1).cumsum(1).flip(1))


# ------------------------------------------------------------------------------------- derivatives that are to stay


SURROGATES = {
    "running free": lambda: sensing.FreeRunningSPAD(400, 150 * PS, axis=AXIS, grad="gaussian"),
    "coincidences": lambda: sensing.CoincidencePixel(
        sensing.SynchronousSPAD(400), 3, coincidence=2, window_s=150 * PS, axis=AXIS, grad="gaussian"
    ),
}


@pytest.mark.parametrize("name", SURROGATES)
def test_normal_surrogates_of_events(name):
    """Their derivative is that of the mean, and of the size of what is beside it as of independent bins."""
    sensor = SURROGATES[name]()
    x = light()
    y, mean = sensor(x, generator=generator()), sensor.expected(x)
    size = (sensor.variance(x) + 1e-4).log() / 2
    wanted = torch.autograd.grad((mean + (y - mean).detach() * size).sum(), x)[0]
    torch.testing.assert_close(torch.autograd.grad(y.sum(), x)[0], wanted)


WIDE = {"bin_width_s": 1e-9}
DARK = torch.tensor(
    [[0.0, 0.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 2.0], [2.0, 2.0, 2.0, 2.0, 2.0],
     [0.0, 1.0, 5.0, 1.0, 0.0], [0.0, -1.0, 1.0, 0.0, 0.0]], dtype=torch.float64).T.reshape(1, 5, 1, 6)  # fmt: skip
LIT = DARK.clamp_min(0) * torch.tensor([1.0, 1e-7, 1.0, 1e-3, 10.0, 1.0], dtype=torch.float64)
BACKWARDS = {
    "peak": lambda x: sensing.peak_position(x),
    "mean": lambda x: sensing.center_of_mass(x),
    "mean around the peak": lambda x: sensing.center_of_mass(x, half_width_bins=1, background=0.5),
    "first": lambda x: sensing.first_return(x, 1.0).position,
    "first of a share": lambda x: sensing.first_return(x, 0.5 * x.amax(1)).position,
    "several": lambda x: sensing.multi_return(x, 2, threshold=0.5).position,
    "soft": lambda x: sensing.soft_argmax(x),
    "equal shares": lambda x: sensing.equi_depth_edges(x.clamp_min(0), 3),
}
DETECTED = {
    "one a cycle": lambda: sensing.SynchronousSPAD(9),
    "several a cycle": lambda: sensing.SynchronousSPAD(9, dead_time_s=1.4e-9, **WIDE),
    "running free": lambda: sensing.FreeRunningSPAD(9, 1.4e-9, **WIDE),
    "frames": lambda: sensing.BinaryFrames(9),
    "shot noise": lambda: sensing.ShotNoise(),
}


@pytest.mark.parametrize("name", BACKWARDS)
def test_positions_of_dark_and_of_flat_pixels_have_derivatives(name):
    """No step on the way back gives NaN that another one hides."""
    x = DARK.clone().requires_grad_()
    with torch.autograd.set_detect_anomaly(True):
        (slope,) = torch.autograd.grad(BACKWARDS[name](x).sum(), x)
    assert bool(slope.isfinite().all())


@pytest.mark.parametrize("name", DETECTED)
def test_detections_in_the_dark_have_derivatives(name):
    """Means, variances and logarithms of chances: of no light at all, of hardly any, and of bright bins."""
    sensor, x = DETECTED[name](), LIT.clone().requires_grad_()
    seen = torch.where(LIT > 0.5, 1.0, 0.0).double()
    values = [sensor.expected(x), sensor.variance(x)]
    if name != "running free":
        values.append(sensor.log_prob(seen, x))
    for value in values:
        assert bool(value.isfinite().all())
        (slope,) = torch.autograd.grad(value.sum(), x, retain_graph=True)
        assert bool(slope.isfinite().all())
