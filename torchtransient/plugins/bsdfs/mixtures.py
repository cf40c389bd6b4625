"""Mixtures (``mask``, ``blendbsdf``, ``blendphase``): a path chooses one part of them and sees that part alone.

Mitsuba samples such a mixture as a whole. Where a part has a delta lobe or lets light through that goes wrong: a blend
divides by a sum of densities that is not that of its samples
(:func:`~torchtransient.plugins.mitsuba_compat.adds_up_wrongly`), and the
derivative of the probability with which a part was chosen is lost. Here the choice is made outside of the BSDFs'
methods, as between delayed and prompt light (:mod:`.delay_table`): the path is handed the pointer of a part and
the factor ``weight / probability``, of which the weight is attached and the probability is not.

Which mixtures are taken apart: blends of delta lobes, of what lets light through, and of what works on different sides
of a surface always; for derivatives also those around a BSDF that hides the probability of its lobes. Where the weight
itself has a derivative and is zero, one or almost, the part that would never or hardly be chosen is, at times: the
slope there is not less than elsewhere. All other mixtures are left to Mitsuba, whose sum over the parts has less noise;
so are those inside a plugin that cannot be rebuilt around a part (one of others), unless they would have to be taken
apart, which is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import GradientError, SceneError
from torchtransient.plugins.described_scene import numbers_below
from torchtransient.plugins.kernel_arrays import PointerTable, host_numbers, registry_number
from torchtransient.plugins.mitsuba_compat import (
    HIDDEN_FLAGS,
    adds_up_wrongly,
    cancels_lobe_probability,
    is_two_sided_itself,
    normal_texture,
    weight_slot,
)
from torchtransient.plugins.node_walk import bsdfs_below, objects_below, objects_of, shown_by
from torchtransient.plugins.parameter_effect import class_of

# ----------------------------------------------------------------------------------------------------------------------
# Mistakes of nested BSDFs that remain in the BSDFs around them, recognised by the classes of all BSDFs that a plugin
# shows. Other plugins declare them by an attribute with the name of the function here, True or False, which counts for
# all BSDFs below as well.


def hides_lobe_probability(bsdf: Any) -> bool:
    """Return True if the weight of a delta lobe lacks the derivative of the lobe's probability, to be put back.

    Of a mixture (mask, blend) it is asked for each part, since a part's probability hides its weight as well.

    Args:
        bsdf: one ``mi.BSDF``, asked with all that it holds.
    """
    return _has(bsdf, "hides_lobe_probability", cancels_lobe_probability, lambda node: weight_slot(node) is not None)


def mirrors_matrices(bsdf: Any) -> bool:
    """Return True if a BSDF is ``twosided`` or holds one (in a mask, in a blend).

    From behind, Mitsuba's ``twosided`` evaluates its nested BSDF for the mirror images of the directions, and returns
    its Mueller matrix as if it belonged to the directions themselves: turned, and with the hands of circular light
    exchanged.

    Args:
        bsdf: one ``mi.BSDF``.
    """
    return _has(bsdf, "mirrors_matrices", is_two_sided_itself, lambda node: False)


def _has(bsdf: Any, attribute: str, itself: Callable[[Any], bool], ends: Callable[[Any], bool]) -> bool:
    """Return the ``attribute`` that ``bsdf`` declares, else whether it or a BSDF below satisfies ``itself``; the search
    stops at BSDFs that satisfy ``ends``.
    """
    declared = getattr(bsdf, attribute, None)
    if declared is not None:
        return bool(declared)
    if ends(bsdf):
        return False
    return itself(bsdf) or any(_has(part, attribute, itself, ends) for part in bsdfs_below(bsdf))


# ----------------------------------------------------------------------------------------------------------------------
# Copies of BSDFs that hold one other (two-sided, bump and normal maps), around another nested one.


def _can_be_rebuilt(wrapper: Any) -> bool:
    """Return True if a BSDF is one that :func:`_rebuild_wrapper` knows."""
    return is_two_sided_itself(wrapper) or normal_texture(wrapper) is not None


def _rebuild_wrapper(wrapper: Any, nested: Any, flags: dict[str, bool]) -> Any:
    """Wrap ``nested`` as ``wrapper`` (two-sided, bump or normal map) wraps its own nested BSDF. Shares
    the textures. ``flags``: see :func:`_flags_of`.
    """
    slot = normal_texture(wrapper)
    if slot is None:
        return mi.load_dict({"type": "twosided", "allow_transmission": True, "nested": nested})
    plain = {shown.key: shown.read(wrapper) for shown in shown_by(wrapper)[0]}
    texture = dict(objects_of(wrapper))[slot]
    return mi.load_dict({"type": wrapper.class_name().lower(), slot: texture, **plain, **flags, "nested": nested})


def _flags_of(wrapper: Any) -> dict[str, bool]:
    """Properties of a bump or normal map that a built one does not show.

    They are found out from its samples, with values of textures for which all choices differ: not with the present
    ones, since a map that is flat or a surface that is black now may be changed.
    """
    if normal_texture(wrapper) is None:
        return {}
    own = next(value for _, value in objects_of(wrapper) if isinstance(value, mi.BSDF))
    with _telling_values(wrapper):
        reference = _samples_of(wrapper)
        for number in reversed(range(2 ** len(HIDDEN_FLAGS))):
            flags = {name: bool(number >> place & 1) for place, name in enumerate(HIDDEN_FLAGS)}
            if _samples_of(_rebuild_wrapper(wrapper, own, flags)) == reference:
                return flags
    raise SceneError(
        f"{wrapper.class_name()} '{wrapper.id()}': expected one that samples as those of Mitsuba with some choice of "
        f"{', '.join(HIDDEN_FLAGS)}, got other samples. Put it into the parts of the mixture that it holds."
    )


@contextmanager
def _telling_values(wrapper: Any) -> Iterator[None]:
    """Put random numbers in all textures below a BSDF, and a scale that is not zero, within the context."""
    rng, before = np.random.default_rng(0), []
    try:
        with dr.resume_grad():
            for node in (wrapper, *objects_below(wrapper, mi.Texture)):
                params = mi.traverse(node)
                for key in {"value", "data", "scale"} & set(params.keys()):
                    value = params[key]
                    before.append((params, key, type(value)(value)))
                    params[key] = _random(value, rng)
                params.update()
        yield
    finally:
        with dr.resume_grad():
            for params, key, value in before:
                params[key] = value
                params.update()


def _random(value: Any, rng: np.random.Generator) -> Any:
    """Numbers between 0.6 and 1 (of the range of whole ones) of the shape of a parameter."""
    numbers = host_numbers(value, None)
    drawn = rng.uniform(0.6, 1.0, numbers.shape)
    if np.issubdtype(numbers.dtype, np.integer):
        drawn = drawn * np.iinfo(numbers.dtype).max
    return type(value)(drawn.astype(numbers.dtype) if dr.is_array_v(value) else float(drawn))


def _samples_of(bsdf: Any) -> list[bytes]:
    """Directions and weights that a BSDF draws from many sides at many places."""
    rng = mi.PCG32(size=4096)
    u = [rng.next_float32() for _ in range(7)]
    si = dr.zeros(mi.SurfaceInteraction3f, 4096)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.uv = mi.Point2f(u[0], u[1])
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(u[2], u[3]))
    si.wavelengths = mi.sample_rgb_spectrum(mi.sample_shifted(u[4]))[0] if mi.is_spectral else []
    with dr.suspend_grad():
        bs, weight = bsdf.sample(mi.BSDFContext(), si, u[4], mi.Point2f(u[5], u[6]))
        return [np.array(bs.wo).tobytes(), np.array(mi.unpolarized_spectrum(weight)).tobytes()]


# ----------------------------------------------------------------------------------------------------------------------

# Probability of a part of less weight, where the derivative by the weight is asked for and the mixture is taken apart.
LEAST_PROBABILITY = 0.25
# Mixtures are taken apart for it where a part has less weight than this. The derivative is that of a whole part, and in
# Mitsuba's sum its standard deviation grows by the root of one over the weight; above, the sum has less noise.
FAINT = 0.05


@dataclass(frozen=True)
class Leaf:
    """Part of a mixture; ``index`` among its parts."""

    index: int


@dataclass(frozen=True)
class Choice:
    """Choice of ``second`` with the weight of ``texture``, of ``first`` with the rest."""

    texture: Any
    first: Any
    second: Any


@dataclass(frozen=True)
class Sides:
    """A two-sided BSDF with different faces."""

    front: Any
    back: Any


class Mixture:
    """The parts of one BSDF or phase function of a scene.

    Args:
        node: the BSDF or phase function.
        kind: ``mi.BSDF`` or ``mi.PhaseFunction``.
        shapes: shapes that weights may be attributes of.

    Attributes:
        always: it is taken apart in renders, too.
        for_derivatives: it is taken apart where there are derivatives.
        parts: BSDFs or phase functions that it is taken apart into.
        textures: textures of the weights.
    """

    def __init__(self, node: Any, kind: type, shapes: Sequence[Any]) -> None:
        self.node, self._kind, self._shapes = node, kind, shapes
        self.parts: list[Any] = []
        self.textures: list[Any] = []
        # (the wrapper of the scene, the one around a part), whose plain numbers have to be kept equal
        self.wrapped: list[tuple[Any, Any]] = []
        self._flags: dict[int, dict[str, bool]] = {}
        self._null: Any = None
        self.tree = self._tree_of(node, ())
        self.always = any(map(_needs_choice, [node, *objects_below(node, kind)]))
        self.for_derivatives = self.always or any(hides_lobe_probability(part) for part in self.parts)

    def _tree_of(self, node: Any, wrappers: tuple[Any, ...]) -> Any:
        slot = weight_slot(node)
        nested = [value for _, value in objects_of(node) if isinstance(value, self._kind)]
        if slot is not None:
            texture = dict(objects_of(node))[slot]
            self.textures.append(texture)
            if len(nested) == 1:  # a mask: the rest passes straight through
                self._null = self._null or mi.load_dict({"type": "null"})
                nested = [self._null, *nested]
            first, second = (self._tree_of(part, wrappers) for part in nested)
            return Choice(texture, first, second)
        if not _is_mixture(node):
            return self._leaf(node, wrappers)
        trees = [self._tree_of(part, (*wrappers, node)) for part in nested]
        return trees[0] if len(trees) == 1 else Sides(*trees)

    def _leaf(self, node: Any, wrappers: tuple[Any, ...]) -> Leaf:
        for wrapper in reversed(wrappers):
            if wrapper.ptr not in self._flags:
                self._flags[wrapper.ptr] = _flags_of(wrapper)
            node = _rebuild_wrapper(wrapper, node, self._flags[wrapper.ptr])
            self.wrapped.append((wrapper, node))
        self.parts.append(node)
        return Leaf(len(self.parts) - 1)

    def follow(self) -> None:
        """Hand changed numbers of the scene's wrappers on to those around parts."""
        for original, copy in self.wrapped:
            now, before = ({shown.key: shown.read(node) for shown in shown_by(node)[0]} for node in (original, copy))
            plain = {key: value for key, value in now.items() if isinstance(value, float) and value != before[key]}
            if plain:
                params = mi.traverse(copy)
                for key, value in plain.items():
                    params[key] = value
                params.update()

    def taken_apart(self, derivatives: bool) -> tuple[bool, bool]:
        """Return (everywhere, where a weight is about 0 or 1)."""
        return self.for_derivatives if derivatives else self.always, derivatives and self._has_derivative()

    def _has_derivative(self) -> bool:
        """Return True if one of the weights carries derivatives; call with gradients enabled."""
        numbers = (value for texture in self.textures for value in numbers_below(texture, self._shapes))
        return any(map(dr.grad_enabled, numbers))


