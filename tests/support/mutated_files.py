"""Every reader of files against mutants of files that it reads, in a process of its own: what it must never do is die,
wait, raise what has no type, or return other content where a checksum stands beside it.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# Beside the longest path of a test's folder.
MOST_LETTERS = 400
SECONDS = 30
_MEMORY = 4 * 2**30
TESTS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Reader:
    """``sources``: writes sound files; ``read``: of one file, what decides about its content, None where nothing is
    compared; ``sealed``: whether a source carries checksums; ``beside``: files that lie beside each mutant.
    """

    sources: Callable[[Path], list[Path]]
    read: Callable[[Path], Any]
    sealed: Callable[[Path], bool] = lambda path: False


@dataclass
class Report:
    """What came of the mutants of one reader: how many were read and refused, by how many bytes the process has grown,
    and what must not be, a line each.
    """

    reader: str
    read: int = 0
    refused: int = 0
    grown: int = 0
    seconds: float = 0.0
    slowest: float = 0.0
    findings: list[str] = field(default_factory=list)


# ---------------------------------------------------------------------------------------------------------- the readers


def _content(value: Any) -> str:
    from torchtransient.files.content_key import content_key

    return content_key(value)


def _results(folder: Path) -> list[Path]:
    import torch

    from support.sealed_files import as_first_version
    from torchtransient.axes import FrequencyAxis, TimeAxis
    from torchtransient.files.result_file import write_result
    from torchtransient.gates import Gate
    from torchtransient.rendering.output import RenderOutput, RenderStats

    generator = torch.Generator().manual_seed(0)
    stats = RenderStats(
        spp=16, seconds=0.5, samples_per_second=1e4, variant="llvm_ad_rgb", integrator="transient_path",
        temporal_filter="box", seeds=(0,), energy_before=(0.0,), energy_after=(0.25,),
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
    from torchtransient.files.result_file import read_result

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
        from support.capture_files import holdable, read_only
        from support.hostile_captures import ENDINGS, old_mat
        from torchtransient.files.captures.mat_file import write_mat

        found = []
        for number, (name, _, capture) in enumerate(holdable()):
            if name == layout:
                found.append(capture.write(folder / f"{number}{ENDINGS[layout]}", layout))
        for number, (name, arrays) in enumerate(read_only()):
            if name == layout:
                found.append(folder / f"only{number}.mat")
                write_mat(found[-1], arrays)
        return [*found, old_mat(folder / "old.mat")] if layout == "phasor_field" else found

    def read(path: Path) -> None:
        import torchtransient as tt

        answers = {
            "wall_size": 0.6, "bin_width_s": 1e-11, "start_s": 0.0, "sensor_origin": (0.0, 0.0, 1.0),
            "laser_origin": (0.0, 0.0, 1.0),
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
    from torchtransient.data.storage.chunks import COMPRESSIONS

    samples = [sample(0, (1, 256, 4, 4)), ValueError("dark"), sample(2, (1, 256, 4, 4))]
    return [write(folder / f"{name}.h5", samples, compression=name) for name in COMPRESSIONS]


def _read_shard(path: Path) -> str | None:
    from torchtransient.data.storage.shard_file import Shard

    with Shard(path) as shard:
        fault = shard.verify()
        content: list[Any] = [shard.header, shard.failed, shard.structure]
        for row in shard.index.values():
            content += [shard.values(row), *(shard.read(name, row) for name in shard.names)]
            content += [shard.dtype(name) for name in shard.names]
        return _content(content) if fault is None else None


def _data_sets(folder: Path) -> list[Path]:
    from support.stored_samples import sample, write
    from torchtransient.data.storage.manifest import build_manifest

    place = folder / "set"
    place.mkdir()
    for number in range(2):
        samples = [sample(i, (1, 256, 4, 4)) for i in (2 * number, 2 * number + 1)]
        write(place / f"shard-{number:06d}.h5", samples, shard=number)
    build_manifest(place)
    described = {name: 1 for name in ("key", "n", "per_shard", "store", "compression", "max_outside")}
    text = json.dumps({**described, "n": 4, "key": "abc123", "about": {"spp": 16}, "recipe": {"n": 4}})
    (place / "recipe.json").write_text(text)
    return sorted(place.iterdir())


def _read_data_set(path: Path) -> None:
    """The mutant in the place of the file that it was made of, whose name it ends with."""
    from torchtransient.data.generation.settings import read_description
    from torchtransient.data.reading.transient_dataset import TransientDataset
    from torchtransient.data.storage.manifest import build_manifest, verify

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
    from torchtransient.data.storage.web_dataset import export_web_dataset

    (folder / "shards").mkdir()
    write(folder / "shards" / "shard-000000.h5", [sample(i, (1, 256, 4, 4)) for i in range(2)])
    return export_web_dataset(folder / "shards", folder, progress=False)


def _read_tar(path: Path) -> None:
    from torchtransient.data.storage.web_dataset import read_web_dataset

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


_RECIPES = {
    "scene": """scene: {builtin: cornell_box, resolution: 8}
