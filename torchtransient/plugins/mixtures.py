"""Mixtures (``mask``, ``blendbsdf``, ``blendphase``): a path chooses one part of them and sees that part alone.

Mitsuba samples such a mixture as a whole. Where a part has a delta lobe or lets light through that goes wrong: a blend
divides by a sum of densities that is not that of its samples (:func:`.mitsuba_compat.adds_up_wrongly`), and the
derivative of the probability with which a part was chosen is lost. Here the choice is made outside of the BSDFs'
methods, as between delayed and prompt light (:mod:`.bsdfs.delay_table`): the path is handed the pointer of a part and
the factor ``weight / probability``, of which the weight is attached and the probability is not.

Which mixtures are taken apart: blends of delta lobes, of what lets light through, and of what works on different sides
of a surface always; for derivatives also those around a BSDF that hides the probability of its lobes. Where the weight
itself has a derivative and is zero, one or almost, the part that would never or hardly be chosen is, at times: the
slope there is not less than elsewhere. All other mixtures are left to Mitsuba, whose sum over the parts has less noise;
so are those inside a plugin that cannot be rebuilt around a part (one of others), unless they would have to be taken
apart, which is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError, SceneError
from torchtransient.plugins.bsdfs.inherited import hides_lobe_probability
from torchtransient.plugins.bsdfs.wrapper_copy import can_be_rebuilt, flags_of, rebuild_wrapper
from torchtransient.plugins.host_numbers import host_numbers
from torchtransient.plugins.mitsuba_compat import adds_up_wrongly, weight_slot
from torchtransient.plugins.node_walk import bsdfs_below, objects_below, objects_of, shown_by
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.pointer_table import PointerTable, registry_number
from torchtransient.plugins.texture_uses import numbers_below

# Probability of a part of less weight, where the derivative by the weight is asked for and the mixture is taken apart.
LEAST_PROBABILITY = 0.25
# Mixtures are taken apart for it where a part has less weight than this. The derivative is that of a whole part, and in
# Mitsuba's sum its standard deviation grows by the root of one over the weight; above, the sum has less noise.
FAINT = 0.05


@dataclass(frozen=True)
class Leaf:
    """A part; ``index`` among those of its mixture."""

    index: int


@dataclass(frozen=True)
class Choice:
    """``second`` with the weight that ``texture`` has, ``first`` with the rest."""

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

    ``always``: it is taken apart in renders, too. ``for_derivatives``: it is taken apart where there are derivatives.
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
        self.always = any(map(needs_choice, [node, *objects_below(node, kind)]))
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
        if not is_mixture(node):
            return self._leaf(node, wrappers)
        trees = [self._tree_of(part, (*wrappers, node)) for part in nested]
        return trees[0] if len(trees) == 1 else Sides(*trees)

    def _leaf(self, node: Any, wrappers: tuple[Any, ...]) -> Leaf:
        for wrapper in reversed(wrappers):
            if wrapper.ptr not in self._flags:
                self._flags[wrapper.ptr] = flags_of(wrapper)
            node = rebuild_wrapper(wrapper, node, self._flags[wrapper.ptr])
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
        """(everywhere, where a weight is about 0 or 1)."""
        return self.for_derivatives if derivatives else self.always, derivatives and self._has_derivative()

    def _has_derivative(self) -> bool:
        """Whether one of its weights carries derivatives; asked with gradients enabled."""
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
            if needs_choice(part):
                raise SceneError(
                    f"{self._names(part)}. Mitsuba samples a blend wrongly of which a part has a delta lobe or lets "
                    f"light through, or works on other sides than another. {self._REMEDY}"
                )
        # One that says what its weights hide is taken at its word.
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


def needs_choice(node: Any) -> bool:
    """Whether a mixture has wrong values where Mitsuba samples it as a whole."""
    held = [part for _, part in objects_of(node) if isinstance(part, mi.BSDF)]
    return adds_up_wrongly(node, held, objects_below(node, mi.BSDF))


def is_mixture(node: Any) -> bool:
    """Whether a BSDF or phase function is a mixture, or one that can be rebuilt around the parts of what it holds."""
    if weight_slot(node) is not None:
        return True
    return can_be_rebuilt(node) and any(is_mixture(part) for part in bsdfs_below(node))


def seals_of(node: Any, kind: type, shapes: Sequence[Any]) -> list[Seal]:
    """Of a BSDF or phase function and all that it holds."""
    others = (part for part in (node, *objects_below(node, kind)) if weight_slot(part) is None)
    return [
        Seal(part, kind, shapes)
        for part in others
        if not can_be_rebuilt(part) and any(weight_slot(below) is not None for below in objects_below(part, kind))
    ]


class Mixtures:
    """The mixtures of a scene: what of them does not change with their parameters."""

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
        """Which of them are taken apart in a job, None for none; ``wanted``: the derivatives of the job, or None."""
        for mixture in self.mixtures.values():
            mixture.follow()
        with dr.resume_grad():
            for seal in self._seals if wanted is not None else ():
                seal.check(wanted)
            chosen = {ptr: mixture.taken_apart(wanted is not None) for ptr, mixture in self.mixtures.items()}
        chosen = {ptr: how for ptr, how in chosen.items() if any(how)}
        return MixtureChoice(self, chosen) if chosen else None

    def number(self, pointer: Any, index: Any, active: Any) -> Any:
        """Number in Dr.Jit's registry of the part ``index`` of what ``pointer`` points to."""
        at = self._first.look_up(pointer, active) + index
        return dr.gather(mi.UInt32, self._numbers, at, active)


