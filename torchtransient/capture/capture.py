"""Light that was measured on a relay wall, as tensors with a scan and an axis."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture.scan import Scan, laser_index
from torchtransient.checks import finite, shown
from torchtransient.errors import ArgumentError, ShapeError, StorageError, UnitError
from torchtransient.tensor_record import TensorRecord

_CHANNEL_AND_TIME = 2
# `tt.nlos.read_capture` and `tt.nlos.write_capture`, which stand above.
ReadsCaptures = Callable[..., Any]
WritesCaptures = Callable[..., Path]
_files: list[tuple[ReadsCaptures, WritesCaptures]] = []


@dataclass(frozen=True, eq=False, repr=False)
class Capture(TensorRecord):
    """Capture around a corner: light that leaves each sensor point of `scan` towards the sensor's origin.

    Args:
        transient: (C, T, Sy, Sx) real, or (C, T, N) for a list of points or of pairs; exhaustive (C, T, Ly, Lx, Sy,
            Sx), lists (C, T, M, N). Radiance per joule of the laser, summed over each bin of ``axis``. None with a
            ``phasor`` alone.
        axis: time axis of the transient, metres of optical path, counted as the scan's ``first_and_last_leg`` says.
        scan: points of the capture.
        metadata: plain data that JSON can hold; names are texts, tuples come back as lists. That of a batch is a list
            under ``batch``.
        phasor: complex, the shape of the transient with F frequencies in place of T: radiance times
            ``exp(-2 pi i nu (opl - start_opl))``.
        frequencies: frequencies of the phasor, cycles per metre.
        steady: light of all times, (C, ...) without the time dimension.
        channels: names of the C channels.
        polarized: True where a dimension of the four Stokes components stands before C in all of these tensors.

    Raises:
        ShapeError: if tensors, scan and axis do not fit, or nothing was measured.
        ArgumentError: for channels that are no tuple of names.
        StorageError: for metadata that is not plain.

    Other leading dimensions are a batch. Measured arrays of numpy and lists become tensors; arrays keep their numbers'
    kind, and their memory if possible. Two captures are equal if all but ``metadata`` is.

    ``to``, ``detach``, ``clone``, ``map``, ``stack`` and ``cat`` as in results of renders: they concern the measured
    tensors, and ``detach`` the scan's points too; the scan stays on its device, as the axes do
    (``capture.scan.to(device)`` moves it).
    """

    notes: ClassVar[tuple[str, ...]] = ("metadata",)

    transient: Tensor | None
    axis: TimeAxis | None
    scan: Scan
    _: KW_ONLY
    metadata: Mapping[str, Any] = field(default_factory=dict)
    phasor: Tensor | None = None
    frequencies: FrequencyAxis | None = None
    steady: Tensor | None = None
    channels: tuple[str, ...] = ()
    polarized: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.channels, tuple) or not all(isinstance(name, str) for name in self.channels):
            raise ArgumentError(f"Capture: expected channels as a tuple of names, got {shown(self.channels)}.")
        for name in ("transient", "phasor", "steady"):
            object.__setattr__(self, name, _measured(name, getattr(self, name)))
        if self.transient is None and self.phasor is None:
            raise ShapeError(
                "Capture: expected a transient (with axis=), a phasor (with frequencies=) or both, got neither."
            )
        if self.transient is not None:
            self._check("transient", self.transient, None if self.axis is None else self.axis.num_bins)
        if self.phasor is not None:
            self._check("phasor", self.phasor, None if self.frequencies is None else self.frequencies.num_frequencies)
        if self.steady is not None:
            self._check_shape("steady", self.steady, ("C",))
        metadata_text(self.metadata, "Capture")

    def _check(self, name: str, tensor: Tensor, count: int | None) -> None:
        if count is None:
            raise ShapeError(f"Capture: a {name} has no times. Give axis= of transients, frequencies= of phasors.")
        if tensor.is_complex() != (name == "phasor"):
            kind = "complex" if name == "phasor" else "real"
            raise ShapeError(f"Capture: expected {name} of {kind} numbers, got {tensor.dtype}.")
        self._check_shape(name, tensor, ("C", count))

    def _check_shape(self, name: str, tensor: Tensor, front: Sequence[Any]) -> None:
        expected = ([4] if self.polarized else []) + [*front, *self.scan.shape]
        found = tensor.shape[-len(expected) :]
        sizes = zip(expected, found, strict=False)
        fits = len(found) == len(expected) and all(wanted in ("C", size) for wanted, size in sizes)
        if not fits or tensor.numel() == 0:
            words = ", ".join(map(str, expected))
            raise ShapeError(
                f"Capture: expected {name} ({words}) as its {self.scan!r} and axis say, got {tuple(tensor.shape)}."
            )

    def detach(self) -> Capture:
        """Return the capture without gradients, in the scan's points neither."""
        return replace(super().detach(), scan=self.scan.detach())

    @classmethod
    def merged_notes(cls, records: Sequence[Capture]) -> dict[str, Any]:
        """Return the metadata of a batch.

        Args:
            records: captures of the batch.
        """
        return {"metadata": {"batch": [dict(record.metadata) for record in records]}}

    def _shown_notes(self) -> dict[str, str]:
        return {"metadata": ", ".join(self.metadata)} if self.metadata else {}

    # ------------------------------------------------------------------------------------------------------- on disk

    @classmethod
    def read(cls, path: str | Path, format: str | None = None, **said: Any) -> Capture:
        """Read a capture of any known layout.

        Args:
            path: the file.
            format: name of the layout, None to find it.
            said: other arguments of `tt.nlos.read_capture`, whose errors it raises.
        """
        read, _ = _registered()
        capture: Capture = read(path, format, **said)
        return capture

    def write(self, path: str | Path, format: str = "torchtransient") -> Path:
        """Write the capture in the library's layout or another one.

        Args:
            path: place of the file.
            format: name of the layout; errors as `tt.nlos.write_capture`.

        Returns:
            The path.
        """
        _, write = _registered()
        return write(path, self, format=format)

    # -------------------------------------------------------------------------------------------------- measurements

    def total(self) -> Tensor:
        """Return all light of the transient, its sum over time.

        Returns:
            (C, *scan.shape). Whole numbers stay whole (int64), half precision becomes float32.

        Raises:
            ShapeError: without a transient.
        """
        return summed(self._cube("total"), self._time)

    def peak_time(self) -> Tensor:
        """Return the centre of the bin in which most light arrives, summed over channels (S0 of a polarized capture).

        Returns:
            Metres, float64 in the scan's shape; NaN without light.

        Raises:
            ShapeError: without a transient.
        """
        cube = self._cube("peak_time")
        if self.polarized:
            cube = cube.select(self._time - _CHANNEL_AND_TIME, 0)
        highest, index = summed(cube, self._time - 1).max(self._time)
        assert self.axis is not None  # a transient has one
        return torch.where(highest > 0, self.axis.centers_opl.to(cube.device)[index], torch.nan)

    def crop(self, start_opl: float, end_opl: float) -> Capture:
        """Return the capture with the bins that lie in [start_opl, end_opl), at least in part.

        Args:
            start_opl: start of the kept part, metres of optical path.
            end_opl: end of the kept part, metres of optical path.

        Returns:
            A view, with an axis of its own; ``steady`` stays all light, and a phasor is kept.

        Raises:
            ShapeError: without a transient.
            UnitError: if no bin is left.
        """
        cube, axis = self._cube("crop"), self.axis
        assert axis is not None
        start_opl, end_opl = finite("Capture.crop: start_opl", start_opl), finite("Capture.crop: end_opl", end_opl)
        if not start_opl < end_opl:
            raise UnitError(f"Capture.crop: expected a start before an end in metres, got {start_opl!r}, {end_opl!r}.")
        # An edge that was computed in another way belongs to the bin that it is meant for, and keeps its digits.
        first = max(0, math.floor((start_opl - axis.start_opl) / axis.bin_width_opl + 1e-6))
        last = min(axis.num_bins, math.ceil((end_opl - axis.start_opl) / axis.bin_width_opl - 1e-6))
        if last <= first:
            raise UnitError(f"Capture.crop: no bin of {axis} is within {start_opl:.6g} to {end_opl:.6g} m.")
        start = axis.start_opl + first * axis.bin_width_opl
        start = start_opl if abs(start - start_opl) < 1e-6 * axis.bin_width_opl else start
        kept = TimeAxis(start, axis.bin_width_opl, last - first)
        return replace(self, transient=cube.narrow(self._time, first, last - first), axis=kept)

    # ---------------------------------------------------------------------------------------------- parts of a scan

    def confocal(self) -> Capture:
        """Return the confocal capture in an exhaustive one: its diagonal. Raises SceneError unless spots are sensor
        points.
        """
        scan, rank = self.scan.confocal(), len(self.scan.sensor_shape)

        def diagonal(tensor: Tensor) -> Tensor:
            # Each laser dimension with the sensor dimension that it equals; `diagonal` puts the pair at the end.
            for left in range(rank, 0, -1):
                tensor = tensor.diagonal(dim1=tensor.ndim - rank - left, dim2=tensor.ndim - rank)
            return tensor

        return replace(self, scan=scan, **self._mapped(diagonal))

    def single(self, laser: int | tuple[int, ...]) -> Capture:
        """Return the single capture of one spot of an exhaustive one, a view.

        Args:
            laser: index in the laser's list or grid.

        Raises:
            SceneError: for other kinds of scan.
            ShapeError: for an index out of range.
        """
        scan, index = self.scan.single(laser), laser_index(self.scan, laser)
        rank = len(self.scan.sensor_shape)

        def chosen(tensor: Tensor) -> Tensor:
            for number in reversed(index):
                tensor = tensor.select(tensor.ndim - rank - 1, number)
            return tensor

        return replace(self, scan=scan, **self._mapped(chosen))

    def _mapped(self, function: Any) -> dict[str, Any]:
        return {name: function(tensor) for name, tensor in self.tensors().items()}

    @property
    def _time(self) -> int:
        """Dimension of time, counted from the last."""
        return -len(self.scan.shape) - 1

    def _cube(self, who: str) -> Tensor:
        if self.transient is None:
            raise ShapeError(f"Capture.{who}: expected a capture with a transient, got phasors alone.")
        return self.transient


