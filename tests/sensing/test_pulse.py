"""Pulses after a render: the convolution itself, and that it is what the film does while rendering."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import make_room
from torchtransient import plugins
from torchtransient.sensing import apply_pulse, axis_with_margin
from torchtransient.sensing.impulse_response import pulse_kernel

VARIANT = "llvm_ad_mono"
MEASURED = tt.Pulse.tabulated([-0.1, 0.0, 0.05, 0.4], [0, 2, 1, 0])
PULSES = {
    "gaussian": (tt.Pulse.gaussian(0.3),),
    "late box": (tt.Pulse.rectangular(0.2, center_opl=0.5),),
    "measured": (MEASURED,),
    "both": (MEASURED, tt.Pulse.gaussian(0.2)),
}
AXIS = tt.TimeAxis(1.0, 0.02, 150)


def impulse(bins=150, at=60, dtype=torch.float64):
    x = torch.zeros(2, bins, 1, 3, dtype=dtype)
    x[:, at] = 1
    return x


@pytest.mark.parametrize("name", PULSES)
def test_kernel(name):
    pulses = PULSES[name]
    first, kernel = pulse_kernel(0.02, *pulses)
    assert kernel.min() >= 0 and float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    centers = (first + torch.arange(kernel.numel())) * 0.02
    mean = sum(_moment(p, 1) for p in pulses)
    assert float((kernel * centers).sum()) == pytest.approx(mean, abs=1e-4)
    # variances add: those of the pulses, and of two positions within a bin
    variance = float((kernel * (centers - mean) ** 2).sum())
    expected = sum(_moment(p, 2) - _moment(p, 1) ** 2 for p in pulses)
    assert variance - expected == pytest.approx(2 * 0.02**2 / 12, rel=0.2)


def _moment(pulse, power):
    x = np.linspace(*pulse.support_opl, 20001)
    return float((np.diff(pulse.cumulative(x)) * (0.5 * (x[1:] + x[:-1])) ** power).sum())


def test_short_and_long_kernels_agree():
    x = torch.rand(3, 400, 2, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    axis = tt.TimeAxis(0.0, 0.02, 400)
    pulse = tt.Pulse.gaussian(3.0)
    first, kernel = pulse_kernel(0.02, pulse)
    assert kernel.numel() > 192
    direct = np.array([np.convolve(row, kernel.numpy()) for row in x.movedim(1, -1).reshape(-1, 400).numpy()])
    direct = direct[:, -first : -first + 400].reshape(3, 2, 1, 400)
    np.testing.assert_allclose(apply_pulse(x, axis, pulse).movedim(1, -1).numpy(), direct, atol=1e-12)


def test_a_pulse_that_leaves_the_axis():
    late, early = tt.Pulse.rectangular(0.1, center_opl=9.0), tt.Pulse.rectangular(0.1, center_opl=-9.0)
    for pulse in (late, early):
        result = apply_pulse(impulse(), AXIS, pulse)
        assert result.shape == impulse().shape and float(result.abs().max()) == 0


def test_keep_is_part_of_a_larger_axis():
    pulses = PULSES["both"]
    wide = axis_with_margin(AXIS, *pulses)
    assert wide.start_opl < AXIS.start_opl and wide.end_opl > AXIS.end_opl
    x = torch.rand(1, wide.num_bins, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    kept = apply_pulse(x, wide, *pulses, keep=AXIS)
    # every bin of the axis has all its light: a wider render changes nothing
    more = tt.TimeAxis(wide.start_opl - 1.0, 0.02, wide.num_bins + 100)
    longer = torch.nn.functional.pad(x, (0, 0, 0, 0, 50, 50), value=3.0)
    torch.testing.assert_close(apply_pulse(longer, more, *pulses, keep=AXIS), kept)


def test_gradients():
    x = torch.rand(1, 9, 1, 1, dtype=torch.float64, requires_grad=True)
    axis = tt.TimeAxis(0.0, 0.1, 9)
    assert torch.autograd.gradcheck(lambda v: apply_pulse(v, axis, MEASURED), (x,), fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda v: apply_pulse(v, axis, MEASURED), (x,), fast_mode=True)


@pytest.fixture(scope="module")
def room():
    mi.set_variant(VARIANT)
    plugins.sync()
    return tt.load(make_room(), variant=VARIANT)


def test_render_time_and_torch_agree(room):
    """Same seed, same paths: what differs is where in its bin an arrival is."""
    pulses = PULSES["both"]
    axis = tt.TimeAxis(5.0, 0.02, 400)
    plain = tt.TransientRenderer(room, time_axis=axis, spp=64)(seed=3)
    spread = dict(zip(("pulse", "irf"), pulses, strict=False))
    rendered = tt.TransientRenderer(room, time_axis=axis, spp=64, **spread)(seed=3)
    assert rendered.steady.equal(plain.steady) and plain.transient.sum() > 0
    applied = apply_pulse(plain.transient, axis, *pulses)
    error = (applied - rendered.transient).norm() / rendered.transient.norm()
    shift = (apply_pulse(plain.transient, axis, *(p.shifted(0.02) for p in pulses[:1]), *pulses[1:]) - applied).norm()
    # far below an error of one bin in the pulse's position
    assert error < 0.1 * shift / applied.norm()
    coarse_axis = tt.TimeAxis(5.0, 0.04, 200)
    coarse = tt.TransientRenderer(room, time_axis=coarse_axis, spp=64)(seed=3).transient
    coarse_rendered = tt.TransientRenderer(room, time_axis=coarse_axis, spp=64, **spread)(seed=3).transient
    coarse_error = (apply_pulse(coarse, coarse_axis, *pulses) - coarse_rendered).norm() / coarse_rendered.norm()
    # of second order in the bin's width
    assert coarse_error > 2.0 * error
