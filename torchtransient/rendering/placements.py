"""Where the nodes of a description are placed."""

from __future__ import annotations

from typing import Any

import numpy as np


def mesh_transforms(state: Any) -> dict[str, np.ndarray]:
    """``to_world`` as described, by the name of the shape: meshes apply it while loading and forget it."""
    import mitsuba as mi

    result = {}
    for node in state.nodes:
        if node.type == mi.ObjectType.Shape and node.props.id():
            matrix = np.eye(4)
            if "to_world" in node.props:
                matrix = np.array(node.props["to_world"].matrix, dtype=np.float64)
            result[node.props.id()] = matrix
    return result


def placements(state: Any) -> dict[str, np.ndarray]:
    """Every ``to_world`` of the description, by its key."""
    found = {}
    for node in state.nodes:
        if "to_world" in node.props:
            name = node.props.id() or node.props.plugin_name()
            found[f"{name}.to_world"] = np.array(node.props["to_world"].matrix, dtype=np.float64)
    return found
