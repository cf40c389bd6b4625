"""The one table of parameters: what each parameter of each plugin can move, and whether its derivative is right.

Everything that asks such a question asks it here: which terms of a derivative are computed, which temporal filter is
taken, ``scene.parameters()``, the plan, the page of gradients. How rows are entered and which one counts:
:mod:`.parameter_effect`. Rows of Mitsuba's plugins: :mod:`.mitsuba_parameters`; those of our own stand in their files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import GradientError
from torchtransient.plugins import mitsuba_parameters as mitsuba_parameters
from torchtransient.plugins.mitsuba_compat import (
    NUMBERS,
    PIXELS,
    VERTEX_COLUMNS,
    attribute_name,
    attribute_scale,
    forgets_black_samples,
    is_replaced_for,
    normal_texture,
    users_name,
    weight_slot,
)
from torchtransient.plugins.node_walk import ShownValue, objects_of, owners_of, shown_by, unshared
from torchtransient.plugins.parameter_effect import CORRECT as CORRECT
from torchtransient.plugins.parameter_effect import ParameterEffect as ParameterEffect
from torchtransient.plugins.parameter_effect import Site, class_of, location_of, matching_effect
from torchtransient.plugins.spectral_colours import keeps_coefficients

# ----------------------------------------------------------------------------------------------------------------------
# Textures that are exactly zero where Mitsuba then loses the derivative: inside normal and bump maps, and in lights
# that are sampled by their own brightness.
#
# Mitsuba's maps drop samples whose weight is zero (:func:`.mitsuba_compat.forgets_black_samples`), and a light of which
# all texels are black has no density to sample it by: the derivative by what is black, as far as it is due to the light
# beyond, is lost. A number that leaves no weight to speak of, but is not zero, keeps both.

# Far above the least number of single precision, far below anything that can be seen.
ALMOST_BLACK = 1e-30


class Attached(NamedTuple):
    """Number of a plugin that carries gradients.

    Attributes:
        node, key: plugin, and its name there.
        value: the attached number.
        owners: all objects that hold the plugin, directly or not, as (holder, name there).
        holders: objects that hold it directly.
    """

    node: Any
    key: str
    value: Any
    owners: Sequence[tuple[Any, str]]
    holders: Sequence[tuple[Any, str]]


def loses_black(node: Any, key: str, owners: Sequence[tuple[Any, str]]) -> bool:
    """Return True if the derivative by a plugin's numbers is lost where they are zero.

    Shapes themselves are in no map: the attributes of a mesh are numbers that textures hold.

    Args:
        node, key: plugin, and name of the parameter there.
        owners: all objects that hold the plugin, see :class:`Site`.
    """
    return _is_in_a_map(node, owners) or _is_light(node, key, owners)


def _is_in_a_map(node: Any, owners: Sequence[tuple[Any, str]]) -> bool:
    if not isinstance(node, mi.Texture | mi.Volume | mi.Mesh):
        return False
    return any(forgets_black_samples(holder) and normal_texture(holder) != name for holder, name in owners)


def _is_light(node: Any, key: str, owners: Sequence[tuple[Any, str]]) -> bool:
    if isinstance(node, mi.Emitter):
        return key == PIXELS
    return isinstance(node, mi.Texture) and any(isinstance(holder, mi.Emitter) for holder, _ in owners)


def without_zeros(value: Any) -> Any:
    """Return an array of numbers with :data:`ALMOST_BLACK` in place of zeros.

    Args:
        value: floating-point Dr.Jit array.
    """
    return dr.select(value == 0, ALMOST_BLACK, value)


def check_black(attached: Iterable[Attached]) -> None:
    """Check that no derivative is lost at numbers of zero.

    Args:
        attached: attached parameters of a scene.

    Raises:
        GradientError: if one is, with the parameter's name.
    """
    for one in attached:
        # Paths are handed a part of a mixture: its weight is none of what maps drop.
        only_weighs = bool(one.holders) and all(weight_slot(holder) == name for holder, name in one.holders)
        if _is_in_a_map(one.node, one.owners) and not only_weighs and _zeros(one.value, dr.any):
            where = "inside a normalmap or bumpmap, which drops samples of weight zero and with them the derivative"
        elif _is_light(one.node, one.key, one.owners) and _zeros(one.value, dr.all):
            where = "everywhere in a light, which then has no density to sample it by"
        else:
            continue
        raise GradientError(
            f"{f'{one.node.id()}.{one.key}'.lstrip('.')!r} is zero {where}. Set it to {ALMOST_BLACK:g}, as "
            "tt.TransientRenderer does."
        )


def _zeros(value: Any, how: Any) -> bool:
    """Return True if any or all (``how``: ``dr.any`` or ``dr.all``) of the numbers of a value are zero."""
    if not (dr.is_array_v(value) and dr.is_float_v(value)):
        return False
    with dr.suspend_grad():
        flat = dr.ravel(value)
        return bool(dr.width(flat) and how(flat == 0)[0])


# ----------------------------------------------------------------------------------------------------------------------


def effect_of(node: Any, key: str, flags: int = 0, owners: Sequence[tuple[Any, str]] = ()) -> ParameterEffect:
    """Return the effect of the parameter ``key`` of the plugin ``node``, and whether its derivative is right.

    Args:
        node: plugin that has the parameter.
        key: name in the plugin, as "to_world"; of a dotted name the last part counts.
        flags: Mitsuba's ``ParamFlags`` of the parameter.
        owners: holders of the plugin, as in :class:`Site`; without them a texture or volume is judged by itself alone.
    """
    site = Site(node, key.rsplit(".", 1)[-1], tuple(owners))
    effect = matching_effect(site)
    if flags & int(mi.ParamFlags.ReadOnly):
        return replace(effect, supported=False, reason="read-only in Mitsuba")
    if flags & int(mi.ParamFlags.NonDifferentiable) and not effect.trusted:
        reason = f"Mitsuba marks it as not differentiable ({class_of(node)})"
        return replace(effect, supported=False, reason=reason)
    if effect.reason == CORRECT and keeps_coefficients(node, site.key):
        reason = f"{CORRECT}; the numbers are coefficients of Mitsuba's spectral model, not a colour"
        return replace(effect, reason=reason)
    return effect


def attached_effects(params: Any) -> list[tuple[Any, str, ParameterEffect]]:
    """Return (plugin, key, effect) of the parameters that carry gradients now; to be called with gradients enabled.

    Args:
        params: result of ``mi.traverse``, or a :class:`ParameterTracker`, which spares a walk over the scene.
    """
    if isinstance(params, ParameterTracker):
        return params.attached()
    attached = []
    for name, (handle, cpptype, node, flags) in params.properties.items():
        value = handle if cpptype is None else mi.get_property(handle, cpptype, node)
        if can_carry_gradients(value) and dr.grad_enabled(value):
            attached.append((node, users_name(node, name.rsplit(".", 1)[-1]), flags))
    # A walk of its own: the names in ``params`` tell of one holder of each plugin, and not of what reads an attribute.
    tracker = ParameterTracker.from_params(params) if attached else None
    return [(node, key, tracker.effect_of(node, key, flags)) for node, key, flags in attached]


class ParameterTracker:
    """Parameters below a plugin, walked over once, to be asked repeatedly which of them carry gradients.

    Keeps plugins, never a scene: an integrator may keep the tracker of the scene that owns it. Plugins that join a
    scene later (``shape.set_bsdf``) are not known to it. Values of plugins written in Python and attributes of meshes
    may be replaced by their owners, so those few plugins show them anew each time. In a scene of 774 meshes the walk
    takes 0.09 s (``mi.traverse`` 0.07 s) and each question 7 ms.

    Args:
        root: scene or plugin.
    """

    def __init__(self, root: Any) -> None:
        self._holders: dict[int, list[tuple[Any, str]]] = {}
        # By shape and name: the textures that read an attribute.
        self._readers: dict[tuple[int, str], list[Any]] = {}
        self._fixed: list[tuple[Any, ShownValue]] = []
        self._shown_anew: list[tuple[Any, int]] = []
        self._walk(root)

    @staticmethod
    def from_params(params: Any) -> ParameterTracker:
        """Return the tracker of the plugin that ``mi.traverse`` started at to return ``params``."""
        return ParameterTracker(next(node for node, (holder, *_) in params.hierarchy.items() if holder is None))

    def _walk(self, root: Any) -> None:
        visited = {root.ptr}
        waiting = [(root, 0)]
        readers = []
        while waiting:
            node, inherited = waiting.pop()
            if attribute_name(node) is not None:
                readers.append(node)
            values, objects = shown_by(node)
            is_scene = isinstance(node, mi.Scene)
            if not is_scene:
                self._note(node, values, inherited)
            for name, value, flags in objects:
                if not is_scene:
                    self._holders.setdefault(value.ptr, []).append((node, name))
                if value.ptr not in visited:
                    visited.add(value.ptr)
                    waiting.append((value, inherited | flags))
        for reader in readers:
            self._note_reader(reader, str(attribute_name(reader)))

    def _note_reader(self, reader: Any, name: str) -> None:
        """Record a texture as the holder of the values that it reads off its shapes: a mesh attribute, or a texture."""
        shapes = {holder.ptr: holder for holder, _ in self._owners_of(reader) if isinstance(holder, mi.Shape)}
        for shape in shapes.values():
            self._readers.setdefault((shape.ptr, name), []).append(reader)
            for own, texture in objects_of(shape):
                if own == name:
                    self._holders[texture.ptr].append((reader, name))

    def holders_of(self, node: Any, key: str = "") -> list[tuple[Any, str]]:
        """Return the direct holders of a plugin as (holder, name there).

        Args:
            node: plugin.
            key: attribute of a mesh, whose textures come first; empty for none.
        """
        readers = [(reader, key) for reader in self._readers.get((node.ptr, key), ())]
        return readers + self._holders.get(node.ptr, [])

    def _owners_of(self, node: Any, key: str = "") -> tuple[tuple[Any, str], ...]:
        """Return all holders of the parameter ``key`` of a plugin, as in :class:`Site`."""
        found: list[tuple[Any, str]] = []
        for reader in self._readers.get((node.ptr, key), ()):
            found += [(reader, key), *owners_of(reader, self._holders)]
        return (*found, *owners_of(node, self._holders))

    def _note(self, node: Any, values: list[ShownValue], inherited: int) -> None:
        differentiable = [v for v in values if can_carry_gradients(v.read(node))]
        if any(v.cpptype is None or is_attribute(node, v.key) for v in differentiable):
            self._shown_anew.append((node, inherited))
        else:
            self._fixed += [(node, v._replace(flags=v.flags | inherited)) for v in differentiable]

    def effect_of(self, node: Any, key: str, flags: int = 0) -> ParameterEffect:
        """Return :func:`effect_of` with all that holds the plugin ``node``."""
        return effect_of(node, key, flags, self._owners_of(node, key.rsplit(".", 1)[-1]))

    def replaced_plugins(self, node: Any, key: str) -> list[tuple[Any, str]]:
        """Return the plugins that a stand-in replaces for the derivative by a parameter.

        Args:
            node, key: plugin, and name of the parameter there, which has a ``stand_in``.

        Returns:
            The plugin itself, or the BSDFs that hold a texture, as (plugin, name of the held object).
        """
        if isinstance(node, mi.BSDF):
            return [(node, "")]
        owners = [entry for entry in dict.fromkeys(self._owners_of(node, key)) if isinstance(entry[0], mi.BSDF)]
        return [(holder, name) for holder, name in owners if is_replaced_for(holder, name)]

    def loses_black(self, node: Any, key: str) -> bool:
        """Return True if the derivative by a plugin's numbers is lost where they are zero (:func:`loses_black`)."""
        return loses_black(node, key, self._owners_of(node, key))

    def check_black(self) -> None:
        """Check the parameters that carry gradients (:func:`check_black`)."""
        check_black(
            Attached(node, v.key, value, self._owners_of(node, v.key), self._holders.get(node.ptr, ()))
            for node, v, value in self._carrying()
        )

    def location_of(self, node: Any, key: str) -> tuple[str, ...]:
        """Return the names of a parameter and of everything that it is in (:func:`.parameter_effect.is_checked`)."""
        name = key.rsplit(".", 1)[-1]
        return location_of(Site(node, name, self._owners_of(node, name)))

    def _carrying(self) -> list[tuple[Any, ShownValue, Any]]:
        found = [(node, shown, shown.read(node)) for node, shown in self._fixed]
        for node, inherited in self._shown_anew:
            for shown in shown_by(node)[0]:
                found.append((node, shown._replace(flags=shown.flags | inherited), shown.read(node)))
        return [entry for entry in found if dr.grad_enabled(entry[2])]

    def attached(self) -> list[tuple[Any, str, ParameterEffect]]:
        """Return (plugin, key, effect) of the parameters that carry gradients now."""
        return [
            (node, shown.key, self.effect_of(node, shown.key, shown.flags)) for node, shown, _ in self._carrying()
        ]

    def attached_values(self) -> list[Any]:
        """Return the values of the parameters of :meth:`attached`, in the same order."""
        return [value for _, _, value in self._carrying()]


