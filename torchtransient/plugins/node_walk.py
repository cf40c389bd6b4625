"""Walks over the objects of a built scene: what a plugin shows in its ``traverse``."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import TEXTURES_WITHOUT_MEAN, attribute_name, shows_rows, users_name
from torchtransient.plugins.mitsuba_shapes import group_name, has_surface, is_instance


class ShownValue(NamedTuple):
    """Parameter of a plugin, as its ``traverse`` shows it.

    Attributes:
        key: name in the plugin.
        handle: the value itself where ``cpptype`` is None (plugins written in Python), else an address inside the
            plugin.
        flags: Mitsuba's ``ParamFlags``.
        cpptype: type at that address.
    """

    key: str
    handle: Any
    flags: int
    cpptype: Any

    # An address in a plugin, which recorded calls are handed.
    only_remembers = True

    def read(self, node: Any) -> Any:
        """Return the current value, attached where it is; ``node`` is the plugin that showed it."""
        return self.handle if self.cpptype is None else unshared(mi.get_property(self.handle, self.cpptype, node))


def unshared(value: Any) -> Any:
    """Return a copy of a Dr.Jit array, and other values as they are.

    Reading a plugin's literal would evaluate it into memory, which recorded calls cannot find in every plugin (``hg``
    shows it to Mitsuba alone).

    Args:
        value: value of a parameter.
    """
    return type(value)(value) if dr.is_jit_v(value) else value


@functools.cache
def _collector(base: type) -> type:
    """Return a callback class that collects the values and objects that one plugin shows, made once for each variant.
    """

    class Collector(base):  # type: ignore[misc, valid-type]
        def __init__(self) -> None:
            super().__init__()
            self.values: list[ShownValue] = []
            self.objects: list[tuple[str, Any, int]] = []

        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                self.objects.append((name, value, int(flags)))
            elif value is not None:
                self.values.append(ShownValue(name, value, int(flags), cpptype))

        # Older plugins call these two.
        put_object = put
        put_value = put

    return Collector


def shown_by(node: Any) -> tuple[list[ShownValue], list[tuple[str, Any, int]]]:
    """Return the values and objects that one plugin shows to ``mi.TraversalCallback``, without those below it.

    Args:
        node: Mitsuba object.

    Returns:
        (parameters; objects as (name, object, flags)).
    """
    collector = _collector(mi.TraversalCallback)()
    node.traverse(collector)
    if shows_rows() and isinstance(node, mi.Mesh):
        collector.values = [value._replace(key=users_name(node, value.key)) for value in collector.values]
    return collector.values, collector.objects


def objects_of(node: Any) -> list[tuple[str, Any]]:
    """Return the objects that a plugin holds, as (name, object), in order.

    Args:
        node: Mitsuba object.
    """
    return [(name, value) for name, value, _ in shown_by(node)[1]]


def objects_below(node: Any, kind: type, through: bool = True) -> list[Any]:
    """Return the objects of a kind below a plugin, each once and in order.

    Args:
        node: Mitsuba object, which is not among them.
        kind: class of Mitsuba.
        through: also look inside of objects of that kind.
    """
    found: dict[int, Any] = {}
    visited: set[int] = set()
    # Not a function that calls itself: it would be a circle of references, and what it has seen would live on.
    waiting = objects_of(node)[::-1]
    while waiting:
        _, value = waiting.pop()
        if value.ptr in visited:
            continue
        visited.add(value.ptr)
        if isinstance(value, kind):
            found[value.ptr] = value
            if not through:
                continue
        waiting += objects_of(value)[::-1]
    return list(found.values())


def has_mean(texture: Any) -> bool:
    """Return True if Mitsuba knows the mean of a texture, and those of the textures that it holds.

    Args:
        texture: one ``mi.Texture``.
    """
    held = (texture, *objects_below(texture, mi.Texture))
    return not any(t.class_name() in TEXTURES_WITHOUT_MEAN.values() for t in held)


def carries_derivatives(node: Any) -> bool:
    """Return True if a number of a plugin, or of an object in it, is attached. Call with gradients enabled.

    Also for textures that read an attribute of their shapes, which may be attached.

    Args:
        node: Mitsuba object.
    """
    below = (node, *objects_below(node, mi.Object))
    if any(isinstance(part, mi.Texture) and attribute_name(part) is not None for part in below):
        return True
    return any(dr.grad_enabled(shown.read(part)) for part in below for shown in shown_by(part)[0])


def attached_as(*values: Any) -> tuple[int, ...]:
    """Return the AD node of each array, 0 for detached arrays. Call with gradients enabled.

    Args:
        values: Dr.Jit arrays.
    """
    return tuple(value.index_ad if dr.grad_enabled(value) else 0 for value in values)


def bsdfs_below(node: Any) -> list[Any]:
    """Return the outermost BSDFs below a scene, shape or BSDF, those of shape groups included, each once and in order.

    Args:
        node: Mitsuba object, which is not among them.
    """
    return objects_below(node, mi.BSDF, through=False)


def bsdfs_of_scene(scene: Any) -> list[Any]:
    """Return the outermost BSDFs of a scene, those of shape groups included, each once.

    Args:
        scene: Mitsuba scene.
    """
    # Every shape is asked for its own: some (ellipsoids) do not show it in a walk.
    bsdfs = (shape.bsdf() for shape in shapes_of_scene(scene) if has_surface(shape))
    return list({bsdf.ptr: bsdf for bsdf in bsdfs if bsdf is not None}.values())


def shapes_of_scene(scene: Any) -> list[Any]:
    """Return all shapes of a scene, those of shape groups included.

    Args:
        scene: Mitsuba scene.
    """
    shapes = list(scene.shapes())
    if not any(is_instance(shape) for shape in shapes):
        return shapes
    # Shapes of groups are not among the scene's own. Walking the whole scene finds them, at a price per parameter.
    return objects_below(scene, mi.Shape)


def members_of(scene: Any, instance: Any) -> list[Any]:
    """Return the shapes that an instance copies, in the order of their numbers in intersections (``shape_index``).

    Args:
        scene: Mitsuba scene that has the group.
        instance: shape of :func:`~.mitsuba_shapes.is_instance`.
    """
    name = group_name(instance)
    group = next(s for s in objects_below(scene, mi.Shape) if s.class_name() == "ShapeGroupPlugin" and s.id() == name)
    return [shape for _, shape in objects_of(group) if isinstance(shape, mi.Shape)]


def owners_of(node: Any, holders: dict[int, list[tuple[Any, str]]]) -> Iterator[tuple[Any, str]]:
    """Return all that holds a plugin, directly or not, nearest first.

    Args:
        node: plugin.
        holders: direct holders by address of the object held, as (holder, name there).

    Returns:
        Iterator of (holder, its name for the object that leads to ``node``).
    """
    waiting: list[Any] = [node]
    seen: set[int] = set()
    while waiting:
        for holder, name in holders.get(waiting.pop(0).ptr, ()):
            yield holder, name
            if holder.ptr not in seen:
                seen.add(holder.ptr)
                waiting.append(holder)
