"""Every reader of files of the library, with small sound files that it reads."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from support.text_files import RECIPES, SCENE, SETUPS
from torchtransient.files.captures.formats import LAYOUTS


@dataclass(frozen=True)
class Reader:
    """``sources``: writes sound files; ``read``: of one file, what decides about its content, None where nothing is
    compared; ``sealed``: whether a source carries checksums.
    """

    sources: Callable[[Path], list[Path]]
    read: Callable[[Path], Any]
    sealed: Callable[[Path], bool] = lambda path: False


def _content(value: Any) -> str:
    from torchtransient.files.content_key import content_key

    return content_key(value)


def _results(folder: Path) -> list[Path]:
    import torch

    from support.sealed_files import as_first_version
    from torchtransient import RenderOutput, RenderStats
    from torchtransient.axes import FrequencyAxis, TimeAxis
    from torchtransient.files import write_result
    from torchtransient.gates import Gate

    generator = torch.Generator().manual_seed(0)
    stats = RenderStats(
        spp=16, seconds=0.5, samples_per_second=1e4, variant="llvm_ad_rgb", integrator="transient_path",
        temporal_filter="box", seeds=(0,), energy_before=(0.0,), energy_after=(0.25,), energy_total=(1.0,),
    )  # fmt: skip
    cube = torch.rand(3, 5, 4, 6, generator=generator)
    channels = ("r", "g", "b")
    common = {"stats": stats, "channels": channels}
    outputs = {
        "transient": RenderOutput(cube, cube.sum(-3), None, axis=TimeAxis(3.5, 0.02, 5), **common),
        "phasor": RenderOutput(
            None, cube[:, 0], torch.complex(cube[:, :2], cube[:, 2:4]), axis=None,
            frequencies=FrequencyAxis((0.5, 2.0), 1.5), **common,
        ),
        "gated": RenderOutput(
            None, cube[:, :2].sum(-3), None, axis=None, gated=cube[:, :2], **common,
            gates=(Gate.rectangular(0.0, 1.0), Gate.rectangular(1.0, 2.5)),
        ),
    }  # fmt: skip
    found = []
    for name, output in outputs.items():
        for ending in ("h5", "npz"):
            found.append(write_result(folder / f"{name}.{ending}", output, {"scene": "box.xml"}))
            found.append(as_first_version(write_result(folder / f"{name}_first.{ending}", output, {"a": [1, "b"]})))
    return found


def _read_result(path: Path) -> str:
    from torchtransient.files import read_result

    return _content(read_result(path))


def _captures(folder: Path) -> list[Path]:
    from dataclasses import replace

    from support.capture_files import WALL, grids, listed, made
    from support.sealed_files import as_first_version

    wall = replace(grids()["confocal"], wall=dict(WALL.shape))
    captures = {
        "confocal": made(grids()["confocal"]), "list": made(listed("exhaustive"), phasor=True),
        "wall": made(wall, channels=("y",), metadata={"a": [1, 0.1]}),
    }  # fmt: skip
    found = []
    for name, capture in captures.items():
        for ending in ("h5", "npz"):
            found.append(capture.write(folder / f"{name}.{ending}"))
            found.append(as_first_version(capture.write(folder / f"{name}_first.{ending}")))
    return found


def _read_capture(path: Path) -> str:
    import torchtransient as tt

    return _content(tt.nlos.Capture.read(path))


def _volumes(folder: Path) -> list[Path]:
    import torch

    import torchtransient as tt
    from support.sealed_files import as_first_version

    eye = torch.eye(3, dtype=torch.float64)
    axes = dict(zip(("along_x", "along_y", "normal"), eye, strict=True))
    grid = tt.nlos.VoxelGrid(torch.linspace(0.1, 1, 4), (5, 6), (0.1, 0.2), first=eye[0] * 0, **axes)
    volumes = {
        "plain": tt.nlos.HiddenVolume(torch.arange(120.0).reshape(1, 4, 5, 6), grid, "fk", metadata={"a": 1}),
        "film": tt.nlos.HiddenVolume(
            torch.arange(240.0).reshape(1, 2, 4, 5, 6), grid, "fk", times=torch.tensor([0.0, 1.0])
        ),
    }
    found = []
    for name, volume in volumes.items():
        for ending in ("h5", "npz"):
            found.append(tt.nlos.write_volume(folder / f"{name}.{ending}", volume))
            found.append(as_first_version(tt.nlos.write_volume(folder / f"{name}_first.{ending}", volume)))
    return found


def _read_volume(path: Path) -> str:
    import torchtransient as tt

    return _content(tt.nlos.read_volume(path))


def _foreign(layout: str) -> Reader:
    def sources(folder: Path) -> list[Path]:
        from support.capture_files import sound_files
        from support.hostile_captures import old_mat

        found = [path for _, path in sound_files(folder, (layout,))]
        return [*found, old_mat(folder / "old.mat")] if layout == "phasor_field" else found

    def read(path: Path) -> None:
        import torchtransient as tt

        answers = {
            "wall_size": 0.6, "bin_width_s": 1e-11, "start_s": 0.0, "sensor_origin": (0.0, 0.0, 1.0),
            "laser_origin": (0.0, 0.0, 1.0), "frame": 0,
        }  # fmt: skip
        said: dict[str, Any] = {}
        while True:
            try:
                tt.nlos.read_capture(path, **said)
            except tt.errors.StorageError as error:
                asked = re.search(r"Give (\w+)=", str(error))
                if asked is None or asked[1] in said or asked[1] not in answers:
                    raise
                said[asked[1]] = answers[asked[1]]
            else:
                return

    return Reader(sources, read)


def _shards(folder: Path) -> list[Path]:
    from support.stored_samples import sample, write
    from torchtransient.data.shard_format import COMPRESSIONS

    samples = [sample(0, (1, 256, 4, 4)), ValueError("dark"), sample(2, (1, 256, 4, 4))]
    return [write(folder / f"{name}.h5", samples, compression=name) for name in COMPRESSIONS]


def _read_shard(path: Path) -> str | None:
    from torchtransient.data import Shard

    with Shard(path) as shard:
        fault = shard.verify()
        content: list[Any] = [shard.header, shard.failed, shard.structure]
        for row in shard.index.values():
            content += [shard.values(row), *(shard.read(name, row) for name in shard.names)]
            content += [shard.dtype(name) for name in shard.names]
        return _content(content) if fault is None else None


def _data_sets(folder: Path) -> list[Path]:
    from support.stored_samples import sample, write
    from torchtransient.data import build_manifest

    place = folder / "set"
    place.mkdir()
    for number in range(2):
        samples = [sample(i, (1, 256, 4, 4)) for i in (2 * number, 2 * number + 1)]
        write(place / f"shard-{number:06d}.h5", samples, shard=number)
    build_manifest(place)
    described = dict.fromkeys(("format", "key", "n", "per_shard", "store", "compression"), 1)
    text = json.dumps({**described, "n": 4, "key": "abc123", "about": {"spp": 16}, "recipe": {"n": 4}})
    (place / "recipe.json").write_text(text)
    return sorted(place.iterdir())


def _read_data_set(path: Path) -> None:
    """The mutant in the place of the file that it was made of, whose name it ends with."""
    from torchtransient.data import TransientDataset, build_manifest, verify
    from torchtransient.data.run_settings import read_description

    source = path.parent / "sources" / "set"
    place = path.parent / "changed"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(source, place)
    (name,) = (one.name for one in source.iterdir() if path.name.endswith(one.name))
    shutil.copyfile(path, place / name)
    str(verify(place))
    read_description(place)
    data = TransientDataset(place)
    for number in range(len(data)):
        data[number]
    build_manifest(place)


def _tars(folder: Path) -> list[Path]:
    from support.stored_samples import sample, write
    from torchtransient.data import export_web_dataset

    (folder / "shards").mkdir()
    write(folder / "shards" / "shard-000000.h5", [sample(i, (1, 256, 4, 4)) for i in range(2)])
    return export_web_dataset(folder / "shards", folder, progress=False)


def _read_tar(path: Path) -> None:
    from torchtransient.data import read_web_dataset

    for _ in read_web_dataset(path):
        pass


def _devices(folder: Path) -> list[Path]:
    import torchtransient as tt

    found = []
    for name in ("kinect_v2_like", "vl53l8_like"):
        device = tt.sensing.device(name)
        device.to_yaml(folder / f"{name}.yaml")
        device.to_json(folder / f"{name}.json")
        found += [folder / f"{name}.yaml", folder / f"{name}.json"]
    return found


def _read_device(path: Path) -> None:
    import torchtransient as tt

    read = tt.sensing.Device.from_yaml if path.suffix == ".yaml" else tt.sensing.Device.from_json
    read(path)


def _recipes(folder: Path) -> list[Path]:
    import torchtransient as tt

    found = []
    for name, text in RECIPES.items():
        (folder / f"{name}.yaml").write_text(text)
        recipe = tt.data.Recipe.read(folder / f"{name}.yaml")
        (folder / f"{name}.json").write_text(json.dumps(recipe.to_dict(), indent=1))
        found += [folder / f"{name}.yaml", folder / f"{name}.json"]
    return found


def _read_recipe(path: Path) -> None:
    import torchtransient as tt

    recipe = tt.data.Recipe.read(path)
    recipe.key()
    recipe.draw(0)


def _setups(folder: Path) -> list[Path]:
    import torchtransient as tt

    found = []
    for name, text in SETUPS.items():
        (folder / f"{name}.yaml").write_text(text)
        tt.nlos.read_setup(folder / f"{name}.yaml")
        found.append(folder / f"{name}.yaml")
    return found


def _read_setup(path: Path) -> None:
    import torchtransient as tt

    tt.nlos.read_setup(path)


def _scenes(folder: Path) -> list[Path]:
    (folder / "scene.xml").write_text(SCENE)
    return [folder / "scene.xml"]


def _read_scene(path: Path) -> None:
    import torchtransient as tt

    tt.load(path, "llvm_ad_rgb")


def _build_scene(path: Path) -> None:
    import torchtransient as tt

    tt.load(path, "llvm_ad_rgb").parameters()


def _is_sealed(path: Path) -> bool:
    return "_first" not in path.name


READERS: dict[str, Reader] = {
    "result": Reader(_results, _read_result, _is_sealed),
    "capture": Reader(_captures, _read_capture, _is_sealed),
    "volume": Reader(_volumes, _read_volume, _is_sealed),
    **{f"capture of {layout.name}": _foreign(layout.name) for layout in LAYOUTS},
    "shard": Reader(_shards, _read_shard, lambda path: True),
    "data set": Reader(_data_sets, _read_data_set),
    "WebDataset": Reader(_tars, _read_tar),
    "device": Reader(_devices, _read_device),
    "recipe": Reader(_recipes, _read_recipe),
    "setup": Reader(_setups, _read_setup),
    "scene": Reader(_scenes, _read_scene),
    "built scene": Reader(_scenes, _build_scene),
}
