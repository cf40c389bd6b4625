"""Response curves, gates and delays together with the other effects."""

from __future__ import annotations

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from tools.small_room import make_room

BANDS = {
    "red": {"type": "regular", "wavelength_min": 550, "wavelength_max": 750, "values": "0, 1, 0.2, 0"},
    "blue": {"type": "regular", "wavelength_min": 400, "wavelength_max": 500, "values": "0, 1, 0"},
}
LATE = {"type": "delayed", "lifetime": 0.5, "elastic_fraction": 0.5, "nested": {"type": "diffuse", "reflectance": 0.5}}
SHIFT = {
    "excitation": {"type": "regular", "wavelength_min": 400, "wavelength_max": 500, "values": "0.2, 0.8, 0.2"},
    "emission": {"type": "regular", "wavelength_min": 500, "wavelength_max": 700, "values": "0, 1, 0"},
}
AXIS = tt.TimeAxis(6.0, 0.05, 200)


def room(bands=False, late=None):
    node = make_room()
    if bands:
        node["sensor"]["film"] |= BANDS
    if late is not None:
        node["wall"]["bsdf"] = late
    return node


def render(node, variant, **settings):
    mi.set_variant(variant)  # or every render switches there and back
    return tt.render(tt.load(node, variant=variant), seed=2, spp=64, **settings)


@pytest.mark.slow
def test_intensity_of_polarized_renders():
    node = room(bands=True, late={**LATE, **SHIFT})
    plain = render(node, "llvm_ad_spectral", time_axis=AXIS)
    polarized = render(node, "llvm_ad_spectral_polarized", time_axis=AXIS)
    assert polarized.channels == plain.channels and polarized.transient.shape == (4, *plain.transient.shape)
    torch.testing.assert_close(polarized.transient[0], plain.transient, rtol=1e-3, atol=1e-5)
    # diffuse surfaces depolarize
    assert polarized.transient[1:].abs().max() == 0


@pytest.mark.slow
def test_gates_and_steady():
    variant = "llvm_ad_mono_polarized"
    gates = (tt.Gate.gaussian(8.0, 0.3), tt.Gate.tabulated([8, 8.5, 12], [0, 1, 0]))
    fine = render(room(late=LATE), variant, time_axis=tt.TimeAxis(6.0, 0.005, 2000))
    gated = render(room(late=LATE), variant, gates=gates)
    weights = torch.stack([torch.from_numpy(g.value(fine.axis.centers_opl.numpy())) for g in gates]).float()
    expected = torch.einsum("...thw,gt->...ghw", fine.transient, weights)
    torch.testing.assert_close(gated.gated, expected, rtol=0, atol=5e-3 * float(expected.max()))
    torch.testing.assert_close(gated.steady, gated.gated.sum(-3))
