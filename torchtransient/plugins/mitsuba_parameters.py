"""The rows of Mitsuba's own plugins in the table of parameters. Classes and keys are those of Mitsuba 3.9.1."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import (
    DIFFERENTIABLE_PLUGINS,
    LOSING,
    LOST_AT,
    METALS,
    NORMALS,
    NUMBERS,
    PLASTICS,
    POSITIONS,
    TEXCOORDS,
    is_absorption_of_hair,
    is_bump_map,
    is_dark,
    loses_slope_of_metal,
    lost_at,
    moved_by,
    normal_texture,
)
from torchtransient.plugins.node_walk import objects_below, objects_of, shown_by
from torchtransient.plugins.parameter_effect import (
    ANY_KEY,
    CORRECT,
    VALUE,
    ParameterEffect,
    Row,
    Site,
    declare_effects,
)
from torchtransient.plugins.spectral_colours import keeps_coefficients

# What moves the rays of a sensor.
SENSOR_KEYS = (
    "to_world",
    "x_fov",
    "principal_point_offset_x",
    "principal_point_offset_y",
    "aperture_radius",
    "focus_distance",
)

SHAPE = ParameterEffect(moves_length=True, moves_silhouette=True, role="shape", trusted=True)
SENSOR = replace(SHAPE, role="sensor")
# Shadow edges move with a light.
EMITTER = replace(SHAPE, role="emitter")
SUN = replace(SHAPE, role="sun", trusted=False)
NORMAL = replace(SHAPE, role="normal", trusted=False)
MEDIUM = ParameterEffect(moves_medium=True, role="medium")
INDEX = ParameterEffect(
    moves_length=True,
    moves_silhouette=True,
    role="index",
    biased=True,
    reason="biased where light is refracted: the path length does not follow this index",
    trusted=True,
)
# Outside of its first and last wavelength such a spectrum is zero.
WAVELENGTHS = ParameterEffect(
    biased=True,
    reason="biased where the values at the first and last wavelength are not zero: the cut there does not follow",
    trusted=True,
)
# Directions are held fixed while the index moves, so what is seen through the surface stays where it is.
PRINCIPLED_INDEX = ParameterEffect(moves_length=True, role="index", trusted=True)
EXCHANGED_INDEX = replace(
    PRINCIPLED_INDEX,
    reason=f"{CORRECT}; built as {DIFFERENTIABLE_PLUGINS['principled']} when asked for, since Mitsuba takes 1.001 for "
    "an index of 1 and loses the derivative",
    stand_in=DIFFERENTIABLE_PLUGINS["principled"],
    stand_in_needed=False,
)
COATING = ParameterEffect(
    reason=f"{CORRECT}; built as {DIFFERENTIABLE_PLUGINS['roughplastic']} when asked for, which differentiates the "
    "tables of its coating",
    trusted=True,
    stand_in=DIFFERENTIABLE_PLUGINS["roughplastic"],
)
VARNISH = ParameterEffect(
    reason=f"{CORRECT}; built as {DIFFERENTIABLE_PLUGINS['plastic']} when asked for, whose index is no plain number",
    trusted=True,
    stand_in=DIFFERENTIABLE_PLUGINS["plastic"],
)
FIBRE = ParameterEffect(
    reason=f"{CORRECT}; built as {DIFFERENTIABLE_PLUGINS['hair']} when asked for, whose lobes are those of its samples",
    stand_in=DIFFERENTIABLE_PLUGINS["hair"],
)
DARK = ParameterEffect(
    supported=False,
    reason="directionalarea shines in one direction, which no path from the sensor meets: it stays dark",
)
# Texture coordinates and normals move no point, and what they move is smooth but for the steps of what a texture shows
# and where normals turn away from the viewer.
COORDINATES = ParameterEffect(moves_silhouette=True)
PATTERN = replace(COORDINATES, role="shape")
PATTERN_AND_NORMALS = replace(NORMAL, role="shape")
_STEPS = "biased: the slope of a bump map jumps from texel to texel, and its coordinates change it by nothing else"
SLOPES = replace(COORDINATES, biased=True, reason=_STEPS)
NORMAL_SLOPES = replace(NORMAL, biased=True, reason=_STEPS)


def _index_by_stand_in(plugin: str) -> ParameterEffect:
    """Return the index of refraction of a plugin of Mitsuba that is built as one of ours when the key is asked for."""
    twin = DIFFERENTIABLE_PLUGINS[plugin]
    return ParameterEffect(
        moves_length=True,
        moves_silhouette=plugin == "dielectric",
        role="index",
        reason=f"{CORRECT}; built as {twin} when asked for, which follows the index through direction, weight and "
        "length",
        trusted=True,
        stand_in=twin,
    )


# ---------------------------------------------------------------------------------------------------------- conditions


def _turns_delta_lobes(bsdf: object) -> bool:
    """Return True if a BSDF with a delta lobe has its frame turned by a texture."""
    return normal_texture(bsdf) is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)  # type: ignore[attr-defined]


def _bsdfs_of(site: Site) -> list[Any]:
    """Return the BSDF of a shape and all that it holds."""
    outer = site.node.bsdf()
    return [] if outer is None else [outer, *objects_below(outer, mi.BSDF)]


def _places_normals(site: Site) -> bool:
    """Return True if the texture coordinates of a mesh place normals of a delta lobe."""
    return any(_turns_delta_lobes(bsdf) for bsdf in _bsdfs_of(site))


def _places_slopes(site: Site) -> bool:
    """Return True if the texture coordinates of a mesh place the slopes of a bump map."""
    return any(is_bump_map(bsdf) for bsdf in _bsdfs_of(site))


def _places_delta_slopes(site: Site) -> bool:
    return _places_slopes(site) and _places_normals(site)


def _places_light(site: Site) -> bool:
    """Return True if the texture coordinates of a mesh place its emission."""
    emitter = site.node.emitter()
    return emitter is not None and any(t.is_spatially_varying() for t in objects_below(emitter, mi.Texture))


def _places_light_and_normals(site: Site) -> bool:
    return _places_light(site) and _places_normals(site)


def _is_clamped(site: Site) -> bool:
    """Return True if the opacities of ellipsoids decide how large they are."""
    return any(shown.key == "extent_adaptive_clamping" and shown.read(site.node) for shown in shown_by(site.node)[0])


def _is_normal(site: Site) -> bool:
    """Return True if a texture holds normals or heights of a delta lobe."""
    return any(
        isinstance(holder, mi.BSDF) and normal_texture(holder) == name and _turns_delta_lobes(holder)
        for holder, name in site.owners
    )


def _is_other_normal(site: Site) -> bool:
    """Return True if a texture holds normals of a BSDF without a delta lobe."""
    return any(
        isinstance(holder, mi.BSDF) and normal_texture(holder) == name and not is_bump_map(holder)
        for holder, name in site.owners
    )


def _is_extinction(site: Site) -> bool:
    """Return True if a plugin is part of a medium's extinction."""
    return any(isinstance(holder, mi.Medium) and _attenuates(holder, name) for holder, name in site.owners)


