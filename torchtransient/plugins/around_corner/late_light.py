"""Light of four and more bounces from chains that neighbouring scan points share (:class:`ChainPlan`).

A scan point sees the heads of its tile's chains, a laser spot the vertices of their tails: one ray each. What is in
between is the same for all points of the tile, so that an event costs two loads and a product::

    value_s value_l Q  g(s, x_i)  link_ik  b_kj g(v_kj, l)      at |s x_i| + |x_i v_k1| + ... + |v_kj l| + legs

``g``: cosines over the squared distance. Points of a tile have correlated noise, which would show in reconstructions.
Therefore a tile is not a patch: its points lie as far from each other as the scan is wide, so that one path arrives at
different times, and neighbours have chains of their own. The chains of all tiles are one set of
Sobol's points, those of neighbouring points in blocks next to each other, which fill each other's gaps. (Sums of a
16 x 16 scan: 2 to 3 times less variance than with patches of 4 x 4.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, UnitError
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner.geometry import (
    OFFSET,
    WallPoints,
    front_normal,
    gather_one_or_each,
    occluded,
    span,
)
from torchtransient.plugins.around_corner.launches import EVENTS, ScanJob
from torchtransient.plugins.bsdfs.lambertian import scatters_behind
from torchtransient.plugins.sampling.area_elements import morton_order
from torchtransient.plugins.sampling.point_sets import DIMENSIONS, sobol, unit_double, unit_float
from torchtransient.plugins.sampling.shared_samples import samples_at
from torchtransient.plugins.transport.strategy import Local

# ----------------------------------------------------------------------------------------------------------------------
# Random walks through a hidden scene that neighbouring scan points share, in groups whose parts are put together anew.
# A chain is a *head* ``x``, a point on hidden geometry that scan points see, and a *tail* ``v_1, v_2, ...``, a walk
# whose vertices laser spots see. The tails of the ``size`` chains of a group are connected to all of its heads, so that
# ``size^2`` paths come of ``size`` walks. ``v_1`` of chain ``k`` is drawn with a density per area
#
#     q_k(v) = (1 - share) V cos(x_k) cos(v) / (pi r^2) + share p(v)
#
# from its own head (``V``: nothing is in between) or over the hidden area. Connected to head ``i`` it weighs ``f_i(v) /
# sum_k q_k(v)`` (balance heuristic over the group, Bekaert et al. 2002), which corners do not make large: ``f_i <= pi
# value_i q_i / (1 - share)``.

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
    """Layout of chains.

    Attributes:
        elements: density of their heads (:class:`..sampling.hidden_elements.HiddenElements`).
        center: middle of the scan points (Point3f of width one, in memory).
        size: chains of a group, a power of two.
        groups: groups of each tile.
        tail: vertices of a tail.
        seed: UInt32 of width one, in memory.
    """

    elements: Any
    center: Any
    size: int
    groups: int
    tail: int
    seed: Any

    @property
    def stride(self) -> int:
        """Number of Sobol's points of a tile, a power of two."""
        return 1 << max(0, self.size * self.groups - 1).bit_length()


class Vertices(Local):
    """Vertices of chains, one of each chain.

    Attributes:
        p, n, geometric_n: place, and normals of the side that light meets.
        value: weight by colour: of a head its albedo over pi times the area that it stands for, of a tail its albedo
            over pi times the light of the step before.
        length: length from the first vertex of the tail, metres.
        alive: mask of vertices that exist.
        shape, primitive, uv: the material point.
    """


def trace_chains(scene: Any, plan: ChainPlan, index: Any) -> tuple[Vertices, list[Vertices]]:
    """Return heads and vertices of tails of some chains, not evaluated.

    Args:
        scene: built scene.
        plan: layout of the chains.
        index: numbers of Sobol's points (UInt32), one for each chain.
    """
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
    """Draw points over the hidden area, and a side of the surface there."""
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
    """Return the probability of the side of ``n`` at ``p``."""
    faces = dr.dot(n, plan.center - p) > 0
    return dr.select(two_sided, dr.select(faces, mi.Float(FACING), 1 - FACING), 1)


