"""Captures as rows of numbers, one for each sensor point, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan

Rows = NDArray[np.float32]


@dataclass(frozen=True)
class RowLayout:
    """What the numbers of a row are: of one sensor point the transient (or phasor, real and imaginary part in turn) of
    shape ``front``, then the steady image's ``steady`` channels, 0 without one. ``front`` has the laser's dimensions of
    an exhaustive scan at its end.
    """

    front: tuple[int, ...]
    steady: tuple[int, ...]
    phasor: bool
    channels: tuple[str, ...]
    polarized: bool

    @classmethod
    def of(cls, capture: Capture) -> RowLayout:
        """That of a capture."""
        measured = _measured(capture)
        rank = len(capture.scan.sensor_shape)
        steady = () if capture.steady is None else tuple(capture.steady.shape[: capture.steady.ndim - rank])
        return cls(
            front=tuple(measured.shape[: measured.ndim - rank]),
            steady=steady,
            phasor=measured.is_complex(),
            channels=capture.channels,
            polarized=capture.polarized,
        )

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> RowLayout:
        """Of what `plain` returned."""
        given: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in plain.items()}
        return cls(**given)

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return asdict(self)

    @property
    def columns(self) -> int:
        """How many numbers a row has."""
        return self._measured_columns() + self._steady_columns()

    def rows(self, capture: Capture) -> Rows:
        """The rows (N, columns) of a capture's sensor points, those of a grid row by row."""
        rank = len(capture.scan.sensor_shape)
        measured = _points_first(_measured(capture), rank)
        if self.phasor:
            measured = torch.view_as_real(measured)
        parts = [measured.reshape(len(measured), -1)]
        if capture.steady is not None:
            parts.append(_points_first(capture.steady, rank).reshape(len(measured), -1))
        found: Rows = torch.cat(parts, 1).numpy() if len(parts) > 1 else parts[0].numpy()
        return found

    def capture(
        self, rows: Rows, scan: Scan, axis: TimeAxis | None, frequencies: FrequencyAxis | None
    ) -> dict[str, Any]:
        """What :class:`Capture` is made of, but its metadata; views of ``rows`` (N, columns)."""
        split, numbers = self._measured_columns(), torch.from_numpy(rows)
        measured, steady = numbers[:, :split], numbers[:, split:]
        if self.phasor:
            # Beside a steady image the pairs of a row may begin at odd places.
            measured = torch.view_as_complex(measured.reshape(len(numbers), -1, 2).contiguous())
        made: dict[str, Any] = {"transient": None, "phasor": None, "steady": None}
        made["phasor" if self.phasor else "transient"] = _points_last(measured, self.front, scan)
        if self.steady:
            made["steady"] = _points_last(steady, self.steady, scan)
        settings = {"channels": self.channels, "polarized": self.polarized}
        return made | settings | {"scan": scan, "axis": axis, "frequencies": frequencies}

    def _measured_columns(self) -> int:
        return int(np.prod(self.front, dtype=np.int64)) * (2 if self.phasor else 1)

    def _steady_columns(self) -> int:
        return int(np.prod(self.steady, dtype=np.int64)) if self.steady else 0


def _measured(capture: Capture) -> torch.Tensor:
    found = capture.transient if capture.transient is not None else capture.phasor
    assert found is not None  # a simulation measures one of them
    return found


def _points_first(tensor: torch.Tensor, rank: int) -> torch.Tensor:
    """(N, ...) of (..., *sensor): in memory as films are."""
    flat = tensor.cpu().flatten(tensor.ndim - rank)
    return flat.movedim(-1, 0).contiguous()


def _points_last(rows: torch.Tensor, front: tuple[int, ...], scan: Scan) -> torch.Tensor:
    """(*front, *sensor) of (N, columns)."""
    moved = rows.reshape(len(rows), *front).movedim(0, -1)
    return moved.reshape(*front, *scan.sensor_shape)
