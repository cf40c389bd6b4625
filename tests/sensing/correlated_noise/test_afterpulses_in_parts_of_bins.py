"""Detectors that obey their afterpulses: gates, bins in parts, pixels of several levels, and transforms of them."""

from __future__ import annotations

import pytest
import torch

from support.marks import long
from torchtransient import TimeAxis, sensing
from torchtransient.sensing import afterpulsing_spad as carriers
from torchtransient.sensing.afterpulsing_spad import _LossyChain
from torchtransient.sensing.dead_time import renewal
from torchtransient.sensing.dead_time.renewal import RenewalChain, bin_response, stationary_phases
from torchtransient.sensing.spad import exposed_cycles

BINS, WIDTH = 5, 100e-12
AXIS = TimeAxis.from_seconds(0.0, WIDTH, BINS)
GATE = torch.tensor([0.0, 0.3, 1.0, 0.6, 0.0])


def light(high=0.4, pixels=2):
    g = torch.Generator().manual_seed(0)
    return 0.02 + high * torch.rand(1, BINS, 1, pixels, generator=g, dtype=torch.float64)


def obeyed(detector, tau_s=400e-12, dead_time_s=150e-12, axis=AXIS, probability=0.2):
    return sensing.AfterpulsingSPAD(detector, sensing.Afterpulsing(probability, tau_s, dead_time_s, axis=axis))


def spad(axis=AXIS, gate=None, cycles=100):
    return sensing.SynchronousSPAD(cycles, gate=gate, dead_time_s=150e-12, axis=axis)


def test_a_gate_that_is_open_is_none():
    x = light()
    torch.testing.assert_close(obeyed(spad(gate=torch.ones(BINS)))(x), obeyed(spad())(x), rtol=1e-10, atol=1e-12)


def test_a_gate_dims_photons_and_carriers_alike():
    """Nothing where it is shut; half open it sees half of each, as of half the light and half the carriers."""
    x = light()
    found = obeyed(spad(gate=GATE))(x)
    assert bool((found[:, GATE == 0] == 0).all()) and bool((found[:, GATE > 0] > 0).all())
    halves = obeyed(spad(gate=torch.full((BINS,), 0.5)), probability=0.2)(x)
    without = sensing.SynchronousSPAD(100, dead_time_s=150e-12, axis=AXIS)
    plain = without(0.5 * x)
    more = halves - plain
    whole = obeyed(spad(), probability=0.1)(0.5 * x) - plain
    torch.testing.assert_close(more.sum(1), whole.sum(1), rtol=0.03, atol=0)


@pytest.mark.parametrize("kind", long(["cycles", "gated", "free"], ["gated"]))
def test_bins_in_parts_are_finer_bins(kind):
    """Carriers of a part of a bin are followed in parts of bins: as where the bins are cut by hand."""
    gated, free = kind == "gated", kind == "free"
    x, parts, tau = (light(0.4, 1), 2, 60e-12) if free else (light(0.4, 1), 4, 30e-12)
    fine_axis = TimeAxis.from_seconds(0.0, WIDTH / parts, BINS * parts)
    gate = GATE if gated else None
    fine_gate = GATE.repeat_interleave(parts) if gated else None
    if free:
        detectors = [sensing.FreeRunningSPAD(100, 150e-12, axis=a) for a in (AXIS, fine_axis)]
    else:
        detectors = [spad(AXIS, gate), spad(fine_axis, fine_gate)]
    coarse, fine = (obeyed(d, tau_s=tau, axis=a) for d, a in zip(detectors, (AXIS, fine_axis), strict=True))
    assert coarse._steps() > 1
    by_hand = fine((x / parts).repeat_interleave(parts, 1)).view(1, BINS, parts, 1, 1).sum(2)
    # detections are taken to be even in their bins, which are narrower by hand
    torch.testing.assert_close(coarse(x), by_hand, rtol=6e-3, atol=1e-4)
    torch.testing.assert_close(coarse.probabilities(x) * 100, coarse(x), rtol=1e-10, atol=0)
    drawn = coarse.sample(x.expand(1, BINS, 20, 1), torch.Generator().manual_seed(0)).mean(2, keepdim=True)
    assert bool(((drawn - coarse(x)).abs() < 5 * (coarse(x) / 20).sqrt() + 0.5).all())