def _cosine_direction(n: Any, numbers: list[Any], which: tuple[int, int]) -> Any:
    u = mi.Point2f(*(unit_float(numbers[i]) for i in which))
    return mi.Frame3f(mi.Normal3f(n)).to_world(mi.warp.square_to_cosine_hemisphere(u))


def _origin(plan: ChainPlan, start: Vertices, towards: Any) -> Any:
    """Return the origin of rays that leave a surface. Offsets as in :func:`.geometry.occluded`, by the size of the
    hidden scene.
    """
    reach = dr.max(dr.abs(start.p)) + dr.norm(plan.center - start.p)
    offset = dr.mulsign(OFFSET * reach, dr.dot(start.geometric_n, towards))
    return mi.Point3f(start.p + start.geometric_n * offset)


def _step(scene: Any, plan: ChainPlan, origin: Any, d: Any, active: Any) -> Vertices:
    """Intersect a ray with the scene; the caller sets ``value``."""
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
    """Return (next vertex, cosine over pi and the density of its direction) by a mixture of cosines and hidden area."""
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
    """Vertices in memory, gathered by number. A plain class."""

    _FIELDS = ("p", "n", "value", "length", "alive")

    def __init__(self, vertices: Vertices, smooth: bool) -> None:
        self.smooth = smooth
        for name in self._FIELDS:
            setattr(self, name, getattr(vertices, name))
        self.geometric_n = vertices.geometric_n if smooth else vertices.n
        dr.schedule(self.geometric_n, *(getattr(self, name) for name in self._FIELDS))

    def take(self, index: Any) -> Local:
        """Gather ``p, n, geometric_n, value, length, alive`` of vertices."""
        rows = Local(**{name: gather_one_or_each(getattr(self, name), index) for name in self._FIELDS})
        rows.geometric_n = gather_one_or_each(self.geometric_n, index) if self.smooth else rows.n
        return rows


# Numbers of chains stand in rows of single precision, which counts so far.
MOST_CHAINS = 2**24


