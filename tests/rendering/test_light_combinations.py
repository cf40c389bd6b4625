"""Response curves and delays with shifted wavelengths in polarized renders."""

from __future__ import annotations

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from tools.small_room import make_room


def regular(low, high, values):
    return {"type": "regular", "wavelength_min": low, "wavelength_max": high, "values": values}


@pytest.mark.slow
def test_intensity_of_polarized_renders():
    room = make_room()
    room["sensor"]["film"] |= {"red": regular(550, 750, "0, 1, 0.2, 0"), "blue": regular(400, 500, "0, 1, 0")}
    room["wall"]["bsdf"] = {
        "type": "delayed", "lifetime": 0.5, "elastic_fraction": 0.5, "nested": {"type": "diffuse", "reflectance": 0.5},
        "excitation": regular(400, 500, "0.2, 0.8, 0.2"), "emission": regular(500, 700, "0, 1, 0"),
    }  # fmt: skip
    found = []
    for variant in ("llvm_ad_spectral", "llvm_ad_spectral_polarized"):
        mi.set_variant(variant)  # or every render switches there and back
        scene = tt.load(room, variant=variant)
        found.append(tt.render(scene, seed=2, spp=64, time_axis=tt.TimeAxis(6.0, 0.05, 200)))
    plain, polarized = found
    assert polarized.channels == plain.channels and polarized.transient.shape == (4, *plain.transient.shape)
    torch.testing.assert_close(polarized.transient[0], plain.transient, rtol=1e-3, atol=1e-5)
    # diffuse surfaces depolarize
    assert polarized.transient[1:].abs().max() == 0
