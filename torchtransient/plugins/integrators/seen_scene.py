"""What an integrator remembers of the scene that it has seen last."""

from __future__ import annotations

from typing import Any

from torchtransient.plugins.described_scene import check_scene, described
from torchtransient.plugins.parameters import ParameterTracker
from torchtransient.plugins.sampling.distant import DistantReference
from torchtransient.plugins.transport.contents import SceneContents


class SeenScene:
    """Look-ups that need to be made once a scene: the ``reference`` sphere of distant light, the contents by sensor,
    the parameters.

    The reference is that of the scene as described, see :mod:`..described_scene`: neither moving a shape nor what was
    rendered before may shift the clock. The scene itself is not kept, since it owns the integrator and would never be
    freed.
    """

    def __init__(self, scene: Any, integrator: Any) -> None:
        self._described = described(scene, integrator)
        check_scene(scene, known=self._described)
        self.reference: DistantReference = self._described.reference
        # So that no later scene can be taken for this one because it got the same addresses.
        self._kept = scene.shapes()[:1]
        self._plugins: tuple[int, ...] = ()
        self._contents: dict[int, tuple[Any, SceneContents]] = {}
        self._tracker: ParameterTracker | None = None

    def is_of(self, scene: Any) -> bool:
        """Whether it is this scene."""
        return self._described.is_of(scene)

    def contents_for(self, scene: Any, sensor: Any) -> SceneContents:
        """What the scene contains for a sensor, which may stand in a medium."""
        self._forget_replaced(scene)
        if sensor.ptr not in self._contents:
            # With the sensor, so that no later one can be taken for it.
            self._contents[sensor.ptr] = sensor, SceneContents(scene, sensor, self.reference)
        return self._contents[sensor.ptr][1]

    def tracker(self, scene: Any) -> ParameterTracker:
        """The scene's parameters. Walked over when first asked for: a render has no use for it."""
        self._forget_replaced(scene)
        if self._tracker is None:
            self._tracker = ParameterTracker(scene)
        return self._tracker


    def _forget_replaced(self, scene: Any) -> None:
        """Look up anew when a shape was given another BSDF (``shape.set_bsdf``) or a BSDF got another lobe."""
        plugins = _plugins_of(scene)
        if plugins != self._plugins:
            self._plugins, self._tracker = plugins, None
            self._contents.clear()


def _plugins_of(scene: Any) -> tuple[int, ...]:
    """What surfaces and lights are made of, by address: those in use are kept by the scene. With the kinds of lobes,
    since changed parameters may add one.
    """
    bsdfs = [bsdf for bsdf in (shape.bsdf() for shape in scene.shapes()) if bsdf is not None]
    lights = (emitter.ptr for emitter in scene.emitters())
    return (*(bsdf.ptr for bsdf in bsdfs), *(bsdf.flags() for bsdf in bsdfs), *lights)
