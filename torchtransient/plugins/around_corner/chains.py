"""Random walks through a hidden scene that neighbouring scan points share, in groups whose parts are put together anew.

A chain is a *head* ``x``, a point on hidden geometry that scan points see, and a *tail* ``v_1, v_2, ...``, a walk whose
vertices laser spots see. The tails of the ``size`` chains of a group are connected to all of its heads, so that
``size^2`` paths come of ``size`` walks. ``v_1`` of chain ``k`` is drawn with a density per area

    q_k(v) = (1 - share) V cos(x_k) cos(v) / (pi r^2) + share p(v)

from its own head (``V``: nothing is in between) or over the hidden area. Connected to head ``i`` it weighs ``f_i(v) /
sum_k q_k(v)`` (balance heuristic over the group, Bekaert et al. 2002), which corners do not make large: ``f_i <= pi
value_i q_i / (1 - share)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.around_corner.geometry import OFFSET, front_normal, occluded
from torchtransient.plugins.bsdfs.lambertian import scatters_behind
from torchtransient.plugins.sampling.shared_samples import samples_at
from torchtransient.plugins.sampling.sobol import DIMENSIONS, sobol, unit_double, unit_float
from torchtransient.plugins.transport.strategy import Local

# Share of the tails that start at a point drawn over the hidden area.
AREA_SHARE = 0.25
# Share of further vertices that are drawn over the hidden area, from surfaces that do not belong to it.
WALL_SHARE = 0.9
# Probability of that side of a two-sided surface which faces the scan.
FACING = 0.9
# Numbers of a head (element, place on it), of the step to the tail (direction or place, which of both), and sides.
_HEAD, _STEP, _CHOICE, _SIDES, _FURTHER = (0, 1), (2, 3), 4, (5, 6), 7
# Vertices of a tail that there are numbers for.
LONGEST_TAIL = 1 + (DIMENSIONS - _FURTHER) // 2


@dataclass
class ChainPlan:
    """What chains are made of: ``elements`` (:class:`..sampling.hidden_elements.HiddenElements`), ``center`` (Point3f
    in memory: about where the scan points are), ``size`` chains of a group (a power of two), ``groups`` of each tile,
    ``tail`` vertices, ``seed`` (UInt32 of width one, in memory).
    """

    elements: Any
    center: Any
    size: int
    groups: int
    tail: int
    seed: Any

    @property
    def stride(self) -> int:
        """Indices of Sobol's points that a tile has for itself, a power of two."""
        return 1 << max(0, self.size * self.groups - 1).bit_length()


class Vertices(Local):
    """Vertices of chains, one each: ``p``, ``n`` and ``geometric_n`` (of the side that light meets), ``value`` (per
    colour: of a head its albedo over pi and the area it stands for, of a tail albedo over pi times what arrives of the
    step before), ``length`` (metres from the first vertex of the tail), ``alive``; ``shape``, ``primitive`` and
    ``uv``: the material point.
    """


def trace_chains(scene: Any, plan: ChainPlan, index: Any) -> tuple[Vertices, list[Vertices]]:
    """(heads, vertices of tails) of the chains of numbers ``index`` (UInt32) of Sobol's points. Not evaluated."""
    numbers = [sobol(index, d, plan.seed) for d in range(_FURTHER + 2 * (plan.tail - 1))]
    head = _drawn(plan, numbers, _HEAD, _SIDES[0])
    guided = unit_float(numbers[_CHOICE]) < AREA_SHARE
    direction = _cosine_direction(head.n, numbers, _STEP)
    origin = _origin(plan, head, direction)
    vertex = _step(scene, plan, origin, direction, head.alive & ~guided)
    drawn = _drawn(plan, numbers, _STEP, _SIDES[1])
    vertex = _select(guided, drawn, vertex)
    # The area it stands for belongs to the density of the step.
    vertex.value = vertex.albedo * dr.inv_pi
    vertex.length = mi.Float(0)
    tail = [vertex]
    for j in range(1, plan.tail):
        last = tail[-1]
        vertex, weight = _guided_step(scene, plan, last, numbers, (_FURTHER + 2 * j - 2, _FURTHER + 2 * j - 1))
        vertex.value = last.value * vertex.albedo * weight
        vertex.alive &= dr.max(vertex.value) > 0
        vertex.length = last.length + dr.norm(vertex.p - last.p)
        tail.append(vertex)
    head.length = mi.Float(0)
    return head, tail


