"""Properties that renders have for all values of a parameter, drawn by hypothesis: the same draws in every run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import torchtransient as tt

# Variant, sampler and number of examples.
RUNS = [
    ("llvm_ad_mono", "owen", 12),
    pytest.param("llvm_ad_mono", "owen", 200, marks=pytest.mark.slow),
    pytest.param("llvm_ad_mono", "independent", 60, marks=pytest.mark.slow),
    pytest.param("llvm_ad_rgb", "owen", 60, marks=pytest.mark.slow),
]
for_all_runs = pytest.mark.parametrize(("variant", "sampler", "examples"), RUNS)


def magnitudes(low: float, high: float, *also: float) -> st.SearchStrategy[float]:
    """Draw numbers of all magnitudes between ``low`` and ``high``, and these two and ``also`` often."""
    exponents = st.floats(math.log10(low), math.log10(high))
    between = exponents.map(lambda exponent: min(max(10.0**exponent, low), high))
    return st.one_of(st.sampled_from([low, high, *also]), between, between)


def numbers(low: float, high: float, *also: float) -> st.SearchStrategy[float]:
    """Draw single precision numbers between ``low`` and ``high``, and these two and ``also`` often."""
    low, high = float(np.float32(low)), float(np.float32(high))
    also = tuple(float(np.float32(number)) for number in also)
    between = st.floats(low, high, width=32)
    return st.one_of(st.sampled_from([low, high, *also]), between, between)


def holds(property_: Callable[..., None], examples: int, **strategies: st.SearchStrategy[Any]) -> None:
    """Call ``property_`` with ``examples`` draws; what fails is shrunk and said."""
    settings(
        max_examples=examples, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
    )(given(**strategies)(property_))()


def one_pixel() -> dict[str, Any]:
    """Film of one pixel."""
    return {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}


def leaves(renderer: tt.TransientRenderer, values: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return ``values`` in the shapes of their keys, to differentiate by."""
    table = renderer.scene.parameters()
    return {
        key: torch.as_tensor(value, dtype=torch.float32).expand(table[key].shape).clone().requires_grad_()
        for key, value in values.items()
    }


def histogram(out: tt.RenderOutput) -> torch.Tensor:
    """Return light over time of a film of one pixel, mean over channels, (T,), float64; finite, and in its sum the steady image."""
    assert torch.isfinite(out.transient).all() and torch.isfinite(out.steady).all()
    return out.transient.double().mean((0, 2, 3))


def gradients(light: torch.Tensor, inputs: Mapping[str, torch.Tensor]) -> dict[str, np.ndarray]:
    """Return derivatives of a number by ``inputs``, by reverse mode; they are finite."""
    found = torch.autograd.grad(light, list(inputs.values()), retain_graph=True)
    assert all(torch.isfinite(gradient).all() for gradient in found), dict(zip(inputs, found, strict=True))
    return {key: gradient.double().numpy() for key, gradient in zip(inputs, found, strict=True)}
