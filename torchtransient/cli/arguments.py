"""Types of values, and how options are put together. Nothing here imports torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])


def combined(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Return a decorator that adds several options to a command.

    Args:
        options: decorators of click, in the order of the help text.
    """

    def decorate(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


class NumberList(click.ParamType):  # type: ignore[type-arg]  # a parameter of newer versions
    """Numbers above zero with commas between them.

    Args:
        kind: ``int`` or ``float``.
        metavar: the form of the text in help and messages.
        most: most numbers, None for any count.
    """

    def __init__(self, kind: Callable[[str], Any], metavar: str, most: int | None = None) -> None:
        self.kind, self.name, self.most = kind, metavar, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[Any, ...]:
        """Return the numbers of a text; anything else is a usage error."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(self.kind(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if not 1 <= len(numbers) <= (self.most or len(numbers)) or not all(number > 0 for number in numbers):
            self.fail(f"expected {self.name}, numbers greater than zero, got '{value[:60]}'", param, ctx)
        return numbers


class NameList(click.ParamType):  # type: ignore[type-arg]  # a parameter of newer versions
    """Words with commas between them."""

    name = "NAME,NAME,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Return the words of a text."""
        return value if isinstance(value, tuple) else tuple(part.strip() for part in value.split(",") if part.strip())
