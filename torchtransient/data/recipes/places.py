"""Where a recipe's scene was found: the same recipe elsewhere is the same one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def without_places(plain: Mapping[str, Any]) -> dict[str, Any]:
    """A recipe as plain data, without the folders that its files were in."""
    return {name: _placeless(entry) if name == "scene" else entry for name, entry in plain.items()}


def _placeless(scene: Any) -> Any:
    if not isinstance(scene, Mapping):
        return scene
    if "one_of" in scene:
        return {**scene, "one_of": {name: _placeless(one) for name, one in scene["one_of"].items()}}
    return {name: entry for name, entry in scene.items() if name not in ("folder", "xml")}
