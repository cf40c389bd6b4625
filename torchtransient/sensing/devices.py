"""Devices as data: sensors described by plain dictionaries, to be kept in files and built for a time axis.

A stage is a dictionary with a ``kind`` (a name in `KINDS`) and the arguments of that class or function; arguments may
be stages themselves (a response, a code). The strings ``"@axis"`` and ``"@num_bins"`` stand for the axis that the
sensor is built for, ``"@cycles"``, ``"@period_s"`` and ``"@background"`` for the laser cycles, the laser period and the
constant counts of a bin of the chain's `PhotonBudget`, so that one change reaches all stages that have to agree. The
``make`` of a ``PixelGroups.by_value`` is a stage, in which ``"@value"`` stands for the value of the pixel. Only kinds
in the list are ever called, so that a file from elsewhere runs no code of its own.

    device = tt.sensing.device("kinect_v2_like")
    sensor = device.sensor(axis, grad="gaussian")          # a Compose, behind a TransientRenderer with that axis
    device.to_json(path);  Device.from_json(path) == device
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from torchtransient.array_files.part_files import write_text
from torchtransient.array_files.plain_texts import json_data, text_of_file, yaml_data
from torchtransient.axes import TimeAxis
from torchtransient.checks import short_errors, short_message, shown, some_of
from torchtransient.chirps import Chirps
from torchtransient.errors import MissingPackageError, StorageError, TorchTransientError
from torchtransient.sensing.afterpulsing import Afterpulsing, MeasuredDelays, PowerLawDelays
from torchtransient.sensing.afterpulsing_spad import AfterpulsingSPAD
from torchtransient.sensing.chain.chains import StreakCamera
from torchtransient.sensing.chain.compose import Compose, PixelGroups
from torchtransient.sensing.checks import check_number
from torchtransient.sensing.coherent.beats import BeatNoise, CoherentReceiver, Speckle
from torchtransient.sensing.coincidence import CoincidencePixel
from torchtransient.sensing.composed_responses import ComposedResponse, MeasuredResponse
from torchtransient.sensing.compressed_histograms import CodedHistogram, EquiDepthHistogram, fourier_codes
from torchtransient.sensing.counts import ShotNoise
from torchtransient.sensing.crosstalk import Crosstalk
from torchtransient.sensing.electronics import PixelElectronics
from torchtransient.sensing.free_running import FreeRunningSPAD
from torchtransient.sensing.gated import GatedIntegration
from torchtransient.sensing.impulse_response import ImpulseResponse
from torchtransient.sensing.itof.codes import (
    FourierCode,
    PiecewiseLinearCode,
    ReversedCode,
    TwoTapCode,
    binary_code,
    hamiltonian_code,
    measured_code,
    sine_code,
    square_code,
)
from torchtransient.sensing.itof.correlation import ItofCalibration, ItofCorrelation, TapDifference
from torchtransient.sensing.macro_pixel import MacroPixel, ZoneSum
from torchtransient.sensing.photon_budget import Optics, PhotonBudget, ambient_photon_rate, hot_pixel_rates
from torchtransient.sensing.polarization import Analyzers, PolarizationMosaic, circular_analyzers, linear_analyzers
from torchtransient.sensing.responses import GaussianResponse, TailedResponse, UniformResponse
from torchtransient.sensing.sensor import GradPolicy
from torchtransient.sensing.spad import BinaryFrames, SynchronousSPAD
from torchtransient.sensing.spatial_psf import LensBlur, SpatialPSF, defocus_psf, gaussian_psf
from torchtransient.sensing.timing import (
    TDC,
    DetectionJitter,
    DetectionSkew,
    PixelSkew,
    SweepJitter,
    random_code_widths,
)


def _seeded_code_widths(num_bins: int, dnl_std: float, seed: int = 0) -> torch.Tensor:
    """Draw the widths of a random TDC, the same ones wherever the file is read."""
    return random_code_widths(num_bins, dnl_std, torch.Generator().manual_seed(seed))


def _seeded_dark_rates(height: int, width: int, seed: int = 0, **numbers: float) -> torch.Tensor:
    """Draw hot pixels, the same ones wherever the file is read."""
    return hot_pixel_rates(height, width, generator=torch.Generator().manual_seed(seed), **numbers)


def _gaussian_psf(fwhm_px: float, size: int) -> torch.Tensor:
    return gaussian_psf(torch.as_tensor(fwhm_px, dtype=torch.float64), size)


def _tensor(values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


KINDS: Mapping[str, Callable[..., Any]] = {
    **{
        made.__name__: made
        for made in (
            Afterpulsing, Analyzers, BinaryFrames, CodedHistogram, ComposedResponse, Crosstalk, DetectionJitter,
            EquiDepthHistogram, FourierCode, FreeRunningSPAD, GatedIntegration, GaussianResponse, ImpulseResponse,
            ItofCalibration, ItofCorrelation, LensBlur, MeasuredResponse, Optics, PhotonBudget, PixelElectronics,
            PolarizationMosaic, ReversedCode, ShotNoise, StreakCamera, SweepJitter, SynchronousSPAD, TDC,
            TailedResponse, TapDifference, TwoTapCode, UniformResponse,
            fourier_codes, hamiltonian_code, linear_analyzers, measured_code, sine_code, square_code,
            AfterpulsingSPAD, CoincidencePixel, DetectionSkew, MacroPixel, MeasuredDelays, PixelGroups, PixelSkew,
            PowerLawDelays, ZoneSum,
            Compose, PiecewiseLinearCode, SpatialPSF, ambient_photon_rate, binary_code, circular_analyzers, defocus_psf,
            BeatNoise, Chirps, CoherentReceiver, Speckle,
        )
    },
    "PixelGroups.by_value": PixelGroups.by_value,
    "gaussian_psf": _gaussian_psf,
    "hot_pixel_rates": _seeded_dark_rates,
    "polarsens": PolarizationMosaic.polarsens,
    "tdc_code_widths": _seeded_code_widths,
    "tensor": _tensor,
}  # fmt: skip


@dataclass(frozen=True)
class Device:
    """Named sensor: its stages and the sources of its numbers. Plain data: equal when all of it is.

    Attributes:
        name: name of the device.
        description: description in one sentence.
        sources: sources of the numbers, one line each, with "assumed:" in front of numbers that no source gives.
        stages: dictionaries with a kind, see the top of this file.
        bin_width_s: bin width of the records in seconds, for `axis`; None without bins.
        num_bins: number of bins of the records; None without bins.

    Raises:
        StorageError: for sources or stages that are no lists, and for a stage that is no such dictionary.
    """

    name: str
    _: KW_ONLY
    description: str
    sources: tuple[str, ...]
    stages: tuple[dict[str, Any], ...]
    bin_width_s: float | None = None
    num_bins: int | None = None

    def __post_init__(self) -> None:
        for name in ("sources", "stages"):
            given = getattr(self, name)
            if not isinstance(given, (list, tuple)):
                raise StorageError(f"Device '{self.name}': expected {name} as a list, got {shown(given)}.")
        for text in (self.name, self.description, *self.sources):
            if not isinstance(text, str):
                raise StorageError(f"Device: expected name, description and sources as texts, got {shown(text)}.")
        object.__setattr__(self, "sources", tuple(self.sources))
        object.__setattr__(self, "stages", tuple(copy.deepcopy(s) for s in self.stages))
        if not self.stages:
            raise StorageError(f"Device '{self.name}': expected at least one stage, got none.")
        for stage in self.stages:
            _check_spec(stage, self.name)

    def axis(self, start_s: float = 0.0) -> TimeAxis:
        """Make the axis of the device's own bins.

        Args:
            start_s: start of the first bin in seconds.

        Raises:
            StorageError: for a device without bins.
        """
        if self.bin_width_s is None or self.num_bins is None:
            raise StorageError(f"Device '{self.name}': expected bin_width_s and num_bins, but it records no bins.")
        return TimeAxis.from_seconds(start_s, self.bin_width_s, self.num_bins)

    def sensor(self, axis: TimeAxis | None = None, *, grad: GradPolicy = "expected") -> Compose:
        """Build the chain of modules.

        Args:
            axis: axis of the light; None for `axis()`, from t = 0.
            grad: gradient policy.

        Raises:
            StorageError: for stages that are no modules.
        """
        if axis is None and self.bin_width_s is not None:
            axis = self.axis()
        budget = next((s for s in self.stages if s["kind"] == "PhotonBudget"), None)
        stages = [build_stage(s, axis, budget) for s in self.stages]
        wrong = [type(s).__name__ for s in stages if not isinstance(s, nn.Module)]
        if wrong:
            raise StorageError(f"Device '{self.name}': expected stages that are modules, got {', '.join(wrong)}.")
        return Compose(stages, grad=grad)

    def changed(self, stage: int | str, **arguments: Any) -> Device:
        """Make the same device with other arguments of one stage.

        Args:
            stage: number of the stage, or its kind if no other stage has that kind; a part of a stage has a kind too,
                such as the `SynchronousSPAD` of a `MacroPixel`.
            arguments: new arguments.

        Raises:
            StorageError: for a stage that is missing or there twice.
        """
        stages = copy.deepcopy(self.stages)
        parts = [stages[stage]] if isinstance(stage, int) else [p for p in _parts(stages) if p["kind"] == stage]
        if len(parts) != 1:
            kinds = [part["kind"] for part in _parts(stages)]
            raise StorageError(f"Device '{self.name}': expected one stage of kind '{stage}', got stages {kinds}.")
        parts[0].update(arguments)
        return replace(self, stages=stages)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, dictionaries, numbers and strings."""
        data = asdict(self)
        return {**data, "sources": list(data["sources"]), "stages": list(data["stages"])}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Device:
        """Make a device of the result of `to_dict`.

        Args:
            data: the entries.

        Raises:
            StorageError: for missing or unknown entries.
        """
        with short_errors("Device"):
            wanted = {"name", "description", "sources", "stages"}
            found = set(data) if isinstance(data, Mapping) else set()
            if not wanted <= found or found - wanted - {"bin_width_s", "num_bins"}:
                got = shown(data) if not found else some_of(sorted(shown(name) for name in found), 160)
                raise StorageError(f"Device: expected the entries {', '.join(sorted(wanted))}, got {got}.")
            return cls(**data)

    def to_json(self, path: str | Path | None = None) -> str:
        """Write JSON text.

        Args:
            path: file to write, or None.

        Returns:
            The text.

        Raises:
            StorageError: for numbers and objects that JSON cannot hold.
        """
        try:
            text = json.dumps(self.to_dict(), indent=2, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise StorageError(f"Device '{self.name}': expected numbers, strings and lists only: {error}.") from error
        if path is not None:
            write_text(path, text + "\n", "Device.to_json")
        return text

    @classmethod
    def from_json(cls, source: str | Path) -> Device:
        """Read a device from JSON.

        Args:
            source: a file (a `Path`, or a name without a brace), or text.

        Raises:
            StorageError: for a file that is missing, or other content.
        """
        return cls.from_dict(json_data(_text(source, "{", "Device.from_json"), "Device.from_json"))

    def to_yaml(self, path: str | Path | None = None) -> str:
        """Write YAML text. Needs PyYAML (``pip install torchtransient[yaml]``).

        Args:
            path: file to write, or None.

        Returns:
            The text.
        """
        text: str = _yaml().safe_dump(json.loads(self.to_json()), sort_keys=False)
        if path is not None:
            write_text(path, text, "Device.to_yaml")
        return text

    @classmethod
    def from_yaml(cls, source: str | Path) -> Device:
        """Read a device from YAML, by the safe loader.

        Args:
            source: a file or text.

        Raises:
            StorageError: for a file that is missing, or other content.
        """
        yaml = _yaml()
        return cls.from_dict(yaml_data(_text(source, "\n", "Device.from_yaml"), "Device.from_yaml", yaml))


def build_stage(spec: Any, axis: TimeAxis | None = None, budget: Mapping[str, Any] | None = None) -> Any:
    """Build the object of a stage: a sensor, response, code, or the value itself where it is no dictionary.

    Args:
        spec: the stage.
        axis: axis for ``"@axis"`` and ``"@num_bins"``.
        budget: stage of the `PhotonBudget` for ``"@cycles"``, ``"@period_s"`` and ``"@background"``.

    Raises:
        StorageError: for an unknown kind, an argument that the kind does not take, or a placeholder without a value;
            errors of the values themselves (UnitError, ShapeError) pass.
    """
    return _build(spec, axis, budget, None)


def _build(spec: Any, axis: TimeAxis | None, budget: Mapping[str, Any] | None, pixel: float | None) -> Any:
    """`build_stage` with the value of a pixel for "@value"."""
    if isinstance(spec, str) and spec.startswith("@"):
        return _placeholder(spec, axis, budget, pixel)
    if isinstance(spec, (list, tuple)):
        return [_build(s, axis, budget, pixel) for s in spec]
    if not isinstance(spec, dict) or "kind" not in spec:
        return spec
    _check_spec(spec, "build_stage")
    arguments = {k: _build(v, axis, budget, pixel) for k, v in spec.items() if k not in ("kind", "make")}
    if "make" in spec:
        made = spec["make"]
        if not isinstance(made, dict) or "@value" not in _walk(made):
            raise StorageError(f"build_stage: expected make as a stage with '@value' in it, got {shown(made)}.")
        arguments["make"] = lambda value: _build(made, axis, budget, value)
    try:
        return KINDS[spec["kind"]](**arguments)
    except TorchTransientError:
        raise
    except TypeError as error:
        raise StorageError(
            f"build_stage: expected arguments of {spec['kind']}, got {some_of(sorted(arguments))}: "
            f"{short_message(error)}."
        ) from error


def _placeholder(name: str, axis: TimeAxis | None, budget: Mapping[str, Any] | None, pixel: float | None) -> Any:
    if name == "@value" and pixel is not None:
        return pixel
    if name in ("@axis", "@num_bins"):
        if axis is None:
            raise StorageError("build_stage: expected a time axis for '@axis'. Give the renderer's, sensor(axis).")
        return axis if name == "@axis" else axis.num_bins
    if name not in ("@cycles", "@period_s", "@background"):
        known = "'@axis', '@num_bins', '@cycles', '@period_s' or '@background'"
        raise StorageError(f"build_stage: expected {known}, got {name!r}.")
    if budget is None:
        raise StorageError(f"build_stage: expected a PhotonBudget in the chain for {name!r}. Give the number itself.")
    if name == "@background":
        return build_stage(budget, axis).background_counts
    rate_hz = check_number(budget.get("repetition_rate_hz", 0.0), "repetition_rate_hz", "PhotonBudget", open_low=True)
    if name == "@period_s":
        return 1 / rate_hz
    exposure_s = budget.get("exposure_s")
    return budget.get("cycles") if exposure_s is None else round(exposure_s * rate_hz)


def _walk(spec: Any) -> Iterator[Any]:
    """Yield a stage, or any other value, and all values in its dictionaries and lists."""
    yield spec
    inner = spec.values() if isinstance(spec, dict) else spec if isinstance(spec, (list, tuple)) else ()
    for value in inner:
        yield from _walk(value)


def _parts(spec: Any) -> list[dict[str, Any]]:
    """Return every dictionary with a kind in a stage, or in a list of them: the stage, and its parts."""
    return [part for part in _walk(spec) if isinstance(part, dict) and "kind" in part]


def _check_spec(spec: Any, where: str) -> None:
    """Raise StorageError for a stage without a kind, and for unknown kinds and numbers that are not finite in it."""
    for part in [spec, *_parts(spec)]:
        kind = part.get("kind") if isinstance(part, dict) else None
        if not isinstance(kind, str) or kind not in KINDS:
            raise StorageError(
                f"Device '{where}': expected a dictionary with a kind, one of {some_of(sorted(KINDS))}; got "
                f"{shown(kind or part)}."
            )
    if any(isinstance(value, float) and not math.isfinite(value) for value in _walk(spec)):
        raise StorageError(f"Device '{where}': expected finite numbers; leave the argument out instead.")


def _text(source: str | Path, mark: str, who: str) -> str:
    return source if isinstance(source, str) and mark in source else text_of_file(source, who)


def _yaml() -> Any:
    try:
        import yaml
    except ImportError as error:
        raise MissingPackageError("Device: expected PyYAML: pip install 'torchtransient[yaml]'.") from error
    return yaml
