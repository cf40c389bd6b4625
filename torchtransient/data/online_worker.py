"""Producer of an online data set: a process that renders ordered samples into shared memory.

It receives ``("make", index, slot)`` and once ``("ring", {name: tensor})``; it sends ``("ready",)``, ``("layout",
{name: (shape, dtype)})`` with its first sample, ``("start", index)``, ``("done", index, values, outside)``,
``("failed", index, reason)`` and ``("error", exception or None, text)``. It ends with its connection.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import traceback
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from torchtransient.data.processes import add_plugins, unpacked
from torchtransient.errors import ShapeError, TorchTransientError

Layout = dict[str, tuple[tuple[int, ...], str]]


def produce(connection: Connection, packed: bytes) -> None:
    """Render samples until the connection closes: the body of the process.

    Args:
        connection: pipe to the trainer.
        packed: pickled recipe and plugin modules.
    """
    # Ctrl-C reaches the whole group of processes; the trainer ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from torchtransient.rendering.threads import threads

    maker = None
    try:
        recipe, plugins = unpacked(packed, "OnlineDataset")
        threads(1)
        add_plugins(plugins, "OnlineDataset")
        maker = recipe.maker()
        connection.send(("ready",))
        _Producer(connection, maker).run()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        # The trainer has ended.
        pass
    except BaseException as error:  # noqa: BLE001 (whatever it is, the trainer has to hear of it)
        _report(connection, error)
    finally:
        if maker is not None:
            maker.close()


def _report(connection: Connection, error: BaseException) -> None:
    text = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
        sent: BaseException | None = error
    except Exception:  # noqa: BLE001 (exceptions of others may raise anything here)
        sent = None
    with contextlib.suppress(OSError):
        connection.send(("error", sent, text))


class _Producer:
    def __init__(self, connection: Connection, maker: Any) -> None:
        self._connection, self._maker = connection, maker
        self._ring: dict[str, np.ndarray] | None = None
        self._layout: Layout = {}
        self._asked: dict[int, int] = {}

    def run(self) -> None:
        """Render samples for ever."""
        while True:
            self._listen()
            # All of them before new orders, so that every structure has its turn.
            for index in self._maker.order(list(self._asked)):
                self._connection.send(("start", index))
                try:
                    sample = self._maker.sample(index)
                except TorchTransientError as error:
                    # A sample that fails does not end the run; a bug does.
                    self._asked.pop(index)
                    self._connection.send(("failed", index, f"{type(error).__name__}: {error}"))
                    continue
                self._write(sample.arrays, index, self._asked.pop(index))
                self._connection.send(("done", index, dict(sample.values), tuple(sample.outside)))

    def _listen(self) -> None:
        """Read messages; waits where no sample is ordered."""
        while not self._asked or self._connection.poll(0):
            self._take()

    def _take(self) -> None:
        message = self._connection.recv()
        if message[0] == "make":
            self._asked[message[1]] = message[2]
        else:
            self._ring = {name: tensor.numpy() for name, tensor in message[1].items()}

    def _write(self, arrays: dict[str, np.ndarray], index: int, slot: int) -> None:
        found = layout_of(arrays)
        if self._ring is None:
            self._layout = found
            self._connection.send(("layout", found))
            while self._ring is None:
                self._take()
        if found != self._layout:
            raise ShapeError(
                f"OnlineDataset: the samples of a recipe have the same names, shapes and types, expected "
                f"{layout_text(self._layout)}, got {layout_text(found)} in sample {index}."
            )
        for name, array in arrays.items():
            self._ring[name][slot, ...] = array


def layout_of(arrays: dict[str, np.ndarray]) -> Layout:
    """Return the shapes and types of the arrays of a sample.

    Args:
        arrays: arrays of a sample by name.

    Returns:
        (shape, dtype) by name.
    """
    return {name: (tuple(np.shape(array)), np.asarray(array).dtype.str) for name, array in arrays.items()}


def layout_text(layout: Layout) -> str:
    """Return a layout as text.

    Args:
        layout: shape and dtype of every array of a sample, by name.

    Returns:
        Text.
    """
    return ", ".join(f"{name} {shape} {np.dtype(kind).name}" for name, (shape, kind) in layout.items())


def empty_ring(layout: Layout, capacity: int) -> dict[str, torch.Tensor]:
    """Allocate shared memory.

    Args:
        layout: shape and dtype of every array of a sample, by name.
        capacity: number of samples.

    Returns:
        Tensors (capacity, ...) by name.
    """
    ring = {}
    for name, (shape, kind) in layout.items():
        like = torch.from_numpy(np.empty(0, np.dtype(kind).newbyteorder("=")))
        ring[name] = torch.empty((capacity, *shape), dtype=like.dtype).share_memory_()  # type: ignore[no-untyped-call]
    return ring
