"""``angulararea``: an area light that emits into a cone around its surface normal."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.parameter_effect import ANY_KEY, VALUE, declare_effects
from torchtransient.plugins.properties import number


class AngularAreaLight(mi.Emitter):
    """Area light with an angular profile, the same at every point of its shape.

    ``radiance`` (texture, 1), ``cutoff_angle`` (degrees from the normal beyond which nothing is emitted, 10),
    ``beam_width`` (degrees within which the radiance is full, default ``cutoff_angle``); linear in the angle between
    the two. The radiance is a radiance: along a ray it does not depend on the distance. Samples the shape by solid
    angle, as ``area`` does with a uniform radiance.

    Differentiable: ``radiance``, and the shape. Raises SceneError for angles outside
    ``0 <= beam_width <= cutoff_angle <= 90``. Not supported: importance sampling of a textured radiance, emission of
    rays (``sample_ray``).
    """

    samples_its_shape = True

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.radiance = props.get_emissive_texture("radiance", 1.0)
        self.cutoff_angle = number(props, "cutoff_angle", 10.0)
        self.beam_width = number(props, "beam_width", self.cutoff_angle)
        if not 0 <= self.beam_width <= self.cutoff_angle <= 90 or self.cutoff_angle == 0:
            raise SceneError(
                "angulararea: expected 0 <= beam_width <= cutoff_angle <= 90 degrees and a cutoff_angle above 0, got "
                f"beam_width {self.beam_width} and cutoff_angle {self.cutoff_angle}."
            )
        self.m_flags = mi.EmitterFlags.Surface
        if self.radiance.is_spatially_varying():
            self.m_flags |= mi.EmitterFlags.SpatiallyVarying

    def traverse(self, cb: Any) -> None:
        super().traverse(cb)
        cb.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

    def falloff(self, cos_theta: Any) -> Any:
        """Return the share of the radiance at an angle from the normal.

        Args:
            cos_theta: cosine of the angle.
        """
        cutoff, beam = math.radians(self.cutoff_angle), math.radians(self.beam_width)
        full, dark = cos_theta >= math.cos(beam), cos_theta <= math.cos(cutoff)
        if cutoff == beam:
            return dr.select(dark, mi.Float(0), 1)
        # The arc cosine has no derivative at the normal: only the slope between the two angles may see it.
        slope = ~(full | dark)
        angle = dr.acos(dr.select(slope, cos_theta, 0.5))
        return dr.select(full, mi.Float(1), dr.select(slope, (cutoff - angle) / (cutoff - beam), 0))

    def eval(self, si: Any, active: Any = True) -> Any:
        cos_theta = si.wi.z
        lit = mi.Bool(active) & (cos_theta > 0)
        return mi.Spectrum(self.radiance.eval(si, lit)) * dr.select(lit, self.falloff(cos_theta), 0)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
        ds = self.get_shape().sample_direction(it, sample, active)
        ds.emitter = mi.EmitterPtr(self)
        lit = mi.Bool(active) & (dr.dot(ds.d, ds.n) < 0) & (ds.pdf != 0)
        value = self._towards(it, ds, lit) * dr.select(lit, dr.rcp(ds.pdf), 0)
        return ds, value

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        lit = mi.Bool(active) & (dr.dot(ds.d, ds.n) < 0)
        return dr.select(lit, self.get_shape().pdf_direction(it, ds, lit), 0)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return self._towards(it, ds, mi.Bool(active) & (dr.dot(ds.d, ds.n) < 0))

    def _towards(self, it: Any, ds: Any, lit: Any) -> Any:
        """Radiance that leaves the sampled point towards ``it``."""
        si = mi.SurfaceInteraction3f(ds, it.wavelengths)
        return mi.Spectrum(self.radiance.eval(si, lit)) * dr.select(lit, self.falloff(-dr.dot(ds.d, ds.n)), 0)

    def sample_position(self, time: Any, sample: Any, active: Any = True) -> Any:
        ps = self.get_shape().sample_position(time, sample, active)
        return ps, dr.select(mi.Bool(active) & (ps.pdf > 0), dr.rcp(ps.pdf), 0)

    def sample_wavelengths(self, si: Any, sample: Any, active: Any = True) -> Any:
        u = mi.sample_shifted(sample) if mi.is_spectral else dr.zeros(type(si.wavelengths))
        return self.radiance.sample_spectrum(si, u, active)

    def bbox(self) -> Any:
        return self.get_shape().bbox()

    def to_string(self) -> str:
        return (
            f"AngularAreaLight[\n  radiance = {self.radiance},\n  cutoff_angle = {self.cutoff_angle},\n"
            f"  beam_width = {self.beam_width}\n]"
        )


register("emitter", "angulararea", AngularAreaLight)
# Its shape moves it, by the shape's own parameters.
declare_effects(AngularAreaLight, {ANY_KEY: VALUE})