class Seal:
    """A plugin that holds mixtures and cannot be rebuilt around their parts: they are left to Mitsuba.

    Raises SceneError where Mitsuba's values of them are wrong.
    """

    def __init__(self, node: Any, kind: type, shapes: Sequence[Any]) -> None:
        self.node, held, self._shapes = node, objects_below(node, kind), shapes
        self._mixtures = [part for part in held if weight_slot(part) is not None]
        for part in self._mixtures:
            if _needs_choice(part):
                raise SceneError(
                    f"{self._names(part)}. Mitsuba samples a blend wrongly of which a part has a delta lobe or lets "
                    f"light through, or works on other sides than another. {self._REMEDY}"
                )
        # A declared value counts without a look at the parts.
        silent = getattr(node, "hides_lobe_probability", None) is None
        self._hides = silent and any(hides_lobe_probability(part) for part in held)

    _REMEDY = (
        "Expected such mixtures outermost, or inside mask, blendbsdf, twosided, bumpmap and normalmap: put the other "
        "plugin into the parts of the mixture."
    )

    def _names(self, mixture: Any) -> str:
        return f"{type(self.node).__name__} '{self.node.id()}' holds {class_of(mixture)} '{mixture.id()}'"

    def check(self, wanted: Any) -> None:
        """Raise GradientError where derivatives need the mixture taken apart; asked with gradients enabled."""
        parts = (value for mixture in self._mixtures for value in numbers_below(mixture, self._shapes))
        if self._hides and (wanted.geometry or any(map(dr.grad_enabled, parts))):
            raise GradientError(
                f"{self._names(self._mixtures[0])}, and a delta lobe in it hides the derivative of its probability. "
                f"{self._REMEDY}"
            )
        for mixture in self._mixtures:
            texture = dict(objects_of(mixture))[weight_slot(mixture)]
            values = numbers_below(texture, self._shapes)
            weights = (host_numbers(value, None) for value in values if dr.grad_enabled(value))
            if any(((weight <= 0) | (weight >= 1)).any() for weight in weights):
                raise GradientError(
                    f"{self._names(mixture)}, whose weight is exactly 0 or 1, where the derivative by it is lost. "
                    f"Start beside that value. {self._REMEDY}"
                )