@pytest.mark.slow
def test_pixels_of_several_levels_are_those_of_each():
    """Dim and bright ones together, in a batch, mapped by torch.func, and their derivatives."""
    module = obeyed(spad())
    x = torch.cat([light(0.1, 1), light(6.0, 1), light(0.3, 1)], -1)
    together = module(x)
    for i in range(3):
        torch.testing.assert_close(together[..., i : i + 1], module(x[..., i : i + 1]), rtol=1e-9, atol=1e-10)
    items = x.movedim(-1, 0).unsqueeze(-1)
    mapped = torch.func.vmap(module.expected)(items)
    torch.testing.assert_close(mapped.squeeze(-1).movedim(0, -1), together, rtol=1e-9, atol=1e-10)


def test_counts_beyond_the_window_reach_mapped_pixels_of_several_levels_once():
    """What the background outside of the window sends is that of each pixel, however many levels there are."""
    afterpulsing = sensing.Afterpulsing(0.2, 400e-12, 150e-12, axis=AXIS, period_s=1.2e-9, background=7.0)
    module = sensing.AfterpulsingSPAD(spad(), afterpulsing)
    x = torch.cat([light(0.1, 1), light(6.0, 1), light(0.3, 1)], -1)
    mapped = torch.func.vmap(module.expected)(x.movedim(-1, 0).unsqueeze(-1))
    torch.testing.assert_close(mapped.squeeze(-1).movedim(0, -1), module.expected(x), rtol=1e-9, atol=1e-10)


def test_what_does_not_reach_the_window_leaves_nothing_below_zero():
    """Afterpulses that all come at once: of counts outside of the window, and of other cycles."""
    window = TimeAxis.from_seconds(0.0, WIDTH, 50)
    for dead in (0.0, 150e-12):
        stage = sensing.Afterpulsing(0.2, 10e-12, dead, axis=window, period_s=60 * WIDTH, background=5.0)
        dark = torch.zeros(1, 50, 1, 1, dtype=torch.float64)
        assert float(stage.extra(dark).min()) >= 0
        assert bool((stage.sample(dark, torch.Generator().manual_seed(0)) >= 0).all())
        one = sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(100, axis=window), stage)
        several = [sensing.SynchronousSPAD(100, dead_time_s=dead, axis=window)] if dead else []
        for module in (one, *(sensing.AfterpulsingSPAD(s, stage) for s in several)):
            flash = dark.clone()
            flash[:, 25] = 5.0
            for x in (dark, flash):
                assert float(module.released(x).min()) >= 0


@pytest.mark.slow
def test_transforms_of_detectors_with_dead_time():
    """Gradients mapped over pixels, of one level and of several: those of autograd."""
    detector = spad()
    weights = torch.linspace(-1, 2, BINS, dtype=torch.float64).view(-1, 1, 1)

    def value(v):
        return (detector.expected(v) * weights).sum()

    for bright in (0.2, 9.0):
        x = torch.cat([light(0.1, 1), light(bright, 1)], -1).movedim(-1, 0).unsqueeze(-1)
        mapped = torch.func.vmap(torch.func.grad(value))(x)
        along = torch.func.vmap(lambda v: torch.func.jvp(value, (v,), (torch.ones_like(v),))[1])(x)
        for i in range(2):
            leaf = x[i].clone().requires_grad_()
            (exact,) = torch.autograd.grad(value(leaf), leaf)
            torch.testing.assert_close(mapped[i], exact, rtol=1e-9, atol=1e-11)
            torch.testing.assert_close(along[i], exact.sum(), rtol=1e-8, atol=1e-10)


