"""What a recipe costs, measured on a few of its samples."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchtransient.checks import count
from torchtransient.data.recipes.checks import SAMPLES, structures_of
from torchtransient.data.recipes.outside_light import OutsideLight
from torchtransient.data.recipes.sample import Sample
from torchtransient.errors import StorageError
from torchtransient.rendering.threads import threads

if TYPE_CHECKING:
    from torchtransient.data.recipes.maker import Maker
    from torchtransient.data.recipes.specification import Specification

# Structures that are measured, and calls of each before a time counts: the second one is recorded, the third launched.
_MEASURED, _WARM = 4, 3


@dataclass(frozen=True)
class StructureCost:
    """Of one structure: ``first_s`` from nothing to its first sample (building, tracing, compiling), ``sample_s`` each
    sample after that (median), seconds with one thread, which workers have.
    """

    text: str
    first_s: float
    sample_s: float


@dataclass(frozen=True)
class Cost:
    """What :meth:`Recipe.cost` found. ``values``: keys that are only values. ``exchanged``: keys whose every new
    combination is a new structure; ``seen`` of these came among the first 64 samples. ``structures``: those measured.
    ``sample_bytes``: before compression; ``stored_bytes``: on disk, by store, None where it could not be measured.
    ``outside``: light outside of the window, as :meth:`Recipe.check` finds it. ``standard_error``: relative, of one
    sample's numbers. ``n``: samples of the data set, None where the recipe does not say.
    """

    values: tuple[str, ...]
    exchanged: tuple[str, ...]
    seen: int
    structures: tuple[StructureCost, ...]
    sample_bytes: int
    stored_bytes: dict[str, float | None]
    outside: OutsideLight
    standard_error: float
    n: int | None

    @property
    def sample_s(self) -> float:
        """Seconds a sample, with its share of building structures: in shards of some 64 samples each structure in it is
        built once. The first one measured may have compiled, which happens once; it counts where it is the only one.
        """
        kept = float(np.mean([one.sample_s for one in self.structures]))
        if self.seen < 2:
            return kept
        built = float(np.mean([one.first_s for one in self.structures[1:]]))
        new = self.seen / SAMPLES
        return new * built + (1 - new) * kept

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"only values       {', '.join(self.values) or 'none'}"
        built = ", ".join(self.exchanged) or "nothing: one structure for all samples"
        seen = f"; {self.seen} structures in {SAMPLES} samples" if self.exchanged else ""
        yield f"built when new    {built}{seen}"
        for one in self.structures:
            name = f" ({one.text})" if one.text else ""
            yield f"seconds           {one.first_s:.2f} for the first sample, then {one.sample_s:.4f} each{name}"
        yield f"bytes a sample    {_bytes(self.sample_bytes)} before compression"
        for store, size in self.stored_bytes.items():
            if size is not None:
                yield f"  store={store!r:<10} {_bytes(size)}, {self.sample_bytes / size:.1f} times smaller"
        yield f"light outside     {self.outside}"
        yield f"standard error    {self.standard_error:.1%} of a sample's numbers (root mean square)"
        if self.n is not None:
            sizes = [self.n * size for size in (*self.stored_bytes.values(), self.sample_bytes) if size]
            hours = self.n * self.sample_s / 3600
            yield (
                f"{self.n} samples    {_duration(hours)} of one worker, {_bytes(min(sizes))} to {_bytes(max(sizes))}"
            )



def _duration(hours: float) -> str:
    if hours >= 1:
        return f"{hours:.2f} hours"
    return f"{60 * hours:.1f} minutes" if hours >= 1 / 60 else f"{3600 * hours:.2g} seconds"


def _bytes(size: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def forecast(recipe: Specification, maker: Maker, samples: int, progress: bool, outside: OutsideLight) -> Cost:
    """See :meth:`Recipe.cost`."""
    wanted = count("cost: samples", samples)
    found = structures_of(recipe, range(SAMPLES))
    bar = None
    if progress:
        from tqdm.auto import tqdm

        bar = tqdm(total=len(found[:_MEASURED]) * (wanted + _WARM), desc="cost", unit="sample")
    costs, rendered = [], []
    # Workers compute with one thread.
    with threads(1):
        for structure, indices in found[:_MEASURED]:
            # Beginning with nothing: what check() has built is thrown away.
            maker.forget(structure)
            times = []
            for step in range(_WARM + wanted):
                index = indices[step % len(indices)]
                start = time.perf_counter()
                rendered.append(maker.sample(index))
                times.append(time.perf_counter() - start)
                if bar is not None:
                    bar.update()
            costs.append(StructureCost(structure.text, times[0], float(np.median(times[_WARM:]))))
    if bar is not None:
        bar.close()
    return Cost(
        values=tuple(key for key in recipe.vary if key not in recipe.exchanged),
        exchanged=tuple(recipe.exchanged),
        seen=len({recipe.structure(index).key for index in range(SAMPLES)}),
        structures=tuple(costs),
        sample_bytes=sum(array.nbytes for array in rendered[0].arrays.values()),
        stored_bytes=_stored(rendered, maker),
        outside=outside,
        standard_error=maker.standard_error(found[0][1][0]),
        n=recipe.n,
    )


def _stored(samples: list[Sample], maker: Maker) -> dict[str, float | None]:
    """Bytes of a sample on disk, by store."""
    from torchtransient.data.storage.encodings import STORES
    from torchtransient.data.storage.shard_writing import ShardWriter

    several = list({sample.index: sample for sample in samples}.values())
    found: dict[str, float | None] = {}
    for store in STORES:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shard.h5"
            try:
                with ShardWriter(path, len(several), {"about": maker.about()}, store=store) as shard:
                    for row, sample in enumerate(several):
                        shard.put(row, sample)
                found[store] = path.stat().st_size / len(several)
            except StorageError:
                # What is no counts cannot be stored as such, and a package may be missing.
                found[store] = None
    return found

