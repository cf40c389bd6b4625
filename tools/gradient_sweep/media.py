"""The media, volumes and phase functions of the sweep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tools.gradient_sweep.bsdfs import rgb
from tools.gradient_sweep.stages import Description, move, stretch

# Where the slab of fog is: the view is narrower.
_LOW, _SIZE = (-2.0, -2.0, 0.5), (4.0, 4.0, 1.5)


def grid(low: float, high: float, channels: int = 1, seed: int = 7) -> Description:
    """A volume of random numbers over the slab."""
    data = np.random.default_rng(seed).uniform(low, high, (4, 4, 4, channels)).astype(np.float32)
    return {"type": "gridvolume", "data": data, "raw": True, "to_world": move(*_LOW) @ stretch(*_SIZE)}


def fibres() -> Description:
    """A volume of SGGX matrices: xx, yy, zz, xy, xz, yz."""
    volume = grid(0.0, 0.1, 6)
    volume["data"] += np.array([0.2, 0.6, 0.4, 0.0, 0.0, 0.0], dtype=np.float32)
    return volume


def volumes() -> dict[str, Callable[[float, float], Description]]:
    """Volumes of numbers between two bounds."""
    return {
        "constvolume": lambda low, high: {"type": "constvolume", "value": (low + high) / 2},
        "constvolume (colour)": lambda low, high: {"type": "constvolume", "value": rgb(low, (low + high) / 2, high)},
        "gridvolume": lambda low, high: grid(low, high),
        "gridvolume (colour)": lambda low, high: grid(low, high, 3),
    }


def phase_functions() -> dict[str, Callable[[], Description]]:
    """Phase functions; what blends holds others."""
    lobe = {"type": "hg", "g": 0.6}
    weight = {"type": "constvolume", "value": 0.4}
    return {
        "isotropic": lambda: {"type": "isotropic"},
        "rayleigh": lambda: {"type": "rayleigh"},
        "hg": lambda: {"type": "hg", "g": 0.4},
        "tabphase": lambda: {"type": "tabphase", "values": "0.5,0.8,1.0,1.6,3.0"},
        "sggx": lambda: {"type": "sggx", "S": fibres()},
        "blendphase": lambda: {"type": "blendphase", "weight": weight, "a": lobe, "b": {"type": "isotropic"}},
    }


def blended(inner: Description) -> Description:
    """A phase function beside another one."""
    return {
        "type": "blendphase", "weight": grid(0.3, 0.6), "a": inner, "b": {"type": "hg", "g": -0.3},
    }  # fmt: skip


def medium(plugin: str, sigma_t: Description, albedo: Description, phase: Description) -> Description:
    return {"type": plugin, "sigma_t": sigma_t, "albedo": albedo, "phase": phase}
