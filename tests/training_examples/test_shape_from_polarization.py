"""The training example finds normals from polarization that histograms of the same light do not tell."""

from __future__ import annotations

import math
import runpy
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[2] / "training_examples" / "shape_from_polarization.py"


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(SCRIPT))


def test_normals_of_a_slope(example):
    x, _ = example["grid"]()
    normals = example["normals"](0.5 * x)
    expected = torch.tensor([-0.5, 0.0, 1.0]) / math.sqrt(1.25)
    torch.testing.assert_close(normals, expected.expand_as(normals), rtol=0, atol=1e-4)
    height, degrees = example["errors_of"](example["true_heights"]() + 1e-3)
    assert height == pytest.approx(1.0, rel=1e-4)
    assert degrees == pytest.approx(0.0, abs=0.05)


@pytest.mark.slow
def test_stokes_components_know_the_normals(example, tmp_path, capsys):
    import mitsuba as mi

    with mi.variant_context("llvm_ad_mono_polarized"):  # else each render goes to and fro between it and another test's
        errors = example["main"](["--smoke", "--output", str(tmp_path)])
    assert capsys.readouterr().out.count("shape_from_polarization, seed 0, ") == 3
    ((alone,), (stokes,), (mosaic,)) = (errors[name] for name in ("S0 alone", "Stokes", "mosaic"))
    # Albedos are free, so S0 has the times alone: a pulse of 15 cm for heights of half a millimetre. S1 and S2 have the
    # normals in a single pixel, with half the light.
    assert stokes[1] < 0.5 * alone[1]
    assert stokes[1] < 0.5 * example["errors_of"](torch.zeros_like(example["true_heights"]()))[1]
    # A quarter of the pixels for each direction, and the noise of a chip: still better than all of the light.
    assert mosaic[1] < 0.6 * alone[1]
    assert (tmp_path / "shape_from_polarization.png").read_bytes().startswith(b"\x89PNG")