variant: llvm_ad_mono
time_axis: {start_opl: 2.0, bin_width_opl: 0.2, num_bins: 60}
spp: 4
n: 12
labels: [depth]
device: vl53l8_like
pulse: {kind: gaussian, fwhm_s: 1e-10}
vary:
  red.reflectance.value: {uniform: [0.05, 0.9]}
  small-box.to_world: {compose: [{turn: {axis: [0, 1, 0]}}, {offset: [[-0.2, 0, 0], [0.2, 0, 0]]}]}
  small-box.type: {choice: [cube, sphere]}
""",
    "capture": """hidden: {letter: {shape: rectangle, scale: 0.2, rotate: [[0, 1, 0], 180], translate: [0, 0, 1]}}
wall: {width: 1, height: 1}
scan: {kind: confocal, size: [4, 4]}
variant: llvm_ad_mono
time_axis: {start_opl: 0, bin_width_opl: 0.02, num_bins: 200}
vary: {letter.to_world: {offset: [[-0.1, -0.1, 0], [0.1, 0.1, 0]]}}
""",
}


def _recipes(folder: Path) -> list[Path]:
    import torchtransient as tt

    found = []
    for name, text in _RECIPES.items():
        if name == "scene":
            text = text.replace("pulse: {kind: gaussian, fwhm_s: 1e-10}\n", "")
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


_SETUPS = {
    "own": """hidden:
  ball: {shape: sphere, scale: 0.2, translate: [0.4, 0, 0.8], albedo: 0.7}
wall: {width: 2.0, height: 2.0, albedo: 0.5}
scan: {kind: confocal, size: [4, 4]}
time_axis: {start_opl: 0.1, bin_width_opl: 0.01, num_bins: 300}
spp: 16
bounces: [3]
sensor: vl53l8_like
seed: 0
variant: llvm_ad_mono
""",
    "tal": """name: letter-single
mitsuba_variant: llvm_ad_mono
integrator_nlos_hidden_geometry_sampling: true
sample_count: 10_000
num_bins: 320
bin_width_opl: 0.003
start_opl: 1.95
sensor_width: 8
sensor_height: 6
geometry:
- name: ball
  mesh:
    type: sphere
  displacement_z: 1.0
  rot_degrees_x: 10.0
  material:
    id: copper
    alpha: 0.2
- name: relay_wall
  mesh:
    type: rectangle
  scale_x: 1
  scale_y: 0.5
  material:
    id: white
relay_wall: relay_wall
""",
}


def _setups(folder: Path) -> list[Path]:
    import torchtransient as tt

    found = []
    for name, text in _SETUPS.items():
        if name == "own":
            text = text.replace("sensor: vl53l8_like\n", "")
        (folder / f"{name}.yaml").write_text(text)
        tt.nlos.read_setup(folder / f"{name}.yaml")
        found.append(folder / f"{name}.yaml")
    return found


def _read_setup(path: Path) -> None:
    import torchtransient as tt

    tt.nlos.read_setup(path)


SCENE = """<scene version="3.0.0">
    <default name="spp" value="8"/>
    <default name="depth" value="3"/>
    <integrator type="transient_path">
        <integer name="max_depth" value="$depth"/>
        <boolean name="camera_unwarp" value="false"/>
        <string name="temporal_filter" value="box"/>
    </integrator>
    <sensor type="perspective" id="eye">
        <float name="fov" value="20"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="transient_hdr_film">
            <integer name="width" value="4"/> <integer name="height" value="3"/>
            <integer name="temporal_bins" value="24"/>
            <float name="bin_width_opl" value="0.25"/> <float name="start_opl" value="6"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <bsdf type="diffuse" id="grey"><spectrum name="reflectance" value="0.5"/></bsdf>
    <shape type="rectangle" id="wall">
        <transform name="to_world"><scale value="3"/></transform>
        <ref id="grey"/>
    </shape>
    <shape type="cube">
        <transform name="to_world"><scale value="0.3"/><translate x="0.4" z="0.5"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.5, 0.2"/></bsdf>
    </shape>
    <emitter type="point" id="light">
        <point name="position" x="-0.5" y="0.25" z="4"/> <rgb name="intensity" value="10, 10, 10"/>
    </emitter>
