"""Renders on disk: HDF5 (`.h5`, `.hdf5`) or NumPy's `.npz`, chosen by the file's ending.

Both hold the same names. Arrays have torch's order: `steady` float32 (..., C, H, W) and one of `transient` float32
(..., C, T, H, W), radiance integrated over each bin, with `edges_opl` float64 (T + 1,), metres; `phasor` complex64
(..., C, F, H, W) with `frequencies_per_metre` float64 (F,), cycles per metre of optical path; `gated` float32 (..., C,
G, H, W) with `gates` (the text of scene files), called `transient` in files of earlier versions; `rates` float32 (...,
C, R, T, H, W) with `edges_opl` and the bins of the rate (`rates_start`, `rates_bin_width` in m/s, `rates_num_bins`);
`beats` float32 (..., C, 2, T, H, W) with `edges_opl` and the chirps (`chirps_bandwidth_hz`, `chirps_duration_s`,
`chirps_wavelength_m`, `chirps_window`); or `slow_phasor` complex64 (..., C, S, F, H, W) with `slow_times` float64 (S,),
seconds, and `frequencies_per_metre`. Polarized variants have the four Stokes components before C. The numbers of the
axis (`start_opl`, and with `edges_opl` the `bin_width_opl`, in metres, and `num_bins`), `channels` (JSON: the names of
the C channels), `format`, `metadata` (JSON) and `checksums` (JSON, see `array_file.py`) are attributes of the HDF5 file
and zero-dimensional arrays of the `.npz`. A cube is written in parts, so that no second copy of it is needed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from torchtransient.array_files.array_file import (
    array_of,
    check_target,
    damage_said,
    read_arrays,
    tensor_in,
    write_arrays,
)
from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.capture.capture import metadata_text
from torchtransient.chirps import Chirps
from torchtransient.errors import StorageError
from torchtransient.files.plain_data import names_of, notes_of, number_of, text_of, whole_of
from torchtransient.gates import Gate
from torchtransient.rendering.error_bars import ErrorBars, ErrorCells
from torchtransient.rendering.films import FILMS, layout_of_entries, layout_of_output
from torchtransient.rendering.output import RenderOutput, named_fields
from torchtransient.tensor_record import TensorRecord

FORMAT = "torchtransient result 2"
# Those of the first version have no checksums.
FORMATS = ("torchtransient result 1", FORMAT)
_WHAT = "result file"
_READ = {
    **dict.fromkeys(("start_opl", "bin_width_opl", "rates_start", "rates_bin_width"), number_of),
    **dict.fromkeys(("num_bins", "rates_num_bins"), whole_of), **dict.fromkeys(("gates", "chirps_window"), text_of),
    **dict.fromkeys(("chirps_bandwidth_hz", "chirps_duration_s", "chirps_wavelength_m"), number_of),
}  # fmt: skip
_OF_ERRORS = ("differences", "squares", "steady_differences")
_KNOWN = {"format", "metadata", "channels", "steady", "edges_opl", "frequencies_per_metre", "slow_times", *_READ}
_KNOWN |= {"cells", *_OF_ERRORS}


@dataclass(frozen=True, eq=False, repr=False)
class Result(ErrorBars, TensorRecord):
    """Render that was read from a file: tensors, axis, and metadata about its making.

    `transient` with `axis`, `phasor` with `frequencies`, `gated` with `gates`, `rates` with `rate_axis` and `beats`
    with `chirps`, both with `axis`, or `slow_phasor` with `slow_times` and `frequencies`; the others are None.
    `others`: tensors and settings of films that have no attribute here, by name. A batch of results (``stack``,
    ``cat``, ``torch.utils.data.default_collate``) has the metadata of each as a list under `batch`.
    """

    notes: ClassVar[tuple[str, ...]] = ("metadata",)

    transient: torch.Tensor | None
    steady: torch.Tensor
    axis: TimeAxis | None
    metadata: dict[str, Any] = field(default_factory=dict)
    phasor: torch.Tensor | None = None
    frequencies: FrequencyAxis | None = None
    channels: tuple[str, ...] = ()
    gates: tuple[Gate, ...] | None = None
    gated: torch.Tensor | None = None
    rates: torch.Tensor | None = None
    beats: torch.Tensor | None = None
    rate_axis: RateAxis | None = None
    chirps: Chirps | None = None
    slow_phasor: torch.Tensor | None = None
    slow_times: tuple[float, ...] | None = None
    others: Mapping[str, Any] = field(default_factory=dict)
    differences: torch.Tensor | None = None
    squares: torch.Tensor | None = None
    steady_differences: torch.Tensor | None = None
    cells: ErrorCells | None = None

    @classmethod
    def merged_notes(cls, records: Sequence[Result]) -> dict[str, Any]:
        """Return the metadata of a batch.

        Args:
            records: results of the batch.
        """
        return {"metadata": {"batch": [record.metadata for record in records]}}

    def _shown_notes(self) -> dict[str, str]:
        return {"metadata": ", ".join(self.metadata)} if self.metadata else {}


def write_result(path: str | Path, output: RenderOutput | Result, metadata: Mapping[str, Any] | None = None) -> Path:
    """Write a render, or a result that was read; an existing file is replaced once the new one is complete.

    Args:
        path: place of the file, ending in .h5, .hdf5 or .npz.
        output: the render.
        metadata: plain data (numbers, strings, lists, dictionaries) stored beside the statistics of the render.

    Returns:
        The path.

    Raises:
        StorageError: for an unknown ending, a folder that is missing, a full disk, or metadata that is not plain.
    """
    target = check_target(path, _WHAT)
    own = {"stats": asdict(output.stats)} if isinstance(output, RenderOutput) else output.metadata
    note = metadata_text({**(metadata or {}), **own}, _WHAT)
    film = layout_of_output(output)
    tensor = None if film is None else film.tensor(output)
    if film is None or tensor is None:
        raise StorageError("result file: expected an output with what its film measured, a transient for instance.")
    settings = film.entries()
    values = {name: value for name, value in settings.items() if not isinstance(value, np.ndarray)}
    entries: dict[str, Any] = {
        "format": FORMAT, **values, "channels": json.dumps(output.channels), "metadata": note,
    }  # fmt: skip
    arrays = {
        "steady": array_of(output.steady, _WHAT),
        film.measures: array_of(tensor, _WHAT),
        **{name: value for name, value in settings.items() if name not in values},
    }
    if output.cells is not None:
        entries["cells"] = json.dumps(output.cells)
        arrays |= {name: array_of(getattr(output, name), _WHAT) for name in _OF_ERRORS}
    write_arrays(target, arrays, entries, _WHAT)
    return target


def read_result(path: str | Path) -> Result:
    """Read a result of :func:`write_result`, as tensors on the CPU.

    Args:
        path: the file. Names that other programs put there are left alone.

    Returns:
        The result. Numbers and texts are compared with their checksums, which files of the first version do not have.

    Raises:
        StorageError: for a file that is missing, damaged, changed by another program or no result.
    """
    values = read_arrays(path, FORMATS, _WHAT, _is_known)
    with damage_said(Path(path), _WHAT):
        return _result(values, Path(path))


def _is_known(name: str) -> bool:
    # Films of others know alone what their settings are called.
    others = any(not film.__module__.startswith("torchtransient.") for film in FILMS)
    return others or name in _KNOWN or any(name == film.measures for film in FILMS)


def _result(values: Mapping[str, Any], source: Path) -> Result:
    metadata, steady = notes_of(values, "metadata"), tensor_in(values["steady"])
    # Files of earlier versions have no names of channels.
    channels = names_of(values, "channels") if "channels" in values else ()
    film = layout_of_entries({**values, **{name: read(values, name) for name, read in _READ.items() if name in values}})
    # Files of earlier versions call gated images a transient.
    response = tensor_in(values[film.measures if film.measures in values else "transient"])
    shape = film.shape
    if response.ndim < 3 + len(shape) or response.shape[-2 - len(shape) : -2] != shape:
        raise StorageError(
            f"result file: '{source}' holds a {film.measures} of shape {tuple(response.shape)}; expected "
            f"(..., C, {film.letter}, H, W) with {film.letter} = {' x '.join(map(str, shape))}."
        )
    if response.is_complex() != film.is_complex or steady.is_complex() or torch.bool in (
        response.dtype, steady.dtype
    ):  # fmt: skip
        raise ValueError(f"{film.measures} is of {response.dtype}, steady of {steady.dtype}")
    image = (*response.shape[: -2 - len(shape)], *response.shape[-2:])
    if steady.shape != image:
        raise ValueError(f"steady is of shape {tuple(steady.shape)}, {film.measures} of {tuple(response.shape)}")
    if channels and len(channels) != steady.shape[-3]:
        raise ValueError(f"{len(channels)} names of channels, {steady.shape[-3]} channels")
    errors: dict[str, Any] = {}
    if "cells" in values:
        bins, rows, columns, shared = json.loads(text_of(values, "cells"))
        errors = {name: tensor_in(values[name]) for name in _OF_ERRORS}
        errors["cells"] = ErrorCells(int(bins), int(rows), int(columns), bool(shared))
    return Result(steady=steady, metadata=metadata, channels=channels, **errors, **named_fields(film, response))
