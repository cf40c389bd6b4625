"""How a :class:`~torchtransient.pulses.Pulse` is written into the properties of a film."""

from __future__ import annotations

from typing import Any

from torchtransient.errors import ArgumentError, SceneError
from torchtransient.pulses import Pulse
from torchtransient.rendering.films.choices import all_films, of_plugin, plugins_in_words

_NAMES = ("fwhm_opl", "width_opl", "center_opl", "opl", "values")
PREFIXES = ("pulse", "irf")
# Every property that a pulse can have in a film.
PROPERTIES = tuple(prefix + suffix for prefix in PREFIXES for suffix in ("", *(f"_{name}" for name in _NAMES)))


def checked_pulse(name: str, value: Any) -> Pulse | None:
    """None or a Pulse. Raises ``ArgumentError``."""
    if value is None or isinstance(value, Pulse):
        return value
    raise ArgumentError(
        f"{name}: expected a tt.Pulse, for instance tt.Pulse.gaussian(fwhm_opl=0.05), got {type(value).__name__}."
    )


def write_pulse(props: Any, prefix: str, pulse: Pulse | None) -> None:
    """Replace the pulse of a film node; None leaves the film its own. Raises ``SceneError`` for films without one."""
    if pulse is None:
        return
    kind = of_plugin(props.plugin_name())
    if kind is None or not kind.takes_pulse:
        spread = plugins_in_words([kind for kind in all_films() if kind.takes_pulse])
        raise SceneError(
            f"{prefix}: the film {props.plugin_name()!r} does not spread arrivals over time, {spread} does. "
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