def _drawn(plan: ChainPlan, numbers: list[Any], place: tuple[int, int], side: int) -> Vertices:
    """Points over the hidden area, and a side of the surface there."""
    u, v = (numbers[i] for i in place)
    s = samples_at(plan.elements, unit_double(u), unit_float(v), plan.size * plan.groups)
    two_sided = scatters_behind(s.shape.bsdf())
    front = _probability_of_front(plan, s.p, mi.Vector3f(s.geometric_n), two_sided)
    is_front = unit_float(numbers[side]) < front
    turn = dr.select(is_front, mi.Float(1), -1)
    value = dr.select(is_front, s.front, s.back)
    density = dr.select(is_front, front, 1 - front)
    return Vertices(
        p=s.p, n=mi.Vector3f(s.n) * turn, geometric_n=mi.Vector3f(s.geometric_n) * turn, albedo=value * dr.pi,
        value=value * s.weight / density, alive=dr.max(value) > 0,
        shape=s.shape, primitive=s.primitive, uv=plan.elements.coordinates(s.element, s.u.x, s.u.y),
    )  # fmt: skip


def _probability_of_front(plan: ChainPlan, p: Any, n: Any, two_sided: Any) -> Any:
    """With which the side of ``n`` is drawn at ``p``."""
    faces = dr.dot(n, plan.center - p) > 0
    return dr.select(two_sided, dr.select(faces, mi.Float(FACING), 1 - FACING), 1)


def _cosine_direction(n: Any, numbers: list[Any], which: tuple[int, int]) -> Any:
    u = mi.Point2f(*(unit_float(numbers[i]) for i in which))
    return mi.Frame3f(mi.Normal3f(n)).to_world(mi.warp.square_to_cosine_hemisphere(u))


def _origin(plan: ChainPlan, start: Vertices, towards: Any) -> Any:
    """Where rays that go off a surface start. Offsets as in :func:`.geometry.occluded`, by the size of the hidden
    scene.
    """
    reach = dr.max(dr.abs(start.p)) + dr.norm(plan.center - start.p)
    offset = dr.mulsign(OFFSET * reach, dr.dot(start.geometric_n, towards))
    return mi.Point3f(start.p + start.geometric_n * offset)


def _step(scene: Any, plan: ChainPlan, origin: Any, d: Any, active: Any) -> Vertices:
    """What a ray meets, its ``value`` still to be said."""
    ray = mi.Ray3f(origin, d)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    valid = active & si.is_valid()
    bsdf = si.bsdf()
    two_sided = scatters_behind(bsdf)
    lit = valid & ((si.wi.z > 0) | (two_sided & (si.wi.z < 0)))
    turn = dr.select(si.wi.z < 0, mi.Float(-1), 1)
    albedo = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, lit))
    n = mi.Vector3f(si.sh_frame.n)
    geometric_n = mi.Vector3f(front_normal(si)) if plan.elements.smooth else n
    alive = lit & (dr.max(albedo) > 0)
    return Vertices(
        p=si.p, n=n * turn, geometric_n=geometric_n * turn, albedo=albedo, value=albedo, alive=alive,
        shape=pi.shape, primitive=pi.prim_index, uv=pi.prim_uv,
    )  # fmt: skip


def _guided_step(scene: Any, plan: ChainPlan, start: Vertices, numbers: list[Any], which: tuple[int, int]) -> Any:
    """(next vertex, cosine over pi and the density of its direction) by a mixture of cosines and hidden area."""
    u, v = (numbers[i] for i in which)
    hidden = plan.elements.per_area(start.shape, start.primitive, start.p, start.alive) > 0
    share = dr.select(hidden, mi.Float(AREA_SHARE), WALL_SHARE)
    # One number chooses and is used again.
    x = unit_double(u)
    guided = x < share
    x = dr.select(guided, x / share, (x - share) / (1 - share))
    element, a = plan.elements.select_element(x, start.alive & guided)
    point, _ = plan.elements.point(element, a, unit_float(v), start.alive & guided)
    cosine = mi.warp.square_to_cosine_hemisphere(mi.Point2f(mi.Float(x), unit_float(v)))
    cosine = mi.Frame3f(mi.Normal3f(start.n)).to_world(cosine)
    origin = _origin(plan, start, dr.select(guided, mi.Vector3f(point - start.p), cosine))
    to = mi.Vector3f(point - origin)
    d = dr.select(guided, dr.normalize(to), cosine)
    cos = dr.dot(start.n, d)
    vertex = _step(scene, plan, origin, d, start.alive & (cos > 0))
    way = mi.Vector3f(vertex.p - origin)
    shape, primitive = plan.elements.surface(element, start.alive & guided)
    arrived = (vertex.shape == shape) & (vertex.primitive == primitive)
    arrived &= dr.norm(vertex.p - point) < 1e-3 * dr.norm(to)
    vertex.alive &= ~guided | arrived
    square = dr.squared_norm(way)
    there = dr.abs(dr.dot(vertex.geometric_n, way)) * dr.rsqrt(square)
    per_area = plan.elements.per_area(vertex.shape, vertex.primitive, vertex.p, vertex.alive)
    own = cos * dr.inv_pi
    density = (1 - share) * own + share * per_area * square * dr.rcp(there)
    return vertex, dr.select(vertex.alive & (there > 0), own / density, 0)