def _attenuates(medium: Any, name: str) -> bool:
    """Return True if the part of a medium under ``name`` changes how far light gets. The albedo does not; a phase
    function does where it is one of flakes, whose projected area is a factor of the extinction.
    """
    if name == "phase_function":
        return bool(mi.has_flag(medium.phase_function().flags(), mi.PhaseFunctionFlags.Microflake))
    return name != "albedo"


def _is_an_index_of_one(site: Site) -> bool:
    """Return True if the index of a principled surface is (what Mitsuba takes for) one."""
    now = mi.traverse(site.node)[site.key]
    taken_for = (0, 1e-3) if site.key == "specular" else (1, 1.001)
    return any(bool(dr.any(dr.abs(now - value) < 1e-7)) for value in taken_for)


def _is_weight_in(cls: str, site: Site) -> bool:
    """Return True if a texture is the weight of a lobe that a BSDF of the class ``cls`` loses at some value."""
    return any(holder.class_name() == cls and lost_at(holder, name) for holder, name in site.owners)


def _is_lost_in(cls: str, site: Site) -> bool:
    """Return True if a BSDF of the class ``cls`` has lost such a lobe at the current value."""
    held = [(holder, name) for holder, name in site.owners if holder.class_name() == cls and lost_at(holder, name)]
    with dr.suspend_grad():
        if cls in PLASTICS:
            textures = [dict(objects_of(holder))[name] for holder, name in held]
            return any(dr.all(mi.Float(texture.mean()) <= 0) for texture in textures)
        if cls in METALS:
            return any(_loses_slope_of_metal(holder, name) for holder, name in held)
        shown = mi.traverse(site.node)[site.key] if held else None
        if not (dr.is_array_v(shown) and dr.is_float_v(shown)):
            return False
        entries = shown.array if dr.is_tensor_v(shown) else shown
        ends = {end for holder, name in held for end in lost_at(holder, name)}
        return any(bool(dr.any(entries == end, axis=None)) for end in ends)


