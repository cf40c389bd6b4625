"""What a scene was like before any value was installed in it: the sphere around it, which distant light is timed by.

A Mitsuba scene has no place for it, and its own environment emitters follow the shapes that move. The scene's Python
plugins keep it: its integrator, the films of its sensors, and whatever integrator renders it. They are told

- when ``mi.traverse`` walks the scene, the one way by which values come in (:func:`note_scene`);
- when the scene is rendered and no one has been told before: then nothing was installed yet.

So it does not depend on what is rendered first. Where the values came in otherwise, for instance by ``mi.traverse`` of
a single shape, or where neither the scene's integrator nor a film of its sensors is one of this library, it is that of
the first render.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.interfaces import IntegratorInterface, is_time_resolved
from torchtransient.plugins.finite_values import check_parameters
from torchtransient.plugins.sampling.distant import distant_reference
from torchtransient.plugins.texture_uses import check_textures


class DescribedScene:
    """``reference``: the sphere around a scene as described. Told from other scenes by the addresses of the scene and
    of its shapes; one shape is kept, so that no later scene can be taken for this one because it got the same ones:
    none that carries a sensor, whose film may keep this, and neither would ever be freed.
    """

    def __init__(self, scene: Any) -> None:
        self.reference = distant_reference(scene)
        self._key = _key_of(scene)
        self._kept = [shape for shape in scene.shapes() if not shape.is_sensor()][:1]
        self.is_checked = False

    def is_of(self, scene: Any) -> bool:
        """Whether it is this scene."""
        return self._key == _key_of(scene)


def described(scene: Any, *also: Any) -> DescribedScene:
    """What is known of a scene as described; ``also``: plugins outside of the scene that keep it, too."""
    keepers = [*also, *_keepers_of(scene)]
    known = (getattr(keeper, "described", None) for keeper in keepers)
    found = next((one for one in known if one is not None and one.is_of(scene)), None)
    if found is None:
        found = DescribedScene(scene)
    for keeper in keepers:
        keeper.described = found
    return found


def note_scene(plugin: Any, callback: Any) -> None:
    """For the ``traverse`` of a plugin that keeps what a scene was like: a scene that ``mi.traverse`` walks is as
    described, or was noted before.
    """
    # Mitsuba's own callback knows the way down to each plugin; others do not install values.
    hierarchy = getattr(callback, "hierarchy", {})
    above = plugin
    while above is not None and not isinstance(above, mi.Scene):
        above = hierarchy.get(above, (None, 0))[0]
    if above is not None:
        described(above)


def check_scene(scene: Any, params: Any = None, known: DescribedScene | None = None) -> None:
    """Raise ``SceneError`` where a number of a scene is NaN or infinite, or a texture stands where it cannot be read;
    a scene that was found right is not asked again. ``params``: its ``mi.traverse``, ``known``: what is known of it,
    where the caller has them.
    """
    known = known or described(scene)
    if known.is_checked or dr.flag(dr.JitFlag.FreezingScope):  # a recording has no values
        return
    params = mi.traverse(scene) if params is None else params
    check_parameters(params)
    check_textures(params)
    known.is_checked = True


def _keepers_of(scene: Any) -> list[Any]:
    films = (sensor.film() for sensor in scene.sensors())
    integrator = scene.integrator()
    own = [integrator] if isinstance(integrator, IntegratorInterface) else []
    return [*own, *(film for film in films if is_time_resolved(film))]


def _key_of(scene: Any) -> tuple[int, ...]:
    return (scene.ptr, *(shape.ptr for shape in scene.shapes()))
