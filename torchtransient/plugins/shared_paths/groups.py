"""Points that groups of pixels share: each pixel of a group connects to all points that the group has drawn.

An *anchor* ``y`` is the first vertex of a pixel's path, where a smooth lobe scatters. Each of the ``size`` anchors of a
group draws a direction, and the Lambertian point ``z`` that it finds is offered to the whole group. Connected to anchor
``j``, point ``k`` weighs (balance heuristic over the group, Bekaert et al. 2002)

    F_j(z_k) / sum_i p_i(z_k)      F = f(y) cos cos' V / r^2,   p_i: density of z_k per area, as drawn from y_i.

Visibility belongs to ``p_i``: the weights would not sum to one without it. The weight is at most the albedo at ``y_j``,
since ``p_j`` is in the sum. A group may depend on its anchors, never on the points that they draw.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.bsdfs.lambertian import is_lambertian
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.kernel_arrays import PointerTable, host_numbers, whole_numbers
from torchtransient.plugins.node_walk import bsdfs_of_scene, shapes_of_scene
from torchtransient.plugins.sampling.area_elements import has_shading_normals, morton_order
from torchtransient.plugins.sampling.point_sets import hashed
from torchtransient.plugins.sensors.origin import sample_rays, sensors_of, views
from torchtransient.plugins.shared_paths.lists import Rows

# Indices of refraction that rounding tells apart are one.
_SAME_INDEX = 1e-4
# Shapes that shade by the normals of their geometry.
_GEOMETRIC_NORMALS = ("Rectangle", "Disk", "Sphere", "Cylinder")


class Sharing:
    """Division of light between the paths of pixels and points that pixels share.

    Shared is all light behind a Lambertian second vertex that a smooth lobe of the first one found, through vacuum.
    Light that the second vertex emits is not. A plain class: Dr.Jit loops leave it alone.

    Args:
        scene: built scene.
        contents: :class:`~..transport.scene_contents.SceneContents`.
        size: pixels of a group, a power of two.
        suffixes: paths that begin at each shared point.

    Attributes:
        behind: :class:`~..transport.context.RenderContext` of the paths behind shared points.
        order: numbers of the pixels, sorted by their groups and filled up to whole groups (UInt32).
        real: mask of those that are no filling.
        possible: some surface is Lambertian.
        diffuse: table of the Lambertian BSDFs, None if all are.
        smooth: some surface may have other normals than those of its geometry.
    """

    def __init__(self, scene: Any, contents: Any, size: int, suffixes: int) -> None:
        self.size, self.suffixes = size, suffixes
        self.possible, self.diffuse = contents.memory.get("diffuse surfaces", 0, lambda: _diffuse(scene))
        self.smooth = _as_they_stand(scene, contents).get("smooth", 0, lambda: _is_smooth(scene))
        self.index_changes = contents.refraction is not None or contents.surroundings is not None
        self.behind = self.order = self.real = None

    def takes_over(self, path: Any, vertex: Any) -> Any:
        """Return a mask of vertices whose further light is shared."""
        shared = (path.depth == 1) & ~path.prev_unconnected & self.is_diffuse(vertex.si.bsdf())
        return shared & self.in_vacuum(path.η) if self.index_changes else shared

    def is_diffuse(self, bsdf: Any) -> Any:
        """Return a mask of BSDFs (pointers) whose light is the same in all directions on its side."""
        return mi.Bool(True) if self.diffuse is None else self.diffuse.lists(bsdf)

    @staticmethod
    def in_vacuum(η: Any) -> Any:
        """Return a mask of indices of refraction that are one."""
        return dr.abs(η - 1) < _SAME_INDEX


def _diffuse(scene: Any) -> tuple[bool, Any]:
    """Return whether some surface is Lambertian, and the table of those, None if all are."""
    bsdfs = bsdfs_of_scene(scene)
    diffuse = [bsdf for bsdf in bsdfs if is_lambertian(bsdf)]
    return bool(diffuse), PointerTable.marking(diffuse) if len(diffuse) < len(bsdfs) else None


def _is_smooth(scene: Any) -> bool:
    """Return True if some surface may have other normals than those of its geometry."""

    def may_be(shape):
        return has_shading_normals(shape) if shape.is_mesh() else shape.class_name() not in _GEOMETRIC_NORMALS

    return any(map(may_be, shapes_of_scene(scene)))


def _as_they_stand(scene: Any, contents: Any) -> Cache:
    """Return the cache of results about the sensor and the shapes, emptied when one of them moves."""
    nodes = [*sensors_of(contents.sensor), *shapes_of_scene(scene)]
    return contents.memory.get("memory of sharing", 0, lambda: Cache(nodes))


class Group:
    """Anchors of some groups, and the points that they have drawn.

    A plain class: Dr.Jit loops leave it alone.

    Args:
        context: :class:`~..transport.context.RenderContext` of the anchors' paths.
        path: :class:`~..transport.walk.Path` of each anchor, with the leg to it; in memory.
        real: mask of lanes with a pixel.
        sampler: sampler ``owen``.
        seed: UInt32, of all that these groups draw.

    Attributes:
        rows: ``r`` and ``F`` for each anchor and point of its group.
        inverse: one over the density of each point in its group.
        first: path length up to each anchor, minus the film's start (Float64).
        earliest: length at which the first anchor of a group sees each point, minus the film's start (Float64).
        z_ray, z_leg, z_alive: ray and leg that found each point, and mask of points.
    """

    def __init__(self, context: Any, path: Any, real: Any, sampler: Any, seed: Any) -> None:
        self.context, self.sharing, self.path, self.real = context, context.sharing, path, real
        self.size, self.lanes = context.sharing.size, dr.width(path.ray)
        self.sampler, self.seed = sampler, seed
        self._draw()
        self.rows, density = _connect(self)
        dr.eval(self.rows.arrays(), density)
        self.inverse, self.earliest = _densities(self, density)
        dr.eval(self.inverse, self.earliest)

    def vertices(self) -> tuple[Any, Any]:
        """Return (vertices, sampled steps) of the anchors: the same ones at each call."""
        path, context = self.path, self.context
        spread(self.sampler, self.seed, self.lanes, self.size)
        vertex = context.segment.arrive(context, path)
        vertex.τ, vertex.η = path.τ + vertex.opl, path.η
        vertex.goes_on = path.active & self.real & vertex.valid
        context.scattering.arrive(context, path, vertex, self.sampler)
        vertex.scattered_τ = vertex.delay.after(vertex.τ)
        _, step = context.scattering.scatter(context, path, vertex, [], self.sampler)
        return vertex, step

    def _draw(self) -> None:
        sharing = self.sharing
        vertex, step = self.vertices()
        # Samples that a BSDF throws away have no density: they are black.
        alive = vertex.goes_on & (step.pdf > 0) & ~step.unconnected & (dr.max(step.weight) > 0)
        if sharing.index_changes:
            alive &= sharing.in_vacuum(vertex.η * step.eta)
        ray = vertex.at.spawn_ray(step.out)
        leg = self.context.scene.ray_intersect_preliminary(ray, coherent=False, active=alive)
        z = leg.compute_surface_interaction(ray, mi.RayFlags.All, alive)
        alive &= z.is_valid() & sharing.is_diffuse(z.bsdf())
        n = mi.Vector3f(z.n) * dr.select(alive, -dr.sign(dr.dot(z.n, ray.d)), 0)
        places = [*z.p, mi.Float(0), *n, mi.Float(0)]
        if sharing.smooth:
            shading = mi.Vector3f(z.sh_frame.n)
            places += [*(shading * -dr.sign(dr.dot(shading, ray.d))), mi.Float(0)]
        self.places, self.stride = dr.ravel(mi.ArrayXf(places)), len(places) // 4
        self.z_ray, self.z_leg, self.z_alive, self.first = ray, leg, alive, vertex.scattered_τ
        dr.eval(self.places, self.z_ray, self.z_leg, self.z_alive, self.first)

    def place(self, point: Any) -> tuple[Any, Any, Any]:
        """Return points, and the normals of the geometry and of the shading on the side that they were found from."""
        at = point * self.stride
        p, n = dr.gather(mi.Vector4f, self.places, at), dr.gather(mi.Vector4f, self.places, at + 1)
        shading = dr.gather(mi.Vector4f, self.places, at + 2) if self.sharing.smooth else n
        return mi.Point3f(p.xyz), mi.Vector3f(n.xyz), mi.Vector3f(shading.xyz)

    def pair(self, vertex: Any, lane: Any, point: Any) -> tuple[Any, Any, Any]:
        """Return (``r``, ``F``, density per area) of a point as seen from an anchor.

        Args:
            vertex: vertices of the anchors.
            lane, point: numbers of anchor and point.
        """
        context, sharing = self.context, self.sharing
        p, n, shading = self.place(point)
        d = p - vertex.at.p
        d2 = dr.squared_norm(d)
        r = dr.sqrt(d2)
        d /= r
        cos = -dr.dot(n, d)
        active = vertex.goes_on & (cos > 0)
        if sharing.smooth:  # sides with a light of their own are surfaces of their own
            active &= dr.dot(shading, d) < 0
        value, pdf = context.scattering.value_towards(context, self.path, vertex, d, active)
        active &= (pdf > 0) & (dr.max(value) > 0)
        if sharing.index_changes:
            wo = vertex.scattered_si.to_local(d)
            eta = context.scattering.relative_index(vertex.bsdf, vertex.scattered_si, wo)
            active &= sharing.in_vacuum(vertex.η * eta)
        # An anchor sees the point that it has found, whatever a shadow ray says.
        hidden = context.scene.ray_test(vertex.at.spawn_ray_to(p), active & (point != lane))
        g = dr.select(active & ~hidden, cos / d2, 0)
        return r, mi.unpolarized_spectrum(value) * g, pdf * g


@dr.syntax
def _connect(group):
    """Return the rows of all pairs, and the density of each."""
    size, lanes = group.size, group.lanes
    rows, density = Rows(lanes * size), dr.empty(mi.Float, lanes * size)
    lane, k = dr.arange(mi.UInt32, lanes), mi.UInt32(0)
    first = lane // size * size
    vertex, _ = group.vertices()
    while dr.hint(k < size, label="pairs of a group"):
        r, F, pdf = group.pair(vertex, lane, first + k)
        at = lane * size + k
        rows.write(at, r, F)
        dr.scatter(density, pdf, at)
        k += 1
    return rows, density


@dr.syntax
def _densities(group, density):
    """Return one over the density of each point as drawn by its whole group, and when it is seen first."""
    size, rows, opl = group.size, group.rows, group.first
    lane = dr.arange(mi.UInt32, group.lanes)
    first, j = lane // size * size, mi.UInt32(0)
    total, earliest = mi.Float(0), mi.Float64(dr.inf)
    while dr.hint(j < size, label="density of a group"):
        at = (first + j) * size + lane - first
        pdf = dr.gather(mi.Float, density, at)
        length = dr.gather(mi.Float64, opl, first + j) + mi.Float64(rows.length(at))
        total += pdf
        earliest = dr.select(pdf > 0, dr.minimum(earliest, length), earliest)
        j += 1
    seen = total > 0
    return dr.select(seen, dr.rcp(total), 0), dr.select(seen, earliest, 0)


# --------------------------------------------------------------------------------------------------------------------
# Numbers that are spread evenly over groups.

def seed_of(seed: Any, number: int) -> Any:
    """Return another seed, a hash.

    Args:
        seed: UInt32.
        number: whole number, another one for each seed.
    """
    return hashed(hashed(seed) + dr.opaque(mi.UInt32, number) * mi.UInt32(0x9E3779B9) + 0x7F4A7C15)


def spread(sampler: Any, seed: Any, lanes: int, count: int) -> None:
    """Seed a sampler such that its samples are evenly spread over every ``count`` lanes.

    Args:
        sampler: sampler ``owen``.
        seed: UInt32.
        lanes: number of lanes.
        count: a power of two.
    """
    lane = dr.arange(mi.UInt32, lanes)
    sampler.seed_sets(seed, lane // count, lane & (count - 1))


# --------------------------------------------------------------------------------------------------------------------
# Groups of a film.

def pixel_order(scene: Any, contents: Any, sensor: Any, film: Any, size: int) -> tuple[Any, Any]:
    """Return the pixels of a film in the order of their groups, by the surfaces that their centres see.

    Found anew when the sensor or a shape has moved.

    Args:
        scene: built scene.
        contents: :class:`~..transport.scene_contents.SceneContents`, which remembers the order.
        sensor, film: sensor and its film.
        size: pixels of a group.

    Returns:
        (numbers of the pixels, UInt32, filled up with zeros to a multiple of ``size``; mask of those that are no
        filling).
    """
    width, height = (int(n) for n in film.crop_size())
    key, memory = (width, height, size), _as_they_stand(scene, contents)
    return memory.get("pixel order", key, lambda: _pixel_order(scene, sensor, width, height, size))


def _pixel_order(scene: Any, sensor: Any, width: int, height: int, size: int) -> tuple[Any, Any]:
    lane = dr.arange(mi.UInt32, width * height)
    place = mi.Point2f(mi.Float(lane % width), mi.Float(lane // width)) + 0.5
    position = place / mi.ScalarVector2f(width, height)
    seen = views(sensor, position, lambda: None)
    ray, _ = sample_rays(sensor, seen, sensor.shutter_open(), mi.Float(0.5), position, mi.Point2f(0.5))
    si = scene.ray_intersect(dr.detach(ray), mi.RayFlags.All, coherent=True)
    found = dr.detach(si.is_valid())
    p, n = (host_numbers(dr.select(found, dr.detach(v), 0)).T for v in (si.p, si.n))
    p, n = (np.broadcast_to(v, (width * height, 3)) for v in (p, n))
    there = np.broadcast_to(np.array(found), width * height)
    place_on_curve = np.full(width * height, width * height)
    curve = np.flatnonzero(there)[morton_order(p[there])]
    place_on_curve[curve] = np.arange(curve.size)
    facing = np.round(n * 1.2) @ (9, 3, 1)
    order = np.lexsort((place_on_curve, facing, ~there))
    more = -order.size % size
    real = np.arange(order.size + more) < order.size
    result = whole_numbers(np.concatenate([order, np.zeros(more, order.dtype)])), mi.Bool(real)
    dr.eval(result)
    return result
