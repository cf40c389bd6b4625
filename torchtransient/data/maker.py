"""Makers of samples: scenes that are built once, calls that are recorded once, and the arrays of each sample."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.checks import real_array, shown
from torchtransient.data.distributions import ANYTHING, NUMBERS, POSE, Choice, Draw, Place, Stream
from torchtransient.data.sample import Sample, in_order
from torchtransient.data.serialization import record_fields
from torchtransient.data.specification import (
    NOISE,
    RENDER,
    SCAN,
    SECOND,
    Specification,
    Structure,
    label_of,
    samples_of,
)
from torchtransient.errors import ArgumentError, GradientError, SceneError, ShapeError, TorchTransientError, UnitError
from torchtransient.files.plain_data import scan_data
from torchtransient.plugins import versions_of_others
from torchtransient.rendering.labels import first_return, label_names, material_names, scene_labels
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.load import Scene, load
from torchtransient.scene.parameters import ParameterTable, unknown_key
from torchtransient.scene.variant import active_variant, stokes_components
from torchtransient.sensing import Analyzers, Compose, Device, PolarizationMosaic

if TYPE_CHECKING:
    from torchtransient.axes import TimeAxis
    from torchtransient.capture import Scan

# Records of a renderer that describe its film.
_AXES = ("axis", "frequencies", "gates", "rates", "chirps")
# Label that is computed from the transient.
FIRST_RETURN = "first_return"
# Most camera paths for the share of light outside of the window.
_PATHS = 2**16
# Scenes that are kept. Mitsuba compiles a method call for all objects that are alive: with 8 scenes of the
# Cornell box a sample takes 350 ms instead of 25, and each new scene compiles anew. To build one takes 50 ms.
MOST_KEPT = 1


class Maker:
    """Maker of the samples of a recipe, which keeps the scene that it has built. Same recipe, same sample, whatever was
    made before, on one kind of processor with one thread (``tt.threads(1)``).

    Args:
        recipe: description.
    """

    def __init__(self, recipe: Specification) -> None:
        self.recipe = recipe
        self._kept: OrderedDict[str, Kept] = OrderedDict()

    def order(self, indices: Iterable[int]) -> list[int]:
        """Order samples by structure, in the order in which structures first come.

        Args:
            indices: numbers of the samples in the recipe, from 0.

        Returns:
            The same indices.
        """
        groups: dict[str, list[int]] = {}
        for index in samples_of(indices):
            groups.setdefault(self.recipe.structure(index).key, []).append(index)
        return [index for group in groups.values() for index in group]

    def kept(self, structure: Structure) -> Kept:
        """Return the scene of a structure, built unless it is kept.

        Args:
            structure: scene of the recipe with its exchanged entries.

        Returns:
            Scene with its renderer.
        """
        found = self._kept.pop(structure.key, None)
        if found is None:
            # Freed before the next one is built.
            while len(self._kept) >= MOST_KEPT:
                self._kept.popitem(last=False)
            found = Kept(self.recipe, structure)
        self._kept[structure.key] = found
        return found

    def draw(self, index: int) -> dict[str, Any]:
        """Draw the values of a sample.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Values by key.
        """
        (index,) = samples_of([index])
        structure = self.recipe.structure(index)
        varied = self.kept(structure).draw(index) if len(self.recipe.exchanged) < len(self.recipe.vary) else {}
        drawn = varied | dict(structure.entries)
        return {key: drawn[key] for key in self.recipe.vary}

    def sample(self, index: int) -> Sample:
        """Make a sample.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Sample.

        Raises:
            UnitError: for light that is not finite. Errors of the renderer pass.
        """
        (index,) = samples_of([index])
        # Of sample 0 in every process: all refuse the same samples.
        expected = self.film
        structure = self.recipe.structure(index)
        kept = self.kept(structure)
        check_film(kept.film, expected, f"sample {index}", "sample 0")
        varied = kept.draw(index)
        seed = kept.seed(index)
        arrays, outside = kept.arrays(index, varied, seed)
        # Labels are NaN where no surface is seen.
        for name in (expected["measures"], "steady", "measurement"):
            if name in arrays and not np.isfinite(arrays[name]).all():
                raise UnitError(f"recipe: sample {index}: {name} has numbers that are not finite.")
        return Sample(
            index,
            seed,
            arrays=arrays,
            values=self._values(structure, varied),
            outside=outside,
            structure=structure.text,
        )

    @functools.cached_property
    def film(self) -> dict[str, Any]:
        """``Kept.film`` of sample 0, which all samples share."""
        return self.kept(self.recipe.structure(0)).film

    def standard_error(self, index: int) -> float:
        """Return the relative standard error of a sample: root mean square of the errors over the cube, divided by that
        of the numbers as they are rendered, so that 1 is noise alone. From two renders.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            The error; 0 for a black sample.
        """
        (index,) = samples_of([index])
        kept = self.kept(self.recipe.structure(index))
        varied = kept.draw(index)
        one, other = (
            kept.light(varied, Stream(self.recipe.seed, index, purpose).seed()) for purpose in (RENDER, SECOND)
        )
        noise, power, second = (float(np.mean(np.abs(x).astype(np.float64) ** 2)) for x in (one - other, one, other))
        # The difference has twice the variance of one render.
        return float(np.sqrt(noise / (power + second))) if power + second > 0 else 0.0

    def about(self) -> dict[str, Any]:
        """Return the description of the measurement as plain data, for headers. Of several scenes, ``plan`` and names
        of shapes and materials stand under the scene's name; of scans that vary all stand in ``scans``, in the order of
        the choices.
        """
        recipe, first = self.recipe, self.recipe.structure(0)
        # Sample 0's scene last, since the last one is kept.
        names = sorted(recipe.scenes.names, key=lambda name: name == first.name)
        several = {name: self.kept(Structure(name, "", first.entries)).named() for name in names}
        of_scenes: dict[str, Any] = dict(several[first.name])
        if len(names) > 1:
            of_scenes = {what: {name: several[name][what] for name in recipe.scenes.names} for what in of_scenes}
        found = self.kept(Structure(first.name, "", first.entries)).about() | of_scenes
        if SCAN in recipe.exchanged:
            choices = recipe.vary[SCAN]
            found["scans"] = [scan_data(scan) for scan in choices.values] if isinstance(choices, Choice) else []
        return found

    def forget(self, structure: Structure) -> None:
        """Free the scene of a structure.

        Args:
            structure: scene of the recipe with its exchanged entries.
        """
        self._kept.pop(structure.key, None)

    def close(self) -> None:
        """Free the scenes."""
        self._kept.clear()

    def _values(self, structure: Structure, varied: Mapping[str, Any]) -> dict[str, NDArray[Any] | str]:
        found: dict[str, NDArray[Any] | str] = {}
        if self.recipe.scenes.names != [""]:
            found["scene"] = structure.name
        exchanged = dict(structure.entries)
        for key in self.recipe.vary:
            value, distribution = exchanged.get(key, varied.get(key)), self.recipe.vary[key]
            # One kind of value in all samples.
            kinds = distribution.values if isinstance(distribution, Choice) else [value]
            is_number = not any(isinstance(one, bool) or not _is_number(one) for one in kinds)
            text = label_of(distribution, value) if not is_number else ""
            # In the precision of the renderer.
            found[key] = text if text else np.asarray(value, dtype=np.float32)
        return found

class Kept:
    """Scene of a structure with its renderer and the places of the values that vary in it.

    Args:
        recipe: description.
        structure: scene of the recipe with its exchanged entries.

    Raises:
        SceneError: for keys that the scene does not have. Errors of the renderer pass.
    """

    def __init__(self, recipe: Specification, structure: Structure) -> None:
        self.recipe, self.structure = recipe, structure
        self.keys = [key for key in recipe.vary if key not in recipe.exchanged and not recipe.is_of_device(key)]
        self.device_keys = [key for key in recipe.vary if recipe.is_of_device(key)]
        self.scan: Scan | None = None
        try:
            self.renderer = self._make()
        except TorchTransientError as error:
            raise _named(error, structure) from error
        # The scene's filter where a pose varies, too: no derivatives are asked for.
        if self.renderer.film.has_bins and self.renderer.temporal_filter == "auto":
            self.renderer.temporal_filter = self.renderer._scene_filter
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
            with self._recipe_errors(lambda: given):
                return TransientRenderer(given, parameters=self.keys, **common, **own)
        # Here, since captures import files of this room.
        from torchtransient.nlos.renderer import CaptureRenderer
        from torchtransient.nlos.scene import capture_scene

        bounces, energy, scan = settings.bounces, settings.energy, self.scan
        # An object in the way of laser or sensor makes it no capture.
        common |= {"bounces": bounces, "energy": energy, "variant": self.recipe.variant, "physics": "error"}
        with self._recipe_errors(
            lambda: load(capture_scene(given, scan, bounces=bounces, energy=energy), variant=self.recipe.variant)
        ):
            renderer = CaptureRenderer(given, scan, parameters=self.keys, **common).renderer
        if settings.physics == "ignore":
            # Samples carry their shares of light outside of the window.
            renderer._watch.window_name = ""
        return renderer

    @contextmanager
    def _recipe_errors(self, scene: Callable[[], Scene]) -> Iterator[None]:
        """Raise errors of keys in the words of recipes."""
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

    def _places(self) -> dict[str, Place]:
        found = {}
        for key in self.keys:
            described = self.renderer.values[key].detach().cpu().numpy().astype(np.float64)
            is_pose = described.shape == (4, 4) and self.renderer._infos[key].kind.endswith("transform")
            found[key] = Place(key, POSE if is_pose else NUMBERS, described.shape, described)
        return found

    def _made(self) -> list[str]:
        """Names of a sample's arrays."""
        steady = () if self.scan is not None and self.scan.kind == "exhaustive" else ("steady",)
        measured = () if self.recipe.device is None else ("measurement",)
        return [self.renderer.film.measures, *steady, *self.recipe.settings.labels, *measured]

    @functools.cached_property
    def film(self) -> dict[str, Any]:
        """Measurement of the film as plain data, and its size in rows, columns, bins."""
        renderer = self.renderer
        return {
            "measures": renderer.film.measures,
            "size": renderer._cube_shape[:-1],
            **{name: record_fields(getattr(renderer, name)) for name in _AXES},
            "channels": list(renderer._channels),
            "spp": renderer.spp or renderer._scene_spp,
        }

    def check_labels(self) -> None:
        """Raise the errors of labels, by one intersection without light."""
        labels = [name for name in self.recipe.settings.labels if name != FIRST_RETURN]
        if labels:
            scene_labels(self.renderer, None, labels)
        if FIRST_RETURN in self.recipe.settings.labels:
            self._axis_of_first_return()

    # ----------------------------------------------------------------------------------------------------- samples

    def draw(self, index: int) -> dict[str, Any]:
        """Draw the parameters and the arguments of the device of a sample.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Values by key.
        """
        return self.drawn({key: Stream(self.recipe.seed, index, key) for key in self.recipe.vary})

    def drawn(self, streams: Mapping[str, Draw]) -> dict[str, Any]:
        """Draw values by key from given random numbers.

        Args:
            streams: sources of numbers by key.

        Returns:
            Values by key.
        """
        found: dict[str, Any] = {}
        for key in (*self.keys, *self.device_keys):
            place = self.places.get(key, Place(key, ANYTHING))
            try:
                found[key] = self.recipe.vary[key].draw(streams[key], place)
            except TorchTransientError as error:
                raise type(error)(f"recipe: vary: {error}") from error
        return found

    def arrays(self, index: int, drawn: Mapping[str, Any], seed: int) -> tuple[dict[str, NDArray[Any]], Any]:
        """Make the arrays of a sample.

        Args:
            index: number of the sample in the recipe, from 0.
            drawn: values by key.
            seed: seed of the render.

        Returns:
            Arrays by name, and the shares of light before and after the window.
        """
        values = self.values(drawn)
        tensors, outside = self._render(values, seed)
        labels = [name for name in self.recipe.settings.labels if name != FIRST_RETURN]
        if labels:
            tensors |= scene_labels(self.renderer, values, labels)
        if FIRST_RETURN in self.recipe.settings.labels:
            polarized = stokes_components(self.recipe.variant) > 1
            axis = self._axis_of_first_return()
            tensors[FIRST_RETURN] = first_return(tensors["transient"], axis, polarized=polarized)
        if self.recipe.device is not None:
            tensors["measurement"] = self._measured(index, drawn, tensors)
        kept = self._names(tensors)
        return {name: in_order(tensors[name]) for name in kept}, outside

    def _names(self, there: Iterable[str]) -> list[str]:
        """Names of a sample's arrays that are kept. Raises ArgumentError."""
        names, keep = list(there), self.recipe.settings.keep
        unknown = [name for name in keep or () if name not in names]
        if unknown or keep == ():
            raise ArgumentError(f"recipe: keep: expected some of {', '.join(names)}, got {shown(unknown or keep)}.")
        return names if keep is None else [name for name in names if name in keep]

    def light(self, drawn: Mapping[str, Any], seed: int) -> NDArray[Any]:
        """Return the light of a sample as the film measures it.

        Args:
            drawn: values by key.
            seed: seed of the render.

        Returns:
            Array of the film.
        """
        return self._render(self.values(drawn), seed)[0][self.renderer.film.measures].cpu().numpy()

    def outside(self, index: int) -> tuple[float, float]:
        """Return the shares of the light of a sample before and after the window, from 65536 camera paths at most.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Two shares.
        """
        rows, columns = self.film["size"][:2]
        spp = self.renderer.samples_drawn(min(self.film["spp"], max(1, _PATHS // (rows * columns))))
        return self._render(self.values(self.draw(index)), self.seed(index), spp)[1]

    def seed(self, index: int) -> int:
        """Return the seed of the render of a sample.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            0 to 2^32 - 1.
        """
        return Stream(self.recipe.seed, index, RENDER).seed()

    def values(self, drawn: Mapping[str, Any]) -> dict[str, torch.Tensor]:
        """Return drawn values as the renderer takes them.

        Args:
            drawn: values by key.

        Returns:
            float32 tensors by key.
        """
        return {key: torch.as_tensor(np.asarray(drawn[key]), dtype=torch.float32) for key in self.keys}

    def _render(
        self, values: Mapping[str, torch.Tensor], seed: int, spp: int | None = None
    ) -> tuple[dict[str, torch.Tensor], tuple[float, float]]:
        """Tensors by name, and shares of the light outside of the window."""
        measures = self.renderer.film.measures
        with torch.no_grad():
            out = self.renderer(values, seed=seed, spp=spp)
        light = out.others[measures] if measures in out.others else getattr(out, measures)
        tensors = {measures: light, "steady": out.steady}
        return tensors if self.scan is None else _of_scan(tensors, self.scan), out.outside

    def _axis_of_first_return(self) -> TimeAxis:
        exhaustive = self.scan is not None and self.scan.kind == "exhaustive"
        if self.renderer.axis is None or self.renderer.film.measures != "transient" or exhaustive:
            raise SceneError(
                f"recipe: labels: {FIRST_RETURN!r} is read off a transient of pixels; give time_axis=, and no "
                "exhaustive scan."
            )
        return self.renderer.axis

    # ------------------------------------------------------------------------------------------------- measurements

    def _measured(self, index: int, drawn: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> torch.Tensor:
        chain = self._chain_for(drawn)
        transient = tensors["transient"]
        is_polarized = any(isinstance(one, Analyzers | PolarizationMosaic) for one in chain.modules())
        if stokes_components(self.recipe.variant) > 1 and not is_polarized:
            # Other detectors count the light of all polarizations.
            transient = transient.select(-5, 0)
        generator = torch.Generator().manual_seed(Stream(self.recipe.seed, index, NOISE).seed())
        return chain.sample(transient, generator)

    def _chain_for(self, drawn: Mapping[str, Any]) -> Compose:
        """Chain of the device that a draw makes."""
        device = self.recipe.device
        assert device is not None
        if self._chain is not None:
            return self._chain
        for key in self.device_keys:
            device = changed_device(device, key, drawn[key])
        return self._chain_of(device)

    def check_device(self, drawn: Mapping[str, Any], *, measures: bool) -> None:
        """Raise the errors of the device that a draw makes.

        Args:
            drawn: values by key.
            measures: measure a film without light too, whose errors depend on the shape of the film, which all draws
                share.
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
        """Return plain data, the same for all structures of a recipe."""
        found: dict[str, Any] = {
            **{name: entry for name, entry in self.film.items() if name != "size"},
            "behind_time": 2 if self.scan is None else len(self.scan.shape),
            "variant": self.recipe.variant,
            "temporal_filter": self.renderer.effective_filter,
            "versions": package_versions(),
        }
        if self.scan is not None:
            found["scan"] = scan_data(self.scan)
        return found

    def named(self) -> dict[str, list[str]]:
        """Return the lines of the plan, and the names that the labels of the scene number."""
        renderer, labels = self.renderer, self.recipe.settings.labels
        film = f"film: {renderer.film.describe(renderer.effective_filter)}"
        found = {"plan": [film, f"variant: {self.recipe.variant}", f"integrator: {self._integrator()}"]}
        for label, names in (("shape", label_names), ("material", material_names)):
            if label in labels:
                found[f"{label}s"] = list(names(renderer))
        return found


def check_film(found: Mapping[str, Any], expected: Mapping[str, Any], mine: str, others: str) -> None:
    """Check that samples go into one array.

    Args:
        found: ``Kept.film`` of one sample.
        expected: ``Kept.film`` of the other samples.
        mine: name of the first for messages.
        others: name of the others.

    Raises:
        ShapeError: for two measurements.
    """
    for name, here in found.items():
        if here != expected[name]:
            raise ShapeError(
                f"recipe: {mine} has {name} {here}, {others} has {expected[name]}. All need the same: give time_axis= "
                "for bins of one kind, spp= for one number of samples, films of one size."
            )


def changed_device(device: Device, key: str, value: Any) -> Device:
    """Make a device with another argument of a stage.

    Args:
        device: description.
        key: "device.PhotonBudget.cycles" or "device.0.cycles".
        value: new value of the argument.

    Returns:
        Device.

    Raises:
        SceneError: for other keys.
    """
    parts = key.split(".")
    if len(parts) < 3:
        raise SceneError(f"recipe: vary: expected 'device.STAGE.ARGUMENT', got {key!r}.")
    stage, argument = parts[1], ".".join(parts[2:])
    plain = value.tolist() if isinstance(value, np.ndarray) else value
    if stage.isdigit() and int(stage) >= len(device.stages):
        raise SceneError(f"recipe: vary: {key!r}: the device has {len(device.stages)} stages, numbered from 0.")
    return device.changed(int(stage) if stage.isdigit() else stage, **{argument: plain})


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that determine the numbers, and of plugins that others have added."""
    # The version of the running code: a checkout may differ from the installed package.
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


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.ndarray) or (isinstance(value, list) and real_array(value) is not None)
