"""Colours from the coefficients of smooth spectra: the inverse of Mitsuba's table."""

import mitsuba as mi
import numpy as np
import pytest

from torchtransient.errors import SceneError
from torchtransient.plugins.spectral_colours import TOLERANCE, as_colours, colours_of, same_spectra


@pytest.fixture(autouse=True)
def spectral():
    mi.set_variant("llvm_ad_spectral")


def fetched(colours):
    rows = [np.array(mi.srgb_model_fetch(mi.ScalarColor3f(*rgb))).ravel() for rgb in colours.tolist()]
    return np.array(rows, dtype=np.float64)


def test_colours_come_back():
    colours = np.random.default_rng(0).uniform(0.0, 1.0, (60, 3))
    colours[:3] = [[0.3, 0.3, 0.3], [0.570068, 0.0430135, 0.0443706], [0.9, 0.9, 0.05]]
    coefficients = fetched(colours)
    found, error = colours_of(coefficients.reshape(6, 10, 3))
    assert error < TOLERANCE and np.abs(found.reshape(-1, 3) - colours).max() < 1e-4
    assert same_spectra(fetched(found.reshape(-1, 3)), coefficients)


def test_coefficients_of_no_colour():
    with pytest.raises(SceneError, match=r"wall.*those of no colour"):
        as_colours(np.array([0.001, -0.5, 20.0]), "wall")
    assert not same_spectra(np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.01]))