class MixtureChoice:
    """Takes mixtures apart in one job. Not a dataclass on purpose: Dr.Jit loops would take it apart as loop state.

    ``chosen``: by address of a mixture, (it is taken apart everywhere, it is where a weight is about 0 or 1).
    """

    def __init__(self, mixtures: Mixtures, chosen: dict[int, tuple[bool, bool]]) -> None:
        self._of, self._chosen = mixtures, chosen

    def take_part(self, sample: Any, si: Any, u: Any, active: Any) -> None:
        """Change ``sample`` (a :class:`.bsdfs.delay_table.DelaySample`) to one part, chosen by the uniform number
        ``u``.
        """
        sample.bsdf, weight = self.part_of(sample.bsdf, si, u, active)
        sample.weight = weight if sample.weight is None else sample.weight * weight

    def part_of(self, pointer: Any, interaction: Any, u: Any, active: Any) -> tuple[Any, Any]:
        """(pointer to one part of what ``pointer`` points to, its weight over its probability)."""
        kind = type(pointer)
        pointer_or_none = dr.select(active, pointer, dr.zeros(kind))
        index, weight, apart = dr.dispatch(pointer_or_none, self._choose, interaction, u, active)
        apart &= active
        number = dr.select(apart, self._of.number(pointer, index, apart), dr.reinterpret_array(mi.UInt32, pointer))
        return dr.reinterpret_array(kind, number), dr.select(apart, weight, 1)

    def _choose(self, node: Any, interaction: Any, u: Any, active: Any) -> tuple[Any, Any, Any]:
        """(number of a part, its weight over its probability, whether it takes the place of ``node``)."""
        everywhere, at_ends = self._chosen.get(node.ptr, (False, False))
        if not (everywhere or at_ends):
            return mi.UInt32(0), mi.Float(1), mi.Bool(False)
        index, weight, end = _descend(self._of.mixtures[node.ptr].tree, interaction, u, active, at_ends)
        return index, weight, mi.Bool(True) if everywhere else end


def _descend(tree: Any, interaction: Any, u: Any, active: Any, at_ends: bool) -> tuple[Any, Any, Any]:
    """(number of a part, its weight over its probability, whether a weight on the way or beside it is about 0 or 1)."""
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
    """(BSDFs or phase functions that paths can meet, the mixtures among them or None): a mixture that is always taken
    apart is replaced by its parts, the parts of others join it. ``shapes``: those that weights may be attributes of.
    """
    met: list[Any] = []
    mixtures: list[Mixture] = []
    seals: list[Seal] = []
    for node in nodes:
        seals += seals_of(node, kind, shapes)
        if not is_mixture(node):
            met.append(node)
            continue
        mixture = Mixture(node, kind, shapes)
        mixtures.append(mixture)
        met += mixture.parts if mixture.always else [node, *mixture.parts]
    return met, Mixtures(mixtures, seals) if mixtures or seals else None
