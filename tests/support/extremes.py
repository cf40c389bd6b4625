"""Properties of renders for all values of a parameter, drawn by hypothesis: the same draws in every run."""

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
from torchtransient.scenes import scale, translate

ROUNDING = 2e-6  # of a product of some ten factors in single precision
SAMPLES = 4096
NOISE = 5 / math.sqrt(SAMPLES)  # five standard errors of the mean of numbers with a variance of one

for_all_runs = pytest.mark.parametrize(
    ("variant", "sampler", "examples"),
    [
        ("llvm_ad_mono", "owen", 8),
        pytest.param("llvm_ad_rgb", "independent", 20, marks=pytest.mark.slow),
    ],
)


def holds(property_: Callable[..., None], examples: int, **strategies: st.SearchStrategy[Any]) -> None:
    """Call ``property_`` with ``examples`` draws of ``strategies``; the draws that fail are shrunk and reported."""
    settings(
        max_examples=examples, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
    )(given(**strategies)(property_))()


def magnitudes(low: float, high: float, *also: float) -> st.SearchStrategy[float]:
    """Draw numbers of all magnitudes between ``low`` and ``high``; one in three is an end or one of ``also``."""
    exponents = st.floats(math.log10(low), math.log10(high))
    between = exponents.map(lambda exponent: _single(min(max(10.0**exponent, low), high)))
    return st.one_of(st.sampled_from([_single(x) for x in (low, high, *also)]), between, between)


def numbers(low: float, high: float, *also: float) -> st.SearchStrategy[float]:
    """Draw numbers between ``low`` and ``high``; one in three is an end or one of ``also``."""
    between = st.floats(_single(low), _single(high), width=32)
    return st.one_of(st.sampled_from([_single(x) for x in (low, high, *also)]), between, between)


def _single(x: float) -> float:
    """Round to single precision, in which values of scenes are kept."""
    return float(np.float32(x))


# ----------------------------------------------------------------------------------------------------------- scenes

FACING_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def meter_at(z: float) -> dict[str, Any]:
    """Radiance meter on the z axis that looks down."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    return {"type": "radiancemeter", "origin": [0, 0, z], "direction": [0, 0, -1], "film": film}


def seen_from(z: float, max_depth: int, **objects: Any) -> dict[str, Any]:
    """Scene of ``objects`` with a meter at height ``z``."""
    kind = "transient_volpath" if "fog" in objects else "transient_path"
    return {"type": "scene", "integrator": {"type": kind, "max_depth": max_depth}, "meter": meter_at(z), **objects}


def square(z: float, size: float) -> np.ndarray:
    """Transform of a rectangle that faces up at height ``z``."""
    return translate([0, 0, z]) @ scale([size, size, 1])


def fog_between(low: float, high: float) -> dict[str, Any]:
    """Slab of fog 6 m wide."""
    medium = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5, "phase": {"type": "hg", "g": 0.1}}
    box = translate([0, 0, (low + high) / 2]) @ scale([3, 3, (high - low) / 2])
    return {"type": "cube", "to_world": box, "bsdf": {"type": "null"}, "interior": medium}


SKY = {  # radiance 1 from everywhere
    "type": "sphere", "radius": 10.0, "flip_normals": True, "bsdf": {"type": "diffuse", "reflectance": 0.0},
    "emitter": {"type": "area", "radiance": 1.0},
}  # fmt: skip


# ---------------------------------------------------------------------------------------------------------- renders


def leaves(renderer: tt.TransientRenderer, values: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return ``values`` in the shapes of their keys, to differentiate by."""
    table = renderer.scene.parameters()
    return {
        key: torch.as_tensor(value, dtype=torch.float32).expand(table[key].shape).clone().requires_grad_()
        for key, value in values.items()
    }


def light_over_time(out: tt.RenderOutput) -> torch.Tensor:
    """Return the histogram of a film of one pixel, mean over channels, (T,), float64.

    Checked: all is finite, and the histogram and the light outside of its window add up to the steady image.
    """
    assert out.transient is not None
    assert torch.isfinite(out.transient).all() and torch.isfinite(out.steady).all()
    light = out.transient.double().mean((0, 2, 3))
    outside = sum(out.stats.energy_before) + sum(out.stats.energy_after)
    steady = float(out.steady.detach().double().mean())
    assert abs(float(light.detach().sum()) + outside - steady) <= 1e-5 * abs(steady)
    return light


def gradients(light: torch.Tensor, values: Mapping[str, torch.Tensor]) -> list[np.ndarray]:
    """Return the derivatives of a number by ``values`` in reverse mode; they are finite."""
    found = torch.autograd.grad(light, list(values.values()))
    assert all(torch.isfinite(gradient).all() for gradient in found), found
    return [gradient.double().numpy() for gradient in found]


def tangent(renderer: tt.TransientRenderer, values: Mapping[str, torch.Tensor], key: str) -> float:
    """Return the derivative of all light by ``key`` in forward mode; it is finite."""
    fixed = {name: value.detach() for name, value in values.items()}

    def light(value: torch.Tensor) -> torch.Tensor:
        return renderer({**fixed, key: value}, seed=0).steady.double().mean()

    found = torch.func.jvp(light, (fixed[key],), (torch.ones_like(fixed[key]),))[1]
    assert torch.isfinite(found)
    return float(found)
