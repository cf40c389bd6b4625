"""``laser_beam``: a laser that lights one spot."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import UnitError
from torchtransient.plugins._registry import register
from torchtransient.plugins.mitsuba_compat import NUMBERS
from torchtransient.plugins.node_walk import shown_by
from torchtransient.plugins.parameter_effect import ANY_KEY, VALUE, ParameterEffect, declare_effects
from torchtransient.plugins.properties import numbers_of
from torchtransient.plugins.spectral_colours import keeps_coefficients


class LaserBeam(mi.Emitter):
    r"""A beam without width (:monosp:`laser_beam`), for the integrator ``transient_nlos_path``.

    ``to_world`` (transform): the laser stands at its origin and shines along its +z; scans that aim the laser
    themselves use the origin alone. ``energy`` (spectrum, 1): joules that fall on the spot, per colour, none of them
    below zero. Both are differentiable.

    Nothing of it has an area or a solid angle: integrators that do not aim at its spot refuse it.
    """

    needs_aim = True

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        if "energy" in props and isinstance(props["energy"], (bool, str)):
            raise UnitError(f"laser_beam: energy: expected joules or a spectrum, got {props['energy']!r}.")
        self.energy = props.get_emissive_texture("energy", 1.0)
        _check_light(self.energy)
        # That of the base class cannot be set from Python.
        self.to_world = mi.Transform4f(super().world_transform())
        dr.make_opaque(self.to_world)
        self.m_flags = +mi.EmitterFlags.DeltaPosition

    def traverse(self, cb: Any) -> None:
        super().traverse(cb)
        cb.put("energy", self.energy, mi.ParamFlags.Differentiable)
        cb.put("to_world", self.to_world, mi.ParamFlags.Differentiable)

    def world_transform(self) -> Any:
        """The laser's pose."""
        return self.to_world

    def energy_at(self, wavelengths: Any, active: Any) -> Any:
        """Return the energy per colour at a path's wavelengths, UnpolarizedSpectrum.

        Args:
            wavelengths: nanometres, in spectral variants.
            active: mask of lanes.
        """
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wavelengths = wavelengths
        return self.energy.eval(si, active)

    def eval(self, si: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
        ds = dr.zeros(mi.DirectionSample3f)
        ds.delta = True
        return ds, mi.Spectrum(0)

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return mi.Float(0)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def bbox(self) -> Any:
        return mi.ScalarBoundingBox3f()

    def to_string(self) -> str:
        return f"LaserBeam[\n  energy = {self.energy}\n]"


def _check_light(energy: Any) -> None:
    """Raise UnitError for joules below zero or that are no number."""
    for value in shown_by(energy)[0]:
        plain = value.key in NUMBERS and not keeps_coefficients(energy, value.key)
        numbers = numbers_of(value.read(energy)) if plain else None
        if numbers is not None and not (np.isfinite(numbers) & (numbers >= 0)).all():
            raise UnitError(
                f"laser_beam: energy: expected joules of at least 0, finite ones, got {numbers.reshape(-1).tolist()}."
            )


register("emitter", "laser_beam", LaserBeam)
# What is lit changes with the spot.
_POSE = ParameterEffect(moves_length=True, moves_silhouette=True, role="emitter")
declare_effects(LaserBeam, {ANY_KEY: VALUE, "to_world": _POSE})
