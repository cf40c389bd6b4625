"""Pulses and impulse responses as properties of films."""

from __future__ import annotations

from typing import Any

from torchtransient.errors import ArgumentError, SceneError
from torchtransient.pulses import Pulse

_NAMES = ("fwhm_opl", "width_opl", "center_opl", "opl", "values")
PREFIXES = ("pulse", "irf")
# Films that spread every arrival by a pulse.
_SPREADING = ("transient_hdr_film", "gated_hdr_film")
# Properties of pulses in films.
PROPERTIES = tuple(prefix + suffix for prefix in PREFIXES for suffix in ("", *(f"_{name}" for name in _NAMES)))


def checked_pulse(name: str, value: Any) -> Pulse | None:
    """Return a pulse of a call, or None.

    Raises:
        ArgumentError: for anything else.
    """
    if value is None or isinstance(value, Pulse):
        return value
    raise ArgumentError(
        f"{name}: expected a tt.Pulse, for instance tt.Pulse.gaussian(fwhm_opl=0.05), got {type(value).__name__}."
    )


def write_pulse(props: Any, prefix: str, pulse: Pulse | None) -> None:
    """Replace the pulse of a film node; None leaves the film its own.

    Args:
        props: properties of the node.
        prefix: "pulse" or "irf".
        pulse: pulse over optical path length, metres.

    Raises:
        SceneError: for films that spread no arrivals.
    """
    if pulse is None:
        return
    if props.plugin_name() not in _SPREADING:
        raise SceneError(
            f"{prefix}: the film {props.plugin_name()!r} does not spread arrivals over time, "
            f"{' and '.join(_SPREADING)} do. "
            "Multiply a phasor by torchtransient.pulses.transform(pulse, frequencies) instead, or leave it out."
        )
    for name in _NAMES:
        if f"{prefix}_{name}" in props:
            del props[f"{prefix}_{name}"]
    props[prefix] = pulse.kind
    props[f"{prefix}_center_opl"] = pulse.center_opl
    if pulse.kind == "tabulated":
        props[f"{prefix}_opl"] = ", ".join(map(repr, pulse.opl))
        props[f"{prefix}_values"] = ", ".join(map(repr, pulse.values))
    else:
        props[f"{prefix}_{'fwhm' if pulse.kind == 'gaussian' else 'width'}_opl"] = pulse.width_opl
