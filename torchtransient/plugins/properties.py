"""Numbers and truth values of a plugin's properties, checked where Python would take others for them."""

from __future__ import annotations

import math
from typing import Any

from torchtransient.checks import shown
from torchtransient.errors import SceneError

# Kernels count in 32 bits.
MOST = 2**32 - 2


def whole_number(props: Any, name: str, default: int, least: int = -1) -> int:
    """A whole number from ``least`` to 2^32 - 2. Raises SceneError."""
    given = props.get(name, default)
    if isinstance(given, bool) or not isinstance(given, (int, float)) or given != given // 1:
        raise SceneError(f"{props.plugin_name()}: {name}: expected a whole number, got {shown(given)}.")
    if not least <= given <= MOST:
        raise SceneError(
            f"{props.plugin_name()}: {name}: expected a whole number from {least} to 2^32 - 2, got {shown(given)}."
        )
    return int(given)


def number(props: Any, name: str, default: float | None = None) -> float:
    """A finite number; without a ``default`` it has to be there. Raises SceneError."""
    given = props[name] if default is None else props.get(name, default)
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        raise SceneError(
            f"{props.plugin_name()}: {name}: expected a number, got {shown(given)}. It takes no texture and no text."
        )
    if not math.isfinite(given):
        raise SceneError(f"{props.plugin_name()}: {name}: expected a finite number, got {shown(given)}.")
    return float(given)


def truth(props: Any, name: str, default: bool) -> bool:
    """True or false, or 1 or 0. Raises SceneError."""
    given = props.get(name, default)
    if not isinstance(given, (bool, int, float)) or given not in (0, 1):
        raise SceneError(f"{props.plugin_name()}: {name}: expected true or false, got {shown(given)}.")
    return bool(given)
