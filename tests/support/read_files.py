"""Every reader of files of the library, with small sound files that it reads."""

from __future__ import annotations

import json
import shutil
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

import torchtransient as tt
from support.capture_files import WALL, grids, listed, made, read_answered, sound_files, volume
from support.hostile_captures import old_mat
from support.sealed_files import as_first_version
from support.stored_samples import sample, write
from support.text_files import RECIPES, SCENE, SETUPS
from torchtransient.data.run_settings import read_description
from torchtransient.data.shard_format import COMPRESSIONS
from torchtransient.files import content_key, read_result, write_result
from torchtransient.files.captures.formats import LAYOUTS


@dataclass(frozen=True)
class Reader:
    """``sources``: writes sound files; ``read``: of one file, what decides about its content, None where nothing is
    compared; ``sealed``: whether a source carries checksums.
    """

    sources: Callable[[Path], list[Path]]
    read: Callable[[Path], Any]
    sealed: Callable[[Path], bool] = lambda path: False


def _both_versions(folder: Path, values: dict[str, Any], write_one: Callable[[Path, Any], Path]) -> list[Path]:
    """Files of both kinds, with checksums and without, as the first version had none."""
    found = []
    for name, value in values.items():
        for ending in ("h5", "npz"):
            found.append(write_one(folder / f"{name}.{ending}", value))
            found.append(as_first_version(write_one(folder / f"{name}_first.{ending}", value)))
    return found


def _results(folder: Path) -> list[Path]:
    generator = torch.Generator().manual_seed(0)
    stats = tt.RenderStats(
        spp=16, seconds=0.5, samples_per_second=1e4, variant="llvm_ad_rgb", integrator="transient_path",
        temporal_filter="box", seeds=(0,), energy_before=(0.0,), energy_after=(0.25,), energy_total=(1.0,),
    )  # fmt: skip
    cube = torch.rand(3, 5, 4, 6, generator=generator)
    common = {"stats": stats, "channels": ("r", "g", "b")}
    outputs = {
        "transient": tt.RenderOutput(cube, cube.sum(-3), None, axis=tt.TimeAxis(3.5, 0.02, 5), **common),
        "phasor": tt.RenderOutput(
            None, cube[:, 0], torch.complex(cube[:, :2], cube[:, 2:4]), axis=None,
            frequencies=tt.FrequencyAxis((0.5, 2.0), 1.5), **common,
        ),
        "gated": tt.RenderOutput(
            None, cube[:, :2].sum(-3), None, axis=None, gated=cube[:, :2], **common,
            gates=(tt.Gate.rectangular(0.0, 1.0), tt.Gate.rectangular(1.0, 2.5)),
        ),
    }  # fmt: skip
    return _both_versions(folder, outputs, lambda path, output: write_result(path, output, {"a": [1, "b"]}))


def _captures(folder: Path) -> list[Path]:
    wall = replace(grids()["confocal"], wall=dict(WALL.shape))
    captures = {
        "confocal": made(grids()["confocal"]), "list": made(listed("exhaustive"), phasor=True),
        "wall": made(wall, channels=("y",), metadata={"a": [1, 0.1]}),
    }  # fmt: skip
    return _both_versions(folder, captures, lambda path, capture: capture.write(path))


def _volumes(folder: Path) -> list[Path]:
    film = replace(volume(), values=torch.arange(240.0).reshape(1, 2, 4, 5, 6), times=torch.tensor([0.0, 1.0]))
    return _both_versions(folder, {"plain": volume(), "film": film}, tt.nlos.write_volume)


def _foreign(layout: str) -> Reader:
    def sources(folder: Path) -> list[Path]:
        found = [path for _, path in sound_files(folder, (layout,))]
        return [*found, old_mat(folder / "old.mat")] if layout == "phasor_field" else found

    return Reader(sources, read_answered)


def _shards(folder: Path) -> list[Path]:
    samples = [sample(0, (1, 256, 4, 4)), ValueError("dark"), sample(2, (1, 256, 4, 4))]
    return [write(folder / f"{name}.h5", samples, compression=name) for name in COMPRESSIONS]


def _read_shard(path: Path) -> str | None:
    with tt.data.Shard(path) as shard:
        fault = shard.verify()
        content: list[Any] = [shard.header, shard.failed, shard.structure]
        for row in shard.index.values():
            content += [shard.values(row), *(shard.read(name, row) for name in shard.names)]
            content += [shard.dtype(name) for name in shard.names]
        return content_key(content) if fault is None else None


