"""Processes that render: pickled recipes and plugin modules on the way there, errors on the way back."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from torchtransient.errors import PluginRegistrationError, SceneError, TorchTransientError

MOST_LINES = 40


class WorkerError(Exception):
    """Traceback of another process: the cause of the error that is raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def traced(error: BaseException) -> str:
    """Return the traceback as text, of its last 40 lines.

    Args:
        error: exception that was raised.

    Returns:
        Text.
    """
    lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
    return "\n".join(lines if len(lines) <= MOST_LINES else ["...", *lines[-MOST_LINES:]])


def unpacked(data: bytes, what: str) -> Any:
    """Unpickle a recipe in a worker.

    Args:
        data: pickled recipe.
        what: caller for messages.

    Returns:
        The object.

    Raises:
        SceneError: for classes that this process does not find.
    """
    try:
        return pickle.loads(data)
    except TorchTransientError:
        raise
    except Exception as error:
        raise SceneError(
            f"{what}: the process that renders cannot unpickle the recipe: {type(error).__name__}: {error}. It imports "
            "what the recipe is made of: classes and functions have to stand in a module that it finds, or in the "
            "script outside of `if __name__ == '__main__':`."
        ) from error


# Name of a module, and the plugins that it declares.
PluginNames = tuple[tuple[str, tuple[tuple[str, str], ...]], ...]


def registered_plugins() -> PluginNames:
    """Return the plugin modules that were added in this process with ``plugins.register_module``, with the plugins of
    each.
    """
    from torchtransient.plugins import modules_of_others

    return tuple((entry.module, entry.plugins) for entry in modules_of_others())


def add_plugins(modules: PluginNames, what: str) -> None:
    """Add plugin modules in this process too.

    Args:
        modules: result of :func:`registered_plugins`.
        what: caller for messages.

    Raises:
        PluginRegistrationError: for modules that cannot be imported here.
    """
    from torchtransient.plugins import register_module

    for module, plugins in modules:
        try:
            register_module(module, plugins)
        except PluginRegistrationError as error:
            raise PluginRegistrationError(
                f"{what}: the process that renders cannot use the plugin module {module!r}: {error} It has to be found "
                "by import there: install it, or add its folder to PYTHONPATH (of a cluster: on every machine)."
            ) from error


def spawned(body: Callable[[Connection, bytes], None], packed: bytes, name: str) -> tuple[BaseProcess, Connection]:
    """Start a process that ignores Ctrl-C from its first instruction on, and that ends with this one. It is spawned: a
    forked one has no threads of Dr.Jit.

    Args:
        body: function of the other end of the pipe and ``packed``.
        packed: pickled data that the process is given.
        name: name of the process.

    Returns:
        Process, and this end of the pipe.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=body, args=(there, packed), name=name, daemon=True)
    try:
        with _interrupts_blocked():
            process.start()
    except BaseException:
        here.close()
        raise
    finally:
        there.close()
    return process, here


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
