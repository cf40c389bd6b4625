"""The progress bar of renders, and of everything else that takes long."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

_T = TypeVar("_T")


class Bar:
    """Progress bar, called with the fraction that is done. tqdm is imported when the first one is made."""

    def __init__(self, name: str = "render") -> None:
        from tqdm.auto import tqdm

        self._bar: Any = tqdm(
            total=1.0, desc=name, bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        )

    def __call__(self, fraction: float) -> None:
        self._bar.update(fraction - self._bar.n)

    def close(self) -> None:
        """Finish the bar."""
        self._bar.close()


class ForecastBar:
    """Progress bar whose end is a forecast: its text says how much is left."""

    def __init__(self, name: str) -> None:
        from tqdm.auto import tqdm

        self._name = name
        form = "{desc} |{bar}| {percentage:3.0f}% {elapsed}"
        self._bar: Any = tqdm(total=1.0, desc=name, bar_format=form, miniters=0)

    def show(self, fraction: float, text: str) -> None:
        """Show the fraction that is done, which may shrink, and a text."""
        self._bar.set_description_str(f"{self._name}: {text}", refresh=False)
        self._bar.update(min(fraction, 1.0) - self._bar.n)

    def close(self) -> None:
        """Finish the bar."""
        self._bar.close()


def with_bar(things: Sequence[_T], name: str, progress: bool) -> Iterator[_T]:
    """Yield the entries of a sequence; show a bar called ``name`` if ``progress``.

    Args:
        things: sequence to iterate over.
        name: text before the bar.
        progress: show the bar.
    """
    bar = Bar(name) if progress else None
    try:
        for done, thing in enumerate(things):
            yield thing
            if bar is not None:
                bar((done + 1) / len(things))
    finally:
        if bar is not None:
            bar.close()
