"""Table of the delayed BSDFs of a scene, by their number in Dr.Jit's registry.

A path chooses at each such surface, once for everything that it does there, whether it takes part in the elastic or in
the delayed scattering; from then on it sees the BSDF of that part alone, by a pointer of its own. So nothing has to be
told to a BSDF's methods, and surfaces without a delay are left as they are.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins.kernel_arrays import PointerTable, registry_number
from torchtransient.plugins.node_walk import objects_below
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.polarized import attenuated

DECAY_NODES = 4097
# Both parts are drawn at least this often, so that the derivative by a yield of zero is there.
LEAST_PROBABILITY = 0.1

_created = 0


def note_creation():
    """Record that a delayed BSDF exists: before that, no scene needs to be searched for one."""
    global _created
    _created += 1


class DelaySample:
    """Choice between elastic and delayed scattering at a surface: ``bsdf`` in its stead, the factor ``weight``, the
    ``delay`` in metres and the ``wavelengths`` beyond the surface; None where nothing changes. A plain object that
    lives within one iteration.
    """

    def __init__(self, bsdf, weight=None, delay=None, wavelengths=None):
        self.bsdf, self.weight, self.delay, self.wavelengths = bsdf, weight, delay, wavelengths

    def after(self, τ):
        """Return a path length, later by the delay."""
        return τ if self.delay is None else τ + mi.Float64(dr.detach(self.delay))

    def scaled(self, value):
        """Return a BSDF's value or weight times the factor."""
        return value if self.weight is None else attenuated(value, self.weight)

    def shift_wavelengths(self, *interactions):
        """Give interactions the wavelengths beyond the surface."""
        if self.wavelengths is not None:
            for interaction in interactions:
                interaction.wavelengths = self.wavelengths


class SpectralShift:
    """Shift from the wavelength with which a path left a surface to the one that excited it.

    With photons per nanometre ``emission`` (normalised) and absorptance ``excitation``, the radiance at L is
    ``emission(L) / L`` times the integral of ``excitation(l) l`` times the radiance at l; l is drawn in proportion to
    the excitation.
    """

    def __init__(self, excitation, emission):
        self.excitation = _distribution(excitation, "excitation")
        self.emission = _distribution(emission, "emission")

    def draw(self, u, wavelengths):
        """Return (wavelengths absorbed, factor of the radiance) for wavelengths emitted and one uniform number."""
        numbers = mi.sample_shifted(u)
        absorbed, factor = mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(0)
        for k in range(len(wavelengths)):
            absorbed[k] = self.excitation.sample(numbers[k])
            share = self.emission.eval_pdf_normalized(wavelengths[k]) * self.excitation.integral()
            factor[k] = share * absorbed[k] / wavelengths[k]
        return absorbed, factor


def _distribution(curve, name):
    low, high = (float(edge) for edge in curve.wavelength_range())
    step = float(curve.spectral_resolution())
    count = 471 if step <= 0 else min(max(math.ceil((high - low) / step) + 1, 65), 4096)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = mi.UnpolarizedSpectrum(dr.linspace(mi.Float, low, high, count))
    values = np.broadcast_to(np.array(mi.unpolarized_spectrum(curve.eval(si))[0], dtype=float), count)
    if not np.all(np.isfinite(values)) or values.min() < 0 or values.max() == 0:
        raise SceneError(
            f"delayed: {name} must be finite, nowhere negative and not zero everywhere, got values between "
            f"{values.min():g} and {values.max():g}."
        )
    return mi.ContinuousDistribution(mi.ScalarVector2f(low, high), mi.Float(values.astype(np.float32)))


class DelayedBSDFs:
    """Delayed BSDFs of a scene, as far as they do not change with their parameters."""

    def __init__(self, bsdfs):
        self.bsdfs = bsdfs
        self.rows = PointerTable(bsdfs, range(1, len(bsdfs) + 1))
        self.delayed = mi.UInt32([registry_number(bsdf.nested) for bsdf in bsdfs])
        self.at_once = mi.UInt32([registry_number(bsdf.at_once or bsdf.nested) for bsdf in bsdfs])
        self.only_delayed = mi.UInt32([int(bsdf.at_once is None) for bsdf in bsdfs])
        decays = []
        for bsdf in bsdfs:
            decays.append(0 if bsdf.decay is None else 1 + sum(d > 0 for d in decays) * DECAY_NODES)
        tables = [bsdf.decay for bsdf in bsdfs if bsdf.decay is not None]
        self.decay_start = mi.UInt32(decays) if tables else None
        self.decay = mi.Float(np.concatenate(tables).astype(np.float32)) if tables else None
        self.spectral_shifts = [(row, bsdf.shift) for row, bsdf in enumerate(bsdfs) if bsdf.shift is not None]
        dr.make_opaque(self.delayed, self.at_once, self.only_delayed, self.decay_start, self.decay)

    @property
    def shifts(self) -> bool:
        """Return whether wavelengths change along a path."""
        return bool(self.spectral_shifts)

    def read(self) -> DelayTable:
        """Return the table of the current parameters. Call outside of loops, once a job."""
        return DelayTable(self)


