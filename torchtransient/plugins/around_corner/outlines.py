"""Choice of the boundary term of mutual occlusion for a job of derivatives, and its gaps."""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import GradientWarning
from torchtransient.plugins.around_corner.division import BOUNCES
from torchtransient.plugins.around_corner.geometry import front_normal
from torchtransient.plugins.around_corner.late_light import FIRST
from torchtransient.plugins.around_corner.occlusion import LateOutlines, MutualOcclusion
from torchtransient.plugins.around_corner.outline_table import OutlineTable, Part, hiding_pairs, parts_of
from torchtransient.plugins.integrators.job import passes_of, seed_array
from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.transport.boundary.moving_edges import (
    Gap,
    MovingEdges,
    edges_in_mirrors,
    rims_without_edges,
)
from torchtransient.plugins.transport.material_points import MaterialVacuum

# Edge samples of a pixel and viewpoint, as a share of its paths.
SHARE = 4
# Viewpoints that the density of edges is made for.
MOST_REFERENCES = 25
_SEED = 0x85EBCA6B


def follows_outlines(segment: type, contents: Any) -> bool:
    """Return whether derivatives follow outlines.

    Args:
        segment: class of the job's segments; with material ones hidden points follow their shapes.
        contents: contents of the scene, in which nothing may scatter with a delay.
    """
    return issubclass(segment, MaterialVacuum) and contents.delays is None


def silhouettes(scene: Any, least: int, most: int) -> MovingEdges:
    """Return what derivatives lack where outlines are followed.

    Args:
        scene: built scene.
        least, most: numbers of bounces that are rendered.
    """
    words, always, bent = [], [], []
    if least <= BOUNCES <= most:
        alone = "" if most == BOUNCES else "in light of three bounces "
        words.append(f"{alone}behind shapes without triangles")
    if most >= BOUNCES:
        words.append("where bodies run into each other")
    if most >= FIRST:
        always, bent = rims_without_edges(scene), edges_in_mirrors(scene)
        if mi.is_polarized:
            where = "in polarized light of more than three bounces where one part hides another"
            always.append(Gap(where, "Set max_depth to 3."))
    return MovingEdges(always, bent, words=words)


class Viewpoints:
    """Viewpoints that hidden shapes are seen from: scanned points, then the laser's spots unless confocal.

    Attributes:
        p, n: places, and normals towards the viewer, (P, 3).
        references: numbers of the viewpoints that a density of edges is made for.
        shapes: registry numbers of the shapes that the viewpoints lie on.
    """

    def __init__(self, scanned: Any, spots: Any, confocal: bool) -> None:
        found = [_visible(scanned)] + ([] if confocal else [_visible(spots)])
        self.p, self.n = (np.concatenate([one[i] for one in found]) for i in range(2))
        # As many times as there are scanned points that stand for a scan, a single spot counts.
        few = [np.unique(np.linspace(0, len(one[0]) - 1, MOST_REFERENCES).astype(int)) for one in found if len(one[0])]
        picked = [np.resize(rows, MOST_REFERENCES) for rows in few]
        first = np.cumsum([0, *(len(one[0]) for one in found if len(one[0]))])
        index = np.concatenate([rows + start for rows, start in zip(picked, first, strict=False)]) if few else []
        self.references = np.asarray(index, dtype=int)
        self.shapes = set(np.unique(np.concatenate([one[2] for one in found])).tolist())


