"""Integrators with the strategies of :mod:`.toy_strategies`; a plugin module, see ``plugins.register_module``."""

from __future__ import annotations

from support.toy_strategies import AreaOfShape, OwnPointLight, SecondEmitterSample
from torchtransient.plugins import register
from torchtransient.plugins.integrators import path, volpath
from torchtransient.plugins.transport.connection.emitter_found import EmitterFound
from torchtransient.plugins.transport.connection.emitter_sampled import EmitterSampled
from torchtransient.plugins.transport.scattering.surface import Surface
from torchtransient.plugins.transport.segment.vacuum import Vacuum


class TwoEmitterSamples(volpath.TransientVolpath):
    """Every vertex is connected to two points on lights."""

    def strategies(self, contents):
        segment, scattering, _ = super().strategies(contents)
        return segment, scattering, [EmitterFound(), EmitterSampled(0.5), SecondEmitterSample(0.5)]


class WithPointLight(volpath.TransientVolpath):
    """Beside the scene's lights, a point light at (0.5, 0, 4)."""

    def strategies(self, contents):
        segment, scattering, connections = super().strategies(contents)
        return segment, scattering, [*connections, OwnPointLight([0.5, 0.0, 4.0], 10.0)]


class Guided(path.TransientPath):
    """Half of the next vertices are drawn over the area of the shape ``side``."""

    def strategies(self, contents):
        return Vacuum(), Surface([AreaOfShape("side", 0.5)]), [EmitterFound(), EmitterSampled()]


register("integrator", "transient_two_emitter_samples", TwoEmitterSamples)
register("integrator", "transient_with_point_light", WithPointLight)
register("integrator", "transient_guided", Guided)
