"""Phasors of transients, and losses of them: delays, Parseval, the branch cut, dark pixels."""

import math

import pytest
import torch

from torchtransient import FrequencyAxis, TimeAxis, losses
from torchtransient.errors import ArgumentError, ShapeError, UnitError

AXIS = TimeAxis(3.0, 0.05, 64)
BAND = FrequencyAxis((0.0, 0.3, 1.7, 4.0), start_opl=0.5)


def pulse(*bins, height=1.0):
    """(1, T, 1, P): one pixel for each bin."""
    record = torch.zeros(1, 64, 1, len(bins), dtype=torch.float64)
    for pixel, k in enumerate(bins):
        record[0, k, 0, pixel] = height
    return record


def test_phasors_are_the_sum_of_oscillations():
    record = torch.rand(2, 1, 64, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = losses.transient_phasors(record, AXIS, BAND)
    assert found.shape == (2, 1, 4, 2, 3)
    angle = -2 * math.pi * BAND.per_metre[:, None] * (AXIS.centers_opl - 0.5)
    torch.testing.assert_close(found, torch.einsum("ft,...tyx->...fyx", torch.polar(torch.ones_like(angle), angle),
                                                   record.to(torch.complex128)))  # fmt: skip
    torch.testing.assert_close(found[:, :, 0].real, record.sum(2))


def test_phases_keep_their_digits_far_away():
    """At 1 km a float32 length is 6e-5 m off, which is 0.4 rad at 1 cm."""
    far, band = TimeAxis(1000.0, 0.002, 64), FrequencyAxis((100.0, 97.3))
    wanted = losses.transient_phasors(pulse(5, 40), far, band)
    found = losses.transient_phasors(pulse(5, 40).float(), far, band)
    torch.testing.assert_close(found.to(torch.complex128), wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("phase_only", [False, True])
@pytest.mark.parametrize("bins", [0, 1, 7, 30])
def test_a_delay_is_two_minus_two_cosines(bins, phase_only):
    """`2 - 2 cos(2 pi nu d)` for light of one. The default floor, 1e-3 of the modulus, takes 1e-6 off a phase."""
    found = losses.transient_phasor_loss(
        pulse(10), pulse(10 + bins), axis=AXIS, frequencies=BAND, phase_only=phase_only, reduction="none"
    )
    wanted = 2 - 2 * torch.cos(2 * math.pi * BAND.per_metre * 0.05 * bins)
    torch.testing.assert_close(found.flatten(), wanted, rtol=1.1e-6 if phase_only else 1e-12, atol=1e-12)


def test_brightness_has_no_part_in_phases():
    first, second = pulse(3, 20), pulse(9, 22)
    loss = losses.TransientPhasorLoss(AXIS, BAND, phase_only=True)
    for factor in (1e-18, 1e-3, 1e18):
        torch.testing.assert_close(loss(factor * first, second), loss(first, second))
    assert float(losses.transient_phasor_loss(2 * first, first, axis=AXIS, frequencies=BAND)) == pytest.approx(1.0)
    assert float(loss(2 * first, first)) == pytest.approx(0.0, abs=1e-20)


def test_parseval():
    a, b = (torch.rand(1, 64, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    whole = FrequencyAxis.uniform(-0.5 / 0.05, 1 / (64 * 0.05), 64)
    found = losses.transient_phasor_loss(a, b, axis=AXIS, frequencies=whole)
    torch.testing.assert_close(found, 64 * losses.squared_loss(a, b))


def test_no_branch_cut():
    """From -179.9 to 179.9 degrees is 0.2 degrees; the gradient goes the short way round."""
    angle = torch.tensor(math.radians(-179.9), dtype=torch.float64, requires_grad=True)
    phasor = torch.polar(torch.ones_like(angle), angle)
    target = torch.polar(*torch.tensor([1.0, math.radians(179.9)], dtype=torch.float64))
    value = losses.phasor_loss(phasor, target, phase_only=True)
    assert value.item() == pytest.approx(2 - 2 * math.cos(math.radians(0.2)), rel=1e-5)
    value.backward()
    assert float(angle.grad) == pytest.approx(2 * math.sin(math.radians(0.2)), rel=1e-5)


def test_dark_pixels():
    """Both dark: alike. One dark: half way between alike and opposite. A dark item takes the scale of the other."""
    light, dark = torch.ones(2, 4, 4, 4, dtype=torch.complex128), torch.zeros(2, 4, 4, 4, dtype=torch.complex128)
    assert float(losses.phasor_loss(dark, dark, phase_only=True)) == 0
    assert float(losses.phasor_loss(dark, light, phase_only=True)) == pytest.approx(1, rel=1e-5)
    x = dark.clone().requires_grad_()
    losses.phasor_loss(x, 50 * light, phase_only=True, reduction="sum").backward()
    torch.testing.assert_close(x.grad, torch.full_like(x, -2 / (1e-3 * 50)), rtol=1e-5, atol=0)


def test_a_window_of_time_by_a_mask():
    """Bins that do not count are empty: the loss is that of the window as an axis of its own."""
    a, b = (torch.rand(1, 64, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    mask = torch.zeros(64, 1, 1, dtype=torch.bool)
    mask[10:30] = True
    window = TimeAxis(3.0 + 0.5, 0.05, 20)
    found = losses.transient_phasor_loss(a, b, axis=AXIS, frequencies=BAND, mask=mask)
    torch.testing.assert_close(
        found, losses.transient_phasor_loss(a[:, 10:30], b[:, 10:30], axis=window, frequencies=BAND)
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_frequencies_above_half_of_one_over_the_bin(sign):
    """10 per metre for bins of 5 cm: above, records of whole bins have the phasors of lower frequencies."""
    record = pulse(3, 20)
    for call in (
        lambda band: losses.transient_phasors(record, AXIS, band),
        lambda band: losses.transient_phasor_loss(record, record, axis=AXIS, frequencies=band),
    ):
        with pytest.raises(UnitError, match="two bins at least, frequencies of 10 per metre"):
            call(FrequencyAxis((1.0, sign * 10.001)))
        call(FrequencyAxis((sign * 10.0,)))
    # of a discrete transform, however it is computed
    for bins, width in ((64, 0.05), (30, 0.1), (7, 0.3), (1000, 0.0299792458 / 3)):
        axis, whole = TimeAxis(0.0, width, bins), FrequencyAxis(torch.fft.rfftfreq(bins, width, dtype=torch.float64))
        record = torch.rand(1, bins, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        found = losses.transient_phasors(record, axis, whole, dim=1)
        middle = torch.polar(torch.ones(len(whole.frequencies)).double(), -math.pi * width * whole.per_metre)
        torch.testing.assert_close(found.flatten(), torch.fft.rfft(record.flatten()) * middle)
    # at two bins even the sign of a delay is lost, one below it is not
    for nu, alike in ((10.0, True), (9.0, False)):
        up, down = (losses.transient_phasors(pulse(10 + k), AXIS, FrequencyAxis((nu,), 3.525)) for k in (1, -1))
        assert torch.allclose(up, down, atol=1e-9) == alike


def test_errors():
    with pytest.raises(ShapeError, match="64 bins"):
        losses.transient_phasors(torch.zeros(1, 60, 2, 2), AXIS, BAND)
    with pytest.raises(ArgumentError, match="and a FrequencyAxis"):
        losses.transient_phasors(torch.zeros(1, 64, 2, 2), AXIS)
    with pytest.raises(UnitError, match="complex phasors"):
        losses.phasor_loss(torch.zeros(3), torch.zeros(3))