def can_carry_gradients(value: Any) -> bool:
    """Return True for a floating-point Dr.Jit array or a transform of one, False for a plain number.

    Args:
        value: value of a parameter.
    """
    if "Transform" in type(value).__name__:  # by name: Dr.Jit arrays answer to any attribute made of component letters
        value = value.matrix
    return value is not None and bool(dr.is_diff_v(value) and dr.is_float_v(value))


def is_attribute(node: Any, key: str) -> bool:
    """Return True for an attribute of a mesh, whose memory moves when another attribute is added.

    Args:
        node: plugin that shows the parameter.
        key: name of the parameter, without the path to the plugin.
    """
    return isinstance(node, mi.Mesh) and key.startswith(("vertex_", "face_")) and key not in VERTEX_COLUMNS


# --------------------------------------------------------------------------------------- what has to be there for them


def check_stand_ins(effects: Sequence[tuple[Any, str, ParameterEffect]]) -> None:
    """Check that no attached parameter belongs to a plugin whose derivative is wrong and has a stand-in.

    Args:
        effects: result of :func:`attached_effects`.

    Raises:
        GradientError: if one does, with the name of the stand-in.
    """
    for node, key, effect in effects:
        if effect.stand_in and effect.stand_in_needed:
            raise GradientError(
                f"{f'{node.id()}.{key}'.lstrip('.')!r}: Mitsuba's {node.class_name()} does not have the whole "
                f"derivative of this parameter. Describe the plugin as '{effect.stand_in}', which takes the same "
                "properties; tt.TransientRenderer does so by itself."
            )