def _data_sets(folder: Path) -> list[Path]:
    place = folder / "set"
    place.mkdir()
    for number in range(2):
        samples = [sample(i, (1, 256, 4, 4)) for i in (2 * number, 2 * number + 1)]
        write(place / f"shard-{number:06d}.h5", samples, shard=number)
    tt.data.build_manifest(place)
    described = dict.fromkeys(("format", "key", "n", "per_shard", "store", "compression"), 1)
    text = json.dumps({**described, "n": 4, "key": "abc123", "about": {"spp": 16}, "recipe": {"n": 4}})
    (place / "recipe.json").write_text(text)
    return sorted(place.iterdir())


def _read_data_set(path: Path) -> None:
    """The mutant in the place of the file that it was made of, whose name it ends with."""
    source = path.parent / "sources" / "set"
    place = path.parent / "changed"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(source, place)
    (name,) = (one.name for one in source.iterdir() if path.name.endswith(one.name))
    shutil.copyfile(path, place / name)
    str(tt.data.verify(place))
    read_description(place)
    data = tt.data.TransientDataset(place)
    for number in range(len(data)):
        data[number]
    tt.data.build_manifest(place)


def _tars(folder: Path) -> list[Path]:
    (folder / "shards").mkdir()
    write(folder / "shards" / "shard-000000.h5", [sample(i, (1, 256, 4, 4)) for i in range(2)])
    return tt.data.export_web_dataset(folder / "shards", folder, progress=False)


def _devices(folder: Path) -> list[Path]:
    found = []
    for name in ("kinect_v2_like", "vl53l8_like"):
        device = tt.sensing.device(name)
        device.to_yaml(folder / f"{name}.yaml")
        device.to_json(folder / f"{name}.json")
        found += [folder / f"{name}.yaml", folder / f"{name}.json"]
    return found


def _read_device(path: Path) -> None:
    (tt.sensing.Device.from_yaml if path.suffix == ".yaml" else tt.sensing.Device.from_json)(path)


def _recipes(folder: Path) -> list[Path]:
    found = []
    for name, text in RECIPES.items():
        (folder / f"{name}.yaml").write_text(text)
        recipe = tt.data.Recipe.read(folder / f"{name}.yaml")
        (folder / f"{name}.json").write_text(json.dumps(recipe.to_dict(), indent=1))
        found += [folder / f"{name}.yaml", folder / f"{name}.json"]
    return found


def _read_recipe(path: Path) -> None:
    recipe = tt.data.Recipe.read(path)
    recipe.key()
    recipe.draw(0)


def _setups(folder: Path) -> list[Path]:
    found = []
    for name, text in SETUPS.items():
        (folder / f"{name}.yaml").write_text(text)
        tt.nlos.read_setup(folder / f"{name}.yaml")
        found.append(folder / f"{name}.yaml")
    return found


def _scenes(folder: Path) -> list[Path]:
    (folder / "scene.xml").write_text(SCENE)
    return [folder / "scene.xml"]


def _is_sealed(path: Path) -> bool:
    return "_first" not in path.name


READERS: dict[str, Reader] = {
    "result": Reader(_results, lambda path: content_key(read_result(path)), _is_sealed),
    "capture": Reader(_captures, lambda path: content_key(tt.nlos.Capture.read(path)), _is_sealed),
    "volume": Reader(_volumes, lambda path: content_key(tt.nlos.read_volume(path)), _is_sealed),
    **{f"capture of {name}": _foreign(name) for name in LAYOUTS},
    "shard": Reader(_shards, _read_shard, lambda path: True),
    "data set": Reader(_data_sets, _read_data_set),
    "WebDataset": Reader(_tars, lambda path: deque(tt.data.read_web_dataset(path), 0)),
    "device": Reader(_devices, _read_device),
    "recipe": Reader(_recipes, _read_recipe),
    "setup": Reader(_setups, tt.nlos.read_setup),
    "scene": Reader(_scenes, lambda path: tt.load(path, "llvm_ad_rgb")),
    "built scene": Reader(_scenes, lambda path: tt.load(path, "llvm_ad_rgb").parameters()),
}
