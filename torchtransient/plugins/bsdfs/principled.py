"""``diff_principled`` and ``diff_principled_thin``: Mitsuba's ``principled`` and ``principledthin`` with derivatives by
weights of lobes that are exactly zero, or so large that another lobe is.
"""

from __future__ import annotations

from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.ior import opaque
from torchtransient.plugins.mitsuba_compat import LOST_AT
from torchtransient.plugins.mitsuba_parameters import PRINCIPLED_INDEX
from torchtransient.plugins.node_walk import attached_as, carries_derivatives
from torchtransient.plugins.parameter_effect import declare_effects
from torchtransient.plugins.properties import number

# How a weight is read by the BSDF of Mitsuba that is asked.
AS_IT_IS, BESIDE_ITS_END, AWAY_FROM_ITS_END = "as it is", "beside its end", "away from its end"
# Share of the range of a weight by which sampling keeps away from an end: the derivative by a weight is that of a whole
# lobe, however little there is of it, and samples that are as rare as the lobe is faint would be as noisy.
AWAY = 0.25
# From zero, and from larger ends relative to them: the least steps that a comparison notices.
STEP, RELATIVE_STEP = 1e-30, 6e-8

# What stands for an index of one in single precision, at which Mitsuba loses the mirror lobe: 1.001, or what makes it.
ONE = {"eta": (1.0, 1.001), "specular": (0.0, (0.001 / 2.001) ** 2 / 0.08)}

# A base colour of zero, where its root is differentiated.
LEAST_COLOUR = 1e-4


class Reading:
    """Rule for reading the weights: ``how``, and ``away``, the weights kept off their ends in sampling because they
    carry derivatives.
    """

    def __init__(self) -> None:
        self.how = AS_IT_IS
        self.away: set[str] = set()


class Weight(mi.Texture):
    """The weight of a lobe.

    Args:
        slot: name under which the surface holds it.
        texture: texture of the weight.
        ends: the values at which Mitsuba skips that lobe or another one.
        reading: rule for reading the weights of the surface.
    """

    def __init__(self, slot: str, texture: Any, ends: tuple[float, ...], reading: Reading) -> None:
        mi.Texture.__init__(self, mi.Properties())
        self.slot, self.texture, self.ends, self.reading = slot, texture, ends, reading

    def eval_1(self, si: Any, active: Any = True) -> Any:
        value = self.texture.eval_1(si, active)
        how = self.reading.how
        if how == BESIDE_ITS_END:
            for end in self.ends:
                beside = value + STEP if end == 0 else value * (1 - RELATIVE_STEP)
                value = dr.select(value == end, beside, value)
        elif how == AWAY_FROM_ITS_END:
            value = dr.detach(value)
            if self.slot in self.reading.away:
                span = max(1.0, *self.ends)
                for end in self.ends:
                    inside = abs(end - AWAY * span)
                    value = dr.maximum(value, inside) if end == 0 else dr.minimum(value, inside)
        return value

    def eval(self, si: Any, active: Any = True) -> Any:
        return mi.UnpolarizedSpectrum(self.eval_1(si, active))

    def mean(self) -> Any:
        return self.texture.mean()

    def is_spatially_varying(self) -> bool:
        return self.texture.is_spatially_varying()

    def to_string(self) -> str:
        return str(self.texture)


class Colour(mi.Texture):
    """The base colour. Sampling does not depend on it: with another one, samples of weight zero are those that were
    thrown away. Transmission has its root, which gets a finite slope.
    """

    def __init__(self, texture: Any, reading: Reading) -> None:
        mi.Texture.__init__(self, mi.Properties())
        self.texture, self.reading = texture, reading

    def eval(self, si: Any, active: Any = True) -> Any:
        if self.reading.how == AWAY_FROM_ITS_END:
            return mi.UnpolarizedSpectrum(0.5)
        colour = self.texture.eval(si, active)
        return dr.select(colour == 0, colour + LEAST_COLOUR, colour) if self.reading.how == BESIDE_ITS_END else colour

    def mean(self) -> Any:
        return self.texture.mean()

    def is_spatially_varying(self) -> bool:
        return self.texture.is_spatially_varying()

    def to_string(self) -> str:
        return str(self.texture)


