"""Chains from their parts: the order of the effects, whatever the order of the arguments."""

from __future__ import annotations

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError

PS, NS = 1e-12, 1e-9
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 64)
WIDTHS = sensing.random_code_widths(64, 0.05, torch.Generator().manual_seed(0))


def budget(**changes):
    numbers = {"pulse_energy_j": 1e-9, "wavelength_m": 532e-9, "repetition_rate_hz": 10e6, "cycles": 500}
    return sensing.PhotonBudget(sensing.Optics(f_number=2.0), **{**numbers, **changes}, axis=AXIS)


def parts():
    return {
        "converter": sensing.TDC(WIDTHS),
        "crosstalk": sensing.Crosstalk(0.01),
        "afterpulsing": sensing.Afterpulsing(0.02, 20 * NS, 10 * NS, axis=AXIS, period_s=100 * NS),
        "skew": sensing.DetectionSkew(30 * PS, AXIS),
        "jitter": sensing.emg_response(120 * PS, 90 * PS),
        "pulse": sensing.GaussianResponse(200 * PS),
        "optics": [sensing.LensBlur(0.8)],
        "readout": [sensing.CodedHistogram(sensing.fourier_codes(64, 8))],
    }


def test_parts_stand_in_the_order_of_light():
    chain = sensing.counting_chain(budget(), sensing.SynchronousSPAD(500), **parts(), grad="straight_through")
    assert [type(s).__name__ for s in chain.stages] == [
        "LensBlur", "ImpulseResponse", "PhotonBudget", "SynchronousSPAD", "DetectionJitter", "DetectionSkew",
        "Afterpulsing", "Crosstalk", "TDC", "CodedHistogram",
    ]  # fmt: skip
    light = torch.rand(1, 64, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 1e-5
    by_hand = light
    for stage in chain.stages:
        by_hand = stage.expected(by_hand)
    assert torch.equal(chain.expected(light), by_hand)
    assert chain(light, generator=torch.Generator().manual_seed(0)).shape == (1, 8, 4, 5)
    assert chain.stages[3].grad == "straight_through"


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"pulse": sensing.ShotNoise()}, "radiance for stage"),
        ({"detector": sensing.ShotNoise()}, "counts of rates"),
        ({"detector": sensing.ImpulseResponse(sensing.GaussianResponse(1e-9), AXIS)}, "counts of rates"),
        ({"detector": sensing.SynchronousSPAD(99)}, "one number of cycles"),
        ({"afterpulsing": sensing.Afterpulsing(0.1, 1e-9, 1e-9, axis=AXIS)}, "one laser period"),
    ],
)
def test_parts_that_do_not_fit(changes, words):
    given = {"budget": budget(), "detector": sensing.SynchronousSPAD(500), **changes}
    with pytest.raises(UnitError, match=f"expected .*{words}"):
        sensing.counting_chain(**given)


def test_afterpulses_once():
    after = sensing.Afterpulsing(0.02, 20 * NS, 10 * NS, axis=AXIS, period_s=100 * NS)
    spad = sensing.SynchronousSPAD(500, dead_time_s=10 * NS, axis=AXIS)
    both = sensing.AfterpulsingSPAD(spad, after)
    assert len(sensing.counting_chain(budget(), both).stages) == 2
    with pytest.raises(UnitError, match="afterpulses of its own"):
        sensing.counting_chain(budget(), both, afterpulsing=after)


def test_the_likelihood_of_moved_detections_has_a_derivative_by_counts():
    """Of a measurement that is learnt, say: counts without a detection are counts, too."""
    axis = TimeAxis.from_seconds(0.0, 100 * PS, 8)
    jitter = sensing.DetectionJitter(sensing.GaussianResponse(80 * PS), axis)
    chain = sensing.Compose([sensing.SynchronousSPAD(500), jitter])
    g = torch.Generator().manual_seed(0)
    rate = 0.1 * torch.rand(1, 8, 1, 1, dtype=torch.float64, generator=g)
    counts = torch.tensor([0.0, 3.0, 9.0, 0.0, 7.0, 1.0, 0.0, 2.0]).double().reshape(1, 8, 1, 1).requires_grad_()
    step = 1e-3 * torch.rand(counts.shape, dtype=torch.float64, generator=g)
    (slope,) = torch.autograd.grad(chain.log_prob(counts, rate).sum(), counts)
    with torch.no_grad():
        here, near, far = (float(chain.log_prob(counts + k * step, rate).sum()) for k in (0, 1, 2))
    assert float((slope * step).sum()) == pytest.approx((4 * near - far - 3 * here) / 2, rel=1e-4)
