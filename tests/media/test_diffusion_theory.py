"""The diffusion formulas against what is known of them otherwise."""

import numpy as np
import pytest
from scipy.integrate import quad

from tools.diffusion import extrapolation_length, slab_transmittance

FOAM = {"reduced_scattering": 262.0, "absorption": 0.53, "index": 1.12}


def test_extrapolation_length_of_the_published_foam():
    # Published with the measurements: 3.6 mm.
    assert extrapolation_length(262.0, 1.12) == pytest.approx(3.65e-3, abs=0.01e-3)


@pytest.mark.parametrize("thickness, late", [(0.0508, [4.0, 5.0]), (0.1016, [14.0, 15.0])])
def test_late_decay_is_that_of_the_lowest_mode(thickness, late):
    before, after = slab_transmittance(np.array(late), thickness, **FOAM)
    diffusion = 1 / (3 * (262.0 + 0.53))
    width = thickness + 2 * extrapolation_length(262.0, 1.12)
    rate = (0.53 + np.pi**2 * diffusion / width**2) / 1.12
    # The next mode of the transmitted flux decays four times faster and is down to exp(-3 rate opl) < 1e-12.
    assert np.log(before / after) == pytest.approx(rate, rel=1e-5)


def test_total_over_time_is_the_steady_solution():
    # sinh solution of D phi'' = mu_a phi with phi = 0 at the extrapolated boundaries, a source at z0, and the flux
    # -D phi' through the far face.
    d, scattering, absorption = 0.0508, 262.0, 0.53
    total = quad(lambda x: float(slab_transmittance(x, d, scattering, absorption, 1.12)), 0, 12, limit=400)[0]
    diffusion = 1 / (3 * (scattering + absorption))
    k = np.sqrt(absorption / diffusion)
    ze, z0 = extrapolation_length(scattering, 1.12), 1 / scattering
    expected = np.sinh(k * (z0 + ze)) / np.sinh(k * (d + 2 * ze)) * np.cosh(k * ze)
    assert total == pytest.approx(expected, rel=1e-4)


def test_lateral_share_integrates_to_one():
    opl = np.array([1.0])
    whole = slab_transmittance(opl, 0.0508, **FOAM)[0]
    ring = quad(lambda r: 2 * np.pi * r * slab_transmittance(opl, 0.0508, **FOAM, rho=r)[0], 0, 1)[0]
    assert ring == pytest.approx(whole, rel=1e-8)
