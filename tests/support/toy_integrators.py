"""Integrators with the strategies of :mod:`.toy_strategies`; a plugin module, see ``plugins.register_module``."""

from __future__ import annotations

from support.toy_strategies import AreaOfShape, OwnPointLight, SecondEmitterSample, ThirdEmitterSample
from torchtransient.plugins import register
from torchtransient.plugins.integrators import volpath
from torchtransient.plugins.transport.emitter_connections import EmitterFound, EmitterSampled
from torchtransient.plugins.transport.media import Media
from torchtransient.plugins.transport.medium_scattering import SurfaceOrMedium
from torchtransient.plugins.transport.surface_scattering import Surface
from torchtransient.plugins.transport.vacuum import Vacuum


class TwoEmitterSamples(volpath.TransientVolpath):
    """Every vertex is connected to two points on lights."""

    def strategies(self, contents):
        segment, scattering, _ = super().strategies(contents)
        return segment, scattering, [EmitterFound(), EmitterSampled(), SecondEmitterSample()]


class WithPointLight(volpath.TransientVolpath):
    """Beside the scene's lights, a point light at (0.5, 0, 4)."""

    def strategies(self, contents):
        segment, scattering, connections = super().strategies(contents)
        return segment, scattering, [*connections, OwnPointLight([0.5, 0.0, 4.0], 10.0)]


class Guided(volpath.TransientVolpath):
    """Half of the next vertices are drawn over the area of the shapes ``side`` and ``wall``."""

    def strategies(self, contents):
        guides = [AreaOfShape("side", 0.3, "first"), AreaOfShape("wall", 0.2, "second")]
        if contents.media is None:
            return Vacuum(), Surface(guides), [EmitterFound(), EmitterSampled()]
        return Media(), SurfaceOrMedium(guides), [EmitterFound(), EmitterSampled()]


class ThreeEmitterSamples(volpath.TransientVolpath):
    """Every vertex is connected to three points on lights."""

    def strategies(self, contents):
        segment, scattering, _ = super().strategies(contents)
        return segment, scattering, [EmitterFound(), EmitterSampled(), SecondEmitterSample(), ThirdEmitterSample()]


class GuidedWithPointLight(Guided):
    """Both at once."""

    def strategies(self, contents):
        segment, scattering, connections = super().strategies(contents)
        return segment, scattering, [*connections, OwnPointLight([0.5, 0.0, 4.0], 10.0)]


class FoundLights(volpath.TransientVolpath):
    """Lights are not sampled: paths have to run into them."""

    def strategies(self, contents):
        segment, scattering, _ = super().strategies(contents)
        return segment, scattering, [EmitterFound()]


register("integrator", "transient_found_lights", FoundLights)
register("integrator", "transient_guided_with_point_light", GuidedWithPointLight)
register("integrator", "transient_three_emitter_samples", ThreeEmitterSamples)
register("integrator", "transient_two_emitter_samples", TwoEmitterSamples)
register("integrator", "transient_with_point_light", WithPointLight)
register("integrator", "transient_guided", Guided)
