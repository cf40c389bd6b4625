"""Parts of `dataset.py` in processes of their own, one thread each; driven by one JSON object per line.

Every request answers with lists of one number a round. CPU milliseconds of the whole process unless it is said.
  {"do": "samples", "film": [resolution, bins, spp], "count", "repeats"}   shards of a worker, and bare kernels
  {"do": "views", "views", "film", "count", "repeats"}
  {"do": "new", "film", "count", "repeats"}                   a kept scene, and one described anew for each
  {"do": "workers", "film", "per_shard", "shards", "repeats"}   seconds of `tt.data.generate` by one and two processes
  {"do": "reading", "film", "count", "repeats", "windows"}    samples from a shard, whole and in part
  {"do": "loader", "film", "count", "batch", "steps", "width"}   training beside a `DataLoader` with one worker
  {"do": "captures", "file", "count"}                         captures of a scene file of y-tal
  {"do": "capture", "index", "out"}                           one of them -> {"place"}, the transient as .npy
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torchtransient as tt

import drjit as dr  # isort: skip
import numpy as np
import torch
from _dataset_cases import captures, described, moving_boxes, several_views, undisturbed

from torchtransient.data.run_settings import RunSettings
from torchtransient.data.shard_making import ShardMaker
from torchtransient.scene.variant import active_variant

CPU = time.process_time
MB = 1e6


class Shards:
    """Shard after shard of a recipe in a folder, as a worker of `generate` makes them, of which none stays."""

    def __init__(self, recipe: Any, folder: str, count: int) -> None:
        self.recipe, self.folder, self.count = recipe, Path(folder), count
        self.maker = ShardMaker(RunSettings(recipe, folder, 10**6, "exact", "blosc2", 0))
        measured = self.maker.measure(range(1), undisturbed)
        self.megabytes = measured.sample_bytes / MB
        self.described = {"per_shard": count, "about": measured.about, "recipe": recipe.to_dict()}
        self._next = 0

    def make(self) -> Path:
        """One more."""
        self.maker.make(self._next, self.described, undisturbed)
        self._next += 1
        return max(self.folder.glob("shard-*.h5"))

    def milliseconds(self) -> float:
        """Of a sample."""
        start = CPU()
        self.make().unlink()
        return 1e3 * (CPU() - start) / self.count


def bare_pass(maker: Any, recipe: Any) -> Callable[[], None]:
    """What a sample of a recipe cannot do without: the integrator's kernels, recorded, with values that stay."""
    renderer = maker.kept(recipe.structure(0)).renderer
    with active_variant(recipe.variant):
        scene = renderer.scene.built(renderer._options).scene
        integrator, spp = scene.integrator(), renderer.spp or renderer._scene_spp
        jobs = [integrator.prepared(scene, sensor, 1, spp) for sensor in renderer._sensors]
        _, arrays = integrator.state_of(jobs)

    def call(scene: Any, arrays: list[Any]) -> list[Any]:
        for job in jobs:
            integrator.run(job)
        return [job.film.release_storage() for job in jobs]

    frozen = dr.freeze(call)

    def launch() -> None:
        with active_variant(recipe.variant):
            for job in jobs:
                job.film.clear()
            dr.eval(frozen(scene, arrays))
            dr.sync_thread()

    return launch


def kernel_milliseconds(maker: Any, indices: range) -> float:
    """What Dr.Jit gives for the kernels of a sample, by the clock: the least of some."""
    found = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for index in indices:
            dr.kernel_history_clear()
            maker.sample(index)
            found.append(sum(kernel.get("execution_time", 0) for kernel in dr.kernel_history()))
    return float(min(found))


def mean(run: Callable[[int], Any], count: int, first: int = 0) -> float:
    """Milliseconds of one of some calls."""
    start = CPU()
    for index in range(first, first + count):
        run(index)
    return 1e3 * (CPU() - start) / count


def samples(film: list[int], count: int, repeats: int) -> dict[str, Any]:
    recipe = moving_boxes(*film)
    with tempfile.TemporaryDirectory() as folder:
        shards = Shards(recipe, folder, count)
        maker = shards.maker._maker
        launch = bare_pass(maker, recipe)
        found: dict[str, list[float]] = {"generated": [], "bare": [], "maker": []}
        for turn in range(-1, repeats):
            times = {
                "generated": shards.milliseconds(),
                "bare": mean(lambda _: launch(), count),
                "maker": mean(maker.sample, count, first=(2 + turn) * count),
            }
            if turn >= 0:
                for name, value in times.items():
                    found[name].append(value)
        kernels = kernel_milliseconds(maker, range(min(count, 20)))
    return {**found, "kernels_by_the_clock": kernels, "megabytes": shards.megabytes}


