"""Phasors as torch tensors: shapes, derivatives of complex outputs, how a scene gets its frequencies."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room

AXIS = tt.FrequencyAxis.uniform(0.0, 0.15, 5)
LIST = (0.3, 1.7, -0.4)


def phasor_room(**film):
    room = make_room()
    size = {key: room["sensor"]["film"][key] for key in ("width", "height", "rfilter")}
    room["sensor"]["film"] = {"type": "phasor_hdr_film", **size, **(film or {"frequencies": "0.3, 1.7, -0.4"})}
    return room


@pytest.fixture(scope="module")
def scene():
    return tt.load(phasor_room(), variant=VARIANT)


@pytest.fixture(scope="module")
def histogram_scene():
    return tt.load(make_room(), variant=VARIANT)


@pytest.fixture(scope="module")
def weights():
    """A fixed complex functional of the phasors (3, 3, 3, 4)."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(3, 3, 3, 4, dtype=torch.complex64, generator=generator)


def test_shapes_and_types(scene):
    out = tt.render(scene, seed=0)
    assert out.phasor.shape == (3, 3, 3, 4) and out.phasor.dtype == torch.complex64
    assert out.steady.shape == (3, 3, 4) and out.steady.dtype == torch.float32
    assert out.transient is None and out.axis is None
    assert out.frequencies == tt.FrequencyAxis(LIST)
    torch.testing.assert_close(out.frequencies.per_metre, torch.tensor(LIST, dtype=torch.float64))
    assert out.stats.temporal_filter == "" and out.stats.energy_after == (0.0,)


def test_frequency_zero_is_the_steady_image(histogram_scene):
    out = tt.render(histogram_scene, seed=0, frequencies=AXIS)
    torch.testing.assert_close(out.phasor[:, 0].real, out.steady)
    assert torch.equal(out.steady, tt.render(histogram_scene, seed=0).steady)


@pytest.mark.parametrize("given", [tt.FrequencyAxis(LIST), LIST, torch.tensor(LIST, dtype=torch.float64)])
def test_frequencies_replace_the_film(scene, histogram_scene, given):
    expected = tt.render(scene, seed=3)
    found = tt.render(histogram_scene, seed=3, frequencies=given)
    torch.testing.assert_close(found.phasor, expected.phasor)
    assert found.frequencies == expected.frequencies
    steady = make_room()
    film = steady["sensor"]["film"]
    steady["sensor"]["film"] = {"type": "hdrfilm", **{k: film[k] for k in ("width", "height", "rfilter")}}
    steady["integrator"]["type"] = "path"
    torch.testing.assert_close(tt.render(tt.load(steady, VARIANT), seed=3, frequencies=given).phasor, expected.phasor)


def test_frequencies_and_time_axes_replace_each_other(histogram_scene):
    given = {"wl_mean": 2.0, "wl_sigma": 4.0, "temporal_bins": 200, "bin_width_opl": 0.1}
    scene = tt.load(phasor_room(**given), variant=VARIANT)
    assert tt.render(scene, seed=0).frequencies.num_frequencies == 7
    assert tt.render(scene, seed=0, frequencies=[0.25]).frequencies == tt.FrequencyAxis((0.25,))
    axis = tt.TimeAxis(6.0, 0.25, 24)
    back = tt.render(scene, seed=0, time_axis=axis)
    assert back.phasor is None and back.frequencies is None and back.axis == axis
    torch.testing.assert_close(back.transient, tt.render(histogram_scene, seed=0).transient)


def test_the_origin_of_the_phase(histogram_scene):
    late = tt.FrequencyAxis(LIST, start_opl=1.25)
    a = tt.render(histogram_scene, seed=0, frequencies=LIST)
    b = tt.render(histogram_scene, seed=0, frequencies=late)
    assert b.frequencies == late
    turned = a.phasor * torch.exp(2j * torch.pi * late.per_metre * 1.25)[:, None, None]
    torch.testing.assert_close(b.phasor, turned.to(torch.complex64), rtol=1e-5, atol=1e-6)


# ----------------------------------------------------------------------------------------------- derivatives


def renderer_of(scene, *keys):
    return tt.TransientRenderer(scene, parameters=list(keys), spp=16, grad_seed="same")


def linear(out, weights):
    """A real functional with another weight for every real and imaginary part, and for the steady image."""
    return (out.phasor * weights.conj()).sum().real + 0.3 * out.steady.sum()


def test_reverse_mode_against_finite_differences(scene, weights):
    """One bounce is linear in the colour: with common random numbers a difference quotient is exact."""
    renderer = tt.TransientRenderer(scene, parameters=[COLOUR], spp=16, grad_seed="same", max_depth=2)
    value = torch.tensor([0.5, 0.4, 0.3])
    x = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(linear(renderer({COLOUR: x}, seed=1), weights), x)
    for c in range(3):
        step = torch.zeros(3)
        step[c] = 0.1
        above, below = (linear(renderer({COLOUR: value + s * step}, seed=1), weights) for s in (1, -1))
        assert float((above - below) / 0.2) == pytest.approx(float(gradient[c]), rel=2e-3, abs=1e-4)


def test_losses_of_complex_numbers(scene):
    """Torch's own rules meet ours at the complex output: reverse mode equals forward mode."""
    renderer = renderer_of(scene, COLOUR)
    value = renderer.values[COLOUR].detach()
    tangent = torch.tensor([1.0, -0.5, 0.3])

    def function(x):
        out = renderer({COLOUR: x}, seed=4)
        return torch.sin(out.phasor[:, 0].angle()).sum() + out.phasor.imag.square().sum() + 0.3 * out.steady.sum()

    x = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(x), x)
    _, forward = torch.func.jvp(function, (value,), (tangent,))
    assert float(forward) != 0
    assert float((gradient * tangent).sum()) == pytest.approx(float(forward), rel=1e-3)


def test_geometry_needs_no_temporal_filter(scene):
    renderer = renderer_of(scene, WALL_POSE)
    assert renderer.effective_filter == "" and renderer.has_slope_for([WALL_POSE])