</scene>
"""


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
    **{
        f"capture of {layout}": _foreign(layout)
        for layout in ("tal", "zaragoza", "dirac", "phasor_field", "keyhole", "rect_data", "cdt")
    },
    "shard": Reader(_shards, _read_shard, lambda path: True),
    "data set": Reader(_data_sets, _read_data_set),
    "WebDataset": Reader(_tars, _read_tar),
    "device": Reader(_devices, _read_device),
    "recipe": Reader(_recipes, _read_recipe),
    "setup": Reader(_setups, _read_setup),
    "scene": Reader(_scenes, _read_scene),
    "built scene": Reader(_scenes, _build_scene),
}


# ------------------------------------------------------------------------------------------------------ in the child


def _in_child(names: list[str], folder: Path, first: int, last: int) -> None:
    """Mutants ``first`` to ``last`` - 1 of each reader; what comes of it in ``report.jsonl``, what is being read in
    ``now``.
    """
    import torchtransient  # noqa: F401  # before Mitsuba

    warnings.simplefilter("ignore")
    now = os.open(folder / "now", os.O_CREAT | os.O_RDWR)
    for name in names:
        reader, place = READERS[name], folder / re.sub(r"\W", "_", name)
        if not (place / "sources").exists():
            (place / "sources").mkdir(parents=True)
            written = reader.sources(place / "sources")
            (place / "sources.txt").write_text("\n".join(map(str, written)))
        _run(name, reader, place, (first, last), now, folder / "report.jsonl")
        first = 0


def _run(name: str, reader: Reader, place: Path, seeds: tuple[int, int], now: int, report: Path) -> None:
    from support.mutations import mutant
    from torchtransient.errors import TorchTransientError

    sources = [Path(line) for line in (place / "sources.txt").read_text().split("\n")]
    whole = {path: reader.read(_copy(path, place)) for path in sources}
    space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space + _MEMORY, resource.RLIM_INFINITY))
    found, before, began = Report(name), _resident(), time.monotonic()
    for seed in range(*seeds):
        source = sources[seed % len(sources)]
        target = place / f"{seed}_{source.name}"
        mutant(source, target, seed)
        os.pwrite(now, f"{name}\n{seed}\n".ljust(80).encode(), 0)
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        started = time.monotonic()
        try:
            content = reader.read(target)
            found.read += 1
            if reader.sealed(source) and content is not None and content != whole[source]:
                found.findings.append(f"{name} {seed} ({source.name}): other content without a word")
        except TorchTransientError as error:
            found.refused += 1
            said = str(error)
            if len(said) > MOST_LETTERS + len(str(target)) or "\n" in said or "Traceback" in said or not said:
                found.findings.append(f"{name} {seed} ({source.name}): message of {len(said)}: {said[:600]!r}")
        except BaseException as error:  # noqa: BLE001  # that is what is looked for
            where = " < ".join(f"{f.name}:{f.lineno}" for f in reversed(traceback.extract_tb(error.__traceback__)[-4:]))
            found.findings.append(
                f"{name} {seed} ({source.name}): {type(error).__name__}: {str(error)[:200]!r} in {where}"
            )
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        found.slowest = max(found.slowest, time.monotonic() - started)
        target.unlink(missing_ok=True)
        if seed % 500 == 499 or seed == seeds[1] - 1 or found.findings:
            found.grown, found.seconds = _resident() - before, time.monotonic() - began
            with report.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found.__dict__) + "\n")
            found.read = found.refused = 0
            found.findings = []
            began = time.monotonic()
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _copy(source: Path, place: Path) -> Path:
    """A whole file where mutants of it will be."""
    target = place / f"0_{source.name}"
    shutil.copyfile(source, target)
    return target


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


# ----------------------------------------------------------------------------------------------------- in the parent


def run(names: list[str], folder: Path, count: int, most_findings: int = 40) -> dict[str, Report]:
    """Read ``count`` mutants with each reader, in a child process that is started anew where one ends it."""
    waiting, first = list(names), 0
    deaths: list[str] = []
    environment = {**os.environ, "PYTHONPATH": f"{TESTS}:{TESTS.parent}:{os.environ.get('PYTHONPATH', '')}"}
    while waiting:
        (folder / "now").unlink(missing_ok=True)
        code = "import sys; from pathlib import Path; from support.mutated_files import _in_child; "
        code += f"_in_child({waiting!r}, Path({str(folder)!r}), {first}, {count})"
        child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        if child.returncode == 0:
            break
        if child.returncode > 0 or not (folder / "now").exists() or len(deaths) >= most_findings:
            raise AssertionError(f"the child ended with {child.returncode}: {child.stderr[-2000:]}\n{deaths}")
        name, seed, *_ = (folder / "now").read_text().split("\n")
        what = "waits" if child.returncode == -signal.SIGALRM else signal.Signals(-child.returncode).name
        deaths.append(f"{name} {seed}: {what}")
        waiting, first = waiting[waiting.index(name) :], int(seed) + 1
        if first >= count:
            waiting, first = waiting[1:], 0
    found = {name: Report(name) for name in names}
    lines = (folder / "report.jsonl").read_text().splitlines() if (folder / "report.jsonl").exists() else []
    for line in lines:
        part = Report(**json.loads(line))
        whole = found[part.reader]
        whole.read, whole.refused = whole.read + part.read, whole.refused + part.refused
        whole.grown, whole.slowest = max(whole.grown, part.grown), max(whole.slowest, part.slowest)
        whole.seconds += part.seconds
        whole.findings += part.findings
    for death in deaths:
        name = death.rpartition(" ")[0].rpartition(" ")[0] if death.endswith("waits") else death.rpartition(": ")[0]
        found[name.rpartition(" ")[0] if name not in found else name].findings.append(death)
    return found
