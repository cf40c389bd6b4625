"""``diff_directionalarea``: Mitsuba's ``directionalarea``, with the method that it lacks."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register


class DirectionalAreaLight(mi.Emitter):
    """An area light that emits along its normals alone, as Mitsuba's ``directionalarea``.

    ``radiance`` (texture, 1). A path that starts at the sensor meets that one direction with probability zero: to such
    paths the light is dark, and what has an effect is ``sample_ray`` alone. Mitsuba's lacks ``eval_direction``, so that
    scenes that have one beside other lights cannot be differentiated.
    """

    stays_dark = True

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.radiance = props.get_emissive_texture("radiance", 1.0)
        self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.DeltaDirection

    def traverse(self, cb: Any) -> None:
        super().traverse(cb)
        cb.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

    def eval(self, si: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return mi.Float(0)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def sample_position(self, time: Any, sample: Any, active: Any = True) -> Any:
        ps = self.get_shape().sample_position(time, sample, active)
        return ps, dr.select(mi.Bool(active) & (ps.pdf > 0), dr.rcp(ps.pdf), 0)

    def sample_wavelengths(self, si: Any, sample: Any, active: Any = True) -> Any:
        u = mi.sample_shifted(sample) if mi.is_spectral else dr.zeros(type(si.wavelengths))
        return self.radiance.sample_spectrum(si, u, active)

    def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
        ps = self.get_shape().sample_position(time, sample2)
        si = mi.SurfaceInteraction3f(ps, dr.zeros(type(mi.Ray3f().wavelengths)))
        wavelengths, weight = self.sample_wavelengths(si, sample1, active)
        si.time, si.wavelengths = time, wavelengths
        return si.spawn_ray(ps.n), mi.Spectrum(weight) * self.get_shape().surface_area()

    def bbox(self) -> Any:
        return self.get_shape().bbox()

    def to_string(self) -> str:
        return f"DirectionalAreaLight[\n  radiance = {self.radiance}\n]"


register("emitter", "diff_directionalarea", DirectionalAreaLight)