def _loses_slope_of_metal(metal: Any, slot: str) -> bool:
    textures = dict(objects_of(metal))
    eta, k = (_range_of(textures[name]) for name in ("eta", "k"))
    return eta is not None and k is not None and loses_slope_of_metal(slot, eta, k)


def _range_of(texture: Any) -> tuple[float, float] | None:
    """Smallest and largest number of a texture, None if it shows none."""
    found: list[float] = []
    for node in (texture, *objects_below(texture, mi.Texture)):
        shown_here = [shown for shown in shown_by(node)[0] if shown.key in NUMBERS]
        if any(keeps_coefficients(node, shown.key) for shown in shown_here):
            found += [float(dr.slice(mi.Float(node.mean()), 0))]
            continue
        numbers = [shown.read(node) for shown in shown_here]
        for value in numbers:
            value = mi.Float(value) if isinstance(value, float) else dr.detach(value)
            value = value.array if dr.is_tensor_v(value) else dr.ravel(value)
            found += [float(dr.slice(least_or_most(value), 0)) for least_or_most in (dr.min, dr.max)]
    return (min(found), max(found)) if found else None


def _rows_of_weights() -> Iterator[Row]:
    """Return the rows of the weights of lobes, those of lost ones first."""
    for condition, now in ((_is_lost_in, True), (_is_weight_in, False)):
        for cls, plugin in LOSING.items():
            twin = DIFFERENTIABLE_PLUGINS[plugin]
            reason = f"{CORRECT}; built as {twin} when asked for, which has the derivatives at zero"
            effect = ParameterEffect(reason=reason, stand_in=twin, stand_in_needed=now)
            lost = f" where {'a slope' if cls in METALS else 'a lobe'} is lost" if now else ""
            words = f"in {plugin}, {', '.join(LOST_AT[cls])}{lost}"
            yield Row(effect, partial(condition, cls), words)


def _is_in_hair(site: Site) -> bool:
    return any(is_absorption_of_hair(holder, name) for holder, name in site.owners)


def _lies_in_dark_light(site: Site) -> bool:
    """Return True if all holders of a texture are lights that paths never find."""
    kinds = (mi.BSDF, mi.Emitter, mi.Medium)
    holders = [holder for holder, _ in site.owners if isinstance(holder, kinds)]
    return bool(holders) and all(isinstance(holder, mi.Emitter) and is_dark(holder) for holder in holders)


def _is_wind(site: Site) -> bool:
    return moved_by(site.node) is not None


WIND = Row(ParameterEffect(moves_length=True, role="velocity"), _is_wind, "the velocity of a medium")
IN_HAIR = Row(FIBRE, _is_in_hair, "the absorption of hair")
IN_NORMALS = Row(NORMAL, _is_normal, "normals or heights of a BSDF with a delta lobe")
IN_OTHER_NORMALS = Row(COORDINATES, _is_other_normal, "normals of another BSDF")
IN_EXTINCTION = Row(MEDIUM, _is_extinction, "in a medium: its extinction, or a phase function of flakes (sggx)")

IN_DARK_LIGHT = Row(DARK, _lies_in_dark_light, "the radiance of a directionalarea")