class DelayTable:
    """Lifetimes, yields and parts of delayed BSDFs; attached where their parameters are.

    Not a dataclass on purpose: Dr.Jit loops would take it apart as loop state.
    """

    def __init__(self, bsdfs: DelayedBSDFs):
        self._of = bsdfs
        with dr.resume_grad():
            self.lifetimes = _gathered([bsdf.lifetime for bsdf in bsdfs.bsdfs])
            self.elastic_weights = _gathered([bsdf.weights()[0] for bsdf in bsdfs.bsdfs])
            self.delayed_weights = _gathered([bsdf.weights()[1] for bsdf in bsdfs.bsdfs])
        elastic, delayed = dr.detach(self.elastic_weights), dr.detach(self.delayed_weights)
        p = dr.select(elastic + delayed > 0, delayed / (elastic + delayed), 0.5)
        p = dr.clip(p, LEAST_PROBABILITY, 1 - LEAST_PROBABILITY)
        self._probability = dr.select(bsdfs.only_delayed == 1, 1, p)

    def attached(self) -> list:
        """Return the tables that carry derivatives."""
        return [t for t in (self.lifetimes, self.elastic_weights, self.delayed_weights) if dr.grad_enabled(t)]

    def sample(self, bsdf, u, wavelengths) -> DelaySample:
        """Sample elastic or delayed scattering of the surfaces' ``bsdf``, from two uniform numbers ``u``."""
        row = self._of.rows.look_up(bsdf)
        there = row > 0
        row = dr.select(there, row - 1, 0)
        p = dr.gather(mi.Float, self._probability, row, there)
        delayed = there & (u.x < p)
        own = dr.reinterpret_array(mi.UInt32, bsdf)
        pointer = dr.select(delayed, dr.gather(mi.UInt32, self._of.delayed, row, delayed), own)
        pointer = dr.select(there & ~delayed, dr.gather(mi.UInt32, self._of.at_once, row, there), pointer)
        delayed_weight = dr.gather(mi.Float, self.delayed_weights, row, delayed) * dr.rcp(dr.select(delayed, p, 1))
        once_weight = dr.gather(mi.Float, self.elastic_weights, row, there)
        once_weight *= dr.rcp(dr.select(delayed | ~there, 1, 1 - p))
        weight = dr.select(delayed, delayed_weight, dr.select(there, once_weight, 1))
        lifetime = dr.gather(mi.Float, self.lifetimes, row, delayed)
        delay = dr.select(delayed, lifetime * self._delay(u.x / dr.select(delayed, p, 1), row, delayed), 0)
        beyond = None
        if self._of.shifts:
            weight, beyond = mi.UnpolarizedSpectrum(weight), mi.UnpolarizedSpectrum(wavelengths)
            for number, shift in self._of.spectral_shifts:
                chosen = delayed & (row == number)
                absorbed, factor = shift.draw(u.y, wavelengths)
                weight = dr.select(chosen, weight * factor, weight)
                beyond = dr.select(chosen, absorbed, beyond)
        return DelaySample(dr.reinterpret_array(mi.BSDFPtr, pointer), weight, delay, beyond)

    def _delay(self, v, row, active):
        """Delay in units of the lifetime for uniform numbers in [0, 1)."""
        v = dr.minimum(v, dr.one_minus_epsilon(mi.Float))
        unit = -dr.log(1 - v)
        if self._of.decay is None:
            return unit
        start = dr.gather(mi.UInt32, self._of.decay_start, row, active)
        measured = active & (start > 0)
        x = v * (DECAY_NODES - 1)
        i = dr.minimum(mi.UInt32(x), DECAY_NODES - 2)
        at = dr.select(measured, start - 1, 0) + i
        a, b = dr.gather(mi.Float, self._of.decay, at, measured), dr.gather(mi.Float, self._of.decay, at + 1, measured)
        return dr.select(measured, dr.lerp(a, b, x - mi.Float(i)), unit)


def _gathered(values):
    """Numbers side by side, attached where they are."""
    table = dr.zeros(mi.Float, len(values))
    for i, value in enumerate(values):
        dr.scatter(table, value, mi.UInt32(i))
    return table


def _scatters_late(bsdf) -> bool:
    """Return True if a BSDF declares that its light comes back late."""
    return getattr(bsdf, "scatters_late", False)


def delays_of(bsdfs):
    """Return the BSDFs that paths can meet, and the delayed ones among them.

    Args:
        bsdfs: outermost BSDFs of a scene.

    Returns:
        (BSDFs, where parts stand in place of delayed ones; the delayed ones, None if there are none).

    Raises:
        SceneError: for a delayed BSDF inside another one.
    """
    if _created == 0:
        return bsdfs, None
    met, delayed = [], []
    for bsdf in bsdfs:
        if _scatters_late(bsdf):
            delayed.append(bsdf)
            met += [part for part in (bsdf.nested, bsdf.elastic) if part is not None]
        else:
            met.append(bsdf)
    for bsdf in met:
        if any(_scatters_late(part) for part in [bsdf, *objects_below(bsdf, mi.BSDF)]):
            raise SceneError(
                f"BSDF '{bsdf.id()}' has a delayed BSDF inside; expected it outermost: put {class_of(bsdf)} into "
                "the delayed one."
            )
    return met, DelayedBSDFs(delayed) if delayed else None
