"""How ``transient_nlos_path`` finds which light of a scene, and why, in words."""

from __future__ import annotations

from typing import Any

from torchtransient.plugins.around_corner.division import BOUNCES, Division
from torchtransient.plugins.around_corner.late_light import FIRST

SHARED = "from hidden samples that all scanned points share"


def explanation(integrator: Any, scene: Any, contents: Any) -> str:
    """One line: of light of three bounces, and of later light."""
    division, (least, most) = integrator.division(scene, contents), integrator.asked_bounces()
    parts = []
    if least <= BOUNCES and (most is None or most >= BOUNCES):
        how = SHARED if division.third_bounce else f"from paths{_why(integrator, division)}"
        parts.append(f"light of three bounces {how}")
    else:
        parts.append("light of three bounces is not asked for")
    first = max(least, FIRST)
    if most is not None and most < first:
        return f"{parts[0]}; no later light"
    chained = division.chained
    if chained:
        parts.append(f"light of {_range(chained[0], chained[-1])} from chains that they share")
        first = chained[-1] + 1
    if most is None or most >= first:
        parts.append(f"light of {_range(first, most)} from paths")
    return "; ".join(parts)


def _range(first: int, last: int | None) -> str:
    if last is None:
        return f"{first} and more bounces"
    return f"{first} bounces" if first == last else f"{first} to {last} bounces"


def _why(integrator: Any, division: Division) -> str:
    """Why paths, where samples were not shared."""
    if integrator.third_bounce == "paths":
        return ", as third_bounce asks for"
    return f", since {division.why_not}"
