"""``diff_polarizer``, ``diff_retarder``, ``diff_circular``: ideal thin elements with derivatives in every pose.

Mitsuba's ``polarizer``, ``retarder`` and ``circular`` turn their frames by way of an angle, whose derivative is NaN
where two frames coincide: at normal incidence, where optical benches are built.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.bsdfs.fresnel import two_by_two
from torchtransient.plugins.polarized import rotate_mueller, rotation_along
from torchtransient.plugins.properties import truth


class ThinElement(mi.BSDF):
    """Abstract base: light goes straight through, and its Stokes vector is changed.

    ``transmittance`` (texture, 1) scales what is let through. Subclasses give ``matrix(si, forward, active)``, the
    Mueller matrix between the implicit frames of the direction of travel, and the ``share`` of unpolarized light that
    passes.
    """

    angles: tuple[str, ...] = ()
    share = 0.5

    def __init__(self, props: Any) -> None:
        mi.BSDF.__init__(self, props)
        self.transmittance = props.get_texture("transmittance", 1.0)
        sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        self.m_components = [mi.BSDFFlags.Null | sides]
        self.m_flags = self.m_components[0]

    def traverse(self, cb: Any) -> None:
        for name in (*self.angles, "transmittance"):
            cb.put(name, getattr(self, name), +mi.ParamFlags.Differentiable)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = -si.wi
        bs.pdf, bs.eta = mi.Float(1), mi.Float(1)
        bs.sampled_type, bs.sampled_component = mi.UInt32(+mi.BSDFFlags.Null), mi.UInt32(0)
        forward = si.wi if ctx.mode == mi.TransportMode.Radiance else -si.wi
        return bs, self._through(si, forward, active)

    def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
        return self._through(si, si.wi, active)

    def _through(self, si: Any, forward: Any, active: Any) -> Any:
        transmittance = self.transmittance.eval(si, active)
        if not mi.is_polarized:
            return transmittance * self.share & active
        return mi.mueller.absorber(transmittance) @ self.matrix(si, forward, active) & active

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Spectrum(0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Float(0)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return mi.Spectrum(0), mi.Float(0)

    def to_string(self) -> str:
        values = [f"  {name} = {getattr(self, name)}" for name in (*self.angles, "transmittance")]
        return f"{type(self).__name__}[\n" + ",\n".join(values) + "\n]"


def _turned_to_basis(matrix: Any, forward: Any, x: Any, y: Any, z: Any) -> Any:
    """Return a matrix whose horizontal axis is the projection of (x, y, z) across the direction, in the implicit frame.

    The components are spectra: angles may depend on the wavelength.
    """
    basis = mi.coordinate_system(forward)[0]
    across = dr.cross(basis, forward)
    rotation = rotation_along(
        x * basis.x + y * basis.y + z * basis.z,
        x * across.x + y * across.y + z * across.z,
    )
    return rotate_mueller(matrix, rotation, rotation)


class DiffPolarizer(ThinElement):
    """Linear polarizer, parameters and values as Mitsuba's ``polarizer``.

    ``theta`` (texture, degrees, 0), ``transmittance`` (texture, 1), ``polarizing`` (bool, true; false makes it a grey
    filter of one half). The axis of absorption is (sin theta, cos theta, 0) in the local frame, projected across the
    direction of travel (Korger et al. 2013). Differentiable: ``theta``, ``transmittance``, the direction.
    """

    angles = ("theta",)

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.theta = props.get_unbounded_texture("theta", 0.0)
        self.polarizing = truth(props, "polarizing", default=True)

    def matrix(self, si: Any, forward: Any, active: Any) -> Any:
        if not self.polarizing:
            return mi.mueller.absorber(mi.UnpolarizedSpectrum(0.5))
        sin, cos = dr.sincos(dr.deg2rad(self.theta.eval(si, active)))
        # Light passes that oscillates across the axis of absorption and the direction.
        f = forward
        return _turned_to_basis(two_by_two(0.5, 0.5, 0.0, 0.0), f, -f.z * cos, f.z * sin, f.x * cos - f.y * sin)


class DiffRetarder(ThinElement):
    """Wave plate, parameters as Mitsuba's ``retarder``.

    ``theta`` (texture, degrees, 0): the fast axis is (cos theta, sin theta, 0) in the local frame; ``delta`` (texture,
    degrees, 90): retardance at normal incidence, falling with the cosine; ``transmittance`` (texture, 1).
    Differentiable: all of them and the direction. Values are Mitsuba's at normal incidence. For oblique light the fast
    axis is projected across the direction of travel, where Mitsuba's takes an angle to a vector that is not across
    it, and jumps.
    """

    angles = ("theta", "delta")
    share = 1.0

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.theta = props.get_unbounded_texture("theta", 0.0)
        self.delta = props.get_unbounded_texture("delta", 90.0)

    def matrix(self, si: Any, forward: Any, active: Any) -> Any:
        sin, cos = dr.sincos(dr.deg2rad(self.theta.eval(si, active)))
        sin_d, cos_d = dr.sincos(dr.deg2rad(self.delta.eval(si, active)) * dr.abs(forward.z))
        # The fast axis is horizontal: light along the other one comes later.
        return _turned_to_basis(two_by_two(1.0, 0.0, cos_d, -sin_d), forward, cos, sin, cos * 0.0)


class DiffCircular(ThinElement):
    """Polarizer for right (or, with ``left_handed``, left) circular light, as Mitsuba's ``circular``.

    ``transmittance`` (texture, 1), ``left_handed`` (bool, false). Differentiable: ``transmittance``.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.left_handed = truth(props, "left_handed", default=False)

    def matrix(self, si: Any, forward: Any, active: Any) -> Any:
        # It has no axis: turning its frame changes nothing.
        left = self.left_handed
        return mi.Spectrum(mi.mueller.left_circular_polarizer() if left else mi.mueller.right_circular_polarizer())


register("bsdf", "diff_polarizer", DiffPolarizer)
register("bsdf", "diff_retarder", DiffRetarder)
register("bsdf", "diff_circular", DiffCircular)
