"""Recognition of Lambertian BSDFs, whose value is known without calling the plugin."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from torchtransient.plugins.node_walk import bsdfs_below


def is_lambertian(bsdf: Any) -> bool:
    """Return True for Mitsuba's ``diffuse``, or ``twosided`` around nothing else.

    By class, since other plugins may set the diffuse flag without being Lambertian.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    name = bsdf.class_name()
    if name == "TwoSidedBRDF":
        nested = bsdfs_below(bsdf)
        return bool(nested) and all(part.class_name() == "SmoothDiffuse" for part in nested)
    return name == "SmoothDiffuse"


def scatters_behind(bsdf: Any) -> Any:
    """Return a mask of BSDFs that scatter light behind the normal as well.

    Args:
        bsdf: one ``mi.BSDF``, or array of BSDF pointers.
    """
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide)
