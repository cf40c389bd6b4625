"""Rendering while training: processes fill a ring in shared memory, the trainer draws from it at random."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch.utils.data import IterableDataset, get_worker_info

from torchtransient.checks import MOST, a_recipe, as_number, count, shown
from torchtransient.data.reading.online_producers import WHAT, Producers
from torchtransient.data.reading.online_schedule import Schedule
from torchtransient.data.reading.sample_draws import checked_transform
from torchtransient.errors import ShapeError, TorchTransientError, UnitError


class OnlineDataset(IterableDataset[dict[str, Any]]):
    """Samples of a recipe, rendered while they are used: endless, drawn at random from the latest ``capacity`` of them.

    A sample is a dictionary as of :class:`~torchtransient.data.reading.transient_dataset.TransientDataset`: its arrays
    by name as tensors of the caller's own, ``values`` by key, ``outside`` and ``index`` in the recipe.
    ``DataLoader(data, batch_size=8)`` makes batches; ``num_workers`` other than 0 is an error: the data set has
    processes of its own. ::

        with OnlineDataset(recipe, workers=2) as data:
            for step, batch in zip(range(10_000), DataLoader(data, batch_size=8)):
                ...

    ``recipe``: what can be pickled and has ``maker()``. ``workers``: processes that render, with one thread each; they
    are spawned at once, so a script needs ``if __name__ == "__main__":``. ``capacity``: samples that are kept, in
    shared memory. ``warm``: samples there have to be before the first is drawn (at most ``capacity``). ``first``:
    number of the first sample, so that those of a validation set can be left out; the others follow, each once. What a
    sample is depends on recipe and number alone, their order on how fast they are made. ``seed``: of the draws. Ranks
    that train together have a data set each, with another ``first``.

    ``uses``: how often a sample is used, in the mean. It is an upper bound: where the trainer has drawn so many times
    as many samples as were made, it waits for a new one. A producer waits until those that it would replace have been
    used so often: every sample is used about that often, less at first, while the ring fills.
    ``math.inf``: nobody waits, and producers replace what is oldest as fast as they can. ``made``, ``drawn`` and
    ``waited_s`` (seconds) say how it goes.

    Before the first sample is drawn, a PhysicsWarning says how many of those that are there have more than 1 % of their
    light outside of the time window; they are kept.

    ``transform``: function of the transient; its result stands under ``measurement``. ``timeout_s``: so long without
    news from a producer is an error.

    A sample that fails (a TorchTransientError of its scene) is left out with a warning, and counted in ``failed``;
    16 in a row are an error. Any other exception of a producer is raised where samples are drawn. A producer that
    ends otherwise (killed, a crash) is started again with a warning; one that ends twice at the same sample is an
    error. ``close()``, the end of the with-block, of the object or of the process end the producers and free the
    memory. Raises UnitError, StorageError (not enough shared memory), ShapeError (samples that differ in kind),
    TorchTransientError. Not supported: pickling, use in processes that were forked.
    """

    def __init__(
        self, recipe: Any, capacity: int = 1024, *, workers: int = 1, uses: float = 5.0, seed: int = 0, warm: int = 64,
        first: int = 0, transform: Callable[[torch.Tensor], Any] | None = None, timeout_s: float = 600.0,
    ) -> None:  # fmt: skip
        super().__init__()

        def whole(name: str, value: Any, least: int = 1) -> int:
            return count(f"{WHAT}: {name}", value, least, UnitError, None if name == "seed" else MOST)

        capacity, workers, warm = whole("capacity", capacity, 2), whole("workers", workers), whole("warm", warm)
        first, seed = whole("first", first, 0), whole("seed", seed, 0)
        for name, value in (("uses", uses), ("timeout_s", timeout_s)):
            if (number := as_number(value)) is None or not number > 0:
                raise UnitError(f"{WHAT}: expected {name} as a number above zero, got {shown(value)}.")
        a_recipe(WHAT, recipe, "maker")
        self.transform = checked_transform(WHAT, transform)
        schedule = Schedule(capacity, workers, float(uses), min(warm, capacity), first, seed)
        self._producers = Producers(recipe, schedule, capacity, workers, float(timeout_s))
        # Also when the object is forgotten, and at the end of the interpreter.
        self._finalizer = weakref.finalize(self, self._producers.close)
        try:
            self._producers.start()
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Iterator[dict[str, Any]]:
        if get_worker_info() is not None:
            raise TorchTransientError(
                f"{WHAT}: it renders in processes of its own; use DataLoader(..., num_workers=0) and "
                f"{WHAT}(workers=...)."
            )
        while True:
            yield self.draw()

    def draw(self) -> dict[str, Any]:
        """One sample; waits where there is none that may be used."""
        sample = self._producers.draw()
        if self.transform is not None:
            with torch.no_grad():
                if "transient" not in sample:
                    raise ShapeError(f"{WHAT}: transform= is for transients, and samples have {', '.join(sample)}.")
                sample["measurement"] = self.transform(sample["transient"])
        return sample

    @property
    def made(self) -> int:
        """Samples that were rendered."""
        return self._producers.schedule.made

    @property
    def next_index(self) -> int:
        """Number of the next sample that nobody was asked for: ``first`` of a data set that goes on after this one. Its
        ring fills anew, so that draws are others than those of a run that was not stopped.
        """
        return self._producers.schedule.next_index

    @property
    def failed(self) -> int:
        """Samples that could not be rendered."""
        return self._producers.failed

    @property
    def drawn(self) -> int:
        """Samples that were drawn."""
        return self._producers.schedule.drawn

    @property
    def waited_s(self) -> float:
        """Seconds that draws have waited for samples."""
        return self._producers.waited_s

    def close(self) -> None:
        """End the producers and free the memory; what was drawn stays."""
        self._finalizer()

    def __enter__(self) -> OnlineDataset:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        raise TorchTransientError(
            f"{WHAT}: processes and shared memory cannot be pickled; make one in each process, or use num_workers=0."
        )