def _select(mask: Any, a: Vertices, b: Vertices) -> Vertices:
    return Vertices(**{name: dr.select(mask, value, getattr(b, name)) for name, value in vars(a).items()})


class VertexTable:
    """Vertices in memory, loaded by number. A plain class."""

    _FIELDS = ("p", "n", "value", "length", "alive")

    def __init__(self, vertices: Vertices, smooth: bool) -> None:
        self.smooth = smooth
        for name in self._FIELDS:
            setattr(self, name, getattr(vertices, name))
        self.geometric_n = vertices.geometric_n if smooth else vertices.n
        dr.schedule(self.geometric_n, *(getattr(self, name) for name in self._FIELDS))

    def take(self, index: Any) -> Local:
        """``p, n, geometric_n, value, length, alive`` of vertices."""
        taken = Local(**{name: _gather(getattr(self, name), index) for name in self._FIELDS})
        taken.geometric_n = _gather(self.geometric_n, index) if self.smooth else taken.n
        return taken


def _gather(array: Any, index: Any) -> Any:
    return dr.gather(type(array), array, index if dr.width(array) > 1 else mi.UInt32(0))

# Numbers of chains stand in rows of single precision, which counts so far.
MOST_CHAINS = 2**24


class Links:
    """The connections of all heads and tails of groups that carry light, group by group: rows of ``[weight, r, head,
    tail]``. ``first``, ``count``: where those of each group stand. A plain class.

    ``weight``: per colour of the tail what a head makes of it; in monochromatic variants the head's value is in it.
    """

    def __init__(self, scene: Any, plan: ChainPlan, heads: VertexTable, starts: VertexTable, area_density: Any) -> None:
        n = plan.size
        if dr.width(heads.p) > MOST_CHAINS:
            raise SceneError(
                f"late light: expected at most 2^24 chains at a time, got {dr.width(heads.p)}: too many tiles of "
                "scanned points. Scan fewer points at a time, or set late_light to paths."
            )
        lane = dr.arange(mi.UInt32, dr.width(heads.p) * n)
        tail, head = _ends(lane, n)
        x, v = heads.take(head), starts.take(tail)
        d = mi.Vector3f(v.p - x.p)
        square = dr.squared_norm(d)
        inverse = dr.rsqrt(square)
        r = square * inverse
        cos = dr.maximum(dr.dot(x.n, d) * inverse, 0)
        q = cos * dr.abs(dr.dot(v.geometric_n, d)) * dr.square(inverse) * inverse * dr.inv_pi
        active = x.alive & v.alive & (dr.dot(v.n, d) < 0) & (q > 0)
        line = Local(r=r, geometric_cos=dr.dot(x.geometric_n, d))
        facing = mi.Vector3f(dr.mulsign(v.geometric_n, -dr.dot(v.geometric_n, d)))
        q = dr.select(active & ~occluded(scene, x, line, v.p, facing, active), q, 0)
        # One kernel with rays, not one for each of what follows.
        dr.eval(q, r)
        drawn = (1 - AREA_SHARE) * dr.block_sum(q, n) + n * AREA_SHARE * area_density
        weight = q * dr.pi / dr.gather(mi.Float, drawn, tail)
        if len(heads.value) == 1:
            weight *= x.value[0]
        dr.eval(weight)
        some = weight > 0
        self.count = dr.block_sum(dr.select(some, mi.UInt32(1), 0), n * n)
        self.first = dr.cumsum(self.count) - self.count
        # Of the group that has most.
        self.most = int(dr.max(self.count)[0])
        # A row more, so that there is one: lanes without links load what they do not use.
        kept = dr.compress(some)
        self.flat = dr.zeros(mi.Float, 4 * (dr.width(kept) + 1))
        if dr.width(kept):
            tail, head = _ends(kept, n)
            weight, r = dr.gather(mi.Float, weight, kept), dr.gather(mi.Float, r, kept)
            row = mi.Vector4f(weight, r, mi.Float(head), mi.Float(tail))
            dr.scatter(self.flat, row, dr.arange(mi.UInt32, dr.width(kept)))
        dr.eval(self.flat, self.count, self.first)


def _ends(lane: Any, size: int) -> tuple[Any, Any]:
    """(tail, head) of the pairs of groups of a power of two."""
    bits = size.bit_length() - 1
    tail = lane >> bits
    return tail, (tail & ~mi.UInt32(size - 1)) + (lane & (size - 1))


def area_density(plan: ChainPlan, starts: Vertices) -> Any:
    """Density per area with which a tail's first vertex is drawn over the hidden area, on its side of the surface."""
    per_area = plan.elements.per_area(starts.shape, starts.primitive, starts.p, starts.alive)
    two_sided = scatters_behind(starts.shape.bsdf())
    return per_area * _probability_of_front(plan, starts.p, starts.geometric_n, two_sided)