def views(views: int, film: list[int], count: int, repeats: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        shards = Shards(several_views(views, *film), folder, count)
        said = shards.maker._maker.kept(shards.recipe.structure(0)).renderer
        shards.make()
        found = [shards.milliseconds() / views for _ in range(repeats)]
        with torch.no_grad():
            recorded = sorted(set(said(seed=0).stats.recorded))
    return {"view": found, "recorded": recorded, "megabytes": shards.megabytes}


def new(film: list[int], count: int, repeats: int) -> dict[str, Any]:
    recipe = moving_boxes(*film)
    kept = recipe.maker()

    def anew(index: int) -> None:
        description = described(film, recipe.draw(index))
        renderer = tt.TransientRenderer(tt.load(description, variant=recipe.variant), physics="ignore")
        with torch.no_grad():
            renderer(seed=index).transient.contiguous().numpy()

    found: dict[str, list[float]] = {"kept": [], "new": []}
    for turn in range(-1, repeats):
        times = {"kept": mean(kept.sample, 10 * count), "new": mean(anew, count, first=100 * (turn + 2))}
        if turn >= 0:
            for name, value in times.items():
                found[name].append(value)
    return found


def workers(film: list[int], per_shard: int, shards: int, repeats: int) -> dict[str, Any]:
    recipe = moving_boxes(*film)
    few, many = 2 * per_shard, (2 + shards) * per_shard
    found: dict[str, list[float]] = {f"{what}, {k}": [] for what in ("wall", "cpu") for k in (1, 2)}
    for _ in range(repeats):
        for count in (1, 2):
            spent = []
            for n in (few, many):
                with tempfile.TemporaryDirectory() as folder:
                    start, used = time.perf_counter(), sum(os.times()[:4])
                    tt.data.generate(recipe, folder, n, workers=count, per_shard=per_shard, progress=False)
                    spent.append((time.perf_counter() - start, sum(os.times()[:4]) - used))
            # What comes before the first sample, and behind the last one, is in both.
            for what, short, long in zip(("wall", "cpu"), *spent, strict=True):
                found[f"{what}, {count}"].append(1e3 * (long - short) / (many - few))
    return {**found, "load": os.getloadavg()[0]}


def reading(film: list[int], count: int, repeats: int, windows: dict[str, list[int]]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        shards = Shards(moving_boxes(*film), folder, count)
        shards.make()
        data = tt.data.TransientDataset(folder)
        sets = {name: tt.data.TransientDataset(folder, window=slice(*bins)) for name, bins in windows.items()}
        found: dict[str, list[float]] = {name: [] for name in ("whole", *windows)}
        for turn in range(-1, repeats):
            times = {"whole": mean(data.__getitem__, count)}
            times |= {name: mean(each.__getitem__, count) for name, each in sets.items()}
            if turn >= 0:
                for name, value in times.items():
                    found[name].append(value)
    return {**found, "megabytes": shards.megabytes}


class Net(torch.nn.Module):
    """A small U-Net from the bins of every pixel to one number."""

    def __init__(self, bins: int, width: int) -> None:
        super().__init__()

        def block(a: int, b: int) -> torch.nn.Module:
            return torch.nn.Sequential(torch.nn.Conv2d(a, b, 3, padding=1), torch.nn.ReLU())

        self.first, self.down, self.deep = block(bins, width), block(width, 2 * width), block(2 * width, 2 * width)
        self.up, self.last = block(3 * width, width), torch.nn.Conv2d(width, 1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        fine = self.first(x)
        coarse = self.deep(self.down(torch.nn.functional.max_pool2d(fine, 2)))
        wide = torch.nn.functional.interpolate(coarse, scale_factor=2.0)
        answer: torch.Tensor = self.last(self.up(torch.cat([fine, wide], 1)))
        return answer


def loader(film: list[int], count: int, batch: int, steps: int, width: int) -> dict[str, Any]:
    torch.manual_seed(0)
    net = Net(film[1], width)
    optimizer = torch.optim.Adam(net.parameters())
    waits, works = [], []
    with tempfile.TemporaryDirectory() as folder:
        shards = Shards(moving_boxes(*film), folder, count)
        shards.make()
        data = tt.data.TransientDataset(folder, fields=["transient", "steady"])
        repeated = torch.utils.data.RandomSampler(data, replacement=True, num_samples=batch * (steps + 3))
        batches = iter(torch.utils.data.DataLoader(data, batch, sampler=repeated, num_workers=1))
        for _ in range(steps + 3):
            start = time.perf_counter()
            given = next(batches)
            waited = time.perf_counter()
            loss = (net(given["transient"][:, 0]) - given["steady"]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            waits.append(waited - start)
            works.append(time.perf_counter() - waited)
        del batches
    # Without the first ones: the worker starts, and fills its queue.
    waits, works = waits[3:], works[3:]
    share = sum(waits) / (sum(waits) + sum(works))
    return {"share": share, "step_seconds": works, "wait_seconds": waits, "load": os.getloadavg()[0]}


class Captures:
    """Those of a scene file of y-tal; all but the kernels' compilation is in the time."""

    def __init__(self) -> None:
        self._maker: Any = None

    def make(self, file: str, count: int) -> dict[str, Any]:
        recipe = captures(Path(file))
        recipe.check()
        self._maker = recipe.maker()
        for index in range(4):
            self._maker.sample(index)
        with tempfile.TemporaryDirectory() as folder:
            shards = Shards(recipe, folder, count)
            shards.make()
            return {"generated": [shards.milliseconds() for _ in range(3)], "megabytes": shards.megabytes}

    def one(self, index: int, out: str) -> dict[str, Any]:
        sample = self._maker.sample(index)
        (pose,) = sample.values.values()
        np.save(out, sample.arrays["transient"][0])
        return {"place": [float(x) for x in pose[:3, 3]]}


def main() -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    tt.threads(1)
    torch.set_num_threads(1)
    print(json.dumps({"package": str(Path(tt.__file__).parent)}), file=answers)
    of_tal = Captures()
    parts: dict[str, Callable[..., dict[str, Any]]] = {
        "samples": samples, "views": views, "new": new, "workers": workers, "reading": reading, "loader": loader,
        "captures": of_tal.make, "capture": of_tal.one,
    }  # fmt: skip
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(parts[request.pop("do")](**request)), file=answers)


if __name__ == "__main__":
    main()
