"""What a process of the local engine does: it takes shards from its supervisor one at a time, and ends with it."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from torchtransient.array_files.part_files import remove_unfinished
from torchtransient.data.generation.shard_making import ShardMaker, fatal
from torchtransient.data.generation.telling import Telling
from torchtransient.data.generation.told_errors import unpacked

# A render that is under way is waited for so long when the supervisor is gone.
LAST_SECONDS = 10.0
_GONE = 3


def work(link: Connection, packed: bytes) -> None:
    """The whole life of a worker, with its pickled settings. Messages: see the functions of :class:`Telling`."""
    # Ctrl-C reaches the whole group; the supervisor has the last word.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGTERM, _end)
    _end_with_supervisor()
    telling = Telling(link.send)
    try:
        maker = ShardMaker(unpacked(packed, "generate"))
        telling.say("ready")
        while True:
            task = link.recv()
            if task[0] == "stop":
                maker.close()
                return
            _carry_out(task, maker, telling)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        sys.exit(_GONE)
    except Exception as error:  # noqa: BLE001  told, and raised by the supervisor
        with contextlib.suppress(OSError):
            telling.say("fatal", *fatal(error))
        sys.exit(1)
    finally:
        # What the interpreter does at its end need not be left in order.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _carry_out(task: tuple[Any, ...], maker: ShardMaker, telling: Telling) -> None:
    kind, *rest = task
    if kind == "measure":
        indices, telling.skip = rest
        telling.say("measured", maker.measure(indices, telling))
    else:
        shard, described, telling.skip, first = rest
        telling.say("wrote", shard, *maker.make(shard, described, telling, first))


def _end(*_: Any) -> NoReturn:
    # No exception: where Python calls back (of weak references, from plugins) it would be printed and forgotten, or
    # become an error of the scene.
    remove_unfinished()
    os._exit(_GONE)


def _end_with_supervisor() -> None:
    """A thread that waits for the supervisor's end, however it comes: a render takes no notice of a closed pipe."""
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is None:
        return

    def wait() -> None:
        connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(LAST_SECONDS)
        _end()

    threading.Thread(target=wait, daemon=True).start()
