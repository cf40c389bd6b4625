"""Light through foam slabs against counts that were measured, and against diffusion theory."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
VARIANT = "llvm_ad_mono"


@pytest.fixture(scope="module")
def foam():
    spec = importlib.util.spec_from_file_location("foam_slabs", FOLDER / "foam_slabs.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("inches", "paths"),
    [
        pytest.param(2, 200_000, marks=pytest.mark.slow),
        pytest.param(8, 800_000, marks=pytest.mark.soak),
    ],
)
def test_transmittance_is_the_measured_one(foam, inches, paths):
    # Published coefficients, only time and height are fitted. Noise and misfit add up in squares; the standard error is
    # known from eight batches, to about a quarter of itself.
    result = foam.run(inches, paths, max_depth=30_000)
    traced, noise, theory = result["traced"], result["noise"], result["diffusion"]
    assert theory.rms < 0.01
    assert traced.rms < np.hypot(0.01, 1.5 * noise.rms)
    # What is left where the curve is bright, theory leaves too.
    assert traced.rms_bright < np.hypot(theory.rms_bright, 1.5 * noise.rms_bright) + 0.002
    assert noise.rms < 0.03


def test_noise_is_the_standard_error_of_the_mean(foam):
    # Batches of normal noise around a triangle of height 50: rms over the peak is sigma / sqrt(batches) / 50.
    rng = np.random.default_rng(0)
    shape = np.concatenate([np.arange(50.0), 50 - np.arange(50.0), np.zeros(100)])
    batches = [shape + rng.normal(0, 2.0, shape.size) for _ in range(64)]
    noise = foam.noise_of(batches, 0.0, shape.size)
    assert noise.rms == pytest.approx(2.0 / 8 / 50, rel=0.05)
    assert noise.rms_bright == pytest.approx(2.0 / 8 / 50, rel=0.05)
