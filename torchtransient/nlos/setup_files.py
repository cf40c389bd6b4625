"""Captures as files: what they ask for, as arguments of :func:`~torchtransient.nlos.simulation.simulate`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchtransient.array_files.array_file import path_of
from torchtransient.checks import short_errors
from torchtransient.errors import SceneError
from torchtransient.files.yaml_files import read_yaml
from torchtransient.nlos.description import read_description
from torchtransient.nlos.scene import ALL_BOUNCES
from torchtransient.nlos.tal_yaml import TalSettings, read_tal_yaml
from torchtransient.scene.load import load

# Bounces of light that goes from spot to scan point, and around one corner.
_WALL_TO_WALL, _AROUND_A_CORNER = 2, 3


def read_setup(path: str | Path, **xml_parameters: Any) -> dict[str, Any]:
    """The arguments of ``simulate`` that a file stands for: ``simulate(**read_setup("capture.yaml"))``.

    ``path``: a YAML file of this library (:mod:`.description`), a scene file of y-tal's renderer or its folder
    (:mod:`.tal_yaml`), which are told apart by their entries, or an XML file of Mitsuba or mitransient with the
    integrator ``transient_nlos_path``, whose ``$parameters`` are filled by ``xml_parameters``.

    Of y-tal's settings, ``filter_bounces: b`` means light of b + 1 bounces, as mitransient 1.x computes, ``max_depth``
    the largest number of bounces, and ``discard_direct_paths`` leaves out light of less than 3. The laser brings
    ``laser_emission`` in joules; y-tal's scale, that of a projector of a certain distance and field of view, is another
    by one factor for all points.

    Raises StorageError for files that cannot be read, SceneError for what they say.
    """
    with short_errors("read_setup"):
        return _setup(path, xml_parameters)


def _setup(path: str | Path, xml_parameters: Mapping[str, Any]) -> dict[str, Any]:
    source = path_of(path, "read_setup")
    if source.suffix.lower() == ".xml":
        return {"hidden": load(source, **xml_parameters)}
    if xml_parameters:
        given = ", ".join(xml_parameters)
        raise SceneError(f"{source.name}: parameters fill the $NAMES of XML files alone, got {given}; leave them out.")
    if not source.is_dir() and source.suffix.lower() not in (".yaml", ".yml"):
        raise SceneError(
            f"expected a capture as YAML (.yaml, .yml), the folder of a y-tal scene, or Mitsuba's XML, got '{source}'."
        )
    entries, _ = read_yaml(source, "capture")
    if "geometry" in entries or "relay_wall" in entries:
        return _of_tal(read_tal_yaml(source))
    if "hidden" not in entries:
        raise SceneError(
            f"{source.name}: expected an entry 'hidden' (a capture of torchtransient) or 'geometry' (a scene of "
            f"y-tal), got {', '.join(map(str, entries))}."
        )
    found = read_description(source)
    return {
        "hidden": dict(found.hidden),
        "scan": found.scan,
        "time_axis": found.axis,
        "frequencies": found.frequencies,
        "spp": found.spp,
        "bounces": ALL_BOUNCES if found.bounces is None else found.bounces,
        "sensor": found.sensor,
        "seed": found.seed,
        "variant": found.variant,
    }


def _of_tal(settings: TalSettings) -> dict[str, Any]:
    return {
        "hidden": dict(settings.hidden),
        "scan": settings.scan,
        "time_axis": None if settings.frequencies is not None else settings.axis,
        "frequencies": settings.frequencies,
        "spp": settings.spp,
        "bounces": tal_bounces(settings.max_depth, settings.filter_bounces, settings.discard_direct_paths),
        "energy": _energy(settings.laser_emission),
        "variant": settings.variant if "mitsuba_variant" in settings.entries else None,
    }


def tal_bounces(max_depth: int, filter_bounces: int, discard_direct_paths: bool) -> Sequence[int] | str:
    """The bounces that mitransient 1.x counts with laser sampling; -1 is no limit, no filter.

    A flat wall does not light itself, so that light of two bounces is none without a limit. Raises SceneError for
    settings that leave nothing.
    """
    first = _AROUND_A_CORNER if discard_direct_paths else _WALL_TO_WALL
    last = max_depth
    if filter_bounces != -1:
        wanted = filter_bounces + 1
        first, last = max(first, wanted), wanted if max_depth == -1 else min(max_depth, wanted)
    if last == -1:
        return ALL_BOUNCES
    if last < first:
        raise SceneError(
            f"y-tal scene: integrator_max_depth: {max_depth}, integrator_filter_bounces: {filter_bounces} and "
            f"integrator_discard_direct_paths: {str(discard_direct_paths).lower()} leave no light. filter_bounces: 2 "
            "with max_depth: -1 is light around one corner, of three bounces."
        )
    return tuple(range(first, last + 1))


def _energy(emission: Any) -> Any:
    """A number, or a spectrum of Mitsuba."""
    if not isinstance(emission, tuple):
        return emission
    if len(set(emission)) == 1:
        return emission[0]
    return {"type": "rgb", "value": list(emission)}
