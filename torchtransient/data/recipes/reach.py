"""How far light has to go: whether what moves is ever seen within the time axis. Boxes around things, no rendering."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.data.recipes.distribution import POSE
from torchtransient.data.recipes.kept_scene import Kept
from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import POSITIONS

# (2, 3): lower and upper corner of a box along the axes of the world; a point is a box without a size.
Box = NDArray[np.float64]


def check_reach(built: Any, kept: Kept, draws: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
    """Raise SceneError where a moved shape cannot be seen before the time axis ends: the shortest way of light over it
    is longer. ``draws``: words for messages, and what is drawn. Lights without a place (skies, directional ones) and
    films without a time axis are not looked at.
    """
    axis = kept.renderer.axis
    # A pulse that is centred elsewhere brings light at other times.
    if axis is None or not kept.places or kept.renderer._pulsed:
        return
    boxes = {shape.id(): _box(shape.bbox()) for shape in built.scene.shapes() if shape.bbox().valid()}
    for where, drawn in draws:
        moved = _moved(kept, drawn, boxes)
        ends = _ends(built, kept, drawn, boxes | moved)
        if ends is None:
            return
        first, last = ends
        for name, box in moved.items():
            shines = any(box is light for light in first)
            way = min((0.0 if shines else _between(light, box)) for light in first)
            shortest = way + min(_between(box, eye) for eye in last)
            if shortest > axis.end_opl:
                key = next(key for key in kept.places if key.rsplit(".", 1)[0] == name)
                raise SceneError(
                    f"recipe: vary: {key!r} {where} leaves the window: the shortest way of light over {name!r} is "
                    f"{shortest:.4g} m, the time axis ends at {axis.end_opl:.4g} m. Make the axis longer, or keep it "
                    "closer."
                )


def _moved(kept: Kept, drawn: Mapping[str, Any], boxes: Mapping[str, Box]) -> dict[str, Box]:
    """Boxes of the shapes that a draw moves, by their names."""
    found = {}
    for key, place in kept.places.items():
        name, entry = key.rsplit(".", 1)
        if name not in boxes or place.described is None:
            continue
        if entry == "to_world" and place.kind == POSE:
            found[name] = _transformed(boxes[name], drawn[key] @ np.linalg.inv(place.described))
        elif entry == POSITIONS:
            vertices = np.asarray(drawn[key]).reshape(-1, 3)
            found[name] = np.stack([vertices.min(0), vertices.max(0)])
    return found


def _ends(built: Any, kept: Kept, drawn: Mapping[str, Any], boxes: Mapping[str, Box]) -> Any:
    """Boxes that light starts from and boxes that it is counted to; None where it comes from everywhere."""
    if kept.scan is not None:
        scan = kept.scan
        lit, seen = (points.detach().cpu().numpy().reshape(-1, 3) for points in (scan.laser_points, scan.sensor_points))
        return [np.stack([lit.min(0), lit.max(0)])], [np.stack([seen.min(0), seen.max(0)])]
    lights = []
    for emitter in built.scene.emitters():
        light = _place_of(emitter, drawn, boxes)
        if light is None:
            return None
        lights.append(light)
    if getattr(built.scene.integrator(), "camera_unwarp", False):
        # Lengths are counted to the first thing seen.
        return lights, [np.array([[-np.inf] * 3, [np.inf] * 3])]
    eyes = []
    for sensor in built.scene.sensors():
        shape = sensor.get_shape()
        if shape is not None:
            eyes.append(boxes.get(shape.id(), _box(shape.bbox())))
            continue
        pose = drawn.get(f"{sensor.id()}.to_world", np.array(sensor.world_transform().matrix).reshape(4, 4, -1)[..., 0])
        eyes.append(np.stack([pose[:3, 3]] * 2))
    return lights, eyes


def _place_of(emitter: Any, drawn: Mapping[str, Any], boxes: Mapping[str, Box]) -> Box | None:
    shape = emitter.get_shape()
    if shape is not None:
        return boxes.get(shape.id(), _box(shape.bbox()))
    box = emitter.bbox()
    for entry in ("position", "to_world"):
        value = drawn.get(f"{emitter.id()}.{entry}")
        if value is not None:
            point = np.asarray(value if entry == "position" else value[:3, 3], dtype=np.float64)
            return np.stack([point, point])
    return _box(box) if box.valid() else None


def _box(box: Any) -> Box:
    return np.stack([np.array(corner, dtype=np.float64).reshape(3) for corner in (box.min, box.max)])


def _transformed(box: Box, matrix: NDArray[np.float64]) -> Box:
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2], 1.0] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    points = (corners @ matrix.T)[:, :3]
    return np.stack([points.min(0), points.max(0)])


def _between(a: Box, b: Box) -> float:
    """The shortest way from one box to the other."""
    gap = np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))
    return float(np.linalg.norm(gap))
