"""``transient_path``: time-resolved path tracing over surfaces."""

from __future__ import annotations

from torchtransient.plugins._registry import register
from torchtransient.plugins.integrators.base import TransientIntegrator
from torchtransient.plugins.transport.boundary.passes import BoundaryTerm
from torchtransient.plugins.transport.connection.emitter_found import EmitterFound
from torchtransient.plugins.transport.connection.emitter_sampled import EmitterSampled
from torchtransient.plugins.transport.scattering.lambertian import Lambertian
from torchtransient.plugins.transport.scattering.surface import Surface
from torchtransient.plugins.transport.segment.vacuum import Vacuum


class TransientPath(TransientIntegrator):
    r"""Time-resolved path tracer (:monosp:`transient_path`).

    Next-event estimation with multiple importance sampling over surfaces; monochromatic, RGB and spectral variants, and
    the polarized ones, where every event is a Stokes vector in the frame of the sensor.
    Parameters as in :class:`TransientIntegrator`. The optical path length is counted from the sensor's origin, segment
    by segment between hit points, each times the index of refraction it runs through; light from environment and
    directional emitters arrives as plane waves that leave the sphere around the scene at t = 0 (see
    ``plugins/sampling/distant.py``).

    Gradients: reverse mode walks every path backwards over a record in thread-local memory, forward mode carries
    tangents along; both include the time of flight. Visibility changes are not differentiated (no boundary term).

    Not supported: participating media (``SceneError``).
    """

    # Which passes of the boundary term derivatives have, of edge samples so many for each path, and how
    # many candidates an edge is chosen from.
    boundary, boundary_share, boundary_candidates = ("primary", "vertex", "light"), 1.0, 4

    def beside(self, world, sensor, film, seed, samples):
        if not (self.boundary and world.wanted.silhouettes):
            return []
        how = self.boundary, self.boundary_share, self.boundary_candidates
        return [BoundaryTerm(self, world, sensor, film, seed, samples, *how)]

    def strategies(self, contents):
        scattering = Lambertian(draws_lobe=True) if Lambertian.fits(contents) else Surface()
        return Vacuum(), scattering, [EmitterFound(), EmitterSampled()]


register("integrator", "transient_path", TransientPath)
