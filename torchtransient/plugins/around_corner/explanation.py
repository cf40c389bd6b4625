"""How ``transient_nlos_path`` finds which light of a scene, and why, in words."""

from __future__ import annotations

from typing import Any

from torchtransient.plugins.around_corner.late_light import FIRST
from torchtransient.plugins.around_corner.shared_light import BOUNCES, wall_lights_itself, why_not
from torchtransient.plugins.integrators.base import UNLIMITED

SHARED = "from hidden samples that all scanned points share"


def explanation(integrator: Any, scene: Any, contents: Any) -> str:
    """One line: of light of three bounces, and of later light."""
    settings, beside = integrator.settings(), integrator.beside_paths(scene, contents)
    light = 0 if integrator.laser_sampling else 1  # the light's own way is a segment where lights are sampled
    least = settings.min_depth - light if settings.min_depth else 0
    most = None if settings.max_depth == UNLIMITED else settings.max_depth - light
    shared = range(0) if beside is None else range(beside[0], beside[1] + 1)
    parts = []
    if least <= BOUNCES and (most is None or most >= BOUNCES):
        how = SHARED if BOUNCES in shared else f"from paths{_why(integrator, scene, contents, integrator.third_bounce)}"
        parts.append(f"light of three bounces {how}")
    else:
        parts.append("light of three bounces is not asked for")
    first = max(least, FIRST)
    if most is not None and most < first:
        return f"{parts[0]}; no later light"
    chained = [n for n in shared if n >= FIRST]
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


def _why(integrator: Any, scene: Any, contents: Any, choice: str) -> str:
    """Why paths, where samples were not shared."""
    if choice == "paths":
        return ", as third_bounce asks for"
    if not (integrator.laser_sampling and integrator.hidden_sampling) or integrator.equal_shares:
        return ", since nlos_laser_sampling and nlos_hidden_geometry_sampling are not on alone"
    reason = why_not(scene, contents.sensor, contents)
    if reason is None and wall_lights_itself(contents.sensor):
        reason = "the wall is not flat, and points of it that see each other from nearby weigh without bound"
    return f", since {reason}"
