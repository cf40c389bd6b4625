"""What a scene has that light of three bounces from shared samples does not describe."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import has_surface
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.sampling.area_elements import can_be_listed
from torchtransient.plugins.sampling.shared_samples import not_diffuse


def reasons_against(scene: Any, hidden: list[Any], wall: list[Any]) -> list[str]:
    """Why third-bounce light of ``hidden`` and ``wall`` shapes calls for the general path integrator; empty where the
    shared samples are exact. One line each, which names what is in the way.

    Light between points of a wall that is not plane is not counted: a bent wall has to be among ``hidden`` too.
    """
    found = []
    if mi.is_spectral or mi.is_polarized:
        found.append(f"variant {mi.variant()}: samples hold colours, not spectra or Stokes vectors")
    unlisted = [shape for shape in hidden if not can_be_listed(shape)]
    found += [f"hidden shape {_name(shape)}: points on it cannot be drawn" for shape in unlisted]
    listed = [shape for shape in hidden if can_be_listed(shape)]
    found += [f"hidden shape {name}: not diffuse" for name in not_diffuse(listed)]
    found += [f"wall {name}: not diffuse" for name in not_diffuse(wall)]
    for shape in shapes_of_scene(scene):
        if shape.is_medium_transition():
            found.append(f"shape {_name(shape)}: bounds a medium")
        elif has_surface(shape) and _lets_light_through(shape.bsdf()):
            found.append(f"shape {_name(shape)} ({shape.bsdf().class_name()}): lets light through")
    return found


def _name(shape: Any) -> str:
    return str(shape.id() or shape.class_name())


def _lets_light_through(bsdf: Any) -> bool:
    flags = (mi.BSDFFlags.Transmission, mi.BSDFFlags.Null)
    return any(mi.has_flag(bsdf.flags(), flag) for flag in flags)
