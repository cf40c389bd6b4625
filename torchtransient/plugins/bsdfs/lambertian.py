"""Which BSDFs are Lambertian: what scatters alike in all directions can be written down without asking a plugin."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from torchtransient.plugins.node_walk import bsdfs_below


def is_lambertian(bsdf: Any) -> bool:
    """Whether a BSDF is Mitsuba's ``diffuse``, or ``twosided`` around nothing else.

    By class: the flags of a BSDF of someone else may say that it is diffuse, and mean that it is not glossy.
    """
    name = bsdf.class_name()
    if name == "TwoSidedBRDF":
        nested = bsdfs_below(bsdf)
        return bool(nested) and all(part.class_name() == "SmoothDiffuse" for part in nested)
    return name == "SmoothDiffuse"


def scatters_behind(bsdf: Any) -> Any:
    """Whether light scatters on the side that the normal turns away from, too (a mask for BSDF pointers)."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide)
