"""How a worker says what becomes of samples, whatever carries its messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class Telling:
    """See :class:`Told`. ``send`` takes one message; ``skip``: samples that are not to be tried, with the reason."""

    def __init__(self, send: Callable[[tuple[Any, ...]], object], skip: Mapping[int, str] | None = None) -> None:
        self._send = send
        self.skip = skip or {}

    def say(self, *message: Any) -> None:
        """One message."""
        self._send(message)

    def begin(self, shard: int, index: int) -> str | None:
        """See :class:`Told`."""
        if index in self.skip:
            return self.skip[index]
        self.say("begin", shard, index)
        return None

    def end(self, shard: int, index: int, failed: str | None) -> None:
        """See :class:`Told`."""
        self.say("end", shard, index, failed)

    def retry(self, shard: int, index: int, reason: str) -> None:
        """See :class:`Told`."""
        self.say("retry", shard, index, reason)

    def traced(self, shard: int, index: int, trace: str) -> None:
        """See :class:`Told`."""
        self.say("traced", shard, index, trace)

    def closing(self, shard: int) -> None:
        """See :class:`Told`."""
        self.say("closing", shard)
