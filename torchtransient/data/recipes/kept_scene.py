"""A structure's scene, built once: its renderer, what varies in it, and what is measured of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.checks import shown
from torchtransient.data.recipes.distribution import ANYTHING, NUMBERS, POSE, Place
from torchtransient.data.recipes.sample import in_order
from torchtransient.data.recipes.specification import (
    NOISE,
    RENDER,
    Specification,
)
from torchtransient.data.recipes.streams import Draw, Stream
from torchtransient.data.recipes.structures import Structure
from torchtransient.data.recipes.written import written_frequencies, written_shape
from torchtransient.errors import ArgumentError, GradientError, SceneError, ShapeError, TorchTransientError
from torchtransient.files.plain_data import scan_data
from torchtransient.plugins import versions_of_others
from torchtransient.rendering.labels import LABELS, first_return, label_names, material_names, scene_labels
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.load import Scene, load
from torchtransient.scene.parameters import ParameterTable, unknown_key
from torchtransient.scene.variant import active_variant, stokes_components
from torchtransient.sensing import Analyzers, Compose, Device, PolarizationMosaic

if TYPE_CHECKING:
    from torchtransient.axes import TimeAxis
    from torchtransient.capture import Scan

# A label that is read off the transient.
FIRST_RETURN = "first_return"
# Camera paths at most where only the share of light outside of the window is wanted.
_PATHS = 2**16


@dataclass(frozen=True)
class _Measured:
    """What a render of either kind brings: its tensors by name, and shares of the light outside of the window."""

    tensors: dict[str, torch.Tensor]
    outside: tuple[float, float]


@dataclass(frozen=True)
class Measures:
    """What the film of a scene measures: its ``name``, rows, columns, bins and channels, and what these stand for."""

    name: str
    size: tuple[int, ...]
    axis: Any
    frequencies: Any
    gates: Any
    rates: Any
    chirps: Any
    channels: tuple[str, ...]
    spp: int

    def check(self, other: Measures, mine: str, others: str) -> None:
        """Raise ShapeError where another structure's samples do not go into one array with these."""
        for field in fields(self):
            here, there = getattr(self, field.name), getattr(other, field.name)
            if here != there:
                raise ShapeError(
                    f"recipe: {mine} has {field.name} {here}, {others} has {there}. All need the same: give time_axis= "
                    "for bins of one kind, spp= for one number of samples, films of one size."
                )