def _measured(name: str, values: Any) -> Tensor | None:
    """Return numbers of any library as a tensor. Raises ShapeError for sparse tensors and masked arrays."""
    if isinstance(values, Tensor) and values.layout != torch.strided:
        raise ShapeError(f"Capture: expected {name} as a dense tensor, got {values.layout}. Use tensor.to_dense().")
    if values is None or isinstance(values, Tensor):
        return values
    if np.ma.isMaskedArray(values):
        raise ShapeError(f"Capture: the mask of {name} would be lost; fill it in, or give a NaN for what is missing.")
    if not hasattr(values, "__array__"):
        return torch.as_tensor(values)
    array = np.asarray(values)
    # Torch knows neither other byte orders, nor negative strides, nor memory that is not to be written to.
    return torch.from_numpy(np.require(array, array.dtype.newbyteorder("="), ["C", "W"]))


# ----------------------------------------------------------------------------------------------------------- arithmetic


def precision_of(tensor: Tensor) -> torch.dtype:
    """Return the dtype that operators compute in: float64 for captures in double precision, else float32.

    Args:
        tensor: measured numbers.
    """
    return torch.float64 if tensor.dtype == torch.float64 else torch.float32


def computed(tensor: Tensor) -> Tensor:
    """Return measured numbers in the precision of arithmetic, :func:`precision_of`.

    Whole numbers wrap around, half precision overflows, and torch has no arithmetic for some dtypes of files.

    Args:
        tensor: numbers of any dtype.
    """
    return tensor.to(precision_of(tensor))


