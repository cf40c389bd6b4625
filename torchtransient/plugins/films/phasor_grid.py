"""Which frequencies a phasor film keeps, read from its parameters."""

from __future__ import annotations

import warnings

import numpy as np

from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.plugins.properties import number, whole_number
from torchtransient.transform_bins import transform_bins

LIST = ("frequencies",)
GRID = ("frequency_first", "frequency_step", "frequency_count")
WAVELENGTHS = ("wl_mean", "wl_sigma", "temporal_bins", "bin_width_opl")


def frequencies_of(props) -> np.ndarray:
    """The frequencies that a film's properties ask for: float64, cycles per metre. Raises ``SceneError``."""
    given = [names for names in (LIST, GRID, WAVELENGTHS) if any(name in props for name in names)]
    if len(given) > 1:
        sets = " and ".join(", ".join(name for name in names if name in props) for names in given)
        raise SceneError(f"phasor_hdr_film: {sets} exclude each other; give one of the sets.")
    if given == [LIST]:
        return parse_list(props["frequencies"])
    if given == [GRID]:
        missing = [name for name in GRID if name not in props]
        if missing:
            raise SceneError(
                f"phasor_hdr_film: a uniform grid needs {', '.join(GRID)}; {', '.join(missing)} is missing."
            )
        count = whole_number(props, "frequency_count", 0)
        if count < 1:
            raise SceneError(f"phasor_hdr_film: frequency_count must be at least 1, got {count}.")
        return checked(number(props, "frequency_first") + np.arange(count) * number(props, "frequency_step"))
    found = transform_bins(
        number(props, "wl_mean", 100.0),
        number(props, "wl_sigma", 1000.0),
        whole_number(props, "temporal_bins", 4096),
        number(props, "bin_width_opl", 0.003),
    )
    if not given:
        numbers = ", ".join(f"{number:.4g}" for number in found)
        warnings.warn(
            f"phasor_hdr_film: no frequencies are given, so the film keeps those of mitransient's defaults, {numbers} "
            "cycles per metre. Give 'frequencies': '...', numbers with commas in cycles per metre, or wl_mean and "
            "wl_sigma to mean these.",
            TorchTransientWarning,
            stacklevel=2,
        )
    return found


def parse_list(given) -> np.ndarray:
    """Numbers from a string with commas or spaces, or from an array of any kind."""
    try:
        if isinstance(given, str):
            values = [float(word) for word in given.replace(",", " ").split()]
        else:
            values = np.array(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise SceneError(f"phasor_hdr_film: frequencies: expected numbers, got {given!r}.") from None
    return checked(values)


def checked(values) -> np.ndarray:
    """Finite, and at least one."""
    values = np.asarray(values, dtype=np.float64)
    if values.size < 1:
        raise SceneError("phasor_hdr_film: frequencies: expected at least one, got none.")
    if not np.isfinite(values).all():
        raise SceneError(f"phasor_hdr_film: frequencies: expected finite numbers, got {values.tolist()}.")
    return values


def step_of(frequencies: np.ndarray) -> float | None:
    """The step of a uniform grid, None for other lists. Deviations that no phase could show are taken as rounding."""
    count = len(frequencies)
    step = (frequencies[-1] - frequencies[0]) / (count - 1) if count > 1 else 0.0
    deviation = np.abs(frequencies - (frequencies[0] + np.arange(count) * step)).max()
    return float(step) if deviation <= 1e-14 * np.abs(frequencies).max() else None
