"""``transient_prbvolpath``: time-resolved path tracing over surfaces and through participating media."""

from __future__ import annotations

from torchtransient.plugins._registry import register
from torchtransient.plugins.integrators import path
from torchtransient.plugins.transport.emitter_connections import EmitterFound, EmitterSampled
from torchtransient.plugins.transport.media import Media
from torchtransient.plugins.transport.medium_scattering import SurfaceOrMedium


class TransientVolpath(path.TransientPath):
    r"""Time-resolved volumetric path tracer (:monosp:`transient_prbvolpath`, :monosp:`transient_volpath`).

    The path tracer ``transient_path`` with walks through homogeneous and heterogeneous media between its vertices, see
    ``transport/free_flight.py``: any phase function, colours of extinction, open (``null``) and refractive
    boundaries,
    sensors inside a medium. Parameters as in :class:`TransientIntegrator`; ``max_depth`` counts scattering at surfaces
    and in media, not the passage of an open boundary. A ``mask`` or ``thindielectric`` counts, as in
    ``transient_path``. In a scene without media it is ``transient_path``, down to the compiled kernel.

    Optical length is geometric length times the index of the medium, whether the walk collides or not. The index
    changes where a BSDF refracts.

    Gradients as in ``transient_path``, and of extinction, albedo, phase function, grids of both, and path lengths in
    media (see ``docs/media.md``). In polarized variants scattering in a medium leaves no polarization.

    Not supported: media that emit light. The length between a sensor and its near clip plane counts in time but is not
    attenuated, as in Mitsuba.
    """

    walks_through_media = True

    def strategies(self, contents):
        if contents.media is None:
            return super().strategies(contents)
        return Media(), SurfaceOrMedium(), [EmitterFound(), EmitterSampled()]


register("integrator", "transient_prbvolpath", TransientVolpath)
register("integrator", "transient_volpath", TransientVolpath)