class Kept:
    """A structure's scene, its renderer, and the places of what varies in it. Raises SceneError for keys that it does
    not have.
    """

    def __init__(self, recipe: Specification, structure: Structure) -> None:
        self.recipe, self.structure = recipe, structure
        check_label_names(recipe.settings.labels)
        self.keys = [key for key in recipe.vary if key not in recipe.exchanged and not recipe.is_of_device(key)]
        self.device_keys = [key for key in recipe.vary if recipe.is_of_device(key)]
        self.scan: Scan | None = None
        try:
            self.renderer = self._make()
        except TorchTransientError as error:
            raise _named(error, structure) from error
        self._settle_filter()
        self._names(self._made())
        self.places = self._places()
        self._chain = None if recipe.device is None or self.device_keys else self._chain_of(recipe.device)

    # ------------------------------------------------------------------------------------------------------ making

    def _make(self) -> TransientRenderer:
        settings, (given, self.scan) = self.recipe.settings, self.recipe.scenes.build(self.structure)
        common: dict[str, Any] = {
            "time_axis": settings.time_axis, "frequencies": settings.frequencies, "spp": settings.spp,
            "temporal_filter": settings.temporal_filter, "pulse": settings.pulse, "irf": settings.irf,
            "physics": settings.physics, "sampler": settings.sampler,
        }  # fmt: skip
        if self.scan is None:
            own: dict[str, Any] = {"gates": settings.gates, "rates": settings.rates, "chirps": settings.chirps}
            own |= {"max_depth": settings.max_depth, "sensors": settings.sensors}
            own["sensors"] = list(own["sensors"]) if isinstance(own["sensors"], tuple) else own["sensors"]
            with self._keys_told(lambda: given):
                return TransientRenderer(given, parameters=self.keys, **common, **own)
        # Imported where it is used: captures read files of this room.
        from torchtransient.nlos.renderer import CaptureRenderer
        from torchtransient.nlos.scene import capture_scene

        bounces, energy, scan = settings.bounces, settings.energy, self.scan
        # What stands in the way of laser or sensor is no capture.
        common |= {"bounces": bounces, "energy": energy, "variant": self.recipe.variant, "physics": "error"}
        with self._keys_told(
            lambda: load(capture_scene(given, scan, bounces=bounces, energy=energy), variant=self.recipe.variant)
        ):
            renderer = CaptureRenderer(given, scan, parameters=self.keys, **common).renderer
        if settings.physics == "ignore":
            # Of light outside of the window the share is told.
            renderer._watch.window_name = ""
        return renderer

    @contextmanager
    def _keys_told(self, scene: Callable[[], Scene]) -> Iterator[None]:
        """In the words of recipes, where keys are not those of the scene."""
        try:
            yield
        except (SceneError, GradientError):
            # Not before: the table is of a scene of its own, and Mitsuba compiles for all objects that are alive.
            self._check_keys(scene().parameters())
            raise

    def _check_keys(self, table: ParameterTable) -> None:
        for key in self.keys:
            if key not in table:
                hint = unknown_key(key, list(table))
                raise SceneError(
                    f"recipe: vary: {hint} Entries of a scene dictionary ('box.filename') and $names of an XML file "
                    "are keys too, where the scene has them."
                )
            if key not in table.differentiable():
                raise SceneError(
                    f"recipe: vary: {key!r} cannot vary as a value: {table[key].reason}. Where a scene dictionary has "
                    "an entry for it, name that."
                )

    def _settle_filter(self) -> None:
        """Not another filter because a pose varies: nobody asks for derivatives here."""
        renderer = self.renderer
        if renderer.film.has_bins and renderer.temporal_filter == "auto":
            renderer.temporal_filter = renderer._scene_filter

    def _places(self) -> dict[str, Place]:
        found = {}
        for key in self.keys:
            described = self.renderer.values[key].detach().cpu().numpy().astype(np.float64)
            is_pose = described.shape == (4, 4) and self.renderer._infos[key].kind.endswith("transform")
            found[key] = Place(key, POSE if is_pose else NUMBERS, described.shape, described)
        return found

    def _made(self) -> list[str]:
        """Names of what is made of a sample."""
        steady = () if self.scan is not None and self.scan.kind == "exhaustive" else ("steady",)
        measured = () if self.recipe.device is None else ("measurement",)
        return [self.renderer.film.measures, *steady, *self.recipe.settings.labels, *measured]

    @property
    def measures(self) -> Measures:
        """What the film measures."""
        renderer = self.renderer
        return Measures(
            renderer.film.measures, renderer._cube_shape[:-1], renderer.axis, renderer.frequencies, renderer.gates,
            renderer.rates, renderer.chirps, renderer._channels, renderer.spp or renderer._scene_spp,
        )  # fmt: skip

    def check_labels(self) -> None:
        """Raise what would be wrong with labels: one intersection, no light."""
        labels = [name for name in self.recipe.settings.labels if name != FIRST_RETURN]
        if labels:
            scene_labels(self.renderer, None, labels)
        if FIRST_RETURN in self.recipe.settings.labels:
            self._axis_of_first_return()

    # ----------------------------------------------------------------------------------------------------- samples

    def draw(self, index: int) -> dict[str, Any]:
        """What a sample draws of parameters and of the device."""
        return self.drawn({key: Stream(self.recipe.seed, index, key) for key in self.recipe.vary})

    def drawn(self, streams: Mapping[str, Draw]) -> dict[str, Any]:
        """What comes of some random numbers, by key."""
        found: dict[str, Any] = {}
        for key in (*self.keys, *self.device_keys):
            place = self.places.get(key, Place(key, ANYTHING))
            try:
                found[key] = self.recipe.vary[key].draw(streams[key], place)
            except TorchTransientError as error:
                raise type(error)(f"recipe: vary: {error}") from error
        return found

    def arrays(self, index: int, drawn: Mapping[str, Any], seed: int) -> tuple[dict[str, NDArray[Any]], Any]:
        """What is stored of a sample, and the shares of light outside of the window."""
        values = self.values(drawn)
        found = self._render(values, seed)
        tensors = dict(found.tensors)
        labels = [name for name in self.recipe.settings.labels if name != FIRST_RETURN]
        if labels:
            tensors |= scene_labels(self.renderer, values, labels)
        if FIRST_RETURN in self.recipe.settings.labels:
            tensors[FIRST_RETURN] = self._first_return(tensors)
        if self.recipe.device is not None:
            tensors["measurement"] = self._measured(index, drawn, tensors)
        kept = self._names(tensors)
        return {name: in_order(tensors[name]) for name in kept}, found.outside

    def _names(self, there: Iterable[str]) -> list[str]:
        """Of what a sample has, what it keeps. Raises SceneError."""
        names, keep = list(there), self.recipe.settings.keep
        unknown = [name for name in keep or () if name not in names]
        if unknown or keep == ():
            raise ArgumentError(f"recipe: keep: expected some of {', '.join(names)}, got {shown(unknown or keep)}.")
        return names if keep is None else [name for name in names if name in keep]

    def light(self, drawn: Mapping[str, Any], seed: int) -> NDArray[Any]:
        """What the film measures of a sample."""
        return self._render(self.values(drawn), seed).tensors[self.renderer.film.measures].cpu().numpy()

    def outside(self, index: int) -> tuple[float, float]:
        """Shares of the light of a sample before and after the window: those of the sample itself, or, where that
        takes more than ``_PATHS`` camera paths, of about as many.
        """
        rows, columns = self.measures.size[:2]
        spp = self.renderer.samples_drawn(min(self.measures.spp, max(1, _PATHS // (rows * columns))))
        return self._render(self.values(self.draw(index)), self.seed(index), spp).outside

    def seed(self, index: int) -> int:
        """Seed of the render of a sample."""
        return Stream(self.recipe.seed, index, RENDER).seed()

    def values(self, drawn: Mapping[str, Any]) -> dict[str, torch.Tensor]:
        """What is drawn as the renderer takes it."""
        return {key: torch.as_tensor(np.asarray(drawn[key]), dtype=torch.float32) for key in self.keys}

    def _render(self, values: Mapping[str, torch.Tensor], seed: int, spp: int | None = None) -> _Measured:
        measures = self.renderer.film.measures
        with torch.no_grad():
            out = self.renderer(values, seed=seed, spp=spp)
        light = out.others[measures] if measures in out.others else getattr(out, measures)
        tensors = {measures: light, "steady": out.steady}
        return _Measured(tensors if self.scan is None else _of_scan(tensors, self.scan), out.outside)

    def _first_return(self, tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
        axis = self._axis_of_first_return()
        polarized = stokes_components(self.recipe.variant) > 1
        return first_return(tensors["transient"], axis, polarized=polarized)

    def _axis_of_first_return(self) -> TimeAxis:
        if self.renderer.axis is None or self.renderer.film.measures != "transient" or self._is_exhaustive():
            raise SceneError(
                f"recipe: labels: {FIRST_RETURN!r} is read off a transient of pixels; give time_axis=, and no "
                "exhaustive scan."
            )
        return self.renderer.axis

    def _is_exhaustive(self) -> bool:
        return self.scan is not None and self.scan.kind == "exhaustive"

    # ------------------------------------------------------------------------------------------------- measurements

    def _measured(self, index: int, drawn: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
        chain = self._chain_for(drawn)
        transient = tensors["transient"]
        if stokes_components(self.recipe.variant) > 1 and not _is_polarized(chain):
            # A detector that takes no notice of polarization counts all light.
            transient = transient.select(-5, 0)
        generator = torch.Generator().manual_seed(Stream(self.recipe.seed, index, NOISE).seed())
        return chain.sample(transient, generator)

    def _chain_for(self, drawn: Mapping[str, Any]) -> Compose:
        """The device's chain, as a draw makes it."""
        device = self.recipe.device
        assert device is not None
        if self._chain is not None:
            return self._chain
        for key in self.device_keys:
            device = changed(device, key, drawn[key])
        return self._chain_of(device)

    def check_device(self, drawn: Mapping[str, Any], *, measures: bool) -> None:
        """Raise what is wrong with the device, as a draw makes it. ``measures``: of a whole film without light, too;
        what that raises depends on the shape of the film, which all draws share.
        """
        if self.recipe.device is None:
            return
        self._chain_for(drawn)
        if measures:
            renderer = self.renderer
            rows, columns, bins = renderer._cube_shape[0], renderer._cube_shape[1], renderer.film.count
            stokes = (4,) if stokes_components(self.recipe.variant) > 1 else ()
            dark = torch.zeros(*stokes, len(renderer._channels), bins, rows, columns)
            self._measured(0, drawn, {"transient": dark})

    def _chain_of(self, device: Device) -> Compose:
        axis = self.renderer.axis
        if axis is None or self.renderer.film.measures != "transient":
            raise SceneError("recipe: device: a device measures transients; give time_axis= instead of another film.")
        return device.sensor(axis)

    # ------------------------------------------------------------------------------------------------------- about

    def _integrator(self) -> str:
        with active_variant(self.recipe.variant):
            built = self.renderer.scene.built(self.renderer._options)
            depth = getattr(built.scene.integrator(), "max_depth", None)
        return built.integrator + ("" if depth is None else f", max_depth {'unbounded' if depth > 2**31 else depth}")

    def about(self) -> dict[str, Any]:
        """Plain data, the same for all structures of a recipe."""
        renderer = self.renderer
        film = renderer.film
        found: dict[str, Any] = {
            "measures": film.measures,
            "axis": None if renderer.axis is None else asdict(renderer.axis),
            "frequencies": written_frequencies(renderer.frequencies),
            "gates": None if renderer.gates is None else [written_shape(gate) for gate in renderer.gates],
            "rates": None if renderer.rates is None else asdict(renderer.rates),
            "chirps": None if renderer.chirps is None else asdict(renderer.chirps),
            "channels": list(renderer._channels),
            "behind_time": 2 if self.scan is None else len(self.scan.shape),
            "spp": renderer.spp or renderer._scene_spp,
            "variant": self.recipe.variant,
            "temporal_filter": renderer.effective_filter,
            "versions": versions(),
        }  # fmt: skip
        if self.scan is not None:
            found["scan"] = scan_data(self.scan)
        return found

    def named(self) -> dict[str, list[str]]:
        """What a scene has of its own: lines of its plan, names that the labels count."""
        renderer, labels = self.renderer, self.recipe.settings.labels
        film = f"film: {renderer.film.describe(renderer.effective_filter)}"
        found = {"plan": [film, f"variant: {self.recipe.variant}", f"integrator: {self._integrator()}"]}
        for label, names in (("shape", label_names), ("material", material_names)):
            if label in labels:
                found[f"{label}s"] = list(names(renderer))
        return found


def check_label_names(names: tuple[str, ...]) -> None:
    for name in names:
        if name not in (*LABELS, FIRST_RETURN):
            known = ", ".join((*LABELS, FIRST_RETURN))
            raise SceneError(f"recipe: labels: unknown label {name!r}. Known ones are {known}.")


def changed(device: Device, key: str, value: Any) -> Device:
    """A device with another argument of a stage: "device.PhotonBudget.cycles", "device.0.cycles"."""
    parts = key.split(".")
    if len(parts) < 3:
        raise SceneError(f"recipe: vary: expected 'device.STAGE.ARGUMENT', got {key!r}.")
    stage, argument = parts[1], ".".join(parts[2:])
    plain = value.tolist() if isinstance(value, np.ndarray) else value
    if stage.isdigit() and int(stage) >= len(device.stages):
        raise SceneError(f"recipe: vary: {key!r}: the device has {len(device.stages)} stages, numbered from 0.")
    return device.changed(int(stage) if stage.isdigit() else stage, **{argument: plain})


def _is_polarized(chain: Compose) -> bool:
    """Whether a stage looks at the Stokes components."""
    return any(isinstance(module, Analyzers | PolarizationMosaic) for module in chain.modules())


def versions() -> dict[str, str]:
    """Of the packages that decide about the numbers, and of plugins that others have added."""
    # This package's own is that of the code which runs: a checkout on the path need not be the one that is installed.
    from torchtransient import __version__

    others = {name: metadata.version(name) for name in ("mitsuba", "drjit", "torch", "numpy")}
    return {"torchtransient": __version__, **others, **versions_of_others()}


def _of_scan(tensors: Mapping[str, torch.Tensor], scan: Scan) -> dict[str, torch.Tensor]:
    """Pixels of a film as points of a scan. The steady image of an exhaustive one sums over the laser's places."""
    from torchtransient.nlos.renderer import in_scan_shape, steady_in_scan_shape

    found = {name: in_scan_shape(tensor, scan) for name, tensor in tensors.items() if name != "steady"}
    if scan.kind != "exhaustive":
        found["steady"] = steady_in_scan_shape(tensors["steady"], scan)
    return found


def _named(error: TorchTransientError, structure: Structure) -> TorchTransientError:
    where = f"structure '{structure.text}': " if structure.text else ""
    return type(error)(f"{where}{error}")