def moving_names(effects: Sequence[tuple[Any, str, ParameterEffect]]) -> list[str]:
    """Return the names of parameters that can change a path length, which need a temporal filter with a slope.

    Args:
        effects: result of :func:`attached_effects`.
    """
    named = ((f"{node.id()}.{key}".lstrip("."), effect) for node, key, effect in effects)
    return list(dict.fromkeys(name for name, effect in named if effect.moves_length))


def check_slope(moving: Sequence[str], has_slope: bool, response: str, remedy: str) -> None:
    """Check that the film has a slope, where derivatives pass through the time of flight.

    Args:
        moving: names of the attached parameters that can change a path length.
        has_slope: the film's response over time has a slope.
        response: name of that response: a temporal filter, a kind of gate.
        remedy: sentence that says what to do.

    Raises:
        GradientError: if there is no slope and a length can change.
    """
    if moving and not has_slope:
        raise GradientError(
            f"{', '.join(repr(name) for name in moving)} can change path lengths, and the film's {response!r} has no "
            f"slope: the derivative through the time of flight would be lost. {remedy}"
        )


# ----------------------------------------------------------------------------------------------------------------------
# Parameters that have a range outside of which no physical surface, medium, light or sensor has them.
#

# What single precision makes of the ends of a range.
_SLACK = 1e-5


