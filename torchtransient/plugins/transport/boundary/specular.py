"""Edges and shadows that the sensor sees in plane mirrors and through plane, smooth glass.

A *chain* is a sequence of planes with delta lobes that rays of the sensor run through before anything else. For a point
p behind a chain there is one ray of the sensor that arrives there: in mirrors the straight line to the image of p, in
glass found by Newton's method on the planes, which are taken as infinite. The walk then traces that ray and has to
visit the same planes. The importance per area across at p is that per solid angle at the sensor over the determinant of
how p moves across with the direction.

Chains are drawn from those of a few rays of the sensor, in proportion to how often these meet them; one that fills less
than about 1e-4 of the film may be missed. Planes alone are found twice; of curved surfaces every hit has a plane of its
own, and the edges seen in them are left out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.edges.table import EdgeDensity
from torchtransient.plugins.mitsuba_shapes import is_instance
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.polarized import attenuated, intensity, product
from torchtransient.plugins.sensors.seen_from import has_eye
from torchtransient.plugins.transport.boundary.moving_edges import LONGEST, has_delta_lobe
from torchtransient.plugins.transport.boundary.primary import where_normals_face
from torchtransient.plugins.transport.boundary.sides import (
    BoundaryPass,
    at_point,
    both_sides,
    in_memory,
    past_edge,
    place_at,
)
from torchtransient.plugins.transport.context import RenderContext
from torchtransient.plugins.transport.light_tracing import first_row, in_sensor_frame
from torchtransient.plugins.transport.strategy import Connection, Event, Local, Proposal
from torchtransient.plugins.transport.surface_interactions import surface_interaction
from torchtransient.plugins.transport.surface_scattering import Surface
from torchtransient.plugins.transport.walk import advance, start

# Rays that chains are taken from, and the share of those that end at a surface that goes on with a delta lobe.
RAYS, _UNFINISHED = 2**14, 0.125
# Entries of each of two tables of counts. A chain has the lesser of its two counts: others may share one of them.
_BUCKETS = 2**18
_STEPS = 12
# How far from p its ray may pass, in parts of the way; the walk starts its rays a little beside the planes, and may
# miss it by more. Planes are distinguished by a hundredth of their normals and the first share of the scene's radius,
# which is the least distance of an edge from the last plane, too.
_MISS, _MISS_OF_WALK = 1e-4, 2e-3


class KnownLobes(Surface):
    """Scattering by delta lobes alone: by reflection where ``mirrors``, else through the surface."""

    mirrors = False

    def sample(self, bsdf, si, u_lobe, u_dir, active):
        found = []
        for lobes in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.Null):
            ctx = mi.BSDFContext()
            ctx.type_mask = int(lobes)
            found.append(bsdf.sample(ctx, si, u_lobe, u_dir, active))
        (bs, weight), (through, its_weight) = found
        return dr.select(self.mirrors, bs, through), dr.select(self.mirrors, weight, its_weight)


class Chains:
    """Chains of planes that a sensor sees, see the module.

    Args:
        integrator, context: integrator and context of the job.
        places: :class:`~torchtransient.plugins.sensors.seen_from.SensorPlaces`.
        sampler: seeded, with ``RAYS`` lanes.

    Attributes:
        context: :class:`~..context.RenderContext` of paths that go on by delta lobes alone.
        longest: largest number of planes.
        move: some planes move, and so do edges at rest as seen through them.
    """

    def __init__(self, integrator, context, places, sampler):
        self.integrator, self.places = integrator, places
        self.longest = min(LONGEST, context.max_depth - 1)
        self.move = any(
            shape.ptr in context.wanted.shapes and (is_instance(shape) or has_delta_lobe(shape))
            for shape in shapes_of_scene(context.scene)
        )
        segment, _, connections = integrator.strategies(context.contents)
        self._lobes = KnownLobes()
        strategies = segment, self._lobes, connections
        velocities = context.velocities
        self.context = RenderContext(
            context.scene, context.contents, integrator.settings(), strategies, velocities=velocities
        )
        numbers = places.numbers(sampler)
        rays = places.rays_at(context, sampler, sampler.next_2d() * places.size, numbers)
        found = self.follow(context, rays, sampler, mi.UInt32(self.longest), mi.Bool(True))
        weights = [
            dr.select(on, dr.select(after, _UNFINISHED, 1), 0)
            for on, after in zip(found.reached, [*found.reached[1:], mi.Bool(False)], strict=True)
        ]
        self.keys = [dr.concat([key[k] for key in found.keys]) for k in (0, 1)]
        self.directions = mi.Vector3f(dr.detach(rays.ray).d)
        normals, offsets, ratios = zip(*found.planes, strict=True)
        self.normals = mi.Vector3f(*[_concatenated([n[k] for n in normals]) for k in range(3)])
        self.offsets, self.ratios = _concatenated(offsets), _concatenated(ratios)
        weight = _concatenated(weights)
        self.density = EdgeDensity(weight, dr.cumsum(mi.Float64(weight)))
        self.counts = [dr.zeros(mi.Float, _BUCKETS) for _ in self.keys]
        for count, key in zip(self.counts, self.keys, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, count, weight, key % _BUCKETS)
        dr.eval(self.keys, self.directions, self.normals, self.offsets, self.ratios, vars(self.density), self.counts)

    def draw(self, x):
        """Draw a chain by a uniform number.

        Returns:
            ``count`` of its planes, ``planes`` (normal n, offset n . p, ratio of the index behind it to that before, 0
            for a mirror), ``key``, ``inverse`` (one over its probability), ``ω`` (direction of a ray that runs through
            it).
        """
        row, p = self.density.sample(x)
        ray, active = row % RAYS, p > 0
        table = ((mi.Vector3f, self.normals), (mi.Float, self.offsets), (mi.Float, self.ratios))
        planes = [
            [dr.gather(kind, each, ray + i * RAYS, active) for kind, each in table] for i in range(self.longest)
        ]
        key = [dr.gather(mi.UInt32, each, row, active) for each in self.keys]
        counts = [dr.gather(mi.Float, count, k % _BUCKETS, active) for count, k in zip(self.counts, key, strict=True)]
        inverse = dr.select(active, mi.Float(self.density.total) / dr.minimum(*counts), 0)
        ω = dr.gather(mi.Vector3f, self.directions, ray, active)
        return Local(count=row // RAYS + 1, planes=planes, key=key, inverse=inverse, ω=ω)

    def follow(self, context, rays, sampler, count, active, mirrors=None):
        """Trace primary rays through delta vertices.

        Args:
            context: context of the walk.
            rays: :class:`~...sensors.origin.PrimaryRays`.
            count: largest number of vertices, UInt32.
            mirrors: lobes by vertex, as :class:`KnownLobes` takes them (reflection or not); None for the sampled ones.

        Returns:
            ``path``, behind the last one, active where all were delta vertices; by vertex ``reached`` (mask),
            ``planes`` and ``keys`` of the chain that ends there; ``key`` of all.
        """
        ray = dr.detach(rays.ray)
        path = start(context, ray, self.integrator.first_opl(self.places.film, rays), dr.detach(rays.η))
        path.active &= active
        path.leg = context.segment.first(context, ray, sampler)
        key, reached, planes, keys = [mi.UInt32(0), mi.UInt32(0)], [], [], []
        for i in range(self.longest):
            on, η = path.active & (i < count), mi.Float(path.η)
            if mirrors is not None:
                self._lobes.mirrors = mirrors[i]
            path, (pi, ray) = advance(context, sampler, path, dr.minimum(i + 1, count))
            si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, on)
            path.active &= ~on | path.prev_unconnected
            on &= path.active
            reflected = dr.dot(si.n, ray.d) * dr.dot(si.n, path.ray.d) < 0
            n, offset, ratio = mi.Vector3f(si.n), dr.dot(si.n, si.p), dr.select(reflected, 0, path.η / η)
            side = dr.select(dr.dot(n, ray.d) > 0, 2, 0) + dr.select(reflected, 1, 0)
            cells = *dr.round(mi.Vector3f(n) * 100), dr.round(offset / (_MISS * self.places.radius)), side
            parts = [mi.UInt32(mi.Int32(x)) for x in cells]
            parts += [dr.reinterpret_array(mi.UInt32, x) for x in (pi.shape, pi.instance)]
            mixed = key
            for part in parts:
                mixed = mi.sample_tea_32(mixed[0] ^ part, mixed[1])
            key = [dr.select(on, new, old) for new, old in zip(mixed, key, strict=True)]
            reached.append(on)
            planes.append((n, offset, ratio))
            keys.append(key)
        self._lobes.mirrors = False
        return Local(path=path, reached=reached, planes=planes, keys=keys, key=key)

    def lead(self, context, path, sampler, target):
        """Trace paths on to their vertex number ``target``, as :func:`~..walk.advance` does.

        Returns:
            ``path``, ``before`` (last surface and ray, as of advance); ``all`` (mask: all vertices are those of a
            chain) and their ``ratios``.
        """
        every, ratios = target <= self.longest, []
        pi, ray = mi.PreliminaryIntersection3f(context.segment.surface_of(path.leg)[0]), mi.Ray3f(path.ray)
        for i in range(self.longest + 1):
            on, η = path.active & (path.depth < target), mi.Float(path.η)
            stop = target if i == self.longest else dr.minimum(i + 1, target)
            path, (its_pi, its_ray) = advance(context, sampler, path, stop)
            pi, ray = dr.select(on, its_pi, pi), dr.select(on, its_ray, ray)
            if i < self.longest:
                n = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, on).n
                ratios.append(dr.select(dr.dot(n, ray.d) * dr.dot(n, path.ray.d) < 0, 0, path.η / η))
                every &= ~on | path.prev_unconnected
        return Local(path=path, before=(pi, ray), all=every, ratios=ratios)

    # -------------------------------------------------------------------------------------------- rays through planes

    def image_of_eye(self, chain, eye):
        """Return the image of the ``eye`` in the mirrors of a chain."""
        for i, (n, offset, ratio) in enumerate(chain.planes):
            eye = dr.select((i < chain.count) & (ratio == 0), _mirrored(eye, n, offset), eye)
        return mi.Point3f(eye)

    def look(self, chain, eye, p, numbers, active):
        """Find the ray from the ``eye`` through a ``chain`` to a point ``p``.

        Returns:
            ``ω`` at the eye, ``uv`` (place on the film, in pixels), ``importance`` per area across at ``p``, last
            vertex ``o`` and direction ``d``, ``way`` between ``o`` and ``p``, ``length`` from eye to ``p``, ``valid``.
        """
        image = p
        for i, (n, offset, ratio) in reversed(list(enumerate(chain.planes))):
            image = dr.select((i < chain.count) & (ratio == 0), _mirrored(image, n, offset), image)
        straight = dr.normalize(image - eye)
        _, missed, _ = self._missed(self._sent(chain, eye, straight), p)
        # Total reflection may leave the straight line without a ray.
        begin = dr.select(dr.isfinite(dr.norm(missed)), straight, chain.ω)
        end = self._sent(chain, eye, _newton(self, chain, eye, p, begin))
        _, missed, det = self._missed(end, p)
        way = dr.dot(p - end.o, end.d)
        length = end.length + way
        valid = active & end.valid & (way > _MISS * self.places.radius) & (dr.abs(det) > 0)
        valid &= dr.norm(missed) < _MISS * length
        q = eye + end.ω * end.first
        ds, importance = self.places.seen_from(at_point(q), numbers, valid)
        importance *= dr.squared_norm(q - eye) / dr.abs(det)
        valid &= (ds.pdf > 0) & dr.isfinite(importance)
        return Local(
            ω=end.ω, uv=ds.uv, importance=dr.select(valid, importance, 0), o=end.o, d=end.d, way=way, length=length,
            valid=valid,
        )  # fmt: skip

    def turned(self, chain, eye, p, ω, step, least):
        """Take one step of Newton's method.

        A direction that is no better, or no ray at all (total reflection), is tried again with half of the step.

        Args:
            ω: best direction so far.
            step: change to be tried.
            least: distance by which ``ω`` misses ``p``.

        Returns:
            (best direction, next step, its distance).
        """
        tried = dr.normalize(ω + step)
        end = self._sent(chain, eye, tried)
        a, missed, _ = self._missed(end, p)
        across = end.axes[0] * a.x + end.axes[1] * a.y
        miss, size = dr.norm(missed), dr.norm(across)
        better = (miss < least) & dr.isfinite(size)
        across *= dr.select(size > 0.5, 0.5 / size, 1)
        return dr.select(better, tried, ω), dr.select(better, across, step * 0.5), dr.select(better, miss, least)

    def _sent(self, chain, eye, ω):
        """Trace a ray through the chain, with the derivatives of ``o, d`` at its end by ``ω`` along two ``axes``."""
        o, d, length, first, valid = mi.Point3f(eye), mi.Vector3f(ω), mi.Float(0), mi.Float(0), mi.Bool(True)
        axes = [mi.Vector3f(axis) for axis in mi.coordinate_system(ω)]
        moves = [(mi.Vector3f(0), axis) for axis in axes]
        for i, (n, offset, ratio) in enumerate(chain.planes):
            on = i < chain.count
            cos = dr.dot(n, d)
            t = (offset - dr.dot(n, o)) / cos
            out, slope = bent(d, n, ratio)
            following = []
            scale = dr.select(ratio == 0, 1, dr.rcp(ratio))
            for δo, δd in moves:
                c = dr.dot(n, δd)
                δt = -(dr.dot(n, δo) + t * c) / cos
                δout = (δd - n * c) * scale + n * (slope * c)
                following.append((dr.select(on, δo + δd * t + d * δt, δo), dr.select(on, δout, δd)))
            moves = following
            valid &= ~on | ((t > 0) & dr.isfinite(t) & dr.isfinite(slope))
            length += dr.select(on, t, 0)
            if i == 0:
                first = t
            o, d = dr.select(on, o + d * t, o), dr.select(on, out, d)
        return Local(o=o, d=d, ω=ω, axes=axes, moves=moves, length=length, first=first, valid=valid)

    @staticmethod
    def _missed(end, p):
        """Return (change of direction that brings the ray to ``p``, distance across by which it misses ``p``,
        determinant).
        """
        t = dr.dot(p - end.o, end.d)
        u, v = mi.coordinate_system(end.d)
        r = p - (end.o + end.d * t)
        (ax, ay), (bx, by) = ((dr.dot(u, δo + δd * t), dr.dot(v, δo + δd * t)) for δo, δd in end.moves)
        rx, ry = dr.dot(u, r), dr.dot(v, r)
        det = ax * by - bx * ay
        return mi.Vector2f(by * rx - bx * ry, ax * ry - ay * rx) / det, mi.Vector2f(rx, ry), det


def attached_ray(context, ray, ratios, count, active):
    """Return the last ray of an attached primary ray through planes, which move: attached ``o`` and ``d``.

    Args:
        ray: attached primary ray.
        ratios: index of refraction behind each plane over that before it, 0 for a mirror.
        count: number of planes, UInt32.
    """
    carried = mi.Ray3f(ray)
    for i, ratio in enumerate(ratios):
        on = active & (i < count)
        with dr.suspend_grad():
            pi = context.scene.ray_intersect_preliminary(dr.detach(carried), active=on)
            on &= pi.is_valid()
        si = surface_interaction(context.surfaces, pi, carried, mi.RayFlags.All, on)
        out, _ = bent(carried.d, si.sh_frame.n, ratio)
        with dr.suspend_grad():
            ahead = dr.detach(si).spawn_ray(dr.detach(out))
        carried.o = dr.select(on, dr.replace_grad(ahead.o, si.p), carried.o)
        carried.d = dr.select(on, dr.replace_grad(ahead.d, out), carried.d)
    return carried


def ratios_of(chain):
    """Return for each plane the ratio of the index behind it to that before, 0 for a mirror.

    Args:
        chain: planes as :meth:`Chains.draw` returns them.
    """
    return [ratio for _, _, ratio in chain.planes]


@dr.syntax
def _newton(chains, chain, eye, p, ω):
    """Return the direction at the ``eye`` of the ray to ``p``, from a direction ``ω`` of some ray through the chain."""
    i, step, least = mi.UInt32(0), mi.Vector3f(0), mi.Float(dr.inf)
    while dr.hint(i < _STEPS, max_iterations=_STEPS, label="ray through a chain"):
        ω, step, least = chains.turned(chain, eye, p, ω, step, least)
        i += 1
    return ω


def _mirrored(p, n, offset):
    """Return the image of ``p`` in the plane ``n . q = offset``."""
    return p - n * (2 * (dr.dot(n, p) - offset))


def bent(d, n, ratio):
    """Return (direction behind a plane, derivative of its part along ``n`` by that of ``d``).

    Args:
        d, n: direction before the plane, and its normal.
        ratio: index of refraction behind the plane over that before it, 0 for a mirror.
    """
    cos = dr.dot(n, d)
    mirrors = ratio == 0
    inverse = dr.rcp(dr.select(mirrors, 1, ratio))
    cos_out = dr.sqrt(dr.select(mirrors, 1, 1 - (1 - dr.square(cos)) * dr.square(inverse)))
    through = (d - n * cos) * inverse + n * dr.mulsign(cos_out, cos)
    slope = dr.mulsign(cos * dr.square(inverse) / cos_out, cos)
    return dr.select(mirrors, d - n * (2 * cos), through), dr.select(mirrors, -1, slope)


def _concatenated(parts):
    return dr.concat([part + dr.zeros(mi.Float, RAYS) for part in parts])


class SpecularPass(BoundaryPass):
    """Boundary pass of edges that the sensor sees through a chain: draws an edge point and a pixel that sees it."""

    @staticmethod
    def exists(context, sensor):
        """Return True if the sensor can see edges through chains."""
        return sees_chains(context, sensor)

    def run(self, mode, job):
        term = mode.term
        context, edges, chains, sampler = term.context, term.edges, term.chains, term.sampler(job)
        numbers = term.places.numbers(sampler)
        k = edges.pick(edges.by_length if chains.move else edges.of_moving, sampler.next_1d(), sampler.next_1d())
        chain, eye = chains.draw(sampler.next_1d()), term.places.eye(numbers)
        b = edges.seen_from(k, chains.image_of_eye(chain, eye), chain.inverse > 0)
        # A limb depends on where it is seen from; through glass there is no such point.
        refracts = mi.Bool(False)
        for i, ratio in enumerate(ratios_of(chain)):
            refracts |= (i < chain.count) & (ratio != 0)
        seen = chains.look(chain, eye, b.p, numbers, b.valid & ~(b.k.ball & refracts))
        b = edges.seen_from(k, b.p - seen.d * seen.length, seen.valid)
        row, column, weight, inside = term.pixel(seen.uv, sampler.next_2d())
        own, share = mode.rows_in_band(row)
        inside &= own
        row, column = dr.select(inside, row, job.first_row), dr.select(inside, column, 0)
        rays = term.places.rays_at(context, sampler, seen.uv, numbers, row, column, job.total)
        context.start(rays)
        view = mode.view(rays)
        if term.has_vertex_normals:
            b.inner = where_normals_face(b)
        active, path = traced(chains, chain, seen, rays, sampler, b.valid & seen.valid & inside)
        medium = context.segment.medium_towards(b.d)
        place, to_last = place_at(b.beside, path.ray, medium), Local(p=seen.o, d=-b.d, dist=seen.way)
        active, T = context.segment.transmittance(context, place, to_last, sampler.next_2d(), sampler, active)
        β = attenuated(path.β, mi.UnpolarizedSpectrum(T))
        factor = seen.importance * chain.inverse * b.sin * b.inv_pdf * weight * share
        past = past_edge(context, b, path.ray, medium, β, sampler, active)
        edge_state, path_state = (vars(b.k), b.n, b.limb, b.inner), (path, past, β)
        in_memory(context, sampler, edge_state, path_state, vars(seen), vars(chain), vars(numbers), active, factor)
        with dr.resume_grad():
            ray = attached_ray(context, rays.ray, ratios_of(chain), chain.count, active)
            moves = edges.moving(b) - ray.o - ray.d * seen.way
            speeds = [dr.select(active, dr.dot(b.n, moves), 0)] * 2
        first = {
            "ray": path.ray, "β": β, "η": path.η, "τ": path.τ, "prev_p": path.prev_p, "prev_n": path.prev_n,
            "depth": chain.count, "active": active, "medium": medium,
        }  # fmt: skip
        if context.velocities is not None:
            first |= {"rate": path.rate, "prev_v": path.prev_v}
        return both_sides(context, mode, sampler, view, b, past, first, factor, speeds, (mi.Bool(True), mi.Bool(True)))


def traced(chains, chain, seen, rays, sampler, active):
    """Trace rays through their chains to a point.

    Args:
        chain, seen: results of :meth:`Chains.draw` and :meth:`Chains.look`.
        rays: primary rays through ``seen.uv``.

    Returns:
        (mask of rays that visit the same planes and arrive there, the paths behind the planes).
    """
    mirrors = [ratio == 0 for ratio in ratios_of(chain)]
    found = chains.follow(chains.context, rays, sampler, chain.count, active, mirrors)
    path = found.path
    same = (found.key[0] == chain.key[0]) & (found.key[1] == chain.key[1])
    off = dr.norm(dr.cross(path.ray.d, seen.o + seen.d * seen.way - path.ray.o))
    return active & path.active & same & (off < _MISS_OF_WALK * seen.length), path


def sees_chains(context, sensor):
    """Return True if a sensor has a point of view from which it may see something in mirrors or through glass.

    Args:
        context: :class:`~..context.RenderContext` of the job.
        sensor: sensor of the job.
    """
    contents = context.contents
    return context.max_depth > 1 and contents.delta and contents.media is None and has_eye(sensor)


class SensorThroughChain(Connection):
    """Connection to the sensor as seen through a chain, one for all vertices of a path: :meth:`set` before a launch.

    Events are as those of :class:`~..light_tracing.SensorSampled`.
    """

    name = "sensor_through_chain"
    finds_light = False

    def __init__(self, chains):
        self.chains = chains

    def set(self, chain, numbers, η):
        """Set the chain of a launch.

        Args:
            chain: result of :meth:`Chains.draw`.
            η: index of refraction at the sensor.
        """
        self.chain, self.numbers, self.η = chain, numbers, η
        self._eye = self.chains.places.eye(numbers)

    def seen_from(self, p, active):
        """Return (result of :meth:`Chains.look` for the point ``p``, primary rays there)."""
        chains = self.chains
        seen = chains.look(self.chain, self._eye, p, self.numbers, active & (self.chain.inverse > 0))
        return seen, chains.places.rays_at(chains.context, None, seen.uv, self.numbers, η=self.η)

    def propose(self, context, path, vertex, sampler):
        depth = path.depth + 2 + self.chain.count
        active = vertex.goes_on & vertex.connectable & (depth <= context.max_depth)
        seen, rays = self.seen_from(vertex.at.p, context.deep_enough(active, depth))
        active, through = traced(self.chains, self.chain, seen, rays, sampler, seen.valid)
        ds = Local(p=seen.o, n=mi.Normal3f(0), d=-seen.d, dist=seen.way, delta=mi.Bool(True), emitter=None)
        return Proposal(d=-seen.d, active=active, ds=ds, seen=seen, through=through, depth=depth, u=sampler.next_2d(),
                        sampler=sampler)  # fmt: skip

    def end_velocity(self, context, vertex, proposal):
        return proposal.through.prev_v

    def rate_beyond(self, proposal):
        return proposal.through.rate

    def connect(self, context, path, vertex, proposal, answer, zeros):
        seen, through, ds = proposal.seen, proposal.through, proposal.ds
        value = in_sensor_frame(first_row(product(vertex.β, answer.matrix)), mi.Vector3f(ds.d))
        value = product(through.β, value) * (seen.importance * self.chain.inverse)
        active = proposal.active & (dr.max(dr.abs(intensity(value))) > 0)
        opl = vertex.scattered_τ + through.τ + self.chains.places.film.start_opl + mi.Float64(seen.way * through.η)
        active = context.counted(active, opl)
        active, T = context.segment.transmittance(context, vertex, ds, proposal.u, proposal.sampler, active)
        return Event(
            value=value * T, opl=opl, active=active, depth=proposal.depth, uv=seen.uv, d=-seen.ω,
            first=path.depth == 0, speed=2,
        )  # fmt: skip
