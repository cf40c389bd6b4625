"""Gradient cases of surfaces: albedos, roughness, indices of refraction, weights."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, glass_slab, instances, mirror_room, room, transform
from support.gradient_cases.unknowns import scale_texture, set_color


def texture():
    rng = np.random.default_rng(3)
    data = mi.TensorXf(rng.uniform(0.2, 0.7, (4, 4, 1)).astype(np.float32))
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear"}}


def blend():
    """Diffuse and rough metal, mixed."""
    parts = {"a": {"type": "diffuse", "reflectance": 0.5}, "b": {"type": "roughconductor", "alpha": 0.3}}
    return {"type": "blendbsdf", "weight": 0.4, **parts}


def principled_glass():
    return {"type": "principled", "roughness": 0.5, "base_color": 0.8, "eta": 1.4, "spec_trans": 0.8}


def thin_sheet():
    return {
        "type": "principledthin", "roughness": 0.5, "base_color": 0.8, "eta": 1.4, "spec_trans": 0.6, "diff_trans": 0.7,
    }  # fmt: skip


def principled(kind, around, slot, value, **settings):
    """A scene made by ``around`` with a principled surface of which one weight is at its end."""
    weight = {slot: {"type": "uniform", "value": value}}
    return around({"type": kind, "roughness": 0.5, "base_color": 0.7, **weight, **settings})


def coated_wall(bsdf):
    return room(bsdf=bsdf, light=area_light())


def sheet(bsdf):
    return glass_slab(bsdf, "rectangle")


def at_an_end(name, scene, key, value, step, **arguments):
    """A case of a weight where a lobe is lost in Mitsuba's plugin."""
    row = "weight of a lobe of a principled surface, where a lobe vanishes"
    side = -1 if value else 1
    return Case(name, row, scene, set_color(f"{key}.value"), value, step, side=side, **arguments)


def plastic(kind, **reflectances):
    """A room with a wall of plastic; of the lobes that are not named, the reflectance is that of the plugin."""
    lobes = {name: {"type": "uniform", "value": value} for name, value in reflectances.items()}
    return room(bsdf={"type": kind, **lobes}, light=area_light())