def summed(tensor: Tensor, dim: int) -> Tensor:
    """Return the sum over a dimension.

    Args:
        tensor: numbers of any dtype.
        dim: dimension.

    Returns:
        int64 of whole numbers (float64 of uint64), else :func:`computed` numbers.
    """
    if tensor.is_floating_point():
        return computed(tensor).sum(dim)
    wide = torch.float64 if tensor.dtype == torch.uint64 else torch.int64
    return tensor.to(wide).sum(dim)


# ------------------------------------------------------------------------------------------------------------- metadata


def metadata_text(metadata: Any, who: str) -> str:
    """Return metadata as JSON; tuples come back as lists.

    Args:
        metadata: names and plain data.
        who: subject of messages.

    Raises:
        StorageError: for other objects, data that JSON cannot hold, and names that are no texts, which JSON would
            convert: 1 and "1" would be one name.
    """
    try:
        found = json.dumps(dict(metadata))
        _check_names(metadata)
    except (TypeError, ValueError) as error:
        raise StorageError(f"{who}: expected metadata of plain data that JSON can hold: {error}.") from None
    return found


def _check_names(data: Any) -> None:
    if isinstance(data, Mapping):
        for name in data:
            if not isinstance(name, str):
                raise TypeError(f"the name {shown(name)} is a {type(name).__name__} and no text")
    for part in data.values() if isinstance(data, Mapping) else data if isinstance(data, list | tuple) else ():
        _check_names(part)


# ---------------------------------------------------------------------------------------------------------------- files


def register_files(read: ReadsCaptures, write: WritesCaptures) -> None:
    """Register the functions that read and write captures; a later call replaces an earlier one.

    Args:
        read: `tt.nlos.read_capture`.
        write: `tt.nlos.write_capture`.
    """
    _files[:] = [(read, write)]


def _registered() -> tuple[ReadsCaptures, WritesCaptures]:
    """Return reader and writer. Raises StorageError until the room of the layouts is loaded."""
    if not _files:
        raise StorageError("Capture: no layout of files is loaded. Import torchtransient.nlos first.")
    return _files[0]
