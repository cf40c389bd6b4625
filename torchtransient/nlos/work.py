"""Renders of a simulation, whole or in parts: a scan of hidden things, or a complete scene."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import Numbers
from torchtransient.errors import SceneError
from torchtransient.files.content_key import content_key, contents_of
from torchtransient.nlos.renderer import POINTS, SPOTS, CaptureRenderer, as_capture, check_scan
from torchtransient.nlos.scene import capture_scene
from torchtransient.nlos.scene_scan import scan_of_scene
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.inventory import scene_inventory
from torchtransient.scene.load import Scene, load
from torchtransient.scene.objects import LoadedScene
from torchtransient.scene.plan import text_of
from torchtransient.scene.variant import active_variant, is_differentiable, resolve_variant


@dataclass(frozen=True)
class VariantChoice:
    """``name``: of the variant; ``why`` it was chosen."""

    name: str
    why: str


def choose_variant(scene: Scene, requested: str | None) -> VariantChoice:
    """Choose the cheapest variant in which a capture loses nothing.

    ``requested``; else the active one where it is polarized; else one channel where every spectrum of a scene is grey,
    on the device of the variant that :func:`tt.load` would take; else that variant, but none of one channel.

    Args:
        scene: of the capture.
        requested: name of a variant, or None.

    Raises:
        VariantError: for a variant that cannot be used.
        SceneError: for a scene that cannot be read.
    """
    import mitsuba as mi

    if requested is not None:
        return VariantChoice(resolve_variant(requested), "as asked for")
    active, name = mi.variant(), resolve_variant(None)
    if name.endswith("_polarized"):
        return VariantChoice(name, "the active one, which is polarized")
    # In the variant that is active, or becomes so: a switch takes time.
    found = scene_inventory(load(scene, variant=name if is_differentiable(active) else f"{name.split('_')[0]}_ad_mono"))
    coloured = [*found.colours, *found.measured, *found.bands]
    if not coloured:
        device = name.split("_")[0]
        return VariantChoice(f"{device}_ad_mono", "every spectrum is grey, so that one channel carries all of it")
    # One channel may have been chosen for the scene before.
    return VariantChoice(name.replace("_mono", "_rgb"), f"colour: {text_of(coloured)}")


def files_of(scene: Scene) -> dict[str, str]:
    """Return the contents of the files that a scene names anywhere, by the name that it has there.

    Included files, defaults and values of ``$parameters`` count.

    Args:
        scene: a complete one.

    Raises:
        SceneError: for a description that Mitsuba cannot read.
    """
    import mitsuba as mi

    description, found = scene._description, {}
    description.check_described("tt.nlos: a simulation that is kept in files")
    assert not isinstance(description, LoadedScene)  # refused above
    with active_variant(scene.variant), description.resolved_files():
        try:
            nodes = description.parse(mi.parser.ParserConfig(scene.variant)).nodes
        except RuntimeError as error:
            raise SceneError(f"{description.name}: {error}") from error
        for props in (node.props for node in nodes):
            for name in list(props):
                if props.type(name) == mi.Properties.Type.String:
                    value = str(props[name])
                    found[value] = contents_of(Path(str(mi.file_resolver().resolve(value))))
    return {name: contents for name, contents in found.items() if contents}


@dataclass(frozen=True)
class Film:
    """Film and effort of a simulation: ``time_axis`` or ``frequencies``, and ``spp``."""

    time_axis: TimeAxis | None
    frequencies: FrequencyAxis | Numbers | None
    spp: int


class HiddenWork:
    """A scan of hidden things, rendered in runs of sensor points: ``tiles`` of them, or less where points are few."""

    sums = False

    def __init__(
        self, hidden: Any, scan: Scan, settings: dict[str, Any], film: Film, variant: VariantChoice, tiles: int
    ) -> None:
        self.hidden, self.scan, self.film, self.variant = hidden, scan.detach(), film, variant
        self._settings = settings | vars(film) | {"variant": variant.name}
        self._points = self.scan.sensor_points.reshape(-1, 3)
        size = -(-len(self._points) // min(tiles, len(self._points)))
        # Of equal sizes but for the last: a size is a scene to be built.
        self._runs = [(k, min(k + size, len(self._points))) for k in range(0, len(self._points), size)]
        self._renderers: dict[int, CaptureRenderer] = {}
        if self.count > 1:
            # Of all points before the first part, not of some when their turn comes.
            check_scan(load(capture_scene(hidden, self.scan, **settings), variant=variant.name), self.scan)

    @property
    def count(self) -> int:
        """The number of parts."""
        return len(self._runs)

    def run(self, number: int) -> tuple[int, int]:
        """Return the first sensor point of a part, and the one behind its last."""
        return self._runs[number]

    def key(self, seed: int) -> str:
        """Return the key of a part file of this work."""
        return content_key(self.hidden, self.scan, self._settings, seed, self._runs)

    def weight(self, number: int) -> float:
        """Return 1: parts are not added up."""
        return 1.0

    def axes(self) -> tuple[TimeAxis | None, FrequencyAxis | None]:
        """Return time axis and frequencies of the film, one of which is None."""
        return self.renderer(0).axis, self.renderer(0).frequencies

    def renderer(self, number: int) -> TransientRenderer:
        """Return the renderer of a part."""
        return self._of(number).renderer

    def render(self, number: int, seed: int, *, spp: int | None = None, progress: bool = False) -> Capture:
        """Render a part as a capture: of a list of points where there are several parts."""
        first, last = self._runs[number]
        values = {} if self.count == 1 else {POINTS: self._points[first:last]}
        if values and self.scan.kind == "pairs":
            values[SPOTS] = self.scan.laser_points.reshape(-1, 3)[first:last]
        capture: Capture = self._of(number)(values, seed=seed, spp=spp, progress=progress)
        return capture

    def _of(self, number: int) -> CaptureRenderer:
        first, last = self._runs[number]
        if last - first not in self._renderers:
            scan, parameters = self.scan, ()  # type: Scan, tuple[str, ...]
            if self.count > 1:
                scan = _listed(self.scan, first, last)
                parameters = (POINTS, SPOTS) if scan.kind == "pairs" else (POINTS,)
            made = CaptureRenderer(self.hidden, scan, parameters, **self._settings)
            # Parts may be dark; of the whole capture it is said.
            made.says_black = False
            self._renderers[last - first] = made
        return self._renderers[last - first]


class SceneWork:
    """A complete scene, rendered in ``passes`` over all sensor points, with a share of the samples each."""

    sums = True

    def __init__(
        self, scene: Scene, time_axis: TimeAxis | None, frequencies: Any, spp: int | None, variant: VariantChoice,
        passes: int,
    ) -> None:  # fmt: skip
        self._renderer = TransientRenderer(scene, time_axis=time_axis, frequencies=frequencies, spp=spp)
        used = spp or self._renderer._scene_spp
        self.film = Film(self._renderer.axis, self._renderer.frequencies, used)
        self.variant = variant
        self.count = min(passes, used)
        with active_variant(scene.variant):
            self.scan = scan_of_scene(scene.built(self._renderer._options).scene)

    def run(self, number: int) -> tuple[int, int]:
        """Return the range of all sensor points."""
        return 0, math.prod(self.scan.sensor_shape)

    def share(self, number: int) -> int:
        """Return the samples of a pass."""
        whole, more = divmod(self.film.spp, self.count)
        return whole + (number < more)

    def key(self, seed: int) -> str:
        """Return the key of a part file of this work."""
        scene = self._renderer.scene
        return content_key(scene._description, files_of(scene), self.film, self.variant.name, seed, self.count)

    def weight(self, number: int) -> float:
        """Return the weight of a pass in the mean of all samples."""
        return self.share(number) / self.film.spp

    def axes(self) -> tuple[TimeAxis | None, FrequencyAxis | None]:
        """Return time axis and frequencies of the film, one of which is None."""
        return self._renderer.axis, self._renderer.frequencies

    def renderer(self, number: int) -> TransientRenderer:
        """Return the renderer of all parts."""
        return self._renderer

    def render(self, number: int, seed: int, *, spp: int | None = None, progress: bool = False) -> Capture:
        """Render a pass as a capture."""
        out = self._renderer(seed=seed, spp=spp or self.share(number), progress=progress)
        return as_capture(out, self.scan)


Work: TypeAlias = "HiddenWork | SceneWork"


def seed_of(seed: int, number: int) -> int:
    """Return the seed of a part, independent of the seeds of other parts.

    Args:
        seed: of the simulation.
        number: of the part.
    """
    return int.from_bytes(hashlib.sha256(f"{seed}:{number}".encode()).digest()[:4], "little")


def _listed(scan: Scan, first: int, last: int) -> Scan:
    """The scan of a run of its sensor points."""

    def part(values: torch.Tensor | None) -> torch.Tensor | None:
        return None if values is None else values.reshape(-1, 3)[first:last]

    points, normals = part(scan.sensor_points), part(scan.sensor_normals)
    assert points is not None
    changed: dict[str, Any] = {"sensor_points": points, "sensor_normals": normals}
    if scan.kind == "confocal":
        changed |= {"laser_points": points, "laser_normals": normals}
    elif scan.kind == "pairs":
        changed |= {"laser_points": part(scan.laser_points), "laser_normals": part(scan.laser_normals)}
    return replace(scan, **changed)
