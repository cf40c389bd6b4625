"""Lights that are hardly ever drawn (``sampling_weight``), which paths hit nevertheless.

Where one strategy alone takes the derivative of a light's samples, and draws it once in a thousand samples or never,
their light would be gone from the derivative, or come from a few of them. Such lights are left to the paths that hit
them.
"""

from __future__ import annotations

from typing import Any

# Share of what each light would have of the samples if all were drawn alike, below which one is hardly ever drawn: in a
# scene of a thousand lights each has a thousandth of them.
_LEAST_SHARE = 1e-3


def least_probability(count: int) -> float:
    """Probability of being chosen among ``count`` lights, below which a light is hardly ever drawn."""
    return _LEAST_SHARE / count


def is_rare(scene: Any, light: Any) -> bool:
    """Whether a light of a scene is hardly ever drawn."""
    weights = {emitter.ptr: float(emitter.sampling_weight()) for emitter in scene.emitters()}
    return weights[light.ptr] < least_probability(len(weights)) * sum(weights.values())