@dataclass(frozen=True)
class PhysicalRange:
    """Range of a parameter.

    Attributes:
        meaning: the quantity in words, "a roughness".
        low, high: ends of the range.
        is_open: the ends are outside.
    """

    meaning: str
    low: float
    high: float = float("inf")
    is_open: bool = False

    def above(self, number: float) -> bool:
        """Return True if a number is beyond the upper end."""
        return number >= self.high if self.is_open else number > self.high + _SLACK

    def below(self, number: float) -> bool:
        """Return True if a number is beyond the lower end."""
        return number <= self.low if self.is_open else number < self.low - _SLACK


SHARE = PhysicalRange("a share of the light", 0, 1)
WEIGHT = PhysicalRange("a weight", 0, 1)
ROUGHNESS = PhysicalRange("a roughness", 0)
OPTICAL = PhysicalRange("an optical constant of a metal", 0)
INDEX = PhysicalRange("an index of refraction", 0, is_open=True)
EXTINCTION = PhysicalRange("an extinction coefficient", 0)
ANISOTROPY = PhysicalRange("the mean cosine of a phase function", -1, 1, is_open=True)
LIGHT = PhysicalRange("the light of an emitter", 0)
ANGLE = PhysicalRange("an angle of view in degrees", 0, 180, is_open=True)
LENGTH = PhysicalRange("a length", 0)

