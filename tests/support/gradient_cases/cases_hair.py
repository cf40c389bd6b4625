"""Gradient cases of fibres."""

from __future__ import annotations

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import room, transform
from support.gradient_cases.unknowns import rotate, set_color

PIGMENTS = {"eumelanin": 0.3, "pheomelanin": 0.4}
GREY = {"sigma_a": {"type": "uniform", "value": 0.3}}
COLOURED = {"sigma_a": {"type": "rgb", "value": [0.2, 0.3, 0.4]}}
# Each case compiles kernels of its own.
QUICK = ("longitudinal_roughness", "index", "coloured_absorption")


def fibres(**settings):
    """A wall that scatters as fibres along y do, lit at an angle to them."""
    place = transform().look_at(origin=[0.5, 1.0, 2.5], target=[0, 0, 0], up=[0, 0, 1]).scale(0.3)
    light = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 9.0}}
    return room(bsdf={"type": "diff_hair", "int_ior": 1.55, "ext_ior": 1.0, **settings}, light=light)


def of_hair(name, key, value, step, variant="llvm_ad_mono", spp=4096, **settings):
    settings = settings or GREY
    scene = lambda: fibres(**settings)  # noqa: E731
    unknown = set_color(f"wall.bsdf.{key}")
    tags = () if name in QUICK else ("slow",)
    return Case(f"hair_{name}", f"{key} (hair)", scene, unknown, value, step, variant, spp, tags=tags)


# Light is absorbed again and again: differences over larger steps see the curvature.
CASES = [
    of_hair("longitudinal_roughness", "longitudinal_roughness", 0.3, 0.003),
    of_hair("azimuthal_roughness", "azimuthal_roughness", 0.3, 0.005, spp=8192),
    of_hair("scale_tilt", "scale_tilt", 2.0, 0.5),
    of_hair("index", "eta", 1.55, 0.006, spp=8192),
    of_hair("eumelanin", "eumelanin", 0.3, 0.01, "llvm_ad_rgb", **PIGMENTS),
    of_hair("pheomelanin", "pheomelanin", 0.4, 0.015, "llvm_ad_rgb", **PIGMENTS),
    of_hair("pigments_in_wavelengths", "eumelanin", 0.3, 0.01, "llvm_ad_spectral", **PIGMENTS),
    of_hair("coloured_absorption", "sigma_a.value", 0.3, 0.008, "llvm_ad_rgb", **COLOURED),
    Case(
        "hair_turns",
        "shape to_world",
        lambda: fibres(**GREY),
        rotate("wall.to_world", (0, 0, 1)),
        20.0,
        1.0,
        tags=("slow",),
    ),
    of_hair("polarized", "longitudinal_roughness", 0.3, 0.003, "llvm_ad_mono_polarized"),
]