def _visible(si: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places, normals towards the viewer and shapes of the valid interactions."""
    valid = np.array(si.is_valid())
    n = front_normal(si)
    n = dr.select(si.wi.z < 0, -n, n)
    numbers = np.array(dr.reinterpret_array(mi.UInt32, si.shape))
    return np.array(si.p, dtype=np.float64).T[valid], np.array(n, dtype=np.float64).T[valid], numbers[valid]


def mutual_occlusion(
    integrator: Any, context: Any, sensor: Any, film: Any, seed: Any, spp: int, scanned: Any
) -> MutualOcclusion | None:
    """Return the boundary term of a job of derivatives in light of three bounces, None if it is zero or not followed.

    Warns of shapes without edges that may hide another one.

    Args:
        integrator, context, sensor, film: integrator and context of the job, its sensor and film.
        seed: seed of the job.
        spp: samples per pixel of the job, 0 for the sampler's own; there is an edge sample for every ``SHARE`` of them.
        scanned: interactions of the scanned points, detached.
    """
    wanted = context.wanted
    if not (wanted.geometry and follows_outlines(type(context.segment), context.contents)):
        return None
    if not context.min_depth <= BOUNCES <= context.max_depth:
        return None
    moves_viewpoints = wanted.sensor or wanted.light
    if not (moves_viewpoints or wanted.shapes):
        return None
    (spots,) = context.connections
    viewpoints = Viewpoints(scanned, dr.detach(spots.spots.si), spots.confocal)
    shapes = list(context.scene.shapes())
    moving = {k for k, shape in enumerate(shapes) if shape.ptr in wanted.shapes}
    moves_viewpoints |= any(registry_number(shapes[k]) in viewpoints.shapes for k in moving)
    parts, triangles = parts_of(shapes)

    def is_requested(i: int, j: int) -> bool:
        return bool(moves_viewpoints or moving & parts[i].shapes or moving & parts[j].shapes)

    pairs = hiding_pairs(parts, viewpoints.p, is_requested)
    if not pairs:
        return None
    _warn_of_limbs(shapes, parts, pairs)
    hiders = sorted({i for i, _ in pairs if parts[i].edges is not None and len(parts[i].edges.ends)})
    if not hiders:
        return None
    rows = viewpoints.references
    edges = OutlineTable(triangles, [parts[i].edges for i in hiders], viewpoints.p[rows], viewpoints.n[rows])
    sampler = integrator.sampler_of(context.scene, sensor)
    count = spp or sampler.sample_count()
    own_seed, _ = mi.sample_tea_32(seed_array(seed), mi.UInt32(_SEED))
    jobs, _ = passes_of(sampler, film, own_seed, max(1, count // SHARE), 2)
    return MutualOcclusion(integrator, context, sensor, film, edges, spots, jobs)


def late_outlines(integrator: Any, context: Any, sensor: Any, film: Any, seed: Any, spp: int) -> LateOutlines | None:
    """Return the boundary term of light of more than three bounces; arguments as of :func:`mutual_occlusion`.

    None if there is no such light, if nothing moves, or if the hidden scene is one body that cannot hide a part of
    itself.
    """
    wanted = context.wanted
    if not (wanted.geometry and follows_outlines(type(context.segment), context.contents)) or mi.is_polarized:
        return None
    if context.max_depth < FIRST or not (wanted.sensor or wanted.light or wanted.shapes):
        return None
    (spots,) = context.connections
    wall = {shape.ptr for shape in spots.table.wall or ()}
    hidden = [shape for shape in context.scene.shapes() if shape.ptr not in wall]
    if wall and len(hidden) < 2:
        parts, _ = parts_of(hidden)
        if len(parts) < 2 and not any(part.hides_itself for part in parts):
            return None
    count = spp or sensor.sampler().sample_count()
    return LateOutlines(integrator, context, sensor, film, seed, max(1, count // SHARE))


def _names(shapes: list[Any], parts: list[Part], pairs: list[tuple[int, int]]) -> str:
    """Return up to three of the pairs in words."""

    def name(part: Part) -> str:
        return " and ".join(repr(shapes[k].id() or shapes[k].class_name()) for k in sorted(part.shapes))

    words = [
        f"{name(parts[i])} hides another part of itself" if name(parts[i]) == name(parts[j])
        else f"{name(parts[i])} hides {name(parts[j])}"
        for i, j in pairs
    ]  # fmt: skip
    words = list(dict.fromkeys(words))
    return ", ".join(words[:3]) + (f", and {len(words) - 3} more" if len(words) > 3 else "")


def _warn_of_limbs(shapes: list[Any], parts: list[Part], pairs: list[tuple[int, int]]) -> None:
    limbs = [(i, j) for i, j in pairs if parts[i].edges is None]
    if limbs:
        warnings.warn(
            "transient_nlos_path: outlines of shapes without triangles have no edges, and the derivative lacks what "
            f"changes behind them ({_names(shapes, parts, limbs)}). Use a mesh in place of the shape that hides.",
            GradientWarning,
            stacklevel=2,
        )