class Links:
    """Connections of heads and tails that carry light, group by group. A plain class.

    Attributes:
        flat: rows of ``[weight, r, head, tail]``: factor of the tail's light (in monochromatic variants with the
            head's value), distance in metres, and numbers of the chains.
        first, count: first row and number of rows of each group (UInt32).
        most: largest number of rows of a group.
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
        linked = dr.compress(some)
        self.flat = dr.zeros(mi.Float, 4 * (dr.width(linked) + 1))
        if dr.width(linked):
            tail, head = _ends(linked, n)
            weight, r = dr.gather(mi.Float, weight, linked), dr.gather(mi.Float, r, linked)
            row = mi.Vector4f(weight, r, mi.Float(head), mi.Float(tail))
            dr.scatter(self.flat, row, dr.arange(mi.UInt32, dr.width(linked)))
        dr.eval(self.flat, self.count, self.first)


def _ends(lane: Any, size: int) -> tuple[Any, Any]:
    """Return (tail, head) of the pairs of groups of a power of two."""
    bits = size.bit_length() - 1
    tail = lane >> bits
    return tail, (tail & ~mi.UInt32(size - 1)) + (lane & (size - 1))


def area_density(plan: ChainPlan, starts: Vertices) -> Any:
    """Return the density per area of the first vertices of tails that are drawn over the hidden area.

    Args:
        plan: layout of the chains.
        starts: the first vertices; the side of the surface counts.
    """
    per_area = plan.elements.per_area(starts.shape, starts.primitive, starts.p, starts.alive)
    two_sided = scatters_behind(starts.shape.bsdf())
    return per_area * _probability_of_front(plan, starts.p, starts.geometric_n, two_sided)


# ----------------------------------------------------------------------------------------------------------------------

# Bounces of the first vertex of a tail, and the most that chains bring.
FIRST = 4
MOST = FIRST + LONGEST_TAIL - 1
# Scan points of a tile along each side of the scan; chains of a group.
TILE, SIZE = 4, 32
# Regions of the hidden area, as a power of two, that the heads of one group come from one of.
_REGIONS = 2
# Lanes that keep all cores busy, and numbers of a table of a launch at most.
_BUSY = {dr.JitBackend.LLVM: 2**13}
_BUSY_GPU = 2**17
_MOST_ENTRIES = 2**25
# What chains draw has nothing to do with what third-bounce samples or paths of the same seed do.
_STREAM = 0x6C617465


class Tiles:
    """Groups of scan points that share chains. A plain class.

    A tile has ``side`` points along each side of the scan, as far apart as possible.

    Attributes:
        count: number of tiles.
        tile_of_pixel: tile of each pixel of a film (UInt32); ``numbers`` is the same as numpy.
        rank: place of each tile along a curve that keeps neighbours together (UInt32).
    """

    def __init__(self, width: int, height: int, side: int) -> None:
        across, down = -(-width // side), -(-height // side)
        y, x = np.divmod(np.arange(width * height), width)
        self.numbers = (y % down) * across + x % across
        self.count = across * down
        ty, tx = np.divmod(np.arange(self.count), across)
        places = np.stack([tx, ty, np.zeros_like(tx)], 1)
        rank = np.empty(self.count, dtype=np.uint32)
        rank[morton_order(places, bits=max(1, int(max(across, down) - 1).bit_length()))] = np.arange(self.count)
        self.tile_of_pixel, self.rank = mi.UInt32(self.numbers.astype(np.uint32)), mi.UInt32(rank)
        dr.make_opaque(self.tile_of_pixel, self.rank)


@dataclass
class LateLaunch:
    """Launch of some rows of pixels.

    Attributes:
        band: storage band of the film.
        first_row, rows: first row of pixels and number of rows.
        spp: lanes of a pixel, under the name that films read.
        pieces: lanes of a pixel for each group.
        links: most links of a lane.
        listed: the film lists events, and the lanes of a pixel are neighbours.
    """

    band: int
    first_row: int
    rows: int
    spp: int
    pieces: int
    links: int
    listed: bool


class LateLight:
    """Late light of a capture, from chains. Mono and RGB variants, diffuse surfaces, every film; no derivatives.

    Args:
        job: the scan (:class:`.launches.ScanJob`).
        elements: density of the heads (:func:`.shared_light.late_density`).
        lasers: laser spots, in confocal captures one for each scan point.
        capture: type of the capture.
        bounces: lowest and highest number of bounces, within ``FIRST`` and ``MOST``.
        side: scan points of a tile along each side of the scan.
        size: chains of a group, a power of two.

    Raises:
        SceneError: for other numbers of bounces.
        UnitError: for other sizes of groups.
    """

    def __init__(
        self, job: ScanJob, elements: Any, lasers: WallPoints, capture: CaptureType, bounces: tuple[int, int],
        side: int = TILE, size: int = SIZE,
    ) -> None:  # fmt: skip
        if not FIRST <= bounces[0] <= bounces[1] <= MOST:
            raise SceneError(f"LateLight: expected bounces in order, within {FIRST} and {MOST}, got {bounces}.")
        if size < 1 or size & (size - 1):
            raise UnitError(f"LateLight: expected a power of two as the number of chains of a group, got {size}.")
        self.job, self.elements, self.lasers, self.capture = job, elements, lasers, capture
        self.lowest, self.highest = bounces
        self.exhaustive = capture is CaptureType.EXHAUSTIVE
        self.confocal = capture is CaptureType.CONFOCAL
        self.group_size = size
        width, height = (int(n) for n in job.film.crop_size())
        if self.exhaustive:
            # Every tile keeps how all laser spots see its chains.
            while side < max(width, height) and self._entries(-(-width // side) * -(-height // side)) > _MOST_ENTRIES:
                side *= 2
        self.tiles = Tiles(width, height, side)

    def _entries(self, tiles: int) -> int:
        """Return the number of entries of the largest table of one group."""
        seen_by = self.lasers.width * (self.highest - FIRST + 1) if self.exhaustive else 1
        return tiles * self.group_size * max(self.group_size, seen_by)

    def add(self, count: int, seed: Any) -> None:
        """Add light to the film.

        Args:
            count: chains of each tile, rounded up to whole groups.
            seed: a number, or UInt32 of width one.
        """
        job, film = self.job, self.job.film
        size = min(self.group_size, 1 << max(0, count - 1).bit_length())
        center = mi.Point3f(*(dr.mean(c) for c in job.sensors.p))
        seed = mi.UInt32(seed) if dr.is_array_v(seed) else dr.opaque(mi.UInt32, int(seed) % 2**32)
        seed = mi.sample_tea_32(seed, mi.UInt32(_STREAM))[0]
        dr.make_opaque(center, seed)
        groups = -(-count // size)
        self.plan = ChainPlan(self.elements, center, size, groups, self.highest - FIRST + 1, seed)
        at_once = self._groups_at_once()
        for first in range(0, groups, at_once):
            last = min(first + at_once, groups)
            part = GroupBlock(self, first, last - first)
            for band, (row, rows) in enumerate(film.band_layout()):
                for launch in self._launches(part, band, row, rows):
                    self._launch(part, launch)
                job.done(last / groups, band)

    def _groups_at_once(self) -> int:
        """Return the number of groups of a block: all cores have work, and tables stay small."""
        lanes = self.job.sensors.width * (self.lasers.width if self.exhaustive else 1)
        wanted = max(1, _BUSY.get(dr.backend_v(mi.Float), _BUSY_GPU) // lanes)
        return max(1, min(wanted, self.plan.groups, _MOST_ENTRIES // self._entries(self.tiles.count)))

    def _launches(self, part: GroupBlock, band: int, first_row: int, rows: int) -> list[LateLaunch]:
        film = self.job.film
        most = film.lanes_at_most(EVENTS)
        if most is None:
            return [LateLaunch(band, first_row, rows, part.groups, 1, part.links.most, False)]
        links = max(1, EVENTS // len(part.lit))
        pieces = max(1, -(-part.links.most // links))
        lanes = part.groups * pieces
        at_once = max(1, most // (int(film.crop_size()[0]) * lanes))
        last = first_row + rows
        return [
            LateLaunch(band, row, min(at_once, last - row), lanes, pieces, links, True)
            for row in range(first_row, last, at_once)
        ]

    def _launch(self, part: GroupBlock, launch: LateLaunch) -> None:
        film = self.job.film
        lanes = LateLanes(self, part, launch)
        first_row = film.band_layout()[launch.band][0]
        in_band = lanes.pixel - dr.opaque(mi.UInt32, first_row * int(film.crop_size()[0]))
        base = in_band * film.entries_per_pixel()
        if self.exhaustive:
            base = film.pixel_base(base, lanes.laser)
        target = film.create_event_block(launch, base, self.job.match, EVENTS, exclusive=launch.spp == 1)
        sums = {"L": mi.UnpolarizedSpectrum(0), "before": mi.Float(0), "after": mi.Float(0), "block": target.begin()}
        sums = _sum_over_links(self, part, lanes, target, sums)
        target.end(sums["block"])
        film.add_steady(lanes.pixel, self.job.match.to_channels(sums["L"]))
        film.add_outside(lanes.pixel, sums["before"], sums["after"])
        target.finish()


class GroupBlock:
    """Groups ``first`` to ``first + groups`` of all tiles, with their links and visibilities. A plain class.

    Attributes:
        links: the :class:`Links` of the groups.
        seen: ``[g, r]`` of heads from scan points, by row of a tile and point: cosines over the squared distance, and
            distance (metres).
        lit: the same two numbers of tails from laser spots, a list with an array for each vertex of a tail, by chain
            and spot, in confocal captures by row of a tile and point.
    """

    def __init__(self, light: LateLight, first: int, groups: int) -> None:
        plan, job = light.plan, light.job
        self.groups, self.rows = groups, groups * plan.size
        # Chains of a tile stand together.
        chain = dr.arange(mi.UInt32, light.tiles.count * self.rows)
        tile = chain // dr.opaque(mi.UInt32, self.rows)
        row = chain - tile * dr.opaque(mi.UInt32, self.rows) + dr.opaque(mi.UInt32, first * plan.size)
        number = dr.gather(mi.UInt32, light.tiles.rank, tile) * dr.opaque(mi.UInt32, plan.stride)
        heads, tails = trace_chains(job.scene, plan, number + _in_regions(row, plan))
        smooth, drawn = plan.elements.smooth, area_density(plan, tails[0])
        self.heads, tails = VertexTable(heads, smooth), [VertexTable(t, smooth) for t in tails]
        dr.eval(drawn)
        self.links = Links(job.scene, plan, self.heads, tails[0], drawn)
        self.colours = len(job.energy)
        # Those with too few bounces are stepping stones.
        self.tails = tails[light.lowest - FIRST :]
        self.seen = self._visibility(light, job.sensors, self.heads, from_laser=False)
        self.lit = [self._visibility(light, light.lasers, t, from_laser=True) for t in self.tails]

    def _visibility(self, light: LateLight, points: WallPoints, vertices: VertexTable, from_laser: bool) -> Any:
        width = dr.opaque(mi.UInt32, points.width)
        rows = dr.opaque(mi.UInt32, self.rows)
        by_chain = from_laser and not light.confocal
        lane = dr.arange(mi.UInt32, (light.tiles.count if by_chain else 1) * self.rows * points.width)
        row = lane // width
        point = lane - row * width
        chain = row if by_chain else dr.gather(mi.UInt32, light.tiles.tile_of_pixel, point) * rows + row
        p, n, _, _ = points.take(point)
        n = mi.Vector3f(n)
        vertex = vertices.take(chain)
        line = span(vertex, p, n)
        # As in a path from the sensor: cosines towards it by the surface, towards the light by shading normals.
        g = line.wall_cos * line.inverse_square * (line.cos if from_laser else dr.abs(line.geometric_cos))
        active = vertex.alive & (line.cos > 0) & (g > 0)
        active &= ~occluded(light.job.scene, vertex, line, p, n, active)
        r = line.r
        if from_laser:
            r += vertex.length
            if self.colours == 1:
                g *= vertex.value[0]
        target = dr.empty(mi.Float, 2 * dr.width(lane))
        dr.scatter(target, mi.Vector2f(dr.select(active, g, 0), r), lane)
        dr.eval(target)
        return target


def _in_regions(row: Any, plan: ChainPlan) -> Any:
    """Return the number of Sobol's point of each chain of a tile.

    The lowest bits of a number are a part of the hidden area for the head: the heads of a group lie near each other and
    light the same places.
    """
    regions = 1 << _REGIONS
    if plan.groups % regions:
        return row
    size = dr.opaque(mi.UInt32, plan.size)
    group = row // size
    region = group & (regions - 1)
    return (((group >> _REGIONS) * size + row - group * size) << _REGIONS) + region


class LateLanes:
    """Data of the lanes of a launch: constants of the loop. A plain class."""

    def __init__(self, light: LateLight, part: GroupBlock, launch: LateLaunch) -> None:
        job, lasers = light.job, light.lasers
        self.pixel, group, piece, self.laser = self._numbers(light, part, launch)
        _, _, value, leg = job.sensors.take(self.pixel)
        spot = self.pixel if light.confocal else self.laser
        _, _, spot_value, spot_leg = lasers.take(spot)
        self.factor = value * job.energy * spot_value
        self.opl = leg + spot_leg - job.film.start_opl
        tile = dr.gather(mi.UInt32, light.tiles.tile_of_pixel, self.pixel)
        tile_group = tile * dr.opaque(mi.UInt32, part.groups) + group
        first = dr.gather(mi.UInt32, part.links.first, tile_group)
        end = first + dr.gather(mi.UInt32, part.links.count, tile_group)
        self.first = first + piece * dr.opaque(mi.UInt32, launch.links)
        self.last = dr.minimum(self.first + dr.opaque(mi.UInt32, launch.links), end)
        # A chain's number counts through all tiles; a row of the tables through those of one.
        self.offset = tile * dr.opaque(mi.UInt32, part.rows)
        self.stride, self.spot_stride = dr.opaque(mi.UInt32, job.sensors.width), dr.opaque(mi.UInt32, lasers.width)
        self.spot_offset = self.offset if light.confocal else mi.UInt32(0)
        self.spot = spot
        dr.eval(self.pixel, self.factor, self.opl, self.first, self.last, self.offset, self.spot_offset, self.spot)

    @staticmethod
    def _numbers(light: LateLight, part: GroupBlock, launch: LateLaunch) -> tuple[Any, Any, Any, Any]:
        """Return (pixel, group, piece, laser) of each lane, ``UInt32``."""
        width = int(light.job.film.crop_size()[0])
        pixels = np.arange(launch.first_row * width, (launch.first_row + launch.rows) * width)
        if not launch.listed:  # points of a tile, which read the same links, stand together
            pixels = pixels[np.argsort(light.tiles.numbers[pixels], kind="stable")]
        lasers = light.lasers.width if light.exhaustive else 1
        lane = dr.arange(mi.UInt32, len(pixels) * launch.spp * lasers)
        place, laser = _divmod_by(lane, lasers)
        if launch.listed:
            place, rest = _divmod_by(place, launch.spp)
        else:
            rest, place = _divmod_by(place, len(pixels))
        group, piece = _divmod_by(rest, launch.pieces)
        return dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), place), group, piece, laser


def _divmod_by(number: Any, divisor: int) -> tuple[Any, Any]:
    """Return quotient and rest of whole numbers; the divisor is kept in memory, not in the kernel."""
    by = dr.opaque(mi.UInt32, divisor)
    quotient = number // by
    return quotient, number - quotient * by


@dr.syntax
def _sum_over_links(light, part, lanes, target, sums):
    """Add the light of each lane's links to the film's block ``target`` and to ``sums``."""
    k = mi.UInt32(lanes.first)
    while dr.hint(k < lanes.last, label="links"):
        _deposit(light, part, lanes, target, sums, k)
        k += 1
    return sums


def _deposit(light, part, lanes, target, sums, k):
    """Add the events of link ``k``."""
    link = dr.gather(mi.Vector4f, part.links.flat, k)
    head, tail = mi.UInt32(link.z), mi.UInt32(link.w)
    seen = dr.gather(mi.Vector2f, part.seen, (head - lanes.offset) * lanes.stride + lanes.pixel)
    weight, length = seen.x * link.x, seen.y + link.y
    factor = lanes.factor
    if part.colours > 1:
        factor = factor * dr.gather(mi.UnpolarizedSpectrum, part.heads.value, head)
    row = (tail - lanes.spot_offset) * lanes.spot_stride + lanes.spot
    for vertices, lit in zip(part.tails, part.lit, strict=True):
        there = dr.gather(mi.Vector2f, lit, row)
        g = weight * there.x
        active = g > 0
        opl = lanes.opl + mi.Float64(length + there.y)
        if light.job.window is not None:
            active &= light.job.window.counts(opl)
        value = factor * g
        if part.colours > 1:
            value = value * dr.gather(mi.UnpolarizedSpectrum, vertices.value, tail)
        sums["L"] = sums["L"] + dr.select(active, value, 0)
        before, after = target.put(sums["block"], opl, value, active)
        sums["before"] = sums["before"] + before
        sums["after"] = sums["after"] + after
