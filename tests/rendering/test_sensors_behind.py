"""Sensors behind the renderer: histograms, phasor images and Stokes vectors, with gradients back to the scene."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt
from torchtransient import sensing

VARIANT = "llvm_ad_rgb"
KEY = "red.reflectance.value"


@pytest.fixture(scope="module")
def renderer():
    box = tt.scenes.cornell_box(8, start_opl=3.5, bin_width_opl=0.1, num_bins=60, max_depth=3)
    return tt.TransientRenderer(tt.load(box, variant=VARIANT), parameters=[KEY], spp=32)


def test_gradient_of_a_noisy_depth_camera_reaches_the_scene(renderer):
    camera = sensing.Compose(
        [
            sensing.ItofCorrelation(sensing.sine_code(4), 30e6, renderer.axis, electrons_per_unit=1e4),
            sensing.PixelElectronics(read_noise_e=10.0, full_well_e=1e6),
        ],
        grad="gaussian",
    )
    out = renderer(seed=0)
    taps = camera(out, generator=torch.Generator().manual_seed(0))
    assert taps.shape == (3, 4, 8, 8)
    mean = camera.expected(out)
    assert float((taps - mean).detach().abs().max()) < 6 * float(mean.detach().max() + 100) ** 0.5
    (gradient,) = torch.autograd.grad(taps.sum(), renderer.values[KEY])
    # All light goes to some tap: the sum is that of the transient, whose red part grows with the red albedo.
    (wanted,) = torch.autograd.grad(1e4 * renderer(seed=0).transient.sum(), renderer.values[KEY])
    assert float(gradient[0]) > 0
    torch.testing.assert_close(gradient, wanted, rtol=0.1, atol=0.02 * float(wanted.abs().max()))


def test_stokes_vectors_behind_a_polarized_variant():
    box = tt.scenes.cornell_box(8, start_opl=3.5, bin_width_opl=0.5, num_bins=12, max_depth=3)
    with torch.no_grad():
        out = tt.render(tt.load(box, variant="llvm_ad_mono_polarized"), spp=32, seed=0)
        assert out.transient.shape == (4, 1, 12, 8, 8)
        mosaic = sensing.PolarizationMosaic.polarsens()
        raw = sensing.Compose([mosaic])(out)
        whole = out.transient.sum((0, 2))
    assert raw.shape == (1, 12, 8, 8)
    assert whole.shape == (1, 8, 8)
    # Half of unpolarized light passes every analyser.
    share = float(raw.sum() / out.transient[0].sum())
    assert abs(share - 0.5 * (1 + 1 / 300)) < 0.01
