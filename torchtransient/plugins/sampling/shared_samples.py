"""Points on hidden geometry that all scan points share, with what a diffuse surface scatters there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, UnitError, VariantError
from torchtransient.plugins.bsdfs.lambertian import is_lambertian
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.point_sets import plane_points
from torchtransient.plugins.transport.geometry_terms import material_point
from torchtransient.plugins.transport.strategy import Local

# ----------------------------------------------------------------------------------------------------------------------
# Tiles of scan points with densities of their own, where hidden geometry is near beside the width of the scan.
# What a scan point sees falls by the fourth power of the distance: with one density for all of them, an arm 10 cm
# before a scan of 1 m is drawn where most points see little. With 16 tiles there, the standard deviation is a sixth.

# Widths of a tile over the distance of the nearest hidden geometry; tiles along an edge of the scan at most.
_RATIO = 2.0
_MOST = 4
# Points that stand for a tile.
_POINTS = 25


class ScanTiles:
    """Tiles of a scan, one where the scan is not wider than twice the distance of the hidden geometry.

    Args:
        points, normals: points (metres) and normals of the scan, (P, 3).
        distance: distance of the nearest hidden geometry, metres.

    Attributes:
        count: number of tiles.
        tile: tile of each point, (P,).
        points, normals: points that stand for each tile, (count, 25, 3), as ``HiddenElements`` takes them.
    """

    def __init__(self, points: Any, normals: Any, distance: float) -> None:
        points, normals = (np.asarray(a, dtype=np.float64).reshape(-1, 3) for a in (points, normals))
        local = points - points.mean(0)
        # The two directions in which the scan is widest.
        _, vectors = np.linalg.eigh(local.T @ local)
        across = local @ vectors[:, 1:]
        width = np.ptp(across, axis=0)
        along = np.clip(np.ceil(width / (_RATIO * max(distance, 1e-9))), 1, _MOST).astype(int)
        cell = np.minimum((across - across.min(0)) / np.maximum(width, 1e-12) * along, along - 1).astype(int)
        _, self.tile = np.unique(cell[:, 0] * along[1] + cell[:, 1], return_inverse=True)
        self.count = int(self.tile.max()) + 1
        chosen = [_spread(np.flatnonzero(self.tile == t)) for t in range(self.count)]
        self.points, self.normals = points[chosen], normals[chosen]

    def tile_per_point(self) -> Any:
        """Return the tile of every scan point, ``UInt32`` in memory."""
        tile = mi.UInt32(self.tile.astype(np.uint32))
        dr.make_opaque(tile)
        return tile


def distance_to(vertices: np.ndarray, points: np.ndarray) -> float:
    """Return the distance of the vertex that is nearest to any of some points, metres.

    Args:
        vertices: vertices, (V, 3), metres.
        points: points, (P, 3), metres.
    """
    nearest = np.inf
    for p in points:
        nearest = min(nearest, float(((vertices - p) ** 2).sum(1).min()))
    return nearest**0.5


def _spread(numbers: np.ndarray) -> np.ndarray:
    """Select 25 of the rows in equal steps; some repeat where there are fewer."""
    return numbers[np.linspace(0, len(numbers) - 1, _POINTS).round().astype(int)]


# ----------------------------------------------------------------------------------------------------------------------

# A launch has a lane per sample, and chunks of it are numbered in 32 bits.
MAX_SAMPLES = 2**26


@dataclass
class SharedSamples:
    """Samples on hidden geometry that scan points share, for each tile of the scan.

    One tile after the other, in the order of the elements of ``HiddenElements`` (neighbours stand together).

    Attributes:
        count: number of samples of each tile.
        p: Point3f.
        n, geometric_n: shading and geometric normal, Normal3f, the same where ``smooth`` is false.
        front, back: albedo over pi on the side that the shading normal points to, and on the other,
            UnpolarizedSpectrum.
        weight: one over ``count`` times the density per area, Float: a mean over the area is a sum over samples.
        element: number in the table, UInt32.
        shape, primitive, u: material point (ShapePtr, UInt32, Point2f), the same for other positions of the shape.
        smooth: some normals are interpolated.
        tiles: number of tiles.
        clear: number of samples of each tile, the first ones, that nothing hides from points that ``region.holds``,
            UInt32.
        has_clear: there are elements of that kind.
        region: region of those points, or None.
    """

    count: int
    p: Any
    n: Any
    geometric_n: Any
    front: Any
    back: Any
    weight: Any
    element: Any
    shape: Any
    primitive: Any
    u: Any
    smooth: bool
    tiles: int
    clear: Any
    has_clear: bool
    region: Any


def draw_samples(elements: HiddenElements, count: int, seed: Any) -> SharedSamples:
    """Draw samples of the hidden geometry's density, for each tile of the table.

    Args:
        elements: hidden surfaces and their density.
        count: number of samples of each tile.
        seed: UInt32 of width one, in memory, or a whole number.

    Raises:
        SceneError: for surfaces that are not plainly diffuse (``diffuse``, ``twosided`` around it).
        UnitError: if ``count`` is out of range.
        VariantError: in spectral and polarized variants, where a sample has no fixed colour.
    """
    sets = elements.tile_count
    if not 1 <= count <= MAX_SAMPLES // sets:
        raise UnitError(f"draw_samples: expected 1 to {MAX_SAMPLES // sets} samples, got {count!r}.")
    if mi.is_spectral or mi.is_polarized:
        raise VariantError(
            f"draw_samples: shared samples hold a colour, which variant {mi.variant()} has not; expected a mono or RGB "
            "variant without polarization. Use the general path integrator."
        )
    others = _not_diffuse([elements.shapes[s] for s in set(elements.elements.shape.astype(int))])
    if others:
        raise SceneError(
            "draw_samples: expected surfaces of 'diffuse', or of 'twosided' around it, got "
            f"{'; '.join(others)}. Use the general path integrator."
        )
    seed = mi.UInt32(seed) if dr.is_array_v(seed) else dr.opaque(mi.UInt32, int(seed) % 2**32)
    x, y = plane_points(count, seed, sets)
    tile = dr.arange(mi.UInt32, count * sets) // dr.opaque(mi.UInt32, count) if sets > 1 else None
    samples = samples_at(elements, x, y, count, tile)
    clear = dr.select(samples.element < elements.clear_count, mi.UInt32(1), 0)
    samples.tiles, samples.clear = sets, dr.block_sum(clear, count)
    dr.eval(samples)
    return samples


def samples_at(elements: HiddenElements, x: Any, y: Any, count: int, tile: Any = None) -> SharedSamples:
    """Return the samples of given numbers, not evaluated and without ``clear``.

    Args:
        elements: hidden elements.
        x, y: numbers in [0, 1) for each lane, Float64 and Float.
        count: number of samples that make up the area.
        tile: tile of each lane, UInt32; None for the first.
    """
    element, a = elements.select_element(x, tile=tile)
    p, n = elements.point(element, a, y)
    shape, primitive = elements.surface(element)
    # For the shading frame and texture coordinates.
    pi, ray = _preliminary(elements, element, p, n, a, y)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    weight = dr.rcp(elements.density_of(element, tile=tile) * dr.opaque(mi.Float, float(count)))
    smooth = elements.smooth
    if smooth:
        n = dr.mulsign(n, dr.dot(si.sh_frame.n, n))
    return SharedSamples(
        count=count, p=p, n=mi.Normal3f(si.sh_frame.n) if smooth else n, geometric_n=n,
        front=_scattered(si, 1.0), back=_scattered(si, -1.0), weight=weight,
        element=element, shape=shape, primitive=primitive, u=mi.Point2f(a, y), smooth=smooth,
        tiles=1, clear=None, has_clear=elements.has_clear, region=elements.region,
    )  # fmt: skip


def material_samples(elements: HiddenElements, samples: SharedSamples, meshes: Any) -> Local:
    """Return samples as material points, attached where their shapes are.

    Args:
        elements: hidden elements.
        samples: samples of their density.
        meshes: :class:`~..kernel_arrays.PointerTable` of the shapes with vertices of their own.

    Returns:
        ``p``, ``n``, ``geometric_n``, and ``front`` and ``back``: albedo over pi of the sides times the area that a
            sample
        stands for.
    """
    a, y = samples.u.x, samples.u.y
    pi, ray = _preliminary(elements, samples.element, samples.p, samples.geometric_n, a, y)
    si, area = material_point(pi, ray, mi.Mask(True), meshes)
    weight = samples.weight * dr.relative_grad(area)
    geometric_n = dr.mulsign(mi.Vector3f(si.n), dr.dot(mi.Vector3f(samples.geometric_n), si.n))
    n = mi.Vector3f(si.sh_frame.n) if samples.smooth else geometric_n
    front, back = (_scattered(si, side) * weight for side in (1.0, -1.0))
    return Local(p=mi.Point3f(si.p), n=n, geometric_n=geometric_n, front=front, back=back)


def _not_diffuse(shapes: list[Any]) -> list[str]:
    """Return the names of the shapes, with their BSDFs, that scatter otherwise than a Lambertian surface."""
    others = [(shape, shape.bsdf()) for shape in shapes if not is_lambertian(shape.bsdf())]
    return list(dict.fromkeys(f"{shape.id() or shape.class_name()} ({bsdf.class_name()})" for shape, bsdf in others))


def _preliminary(elements: HiddenElements, element: Any, p: Any, n: Any, a: Any, y: Any) -> tuple[Any, Any]:
    """Return (the points as hits, the rays that find them from a metre away along their normals)."""
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(p))
    pi.shape, pi.prim_index = elements.surface(element)
    pi.valid, pi.t = mi.Mask(True), mi.Float(1)
    pi.prim_uv = elements.coordinates(element, a, y)
    ray = dr.zeros(mi.Ray3f, dr.width(p))
    ray.o, ray.d = mi.Point3f(p + mi.Vector3f(n)), -mi.Vector3f(n)
    return pi, ray


def _scattered(si: Any, side: float) -> Any:
    """Return the albedo over pi of one side."""
    si = mi.SurfaceInteraction3f(si)
    si.wi = mi.Vector3f(0, 0, side)
    return mi.unpolarized_spectrum(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, side)))
