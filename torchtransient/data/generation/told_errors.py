"""Errors of other processes: what they were, where they were raised, and what could not be handed over."""

from __future__ import annotations

import pickle
import traceback
from typing import Any

from torchtransient.errors import SceneError, TorchTransientError

MOST_LINES = 40


class ToldError(Exception):
    """What another process has raised, as it printed it there: the cause of the error that is raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def traced(error: BaseException) -> str:
    """An error with files and lines, the last ones of them."""
    lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
    return "\n".join(lines if len(lines) <= MOST_LINES else ["...", *lines[-MOST_LINES:]])


def unpacked(data: bytes, what: str) -> Any:
    """What was pickled in another process. Raises SceneError where that cannot be found in this one."""
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
