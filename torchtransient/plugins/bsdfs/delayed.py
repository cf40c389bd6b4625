"""``delayed``: a surface that keeps light for a while before it gives it back (fluorescence, phosphorescence)."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs import delay_table
from torchtransient.plugins.bsdfs.delay_table import SpectralShift
from torchtransient.plugins.bsdfs.ior import opaque
from torchtransient.plugins.films.temporal_filters import numbers_of
from torchtransient.plugins.parameter_effect import VALUE, ParameterEffect, declare_effects
from torchtransient.plugins.properties import number
from torchtransient.pulses import Pulse
from torchtransient.units import SPEED_OF_LIGHT


class DelayedBSDF(mi.BSDF):
    """Nested BSDF with delayed scattering, beside one that scatters at once (:monosp:`delayed`).

    The light that the nested BSDF scatters is held for a random time and multiplied by the quantum yield:
    ``f(t) = f_elastic delta(t) + quantum_yield f_nested p(t)`` with the density ``p`` of the delay.

    nested BSDF
        Direction and colour of the delayed light.
    ``lifetime`` (metres of optical path) or ``lifetime_s`` (seconds)
        Mean delay. ``p`` is exponential, unless a measured decay is given:
    ``decay_opl``, ``decay_values`` (numbers between spaces or commas)
        Density of the delay, linear between values at lengths of zero or more; the lifetime is its mean, and a given
        ``lifetime`` stretches it to that mean.
    ``quantum_yield`` (1)
        Share of the absorbed photons that come back.
    ``elastic`` (BSDF) or ``elastic_fraction`` (number)
        What is scattered at once: another BSDF, or this share of the nested one, whose rest is delayed. Default: none.
    ``excitation``, ``emission`` (spectra; both or none; spectral variants)
        A shift of wavelength: ``excitation`` is the share of photons that is absorbed at a wavelength, ``emission`` the
        spectrum of the photons that come back, normalised here. The radiance at wavelength L is
        ``quantum_yield emission(L) / L`` times the integral over l of ``excitation(l) l`` times the radiance at l; the
        nested BSDF is evaluated at the absorbed wavelength.

    Differentiable: ``lifetime`` (through the time of flight), ``quantum_yield``, ``elastic_fraction`` and the nested
    BSDFs. It must be the outermost BSDF of a surface: put ``twosided`` or ``mask`` inside. Integrators that know no
    time, Mitsuba's own, see the sum of both parts, without a shift of wavelength: of a shifted surface only the elastic
    part. Raises SceneError for impossible numbers and for a shift in a variant without wavelengths.
    """

    scatters_late = True  # what `delay_table` asks a BSDF

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.nested, self.elastic = _children(props)
        self.elastic_fraction = None
        if "elastic_fraction" in props:
            if self.elastic is not None:
                raise SceneError("delayed: expected one of an elastic BSDF and elastic_fraction, got both.")
            self.elastic_fraction = _number(props, "elastic_fraction", 0.0, 0.0, 1.0)
        self.quantum_yield = _number(props, "quantum_yield", 1.0, 0.0, math.inf)
        self.decay, mean = _decay(props)
        self.lifetime = opaque(mi.Float(_lifetime(props, mean)))
        self.shift = _shift(props)
        parts = [self.nested] if self.elastic is None else [self.elastic, self.nested]
        self.m_components = [part.flags(i) for part in parts for i in range(part.component_count())]
        self.m_flags = 0
        for flags in self.m_components:
            self.m_flags |= flags
        delay_table.note_creation()

    def traverse(self, cb: Any) -> None:
        cb.put("lifetime", self.lifetime, mi.ParamFlags.Differentiable)
        cb.put("quantum_yield", self.quantum_yield, mi.ParamFlags.Differentiable)
        if self.elastic_fraction is not None:
            cb.put("elastic_fraction", self.elastic_fraction, mi.ParamFlags.Differentiable)
        cb.put("nested", self.nested, mi.ParamFlags.Differentiable)
        if self.elastic is not None:
            cb.put("elastic", self.elastic, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Any) -> None:
        opaque(self.lifetime)
        opaque(self.quantum_yield)
        if self.elastic_fraction is not None:
            opaque(self.elastic_fraction)

    # ------------------------------------------------------------------------------------------- for the table

    @property
    def at_once(self) -> Any:
        """Return the BSDF that scatters at once, None without one."""
        return self.nested if self.elastic_fraction is not None else self.elastic

    def weights(self) -> tuple[Any, Any]:
        """Return the factors of the elastic and of the delayed part, Float."""
        if self.elastic_fraction is not None:
            return self.elastic_fraction, (1 - self.elastic_fraction) * self.quantum_yield
        return mi.Float(0 if self.elastic is None else 1), self.quantum_yield

    # --------------------------------------------------------------------- the sum, for integrators without time

    def _sum(self) -> list[tuple[Any, Any]]:
        elastic, delayed = self.weights()
        parts = [] if self.at_once is None else [(self.at_once, elastic)]
        return parts if self.shift is not None else [*parts, (self.nested, delayed)]

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        value, pdf = mi.Spectrum(0), mi.Float(0)
        parts = self._sum()
        for part, weight in parts:
            v, p = part.eval_pdf(ctx, si, wo, active)
            value, pdf = value + v * weight, pdf + p * (1 / len(parts))
        return value, pdf

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs, weight = dr.zeros(mi.BSDFSample3f), mi.Spectrum(0)
        parts = self._sum()
        for index, (part, factor) in enumerate(parts):
            chosen = active & (mi.UInt32(dr.minimum(sample1 * len(parts), len(parts) - 1)) == index)
            bs_part, w = part.sample(ctx, si, sample1 * len(parts) - index, sample2, chosen)
            bs_part.pdf *= 1 / len(parts)
            bs = dr.select(chosen, bs_part, bs)
            weight = dr.select(chosen, w * (factor * len(parts)), weight)
        if len(parts) > 1:
            value, pdf = self.eval_pdf(ctx, si, bs.wo, active)
            smooth = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (pdf > 0)
            bs.pdf = dr.select(smooth, pdf, bs.pdf)
            weight = dr.select(smooth, value * dr.rcp(pdf), weight)
        return bs, weight

    def eval_pdf_sample(self, ctx: Any, si: Any, wo: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        return (*self.eval_pdf(ctx, si, wo, active), *self.sample(ctx, si, sample1, sample2, active))

    def to_string(self) -> str:
        return (
            f"DelayedBSDF[\n  lifetime = {self.lifetime},\n  quantum_yield = {self.quantum_yield},\n"
            f"  elastic = {self.elastic if self.elastic_fraction is None else self.elastic_fraction},\n"
            f"  nested = {self.nested}\n]"
        )


def _children(props: Any) -> tuple[Any, Any]:
    """Return (nested, elastic)."""
    found = {}
    for name in list(props.keys()):
        if props.type(name) == mi.Properties.Type.Object:
            used = props.was_queried(name)
            value = props[name]
            props.mark_queried(name, used or isinstance(value, mi.BSDF))
            if isinstance(value, mi.BSDF):
                found[name] = value
    elastic = found.pop("elastic", None)
    if len(found) != 1:
        raise SceneError(
            "delayed: expected one nested BSDF whose light is delayed, and perhaps another one called 'elastic'; got "
            f"{len(found)} beside it: {', '.join(found) or 'none'}."
        )
    return next(iter(found.values())), elastic


def _number(props: Any, name: str, default: float, low: float, high: float) -> Any:
    value = number(props, name, default)
    if not (math.isfinite(value) and low <= value <= high):
        raise SceneError(f"delayed: expected {name} between {low:g} and {high:g}, got {value!r}.")
    return opaque(mi.Float(value))


def _decay(props: Any) -> tuple[np.ndarray | None, float | None]:
    """Return (delays in units of their mean at equal steps of probability, mean in metres); None for an exponential."""
    given = [name for name in ("decay_opl", "decay_values") if name in props]
    if not given:
        return None, None
    if len(given) == 1:
        raise SceneError(f"delayed: decay_opl and decay_values go together, got only {given[0]}.")
    opl, values = (numbers_of(props[name], name, "delayed") for name in given)
    try:
        pulse = Pulse.tabulated(opl, values)
    except TorchTransientError as error:
        raise SceneError(f"delayed: decay: {error}") from error
    if pulse.opl[0] < 0:
        raise SceneError(f"delayed: a delay cannot be negative, decay_opl begins at {pulse.opl[0]!r} m.")
    fine = np.unique(np.concatenate([np.linspace(pulse.opl[0], pulse.opl[-1], 1 << 15), pulse.opl]))
    share = pulse.cumulative(fine)
    delays = np.interp(np.linspace(0, 1, delay_table.DECAY_NODES), share, fine)
    mean = float(np.sum(np.diff(share) * 0.5 * (fine[1:] + fine[:-1])))
    return delays / mean, mean


def _lifetime(props: Any, mean: float | None) -> float:
    given = [name for name in ("lifetime", "lifetime_s") if name in props]
    if len(given) > 1 or (not given and mean is None):
        raise SceneError(
            "delayed: expected one of lifetime (metres of optical path) and lifetime_s (seconds), got "
            f"{'both' if given else 'neither'}."
        )
    value = mean if not given else number(props, given[0]) * (SPEED_OF_LIGHT if given[0] == "lifetime_s" else 1.0)
    if value is None or not (math.isfinite(value) and value >= 0):
        raise SceneError(f"delayed: expected a finite {given[0]} of zero or more, got {props[given[0]]!r}.")
    return value


def _shift(props: Any) -> SpectralShift | None:
    given = [name for name in ("excitation", "emission") if name in props]
    if not given:
        return None
    if len(given) == 1:
        raise SceneError(f"delayed: excitation and emission go together, got only {given[0]}.")
    if not mi.is_spectral:
        raise SceneError(
            "delayed: excitation and emission shift wavelengths and need a variant that carries them, such as "
            f"llvm_ad_spectral; the active one is {mi.variant()}."
        )
    return SpectralShift(props.get_unbounded_texture("excitation"), props.get_unbounded_texture("emission"))


register("bsdf", "delayed", DelayedBSDF)
declare_effects(
    DelayedBSDF,
    {
        "lifetime": ParameterEffect(moves_length=True, role="delay", trusted=True),
        "quantum_yield": VALUE,
        "elastic_fraction": VALUE,
    },
)