CASES = [
    Case("diffuse_albedo", "diffuse albedo", room, set_color("side.bsdf.reflectance.value"), 0.8, 0.02),
    Case(
        "texture",
        "textured albedo",
        lambda: room(bsdf=texture()),
        scale_texture("wall.bsdf.reflectance.data"),
        0.0,
        0.05,
    ),
    Case(
        "roughness",
        "roughness (rough conductor)",
        lambda: room(bsdf={"type": "roughconductor", "alpha": 0.3, "distribution": "ggx"}, light=area_light()),
        set_color("wall.bsdf.alpha.value"),
        0.3,
        0.01,
        spp=4096,
    ),
    Case(
        "smooth_glass_index",
        "dielectric index, smooth",
        lambda: glass_slab({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
        set_color("slab.bsdf.eta"),
        1.5,
        4e-3,
        spp=8192,
    ),
    Case(
        "rough_glass_index",
        "dielectric index, rough",
        lambda: glass_slab({"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.2}),
        set_color("slab.bsdf.eta"),
        1.5,
        4e-3,
        spp=16384,
    ),
    Case(
        "mirror_reflectance",
        "specular reflectance (delta lobe)",
        lambda: mirror_room(),
        set_color("wall.bsdf.specular_reflectance.value"),
        0.9,
        0.05,
        spp=2048,
    ),
    Case(
        "plastic_alpha",
        "roughness (rough plastic)",
        lambda: room(bsdf={"type": "diff_rough_plastic", "alpha": 0.3, "diffuse_reflectance": 0.3}, light=area_light()),
        set_color("wall.bsdf.alpha"),
        0.3,
        0.01,
        spp=4096,
    ),
    Case(
        "plastic_index",
        "index of a rough plastic",
        lambda: room(bsdf={"type": "diff_rough_plastic", "alpha": 0.2, "diffuse_reflectance": 0.8}, light=area_light()),
        set_color("wall.bsdf.eta"),
        1.49,
        # Mitsuba's quadrature of the internal reflectance is rough on smaller scales.
        0.04,
        spp=4096,
    ),
    Case(
        "smooth_plastic_index",
        "index of a smooth plastic",
        lambda: plastic("diff_plastic"),
        set_color("wall.bsdf.eta"),
        1.49,
        0.02,
        spp=4096,
    ),
    Case(
        "black_mirror_of_a_plastic",
        "reflectance of a black lobe of a plastic",
        lambda: plastic("diff_plastic", specular_reflectance=0.0),
        set_color("wall.bsdf.specular_reflectance.value"),
        0.0,
        0.2,
        side=1,
        spp=16384,
        fd_spp=16384,
    ),
    Case(
        "principled_glass_index",
        "index of a principled surface that transmits",
        lambda: glass_slab(principled_glass()),
        set_color("slab.bsdf.eta"),
        1.4,
        4e-3,
        spp=4096,
    ),
    # Of very rough glass, a tenth of the samples leads to the wrong side of the surface and is thrown away.
    Case(
        "very_rough_glass",
        "specular transmittance (rough glass)",
        lambda: glass_slab(
            {"type": "roughdielectric", "alpha": 0.7, "int_ior": 1.5, "ext_ior": 1.0, "specular_transmittance": 0.7}
        ),
        set_color("slab.bsdf.specular_transmittance.value"),
        0.7,
        0.02,
        spp=2048,
    ),
    Case(
        "principled_thin_colour",
        "colour of a thin principled sheet",
        lambda: glass_slab(thin_sheet(), "rectangle"),
        set_color("slab.bsdf.base_color.value"),
        0.8,
        0.02,
        spp=4096,
    ),
    Case(
        "principled_roughness",
        "roughness (principled)",
        lambda: room(
            bsdf={"type": "principled", "roughness": 0.5, "base_color": {"type": "rgb", "value": 0.5}, "specular": 0.7},
            light=area_light(),
        ),
        set_color("wall.bsdf.roughness.value"),
        0.5,
        0.02,
        spp=4096,
    ),
    Case(
        "mask_opacity",
        "mask opacity",
        lambda: room(
            screen={
                "type": "rectangle",
                "to_world": transform().translate([0, 0, 0.5]).scale(2),
                "bsdf": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse", "reflectance": 0.5}},
            }
        ),
        set_color("screen.bsdf.opacity.value"),
        0.4,
        0.02,
        spp=4096,
    ),
    Case(
        "blend_weight",
        "blend weight",
        lambda: room(bsdf=blend()),
        set_color("wall.bsdf.weight.value"),
        0.4,
        0.02,
        spp=2048,
    ),
    Case(
        "conductor_eta",
        "complex index of a conductor",
        lambda: mirror_room({"type": "conductor", "eta": 0.5, "k": 2.0}),
        set_color("wall.bsdf.eta.value"),
        0.5,
        0.02,
        spp=2048,
    ),
    Case(
        "glass_in_a_group",
        "dielectric index, smooth",
        lambda: instances({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}),
        set_color("group.plate.bsdf.eta"),
        1.5,
        4e-3,
        spp=8192,
    ),
    at_an_end(
        "no_clearcoat",
        lambda: principled("diff_principled", coated_wall, "clearcoat", 0.0),
        "wall.bsdf.clearcoat",
        0.0,
        0.2,
        spp=4096,
        fd_spp=16384,
    ),
    at_an_end(
        "all_metal",
        lambda: principled("diff_principled", coated_wall, "metallic", 1.0),
        "wall.bsdf.metallic",
        1.0,
        0.05,
        spp=4096,
    ),
    at_an_end(
        "no_transmission",
        lambda: principled("diff_principled", sheet, "spec_trans", 0.0, eta=1.4),
        "slab.bsdf.spec_trans",
        0.0,
        0.1,
        spp=8192,
        fd_spp=65536,
    ),
    at_an_end(
        "no_light_through_paper",
        lambda: principled("diff_principled_thin", sheet, "diff_trans", 0.0, eta=1.4),
        "slab.bsdf.diff_trans",
        0.0,
        0.1,
        spp=8192,
        fd_spp=65536,
    ),
]