def _needs_choice(node: Any) -> bool:
    """Return True if a mixture has wrong values where Mitsuba samples it as a whole."""
    held = [part for _, part in objects_of(node) if isinstance(part, mi.BSDF)]
    return adds_up_wrongly(node, held, objects_below(node, mi.BSDF))


def _is_mixture(node: Any) -> bool:
    """Return True if a BSDF or phase function is a mixture, or one that can be rebuilt around the parts of a
    nested one.
    """
    if weight_slot(node) is not None:
        return True
    return _can_be_rebuilt(node) and any(_is_mixture(part) for part in bsdfs_below(node))


def _seals_of(node: Any, kind: type, shapes: Sequence[Any]) -> list[Seal]:
    """Return the seals of a BSDF or phase function and all that it holds."""
    others = (part for part in (node, *objects_below(node, kind)) if weight_slot(part) is None)
    return [
        Seal(part, kind, shapes)
        for part in others
        if not _can_be_rebuilt(part) and any(weight_slot(below) is not None for below in objects_below(part, kind))
    ]


class Mixtures:
    """Mixtures of a scene, as far as they do not change with their parameters."""

    def __init__(self, mixtures: list[Mixture], seals: list[Seal]) -> None:
        self.mixtures, self._seals = {mixture.node.ptr: mixture for mixture in mixtures}, seals
        firsts, numbers = [], []
        for mixture in mixtures:
            firsts.append(len(numbers))
            numbers += [registry_number(part) for part in mixture.parts]
        self._first = PointerTable([mixture.node for mixture in mixtures], firsts)
        self._numbers = mi.UInt32(numbers)
        dr.make_opaque(self._numbers)

    def read(self, wanted: Any) -> MixtureChoice | None:
        """Return the mixtures that a job takes apart, None for none.

        Args:
            wanted: :class:`~..transport.context.Wanted` of the derivatives of the job, None for renders.

        Raises:
            GradientError: for a derivative that needs a mixture taken apart which cannot be.
        """
        for mixture in self.mixtures.values():
            mixture.follow()
        with dr.resume_grad():
            for seal in self._seals if wanted is not None else ():
                seal.check(wanted)
            chosen = {ptr: mixture.taken_apart(wanted is not None) for ptr, mixture in self.mixtures.items()}
        chosen = {ptr: how for ptr, how in chosen.items() if any(how)}
        return MixtureChoice(self, chosen) if chosen else None

    def number(self, pointer: Any, index: Any, active: Any) -> Any:
        """Return the numbers of parts in Dr.Jit's registry, UInt32.

        Args:
            pointer: pointers to mixtures.
            index: number of the part among those of its mixture, UInt32.
            active: mask of lanes.
        """
        at = self._first.look_up(pointer, active) + index
        return dr.gather(mi.UInt32, self._numbers, at, active)