# Of what gives numbers to other plugins: textures, volumes, attributes of meshes.
NUMBER_ROWS = (IN_NORMALS, IN_OTHER_NORMALS, IN_EXTINCTION, *_rows_of_weights(), IN_HAIR, IN_DARK_LIGHT)

# ---------------------------------------------------------------------------------------------------------------- rows

declare_effects("Shape", {"to_world": SHAPE})
declare_effects(
    "Mesh",
    {
        "to_world": SHAPE,
        POSITIONS: SHAPE,
        NORMALS: SHAPE,
        TEXCOORDS: (
            Row(NORMAL_SLOPES, _places_delta_slopes, "a bump map over a delta lobe"),
            Row(SLOPES, _places_slopes, "another bump map"),
            Row(PATTERN_AND_NORMALS, _places_light_and_normals, "a textured light with a normal map over a delta lobe"),
            Row(NORMAL, _places_normals, "a normal map over a delta lobe"),
            Row(PATTERN, _places_light, "a light with a textured radiance"),
            Row(COORDINATES),
        ),
        # Attributes: what a `mesh_attribute` makes of them is told by where that one is.
        ANY_KEY: NUMBER_ROWS,
    },
)
for _curve in ("BSplineCurve", "LinearCurve"):
    declare_effects(_curve, {"control_points": SHAPE})
TURNED_GRID = "; Mitsuba does not draw grids that turn: put the grid into a group and turn an instance of it"
declare_effects(
    "SDFGrid",
    {"grid": replace(SHAPE, trusted=False), "to_world": replace(SHAPE, reason=CORRECT + TURNED_GRID)},
)
for _blobs in ("Ellipsoids", "EllipsoidsMesh"):
    declare_effects(_blobs, {"data": replace(SHAPE, trusted=False)})
CLAMPED = replace(
    SHAPE, trusted=False, reason=f"{CORRECT}; Mitsuba keeps the bounding boxes that the shape was built with"
)
declare_effects("Ellipsoids", {"opacities": (Row(CLAMPED, _is_clamped, "with extent_adaptive_clamping"), Row(VALUE))})

declare_effects("Sensor", dict.fromkeys(SENSOR_KEYS, SENSOR))

# Of an emitter that no shape carries. Projectors and infinitely distant lights are marked as not differentiable.
declare_effects("Emitter", {"to_world": replace(EMITTER, trusted=False), "position": replace(EMITTER, trusted=False)})
declare_effects("PointLight", {"position": EMITTER})
declare_effects("SpotLight", {"to_world": EMITTER})
declare_effects("SunskyEmitter", {"sun_direction": SUN})

declare_effects("BSDF", {"eta": INDEX})
declare_effects("SmoothDielectric", {"eta": _index_by_stand_in("dielectric")})
declare_effects("RoughDielectric", {"eta": _index_by_stand_in("roughdielectric")})
_LOST_INDEX = Row(replace(EXCHANGED_INDEX, stand_in_needed=True), _is_an_index_of_one, "an index of one")
declare_effects("Principled", dict.fromkeys(("eta", "specular"), (_LOST_INDEX, Row(EXCHANGED_INDEX))))
# Nothing is refracted onwards by these: their index changes how much is reflected, and no direction.
declare_effects("ThinDielectric", {"eta": VALUE})
_HAIR_KEYS = ("longitudinal_roughness", "azimuthal_roughness", "scale_tilt", "eta", "eumelanin", "pheomelanin")
declare_effects("Hair", dict.fromkeys(_HAIR_KEYS, FIBRE))
declare_effects("SmoothPlastic", {"eta": VARNISH})
declare_effects("RoughPlastic", {"eta": COATING, "alpha": COATING})

declare_effects("Texture", {ANY_KEY: NUMBER_ROWS})
declare_effects("IrregularSpectrum", {"wavelengths": WAVELENGTHS})
declare_effects("Volume", {ANY_KEY: (WIND, *NUMBER_ROWS)})
declare_effects("PhaseFunction", {ANY_KEY: (IN_EXTINCTION,)})
declare_effects("Medium", {ANY_KEY: MEDIUM})