# Names under which plugins keep such a number, or the texture or volume of them.
_BSDF_RANGES = {
    **dict.fromkeys(
        (
            "reflectance", "transmittance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance",
            "base_color", "opacity", "weight", "quantum_yield", "elastic_fraction",
        ),
        SHARE,
    ),
    **dict.fromkeys(
        (
            "metallic", "spec_trans", "spec_tint", "sheen_tint", "clearcoat", "clearcoat_gloss", "anisotropic",
            "flatness", "share",
        ),
        WEIGHT,
    ),
    **dict.fromkeys(("alpha", "alpha_u", "alpha_v", "roughness"), ROUGHNESS),
    "eta": INDEX,
    "k": OPTICAL,
}  # fmt: skip
_MEDIUM_RANGES = {"albedo": SHARE, "sigma_t": EXTINCTION}
_EMITTER_RANGES = dict.fromkeys(("radiance", "intensity", "irradiance", "energy"), LIGHT)
_SENSOR_RANGES = {"x_fov": ANGLE, "aperture_radius": LENGTH, "focus_distance": LENGTH}

def ranges_of(params: Any) -> dict[str, PhysicalRange]:
    """Return the physical ranges of the parameters that have one.

    The numbers of textures, volumes and attributes of meshes have the range of the parameter that they supply, through
    whatever textures they are read. Coefficients of spectral models have none.

    Args:
        params: ``mi.traverse`` of a scene.

    Returns:
        Ranges by key.
    """
    tracker, found = ParameterTracker.from_params(params), {}
    for key in params.properties:
        limits = list(_ranges_at(tracker, params.properties[key][2], key.rsplit(".", 1)[-1]))
        if limits:  # one that serves for several things: the one with the least room
            found[key] = min(limits, key=lambda one: one.high)
    return found


def _ranges_at(tracker: ParameterTracker, node: Any, name: str) -> Iterator[PhysicalRange]:
    """Return the ranges of a parameter of a plugin."""
    if isinstance(node, mi.Texture | mi.Volume):
        supplies = name in NUMBERS and not keeps_coefficients(node, name)
    else:
        own = _range_in(node, name)
        if own is not None:
            yield own
        supplies = is_attribute(node, name) and not keeps_coefficients(node, name)
    waiting = [(node, name, 1.0)] if supplies else []
    while waiting:
        supplier, attribute, scale = waiting.pop()
        for holder, slot in tracker.holders_of(supplier, attribute):
            if isinstance(holder, mi.Texture | mi.Volume):
                factor = attribute_scale(holder)
                if factor > 0:
                    waiting.append((holder, "", scale * factor))
            elif (limits := _range_in(holder, slot)) is not None:
                yield limits if scale == 1 else replace(limits, low=limits.low / scale, high=limits.high / scale)


def _range_in(node: Any, name: str) -> PhysicalRange | None:
    if isinstance(node, mi.BSDF):
        is_metal = "Conductor" in node.class_name() + type(node).__name__
        return OPTICAL if name == "eta" and is_metal else _BSDF_RANGES.get(name)
    if isinstance(node, mi.PhaseFunction):
        return {"g": ANISOTROPY, "weight": SHARE}.get(name)
    for kind, ranges in ((mi.Medium, _MEDIUM_RANGES), (mi.Emitter, _EMITTER_RANGES), (mi.Sensor, _SENSOR_RANGES)):
        if isinstance(node, kind):
            return ranges.get(name)
    return None


def described_ranges(params: Any) -> Iterator[tuple[str, PhysicalRange, float, float]]:
    """Yield (key, range, smallest, largest number) of the parameters of a scene that have a range.

    Args:
        params: ``mi.traverse`` of the scene.
    """
    for key, limits in ranges_of(params).items():
        numbers = np.array(unshared(params[key]))
        if numbers.size:
            yield key, limits, float(numbers.min()), float(numbers.max())


def sun_axes(params: Any, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the third axis of the sky for each key that is a direction of its sun.

    Args:
        params: ``mi.traverse`` of a scene.
        keys: keys of parameters.

    Returns:
        Unit vectors (3,) in the world by key.
    """
    suns = [key for key in keys if key.endswith(".sun_direction")]
    matrices = {key: params[f"{key.removesuffix('sun_direction')}to_world"].matrix for key in suns}
    return {key: np.array(unshared(matrix), dtype=float).reshape(4, 4)[:3, 2] for key, matrix in matrices.items()}
