"""Ways to store transients, side by side: size, milliseconds to write and to read, and what a window of time costs.

Cornell box of 32 x 32 pixels and 1024 bins, walls of random colours, at 16 samples a pixel and, where more bins hold
light, at 1024; counts are Poisson counts of 500 photons a pixel. CPU seconds of one thread, page cache warm, a whole
shard at a time, the ways taking turns: checksums, compression, HDF5 and the disk in writing; tensors of all samples in
reading, by number and in a shuffled order, of shards that are open, as they are from the second epoch on. A megabyte is
one of float32 before anything is done to it. Bars: writing 4 ms a megabyte, reading 2 ms, a window of 64 bins 1/5 of
the sample (Blosc2). WebDatasets are made of shards, whose reading counts.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _runner import arguments, environment, interleave, report, summary  # before the package, which it chooses

import torchtransient as tt
from torchtransient.data import Shard, ShardWriter, TransientDataset, export_web_dataset, read_web_dataset, verify

WINDOW = slice(496, 560)
PHOTONS = 500
BARS = {"write": 4.0, "read": 2.0, "window": 0.2}


@dataclass(frozen=True)
class Way:
    """A way to store: `counts` takes the measurement, the others the transient."""

    name: str
    store: str
    compression: str

    @property
    def array(self) -> str:
        return "measurement" if self.store == "counts" else "transient"


WAYS = (
    Way("exact", "exact", "blosc2"), Way("rounded", "rounded", "blosc2"), Way("counts", "counts", "blosc2"),
    Way("exact, gzip", "exact", "gzip"), Way("rounded, gzip", "rounded", "gzip"), Way("counts, gzip", "counts", "gzip"),
    Way("exact, none", "exact", "none"),
)  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """What a shard takes."""

    index: int
    arrays: dict[str, Any]
    seed: int = 0
    values: dict[str, Any] = field(default_factory=dict)
    outside: tuple[float, float] = (0.0, 0.0)
    structure: str = ""


def cubes(count: int, resolution: int, bins: int, spp: int) -> np.ndarray:
    """Renders (N, C, T, H, W), each with walls of its own colours."""
    box = tt.scenes.cornell_box(resolution, num_bins=bins, bin_width_opl=10 / bins, start_opl=3.5)
    keys = [f"{wall}.reflectance.value" for wall in ("red", "green", "white")]
    render = tt.TransientRenderer(tt.load(box, variant="llvm_ad_mono"), parameters=keys, spp=spp)
    colours = np.random.default_rng(0).uniform(0.05, 0.9, (count, len(keys)))
    with torch.no_grad():
        found = [
            render({key: torch.tensor(float(c)) for key, c in zip(keys, row, strict=True)}, seed=seed).transient
            for seed, row in enumerate(colours)
        ]
    # Films keep the height first; makers of samples put the numbers into the order of their axes.
    return np.ascontiguousarray(np.stack([cube.numpy() for cube in found]))


def counted(x: np.ndarray) -> np.ndarray:
    """Poisson counts, as many in the mean of all pixels as PHOTONS."""
    scale = PHOTONS / x.sum(axis=(1, 2)).mean()
    return np.random.default_rng(1).poisson(x * scale).astype(np.float32)


def cpu(job: Callable[[], Any]) -> float:
    """CPU seconds of the process."""
    begin = time.process_time()
    job()
    return time.process_time() - begin


def written(path: Path, way: Way, x: np.ndarray) -> None:
    """A shard of all samples."""
    bins = x.shape[2]
    about = {"axis": {"start_opl": 3.5, "bin_width_opl": 10 / bins, "num_bins": bins}, "channels": ["Y"]}
    with ShardWriter(path, len(x), {"about": about}, store=way.store, compression=way.compression) as shard:
        for row, cube in enumerate(x):
            shard.put(row, Sample(row, {way.array: cube}))


def read(path: Path, array: str, window: slice | None) -> float:
    """CPU seconds of all samples of a shard that is open, in a shuffled order."""
    data = TransientDataset(path, fields=[array], window=window)
    data[0]
    order = np.random.default_rng(2).permutation(len(data)).tolist()
    seconds = cpu(lambda: [data[number] for number in order])
    data.close()
    return seconds


def measure(x: np.ndarray, folder: Path, repeats: int, window: slice) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """A row of figures for every way, and those of all of them: verifying, opening."""
    megabytes = x.nbytes / 1e6
    arrays = {"transient": x, "measurement": counted(x)}
    jobs: dict[str, Callable[[int], float]] = {}
    sizes: dict[str, Callable[[], int]] = {}


    def add(
        name: str, path: Path, write: Callable[[], Any], whole: Callable[[], float], part: Callable[[], float]
    ) -> None:
        jobs[f"{name}: write"] = lambda _: cpu(write) / megabytes * 1e3
        jobs[f"{name}: read"] = lambda _: whole() / megabytes * 1e3
        jobs[f"{name}: window"] = lambda _: part() / megabytes * 1e3
        sizes[name] = lambda: sum(file.stat().st_size for file in path.parent.glob(path.name))

    for number, way in enumerate(WAYS):
        path = folder / f"shard-{number:06d}.h5"
        add(
            way.name, path, lambda p=path, w=way: written(p, w, arrays[w.array]),
            lambda p=path, w=way: read(p, w.array, None), lambda p=path, w=way: read(p, w.array, window),
        )  # fmt: skip
    for name, source in (("WebDataset", 0), ("WebDataset, rounded", 1), ("WebDataset, counts", 2)):
        place = folder / name
        place.mkdir()
        shard = folder / f"shard-{source:06d}.h5"

        def stream(place: Path = place) -> float:
            return cpu(lambda: [None for path in sorted(place.glob("*.tar")) for _ in read_web_dataset(path)])

        add(
            name, place / "*.tar",
            lambda s=shard, p=place: export_web_dataset(s, p, progress=False), stream, stream,
        )  # fmt: skip
    jobs["verify"] = lambda _: cpu(lambda: verify(folder)) / megabytes * 1e3 / len(WAYS)
    jobs["open"] = lambda _: cpu(lambda: Shard(folder / "shard-000000.h5").close()) * 1e3
    found = {name: summary(values) for name, values in interleave(jobs, repeats, warm_up=1).items()}
    rows = []
    for name, size in sizes.items():
        figures = {what: found[f"{name}: {what}"] for what in ("write", "read", "window")}
        shares = [a / b for a, b in zip(figures["window"]["runs"], figures["read"]["runs"], strict=True)]
        rows.append({"way": name, "smaller": x.nbytes / size(), **figures, "window_over_whole": summary(shares)})
    return rows, {"verify_ms_per_mb": found["verify"], "open_ms": found["open"]}


def within(row: dict[str, Any]) -> bool:
    """Whether a way reaches the bars."""
    figures = {"write": row["write"]["median"], "read": row["read"]["median"]}
    figures["window"] = row["window_over_whole"]["median"]
    return all(figures[name] <= bar for name, bar in BARS.items())


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = ["| stored as | times smaller | write, ms/MB | read, ms/MB | 64 bins over all |", "|---|---|---|---|---|"]
    for row in rows:
        share = row["window_over_whole"]["median"]
        figures = f"{row['write']['median']:.2f} | {row['read']['median']:.2f} | {share:.2f}"
        lines.append(f"| {row['way']} | {row['smaller']:.1f} | {figures} |")
    return "\n".join(lines)


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--samples", type=int, default=16, help="samples in a shard")
    options = parser.parse_args()
    torch.set_num_threads(1)
    repeats = options.repeats or (1 if options.quick else 7)
    count, resolution, bins = (2, 8, 256) if options.quick else (options.samples, 32, 1024)
    window = slice(96, 160) if options.quick else WINDOW
    results: dict[str, Any] = {"data": {}}
    for spp in (16, 1024):
        x = cubes(count, resolution, bins, spp)
        with tempfile.TemporaryDirectory() as folder:
            rows, rest = measure(x, Path(folder), repeats, window)
        filled = float((x != 0).mean())
        results["data"][f"{spp} spp"] = {"not_zero": filled, "rows": rows, **rest}
        print(f"\n{spp} samples a pixel, {100 * filled:.1f} % of the bins hold light\n{table(rows)}")
        print(", ".join(f"{name} {row['median']:.2f}" for name, row in rest.items()))
        if not options.quick:
            blosc2 = [row for row in rows if row["way"] in ("exact", "rounded", "counts")]
            reached = {row["way"]: within(row) for row in blosc2}
            results["data"][f"{spp} spp"]["within"] = reached
            print(f"bars {BARS}: {reached}")
    settings = {"samples": count, "resolution": resolution, "bins": bins, "repeats": repeats, "quick": options.quick}
    shown = {"environment": environment("llvm_ad_mono")}
    report("dataset_storage", settings, shown | (results if options.json else {}), options.json)


if __name__ == "__main__":
    main()