class MixtureChoice:
    """The mixtures that one job takes apart.

    Args:
        mixtures: mixtures of the scene.
        chosen: how each mixture is taken apart, by its address: a pair of truth values, everywhere and where a weight
            is about 0 or 1.

    Not a dataclass on purpose: Dr.Jit loops would take it apart as loop state.
    """

    def __init__(self, mixtures: Mixtures, chosen: dict[int, tuple[bool, bool]]) -> None:
        self._of, self._chosen = mixtures, chosen

    def take_part(self, sample: Any, si: Any, u: Any, active: Any) -> None:
        """Change a sample of BSDFs to one part of its mixtures.

        Args:
            sample: :class:`.delay_table.DelaySample`, which is changed.
            si: SurfaceInteraction3f.
            u: uniform number that chooses.
            active: mask of lanes.
        """
        sample.bsdf, weight = self.part_of(sample.bsdf, si, u, active)
        sample.weight = weight if sample.weight is None else sample.weight * weight

    def part_of(self, pointer: Any, interaction: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """Choose one part of mixtures.

        Args:
            pointer: BSDFPtr or PhaseFunctionPtr; others than mixtures stay.
            interaction: SurfaceInteraction3f or MediumInteraction3f.
            u: uniform number that chooses.
            active: mask of lanes.

        Returns:
            (pointer to the part, its weight over its probability; the weight is attached, the probability is not).
        """
        kind = type(pointer)
        pointer_or_none = dr.select(active, pointer, dr.zeros(kind))
        index, weight, apart = dr.dispatch(pointer_or_none, self._choose, interaction, u, active)
        apart &= active
        number = dr.select(apart, self._of.number(pointer, index, apart), dr.reinterpret_array(mi.UInt32, pointer))
        return dr.reinterpret_array(kind, number), dr.select(apart, weight, 1)

    def _choose(self, node: Any, interaction: Any, u: Any, active: Any) -> tuple[Any, Any, Any]:
        """Return (number of a part, its weight over its probability, whether it takes the place of ``node``)."""
        everywhere, at_ends = self._chosen.get(node.ptr, (False, False))
        if not (everywhere or at_ends):
            return mi.UInt32(0), mi.Float(1), mi.Bool(False)
        index, weight, end = _descend(self._of.mixtures[node.ptr].tree, interaction, u, active, at_ends)
        return index, weight, mi.Bool(True) if everywhere else end


def _descend(tree: Any, interaction: Any, u: Any, active: Any, at_ends: bool) -> tuple[Any, Any, Any]:
    """Return (number of a part, its weight over its probability, whether a weight on the way or beside it is about 0 or
    1).
    """
    if isinstance(tree, Leaf):
        return mi.UInt32(tree.index), mi.Float(1), mi.Bool(False)
    if isinstance(tree, Sides):
        front = interaction.wi.z > 0
        a, b = (_descend(side, interaction, u, active, at_ends) for side in (tree.front, tree.back))
        return tuple(dr.select(front, x, y) for x, y in zip(a, b, strict=True))
    w = tree.texture.eval_1(interaction, active)
    # Its ends keep their derivative.
    w = dr.select(w < 0, 0, dr.select(w > 1, 1, w))
    p, end = dr.detach(w), mi.Bool(False)
    if at_ends:
        end = (p < FAINT) | (p > 1 - FAINT)
        p = dr.clip(p, LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)
    second = u < p
    chance = dr.select(second, p, 1 - p)
    u = dr.select(second, u, u - p) / dr.select(chance > 0, chance, 1)
    a, b = (_descend(part, interaction, u, active, at_ends) for part in (tree.first, tree.second))
    index, weight, below = (dr.select(second, y, x) for x, y in zip(a, b, strict=True))
    weight *= dr.select(second, w, 1 - w) / dr.select(chance > 0, chance, 1)
    return index, weight, end | a[2] | b[2] if at_ends else below


def mixtures_of(nodes: list[Any], kind: type, shapes: Sequence[Any] = ()) -> tuple[list[Any], Mixtures | None]:
    """Return the BSDFs or phase functions that paths can meet, and the mixtures among them.

    Args:
        nodes: outermost BSDFs or phase functions of a scene.
        kind: their type, ``mi.BSDF`` or ``mi.PhaseFunction``.
        shapes: shapes that weights may be attributes of.

    Returns:
        (nodes: a mixture that is always taken apart is replaced by its parts, the parts of others join it; mixtures,
            None
        if there are none).
    """
    met: list[Any] = []
    mixtures: list[Mixture] = []
    seals: list[Seal] = []
    for node in nodes:
        seals += _seals_of(node, kind, shapes)
        if not _is_mixture(node):
            met.append(node)
            continue
        mixture = Mixture(node, kind, shapes)
        mixtures.append(mixture)
        met += mixture.parts if mixture.always else [node, *mixture.parts]
    return met, Mixtures(mixtures, seals) if mixtures or seals else None
