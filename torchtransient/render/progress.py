"""The progress bar of renders, and of everything else that takes long."""

from __future__ import annotations

from typing import Any


class Bar:
    """A progress bar that takes fractions, under a name. Made on demand: tqdm is imported only when asked for."""

    def __init__(self, name: str = "render") -> None:
        from tqdm.auto import tqdm

        self._bar: Any = tqdm(
            total=1.0, desc=name, bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"
        )

    def __call__(self, fraction: float) -> None:
        self._bar.update(fraction - self._bar.n)

    def close(self) -> None:
        """End it."""
        self._bar.close()
