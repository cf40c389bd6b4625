"""``scene.save``: a scene with its values as an XML file that loads again, and the check that it does."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchtransient import plugins
from torchtransient.array_files.part_files import writing_said
from torchtransient.checks import check_folder, path_of
from torchtransient.errors import SceneError, ShapeError, TorchTransientError, UnitError
from torchtransient.plugins.node_walk import ShownValue, objects_below
from torchtransient.plugins.spectral_colours import keeps_coefficients, same_spectra
from torchtransient.plugins.unfinished import afterwards
from torchtransient.rendering.arguments import as_float, fit_shape
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.node_names import name_nodes, take_merged_apart
from torchtransient.rendering.parameters import read_value
from torchtransient.rendering.saving.values import mesh_as_file, places_of, write_value
from torchtransient.rendering.saving.xml_nodes import XmlWriter
from torchtransient.rendering.session import own_array
from torchtransient.rendering.taken import ReadyScene
from torchtransient.rendering.variant import active_variant, device_type, in_variant

if TYPE_CHECKING:
    from torchtransient.rendering.scene_handle import Scene

# Numbers that went through a file differ by the rounding of single precision.
_RTOL, _ATOL = 1e-5, 1e-6
_WAY_OUT = "Leave such keys out of values, or keep the values and the description: pickle.dumps(scene)."


def save_scene(
    scene: Scene, path: str | os.PathLike[str], values: Mapping[str, Any], load: Callable[..., Scene]
) -> Path:
    """Write a scene with ``values``, load it, and compare. ``load``: ``tt.load``."""
    scene._description.check_described("scene.save")
    target = path_of(path, "scene.save")
    if target.suffix != ".xml":
        raise SceneError(f"scene.save: expected the name of an XML file, such as scene.xml, got {str(target)!r}.")
    if not target.parent.is_dir():
        raise SceneError(f"scene.save: there is no folder {str(target.parent)!r}; make it first.")
    check_folder(target, "scene.save")
    files = f"{target.stem}_files"
    with writing_said(target, "scene.save"), tempfile.TemporaryDirectory(dir=target.parent) as place:
        draft = Path(place) / target.name
        with active_variant(scene.variant):
            wanted = _write(scene, draft, Path(place) / files, values)
            try:
                _compare(load(draft, variant=scene.variant), wanted, tuple(values))
            except SceneError as error:
                # The folder that it was tried in is gone.
                raise SceneError(str(error).replace(f"{place}{os.sep}", "")) from error
        if (target.parent / files).is_dir():
            shutil.rmtree(target.parent / files)
        if (Path(place) / files).is_dir():
            shutil.move(str(Path(place) / files), str(target.parent / files))
        os.replace(draft, target)
    return target


def _write(scene: Scene, draft: Path, folder: Path, values: Mapping[str, Any]) -> dict[str, Any]:
    """Write the files; the numbers that they should bring back, by key."""
    import mitsuba as mi

    description = scene._description
    assert not isinstance(description, ReadyScene)
    keys = tuple(values)
    options = _options(scene, keys)
    slots = scene.slots(keys, options)
    built = slots.built
    try:
        with afterwards(in_variant(scene.variant, lambda: scene.leave(options, slots, attached=True))):
            slots.install([_leaf(slot, values[slot.key], scene.variant) for slot in slots.slots])
            with description.resolved_files(), plugins.plugin_errors():
                state = _parsed(description, scene.variant)
                writer = XmlWriter(state, folder)
                places = places_of(built.scene, state)
                for slot in slots.slots:
                    shape = slot.shape if slot.kind != "mesh_transform" else (4, 4)
                    given = values[slot.key]
                    given = given.detach().cpu() if isinstance(given, torch.Tensor) else given
                    write_value(writer, built, places, slot, np.asarray(given, dtype=np.float64).reshape(shape))
                for value in objects_below(built.scene, mi.Object):
                    place = places.get(value.ptr)
                    if place is None or place.names:
                        continue
                    writer.note_kind(place.node, value)
                    if isinstance(value, mi.Mesh) and state.nodes[place.node].props.plugin_name() == "mesh_arrays":
                        mesh_as_file(writer, place.node, value)
                draft.write_text(writer.text(), encoding="utf-8")
            return _numbers(built)
    except (RuntimeError, ValueError, TypeError) as error:
        if isinstance(error, TorchTransientError):
            raise
        raise SceneError(f"scene.save: {description.name} cannot be written: {error}") from error


def _options(scene: Scene, keys: tuple[str, ...]) -> BuildOptions:
    plain = BuildOptions(real_bitmaps=True)
    return scene.options_for(keys, plain) if keys else plain


def _leaf(slot: Any, value: Any, variant: str) -> Any:
    numbers = as_float(slot.key, value, device_type(variant))
    odd = numbers[~numbers.isfinite()]
    if odd.numel():
        share = f" ({odd.numel()} of {numbers.numel()})" if numbers.numel() > 1 else ""
        raise UnitError(f"scene.save: value of {slot.key!r}: expected finite numbers, got {odd[0].item()}{share}.")
    tensor, batched = fit_shape(slot.key, numbers, slot.shape)
    if batched:
        raise ShapeError(f"scene.save: expected shape {slot.shape} for {slot.key!r}, got {tuple(tensor.shape)}.")
    slot.check(tensor)
    return own_array(tensor)


def _parsed(description: Any, variant: str) -> Any:
    import mitsuba as mi

    config = mi.parser.ParserConfig(variant)
    state = description.parse(config)
    mi.parser.transform_upgrade(config, state)
    mi.parser.transform_resolve(config, state)
    name_nodes(state)
    take_merged_apart(state)
    return state


def _numbers(built: Any) -> dict[str, Any]:
    found = {}
    for key, (handle, cpptype, node, _) in built.params.properties.items():
        current = ShownValue(key, handle, 0, cpptype).read(node)  # type: ignore[call-arg]
        found[key] = np.array(read_value(current, None) if np.ndim(current) == 0 else current)
    return found


def _compare(again: Scene, wanted: dict[str, Any], keys: tuple[str, ...]) -> None:
    """Raise ``SceneError`` where a scene that was read back is another one. It is built as the one of ``wanted``, with
    the plugins that ``keys`` ask for.
    """
    try:
        built = again.built(_options(again, keys))
        found = _numbers(built)
    except TorchTransientError as error:
        raise SceneError(f"scene.save: what was written does not load. {_WAY_OUT} {error}") from error
    other = sorted(found.keys() ^ wanted.keys())
    params = built.params.properties
    for key, value in wanted.items():
        if key in found and not _same(value, found[key]):
            spectral = keeps_coefficients(params[key][2], key.rsplit(".", 1)[-1])
            if not (spectral and same_spectra(value, found[key])):
                other.append(key)
    if other:
        raise SceneError(
            f"scene.save: {', '.join(other[:5])}{' ...' if len(other) > 5 else ''} cannot be said in XML: what was "
            f"read back is different. {_WAY_OUT}"
        )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape or a.dtype.kind not in "fiub":
        return a.shape == b.shape and bool(np.all(a == b))
    return bool(np.allclose(a, b, rtol=_RTOL, atol=_ATOL * max(1.0, float(np.abs(a).max(initial=0)))))
