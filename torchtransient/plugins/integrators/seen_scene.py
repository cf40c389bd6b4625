"""What an integrator remembers of the scene that it has seen last."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.described_scene import check_scene, described
from torchtransient.plugins.node_walk import objects_below, shapes_of_scene
from torchtransient.plugins.parameters import ParameterTracker
from torchtransient.plugins.sampling.lights import DistantReference
from torchtransient.plugins.transport.contents import SceneContents


class SeenScene:
    """Look-ups that need to be made once a scene: the ``reference`` sphere of distant light, the contents by sensor,
    the parameters, the BSDFs with all that they hold.

    The reference is that of the scene as described, see :mod:`..described_scene`: neither moving a shape nor what was
    rendered before may shift the clock. The scene itself is not kept, since it owns the integrator and would never be
    freed.
    """

    # What recorded calls depend on of it is in their worlds.
    only_remembers = True

    def __init__(self, scene: Any, integrator: Any) -> None:
        self._described = described(scene, integrator)
        check_scene(scene, known=self._described)
        self.reference: DistantReference = self._described.reference
        # So that no later scene can be taken for this one because it got the same addresses.
        self._kept = scene.shapes()[:1]
        own = {shape.ptr for shape in scene.shapes()}
        self._in_groups = [shape for shape in shapes_of_scene(scene) if shape.ptr not in own]
        self._pointers: tuple[int, ...] = ()
        self._lobes: list[int] = []
        self._bsdfs: list[Any] = []
        self._followers: list[Any] = []
        self._contents: dict[int, tuple[Any, SceneContents]] = {}
        self._tracker: ParameterTracker | None = None
        self._python: list[Any] | None = None
        # Parameters, by plugin and key, of which it was said which moving edges derivatives do not follow.
        self.told_of_edges: set[tuple[int, str]] = set()

    def is_of(self, scene: Any) -> bool:
        """Whether it is this scene."""
        return self._described.is_of(scene)

    def follow_derivatives(self, scene: Any, asked: bool) -> None:
        """Let the BSDFs that sample otherwise for derivatives look which parameters carry some now. ``asked``: for a
        job of derivatives. What they build for it belongs to the scene's contents.
        """
        self._forget_replaced(scene)
        with dr.resume_grad():
            for bsdf in self._followers:
                bsdf.follow_derivatives(asked)

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

    def python_plugins(self, scene: Any) -> list[Any]:
        """The plugins of the scene that are written in Python: integrator, films, samplers and filters included, and
        without what plugins do not show.
        """
        self._forget_replaced(scene)
        if self._python is None:
            # Of these alone: who holds a light or a sensor may hold its shape, and so on up to the scene.
            below = (mi.BSDF, mi.Texture, mi.Volume, mi.PhaseFunction, mi.Medium)
            found = [one for one in objects_below(scene, mi.Object) if isinstance(one, below)]
            self._python = list({one.ptr: one for one in found if _is_python(one)}.values())
        sensors = scene.sensors()
        films = [sensor.film() for sensor in sensors]
        others = [*sensors, *films, *(sensor.sampler() for sensor in sensors), *(film.rfilter() for film in films)]
        others += [*scene.emitters(), *scene.shapes(), scene.integrator()]
        return [*self._python, *filter(_is_python, others)]

    def _forget_replaced(self, scene: Any) -> None:
        """Look up anew when a shape was given another BSDF (``shape.set_bsdf``) or a BSDF got another lobe."""
        bsdfs = [bsdf for bsdf in (shape.bsdf() for shape in [*scene.shapes(), *self._in_groups]) if bsdf is not None]
        # By address: those in use are kept by the scene.
        pointers = (*(bsdf.ptr for bsdf in bsdfs), *(emitter.ptr for emitter in scene.emitters()))
        if pointers != self._pointers:
            outermost = {bsdf.ptr: bsdf for bsdf in bsdfs}.values()
            nested = [part for bsdf in outermost for part in objects_below(bsdf, mi.BSDF)]
            self._bsdfs = list({bsdf.ptr: bsdf for bsdf in [*outermost, *nested]}.values())
            self._followers = [bsdf for bsdf in self._bsdfs if hasattr(bsdf, "follow_derivatives")]
        # Changed parameters may add a lobe, which those around a BSDF do not tell of.
        lobes = [bsdf.flags() for bsdf in self._bsdfs]
        if pointers != self._pointers or lobes != self._lobes:
            self._pointers, self._lobes = pointers, lobes
            self._tracker = self._python = None
            self._contents.clear()


def _is_python(plugin: Any) -> bool:
    return type(plugin).__module__ != "mitsuba"
