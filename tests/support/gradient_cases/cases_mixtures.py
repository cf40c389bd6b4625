"""Gradient cases of mixtures (mask, blend): delta lobes, what such lobes hide, weights of zero and one."""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np

from support.gradient_cases.cases_media import PHASE, block, homogeneous
from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import mirror_room, transform
from support.gradient_cases.unknowns import move, rotate, set_color

DIFFUSE = {"type": "diffuse", "reflectance": 0.5}
MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": 0.9}
GLASS = {"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}
THIN_GLASS = {"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0}
PLASTIC = {"type": "plastic", "int_ior": 1.5, "diffuse_reflectance": 0.5}
ROUGH_GLASS = {"type": "diff_rough_dielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3}
METAL = {"type": "roughconductor", "alpha": 0.1}


def blend(first, second, weight=0.4):
    return {"type": "blendbsdf", "weight": weight, "first": first, "second": second}


def mask(nested, opacity=0.6):
    return {"type": "mask", "opacity": opacity, "nested": nested}


def two_sided(nested):
    return {"type": "twosided", "nested": nested}


def texture(low, high, seed=3):
    rng = np.random.default_rng(seed)
    size = (4, 4, 3) if np.ndim(low) else (4, 4, 1)
    data = mi.TensorXf(rng.uniform(low, high, size).astype(np.float32))
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear"}


def bump(nested, low=0.2, high=0.7):
    return {"type": "bumpmap", "heights": texture(low, high), "nested": nested, "scale": 0.3}


def normal_map(nested):
    return {"type": "normalmap", "normalmap": texture((0.47, 0.47, 0.98), (0.53, 0.53, 1.0), 5), "nested": nested}


def wide_room(bsdf):
    """A mirror room without edges that paths could run past."""
    scene = mirror_room(bsdf)
    scene["wall"]["to_world"] = transform().scale(30)
    scene["side"]["to_world"] = transform().translate([0, 0, 5]).rotate([0, 1, 0], 180).scale(30)
    return scene


def seen_through(bsdf):
    """The wall from behind, with light on what lies beyond it."""
    scene = mirror_room(bsdf)
    scene["sensor"]["film"]["start_opl"] = 4.0
    scene["wall"]["to_world"] = transform().rotate([0, 1, 0], 180).scale(3)
    scene["side"]["to_world"] = transform().translate([0, 0, -1]).scale(30)
    scene["light"]["position"] = [0.5, 0.3, -0.5]
    return scene


def weight(name, bsdf, value=0.4, key="weight.value", **options):
    """The weight of a mixture on the wall of a mirror room; ``bsdf`` makes it of the value."""
    row = "mask opacity" if key.endswith("opacity.value") else "blend weight"
    return Case(
        name, row, lambda: mirror_room(bsdf(value)), set_color("wall.bsdf." + key), value, 0.02, spp=2048, **options
    )


def moving(name, bsdf, **options):
    apply = move("wall.to_world", (0, 0, 1))
    return Case(name, "shape to_world", lambda: wide_room(bsdf()), apply, 0.0, 2e-3, spp=4096, **options)


def opacity(name, nested, value=0.6, **options):
    return weight(name, partial(mask, nested), value, "opacity.value", **options)


def blend_in_fog(bsdf):
    """The wall in a block of thin fog."""
    scene = mirror_room(bsdf)
    scene["integrator"]["type"] = "transient_prbvolpath"
    fog = {"type": "homogeneous", "sigma_t": 0.1, "albedo": 0.8}
    scene["fog"] = {
        "type": "cube", "to_world": transform().scale([0.8, 0.8, 0.6]), "bsdf": {"type": "null"}, "interior": fog
    }  # fmt: skip
    return scene


def polarizing(weight):
    """A smooth metal, of which a part is painted, seen from behind."""
    scene = mirror_room(two_sided(blend(DIFFUSE, {"type": "diff_conductor", "eta": 0.5, "k": 2.0}, weight)))
    scene["wall"]["to_world"] = transform().rotate([0, 1, 0], 180)
    return scene


def phases(weight):
    """A medium with a blend of phase functions, of which one is a blend as well."""
    inner = {"type": "blendphase", "weight": 0.5, "a": {"type": "isotropic"}, "b": {"type": "hg", "g": -0.6}}
    outer = {"type": "blendphase", "weight": weight, "a": {"type": "hg", "g": 0.8}, "b": inner}
    return block({**homogeneous(), "phase": outer})


def weight_of_the_shape(name, bsdf, value, **options):
    """As :func:`weight`, of a weight that is an attribute of the wall."""
    read, slot = {"type": "mesh_attribute", "name": "vertex_share"}, {"type": "uniform", "value": value}

    def scene():
        room = mirror_room(bsdf(read))
        return {**room, "wall": room["wall"] | {"vertex_share": slot}}

    apply = set_color("wall.vertex_share.value")
    return Case(name, "blend weight", scene, apply, value, 0.02, **{"spp": 16384, **options})


SLOW = {"tags": ("slow",)}
CASES = [
    weight("blend_of_diffuse_and_mirror", partial(blend, DIFFUSE, MIRROR)),
    weight("blend_of_diffuse_and_glass", partial(blend, DIFFUSE, GLASS), seeds=16, **SLOW),
    weight("blend_of_normals", lambda w: normal_map(blend(DIFFUSE, MIRROR, w)), key="nested_bsdf.weight.value", **SLOW),
    weight("two_sided_blend", lambda w: two_sided(blend(DIFFUSE, MIRROR, w)), key="brdf_0.weight.value", **SLOW),
    weight("mask_of_a_blend", lambda w: mask(blend(DIFFUSE, MIRROR, w)), key="nested_bsdf.weight.value", **SLOW),
    opacity("mask_of_thin_glass", THIN_GLASS, **SLOW),
    weight("no_mirror_yet", partial(blend, DIFFUSE, MIRROR), 0.0, side=1),
    weight("no_metal_yet", partial(blend, DIFFUSE, METAL), 0.0, side=1, **SLOW),
    weight_of_the_shape("no_metal_yet_by_an_attribute", partial(blend, DIFFUSE, METAL), 0.0, side=1),
    weight_of_the_shape("nothing_of_paint_by_an_attribute", partial(mask, DIFFUSE), 0.0, side=1, seeds=16, **SLOW),
    opacity("nothing_of_a_mirror", MIRROR, 0.0, side=1),
    Case(
        "roughness_of_blended_glass",
        "roughness",
        lambda: seen_through(blend(ROUGH_GLASS, DIFFUSE)),
        set_color("wall.bsdf.bsdf_0.alpha.value"),
        0.3,
        0.02,
        spp=4096,
    ),
    Case(
        "index_of_masked_thin_glass",
        "eta of thindielectric",
        lambda: mirror_room(mask(THIN_GLASS)),
        set_color("wall.bsdf.nested_bsdf.eta"),
        1.5,
        0.02,
        spp=2048,
    ),
    moving("blended_plastic_moves", lambda: blend(PLASTIC, DIFFUSE), seeds=16, **SLOW),
    moving("textured_blend_moves", lambda: blend(DIFFUSE, MIRROR, texture(0.1, 0.9)), **SLOW),
    Case(
        "masked_thin_glass_tilts",
        "shape to_world",
        lambda: wide_room(mask(THIN_GLASS)),
        rotate("wall.to_world", (0, 1, 0)),
        0.0,
        0.05,
        spp=4096,
        **SLOW,
    ),
    Case(
        "blend_in_fog",
        "blend weight",
        lambda: blend_in_fog(blend(DIFFUSE, MIRROR)),
        set_color("wall.bsdf.weight.value"),
        0.4,
        0.02,
        spp=2048,
        **SLOW,
    ),
    Case(
        "polarized_blend",
        "blend weight",
        lambda: polarizing(0.4),
        set_color("wall.bsdf.brdf_0.weight.value"),
        0.4,
        0.02,
        variant="llvm_ad_mono_polarized",
        spp=2048,
        **SLOW,
    ),
    *(
        Case(
            f"phase_of_weight_{value:g}",
            "phase function",
            lambda value=value: phases(value),
            set_color(PHASE + "weight.value.value"),
            value,
            0.02,
            spp=4096,
            seeds=16,
            side=side,
            **SLOW,
        )
        for value, side in ((0.0, 1), (1.0, -1))
    ),
]