def _is_given(props: Any, name: str) -> bool:
    if name not in props:
        return False
    value = props[name]
    return not (isinstance(value, float | int) and value == 0)


class DiffPrincipled(mi.BSDF):
    """Parameters and values of Mitsuba's ``principled``; differentiable in all of its textures and its index.

    Mitsuba skips a lobe of weight zero, its value and its samples. Here it is asked three times: for values with the
    weights as they are, for derivatives with weights that are beside such an end by less than rounding, and for
    samples with weights that keep away from it. The last holds for weights that carry derivatives in a job that asks
    for them (:meth:`follow_derivatives`); all other samples are those of Mitsuba.

    ``lobes``: names of weights, separated by commas, whose lobes are built although they are zero or not given.
    ``sample`` draws a detached direction, its weight is value over density. Sampling rates are fixed when built.
    """

    plugin = "principled"
    kind = "Principled"
    slots: ClassVar[dict[str, float]] = {
        "base_color": 0.5, "roughness": 0.5, "clearcoat": 0.0, "clearcoat_gloss": 0.0, "metallic": 0.0,
        "anisotropic": 0.0, "spec_tint": 0.0, "sheen": 0.0, "sheen_tint": 0.0, "spec_trans": 0.0, "flatness": 0.0,
    }  # fmt: skip
    always = ("base_color", "roughness", "clearcoat_gloss")
    rates = ("main_specular_sampling_rate", "clearcoat_sampling_rate", "diffuse_reflectance_sampling_rate")

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.index, self.index_value, self._handed_on = "", None, (0,)
        self._read_index(props)
        # Mitsuba leaves out what is not given, or given as the number zero, until it is changed.
        self.built = {name for name in self.slots if name in self.always or _is_given(props, name)}
        self.built |= {name for name in str(props.get("lobes", "")).split(",") if name in self.slots}
        self.textures = {name: self._texture(props, name, default) for name, default in self.slots.items()}
        self.fixed = {name: number(props, name, 1.0) for name in self.rates}
        self.reading = Reading()
        self._build()

    @staticmethod
    def _texture(props: Any, name: str, default: float) -> Any:
        return props.get_texture(name, default)

    def _read_index(self, props: Any) -> None:
        # Mitsuba refuses both at once.
        self.index = "eta" if "eta" in props else "specular"
        given = {name: number(props, name) for name in ("eta", "specular") if name in props}
        own = mi.load_dict({"type": self.plugin, **given})
        self.index_value = opaque(mi.Float(mi.traverse(own)[self.index]))

    def _build(self) -> None:
        """Return the BSDF of Mitsuba, with the lobes of ``built``."""
        ends = LOST_AT[self.kind]
        held: dict[str, Any] = {name: self.textures[name] for name in self.built}
        for name in self.built & set(ends):
            held[name] = Weight(name, self.textures[name], ends[name], self.reading)
        held["base_color"] = Colour(self.textures["base_color"], self.reading)
        if self.index:
            held[self.index] = float(dr.slice(dr.detach(self._away_from_one()), 0))
        self.own = mi.load_dict({"type": self.plugin, **self.fixed, **held})
        self.m_components = [self.own.flags(i) for i in range(self.own.component_count())]
        self.m_flags = self.own.flags()

    def traverse(self, cb: Any) -> None:
        for name, texture in self.textures.items():
            edges = mi.ParamFlags.Discontinuous if name in ("roughness", "eta") else 0
            cb.put(name, texture, mi.ParamFlags.Differentiable | edges)
        if self.index:
            cb.put(self.index, self.index_value, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def parameters_changed(self, keys: Any = ()) -> None:
        self._have_built(set(keys) & set(self.slots))
        self._hand_index_on()
        self.follow_derivatives(True)

    def follow_derivatives(self, asked: bool) -> None:
        """Look which parameters carry derivatives now; to be asked with gradients enabled and before a job. ``asked``:
        it is one of derivatives.

        Mitsuba tells only one of the plugins that share a texture of its changes, and none when derivatives are
        switched on in place.
        """
        attached = {name for name, texture in self.textures.items() if asked and carries_derivatives(texture)}
        self.reading.away = attached & set(LOST_AT[self.kind])
        rebuilt = self._have_built(attached)
        if self.index and (rebuilt or self._handed_on != attached_as(self.index_value)):
            self._hand_index_on()

    def _have_built(self, names: set[str]) -> bool:
        """Build the BSDF of Mitsuba anew if it lacks the lobes of these weights; whether it did."""
        if names <= self.built:
            return False
        self.built |= names
        self._build()
        return True

    def _hand_index_on(self) -> None:
        if not self.index:
            return
        self._handed_on = attached_as(opaque(self.index_value))
        params = mi.traverse(self.own)
        params[self.index] = self._away_from_one()
        params.update()

    def _away_from_one(self) -> Any:
        """Return the index for Mitsuba, moved off one, with the derivative."""
        one, instead = ONE[self.index]
        value = self.index_value
        return dr.select(dr.abs(value - one) < 1e-12, value + (instead - one), value)

    # ------------------------------------------------------------------------------------------- as it is read

    def _call(self, how: str, method: str, *arguments: Any) -> Any:
        self.reading.how = how
        try:
            return getattr(self.own, method)(*arguments)
        finally:
            self.reading.how = AS_IT_IS

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        with dr.suspend_grad():
            value = self._call(AS_IT_IS, "eval", ctx, si, wo, active)
        return dr.replace_grad(value, self._call(BESIDE_ITS_END, "eval", ctx, si, wo, active))

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self._call(AWAY_FROM_ITS_END, "pdf", ctx, si, wo, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs, weight = self._call(AWAY_FROM_ITS_END, "sample", ctx, si, sample1, sample2, active)
        # Samples that Mitsuba throws away have a density all the same.
        kept = mi.Mask(active) & (bs.pdf > 0) & (dr.max(mi.unpolarized_spectrum(weight)) > 0)
        bs = dr.detach(bs)
        bs.pdf = dr.select(kept, bs.pdf, 0)
        value = self.eval(ctx, si, bs.wo, kept)
        return bs, dr.select(kept, value * dr.select(kept, dr.rcp(bs.pdf), 0), 0)

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        return self.textures["base_color"].eval(si, active)

    def to_string(self) -> str:
        return f"{type(self).__name__}[\n  {self.own}\n]"


class DiffPrincipledThin(DiffPrincipled):
    """Parameters and values of Mitsuba's ``principledthin``, as :class:`DiffPrincipled`."""

    plugin = "principledthin"
    kind = "PrincipledThin"
    slots: ClassVar[dict[str, float]] = {
        "eta": 1.5, "roughness": 0.5, "diff_trans": 0.0, "base_color": 0.5, "anisotropic": 0.0, "spec_tint": 0.0,
        "sheen": 0.0, "sheen_tint": 0.0, "spec_trans": 0.0, "flatness": 0.0,
    }  # fmt: skip
    always = ("eta", "base_color", "roughness")
    rates = (
        "specular_reflectance_sampling_rate", "specular_transmittance_sampling_rate",
        "diffuse_transmittance_sampling_rate", "diffuse_reflectance_sampling_rate",
    )  # fmt: skip

    def _read_index(self, props: Any) -> None:
        """Read the index; that of a thin sheet is a texture."""

    @staticmethod
    def _texture(props: Any, name: str, default: float) -> Any:
        return props.get_unbounded_texture(name, default) if name == "eta" else props.get_texture(name, default)


register("bsdf", "diff_principled", DiffPrincipled)
register("bsdf", "diff_principled_thin", DiffPrincipledThin)
declare_effects(DiffPrincipled, {"eta": PRINCIPLED_INDEX, "specular": PRINCIPLED_INDEX})
