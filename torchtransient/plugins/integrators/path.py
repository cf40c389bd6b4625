"""``transient_path``: time-resolved path tracing over surfaces."""

from __future__ import annotations

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.integrators.base import TransientIntegrator
from torchtransient.plugins.properties import truth, whole_number
from torchtransient.plugins.transport.boundary.moving_edges import moving_edges, switched_off
from torchtransient.plugins.transport.boundary.term import BoundaryTerm
from torchtransient.plugins.transport.context import RenderContext
from torchtransient.plugins.transport.ellipsoidal_connections import (
    EllipsoidalMedium,
    EllipsoidalSurface,
    WindowedEmitterSampled,
    flat_faces,
    why_not,
)
from torchtransient.plugins.transport.emitter_connections import EmitterFound, EmitterSampled
from torchtransient.plugins.transport.surface_scattering import Lambertian, Surface
from torchtransient.plugins.transport.vacuum import Vacuum

CONNECTIONS = ("ordinary", "ellipsoidal")


class TransientPath(TransientIntegrator):
    r"""Time-resolved path tracer (:monosp:`transient_path`).

    Next-event estimation with multiple importance sampling over surfaces; monochromatic, RGB and spectral variants, and
    the polarized ones, where every event is a Stokes vector in the frame of the sensor.
    Parameters as in :class:`TransientIntegrator`. The optical path length is counted from the sensor's origin, segment
    by segment between hit points, each times the index of refraction it runs through; light from environment and
    directional emitters arrives as plane waves that leave the sphere around the scene at t = 0 (see
    ``plugins/sampling/lights.py``).

    Gradients: reverse mode walks every path backwards over a record in thread-local memory, forward mode carries
    tangents along; both include the time of flight. Where a parameter moves edges, what they hide and uncover is part
    of the derivative, too (the boundary term, :mod:`..transport.boundary.term`).

    Parameters beside those of :class:`TransientIntegrator`:

    ``connections`` ("ordinary")
        "ellipsoidal" also draws vertices by when their light arrives, for gates and narrow windows
        (:mod:`..transport.ellipsoidal_connections`). For films that count light of a window alone, area lights on
        meshes without textures, unpolarized variants; not with surfaces that scatter late or refract roughly
        (``SceneError``). Derivatives are those of ordinary connections.
    ``boundary`` (true)
        False leaves the boundary term out of derivatives.
    ``spp_boundary`` (half of the samples of the derivative)
        Samples per pixel of each pass of the boundary term.

    Not supported: participating media (``SceneError``).
    """

    # Which passes the boundary term has: fewer for tests and benchmarks.
    boundary_passes = ("primary", "vertex", "light", "specular")

    def __init__(self, props):
        super().__init__(props)
        self.boundary = truth(props, "boundary", default=True)
        self.connections = str(props.get("connections", "ordinary"))
        if self.connections not in CONNECTIONS:
            raise SceneError(
                f"{props.plugin_name()}: connections: expected one of {', '.join(CONNECTIONS)}, got "
                f"{self.connections!r}."
            )
        self.spp_boundary = whole_number(props, "spp_boundary", 0, least=1) if "spp_boundary" in props else None

    def render_context(self, scene, contents, wanted=None, window=None, settings=None, velocities=None):
        if self.connections == "ordinary" or wanted is not None or settings is not None:
            return super().render_context(scene, contents, wanted, window, settings, velocities)
        reason = why_not(contents, contents.sensor.film())
        if reason is not None:
            raise SceneError(f"connections='ellipsoidal': {reason}, or leave the ordinary connections.")
        segment, scattering, (found, _) = self.strategies(contents)
        if contents.media is not None:
            segment.keeps_begin = True
        lights, faces = WindowedEmitterSampled(), flat_faces(scene, contents)
        if faces.count:
            lights.beside += (EllipsoidalSurface(lights, faces),)
        if contents.media is not None:
            lights.beside += (EllipsoidalMedium(lights),)
        strategies = segment, scattering, [found, lights, *lights.beside]
        return RenderContext(scene, contents, self.settings(), strategies, None, window)

    def silhouettes(self, scene, sensors=None):
        if not self.boundary:
            return switched_off()
        return moving_edges(scene, scene.sensors() if sensors is None else sensors, self.max_depth)

    def beside(self, context, sensor, film, seed, samples):
        if not (self.boundary and context.wanted.silhouettes):
            return []
        count = self.spp_boundary or max(1, samples // 2)
        return [BoundaryTerm(self, context, sensor, film, seed, count, self.boundary_passes)]

    def strategies(self, contents):
        scattering = Lambertian(draws_lobe=True) if Lambertian.fits(contents) else Surface()
        return Vacuum(), scattering, [EmitterFound(), EmitterSampled()]


register("integrator", "transient_path", TransientPath)