def test_light_without_pixels():
    empty = torch.zeros(1, BINS, 0, 2, dtype=torch.float64)
    for module in (spad(), sensing.SynchronousSPAD(5, dead_time_s=150e-12, axis=AXIS, grad="gaussian")):
        assert module(empty).shape == module.sample(empty).shape == module.variance(empty).shape == empty.shape


def test_cycles_that_could_fire_once():
    counts = torch.tensor([3.0, 0.0, 2.0, 1.0]).reshape(1, 4, 1, 1)
    assert exposed_cycles(counts, 9, None).flatten().tolist() == [9.0, 6.0, 6.0, 4.0]


# ------------------------------------------------------------------------------------------- what carriers are made of


def number(values):
    return torch.tensor(values, dtype=torch.float64)


class Watched(carriers.FreeRunningTrain):
    """Remembers the lowest rate that it was asked for."""

    least = 1.0

    def trapped(self, rate, lost, back, source):
        Watched.least = min(Watched.least, float(rate.min()))
        return super().trapped(rate, lost, back, source)


@pytest.mark.slow
def test_no_rate_of_other_carriers_is_below_zero():
    """Of pairs in the dark before a flash, where each of them makes others less likely."""
    first = number([[1e-6, 1e-6, 1.0, 1e-6, 1e-6, 1e-6]])
    train = Watched(1, number(0.3))
    hazard, _ = carriers.carrier_hazard(train, None, first, None, number([0.5]), number([2.0]), number(1.3))
    assert 0 < Watched.least <= 1e-6 * (1 + 1e-9) and bool((hazard > 0).all())


@pytest.mark.parametrize("largest", [0.3, 1.9, 2.1, 40.0])
@pytest.mark.parametrize("part", [0.0, 0.35])
def test_a_bin_by_powers_and_by_moments(part, largest):
    """Up to 2 photons powers of them; what a bin does is the same."""
    loss = largest * number([[0.0, 0.01, 0.4], [1.0, 0.7, 0.2]])
    found = carriers._response(loss, number(part), largest)
    wanted = bin_response(loss, number(part))
    for name in ("kept", "waited", "hit_slope", "slope", "wait", "decay"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("whole", [0, 3, 8])
def test_carriers_on_a_ring_start_from_constant_light(whole):
    """Rows that are constant are undone at once, by the losses and shares of their own."""
    loss, kept = number([[0.03], [0.9], [7.0]]).expand(3, 5), number([[0.999], [0.3], [0.8]]).expand(3, 5)
    chain = _LossyChain(loss.contiguous(), kept.contiguous(), number(0.4), whole)
    x = torch.randn(3, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(chain.constant.solve(x - chain.step(x)), x, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(chain.solve(x - chain.step(x)), x, rtol=1e-8, atol=1e-8)
    # all of a share and none of one, too: a number that is near enough
    for share in (0.0, 1.0):
        edge = _LossyChain(loss[:1].contiguous(), share + 0 * kept[:1], number(0.4), whole)
        found = edge.constant.solve(x[:1] - edge.step(x[:1]))
        if share == 0:
            torch.testing.assert_close(found, x[:1], rtol=1e-5, atol=1e-5)
        assert bool(found.isfinite().all())


@pytest.mark.parametrize("whole", [0, 3, 8])
def test_detections_on_a_ring_start_from_constant_light(whole):
    """The mean wait of each row is that of its own light."""
    rate = number([[0.03], [0.9], [7.0]]).expand(3, 5).contiguous()
    chain = RenewalChain(rate, whole, number(0.4))
    pi = stationary_phases(rate, number(0.4), whole)
    torch.testing.assert_close(pi[:, :5], torch.full((3, 5), 0.2, dtype=torch.float64))
    x = torch.randn(3, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    ones = torch.cat([torch.ones(5), torch.zeros(5)]).double()
    right = x - chain.step(x) + x[:, :5].mean(-1, keepdim=True) * ones
    torch.testing.assert_close(renewal._constant_light(chain, 4 * pi).solve(right), x, rtol=1e-8, atol=1e-8)
