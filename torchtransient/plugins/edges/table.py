"""Points of edges and limbs, drawn by length and crease angle, and what is seen at them from a viewpoint.

Creases count, too: interior derivatives hold the points of each face on the rays that found them, and where a face ends
under them light jumps from one face to the next.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.edges.joined import APART, FLAT
from torchtransient.plugins.edges.topology import (
    BALL,
    DISK_RIM,
    EDGE,
    GAP,
    KIND,
    SEAM,
    TUBE_LEFT,
    TUBE_RIGHT,
    TUBE_RIM,
    TWIN,
    TWO,
    Topology,
)
from torchtransient.plugins.transport.strategy import Local

# How far beside an edge one looks past it, in parts of the largest coordinate. Ten times as far, what a fine mesh hides
# of its own outlines is missed: 5 % of the shadow of a torus of 2304 triangles.
BESIDE = 1e-5
# Ends of a rim of two bodies that are farther apart than this, in parts of its coordinates and length, have come apart.
_ASTRAY = 4 * APART
# How many times as far before the edge one begins to look, so that what the edge touches is met.
BEFORE = 100
# How far before it, in parts of the distance, one begins to look along the inside of an edge: spheres are taken to hide
# their own outlines from there only where their radii are more than a hundred times the distance.
WELL_BEFORE = 0.05
# Sines of the angle with the line of sight below which a face is seen edge-on: a few roundings.
_ON_EDGE = 1e-6
# How far inside of its faces paths start, in parts of the face.
INSET = 1e-3
# How far towards the viewer paths start at a limb, in radians: at the limb itself the cosine is rounding.
TILT = 2e-3


class EdgeDensity:
    """Density of rows of a table.

    Args:
        weight: weight of each row, Float.
        cumulative: cumulative sum of the weights, Float64: steps of long tables would be rounding in single precision.
    """

    def __init__(self, weight: Any, cumulative: Any) -> None:
        self.weight, self.cumulative = weight, cumulative
        self.total = dr.gather(mi.Float64, cumulative, dr.width(weight) - 1)

    def sample(self, x: Any) -> tuple[Any, Any]:
        """Return (row, its probability) for uniform numbers; a probability of zero where there is nothing to draw."""
        x = mi.Float64(x) * self.total
        last = dr.width(self.weight) - 1
        row = dr.binary_search(0, last, lambda i: dr.gather(mi.Float64, self.cumulative, i) <= x)
        p = mi.Float(mi.Float64(dr.gather(mi.Float, self.weight, row)) / self.total)
        return row, dr.select(self.total > 0, p, 0)


class EdgeTable:
    """Edges and limbs of a scene for one job, with their numbers as they are now.

    Args:
        topology: topology of the scene.
        moving: addresses of the shapes that move.

    Attributes:
        ends: two attached Point3f: ends of edges; behind those, origins and axes of limbs.
        count: number of rows.
        of_moving: :class:`EdgeDensity` by length times crease angle and by body, of the shapes that move (of all where
            none does).
        by_length: the same of all shapes, with half of the samples for those that move. Nothing is drawn from a table
            of zero rows.
    """

    def __init__(self, topology: Topology, moving: frozenset[Any]) -> None:
        self.topology, self.count = topology, topology.count
        if not self.count:
            self.ends = []
            return
        self.edges = topology.count - topology.rounds
        with dr.resume_grad():
            self.ends = topology.ends()
        self.flags = topology.corners.flags | dr.opaque(mi.UInt32, 0)
        with dr.suspend_grad():
            self._measure()
            weight = self._by_length_and_body()
            self.by_length = self.of_moving = EdgeDensity(weight, dr.cumsum(mi.Float64(weight)))
            if (moves := topology.moves(moving)) is not None:
                own, whole = weight * moves, self.by_length
                self.of_moving = EdgeDensity(own, dr.cumsum(mi.Float64(own)))
                share = [dr.select(one.total > 0, dr.rcp(one.total), 0) for one in (whole, self.of_moving)]
                mixed = weight * mi.Float(share[0]) + own * mi.Float(share[1])
                cumulative = whole.cumulative * share[0] + self.of_moving.cumulative * share[1]
                self.by_length = EdgeDensity(mixed, cumulative)
        dr.eval(self.ends, self.third, self.flags, vars(self.by_length), vars(self.of_moving))

    def _by_length_and_body(self) -> Any:
        """Return the weights of the density: half by length, half with an equal share for each body.

        The longest edges are often those of a floor, behind which there is nothing.
        """
        owner, bodies = self.topology.owners[0], len(self.topology.bodies)
        sums = dr.zeros(mi.Float, bodies)
        dr.scatter_add(sums, self.weight, owner)
        own, total = dr.gather(mi.Float, sums, owner), dr.sum(sums)
        alike = dr.select(own > 0, total / (bodies * own), 0)
        return self.weight * (0.5 + 0.5 * alike)

    def _measure(self) -> None:
        """Compute third corners, flags and weights of the rows."""
        t, rows = self.topology, dr.arange(mi.UInt32, self.count)
        edge = rows < self.edges
        self.third = [dr.zeros(mi.Point3f, self.count)] * 2
        if self.edges:
            points = t.points()
            corner = lambda index: dr.gather(mi.Point3f, points, dr.gather(mi.UInt32, index, rows, edge), edge)  # noqa: E731
            self.third = [corner(index) for index in t.corners.third]
        if t.has_twins:
            own = [dr.gather(mi.Point3f, dr.detach(end), rows) for end in self.ends]
            off = [dr.max(dr.abs(p - corner(i))) for p, i in zip(own, t.corners.other, strict=True)]
            reach = dr.maximum(dr.norm(own[1] - own[0]), dr.max(dr.maximum(dr.abs(own[0]), dr.abs(own[1]))))
            lone = (self.flags & TWIN != 0) & (dr.maximum(*off) > _ASTRAY * reach)
            self.flags = dr.select(lone, self.flags & ~mi.UInt32(TWO | TWIN), self.flags)
        k = self._row(rows)
        weight = k.length
        if self.edges:
            ha, hb = (_across(third - k.a, dr.normalize(k.b - k.a)) for third in self.third)
            bend = _bend(k, ha, hb)
            weight *= dr.select(k.flags & TWO != 0, dr.select(bend > (FLAT / 2) ** 0.5, bend, 0), 1)
        self.weight = dr.select(dr.isfinite(weight), weight, 0)

    def _row(self, e: Any) -> Local:
        """Return rows: ends, or origin and axes ``a, x, y, z`` of limbs; lengths, halves of what is listed twice."""
        k = Local(e=e, flags=dr.gather(mi.UInt32, self.flags, e))
        k.kind = k.flags // KIND
        k.a, k.b = (dr.gather(mi.Point3f, dr.detach(end), e) for end in self.ends)
        k.length = dr.norm(k.b - k.a)
        if self.topology.rounds:
            rounds, second = k.kind != EDGE, e + self.topology.rounds
            k.y, k.z = (mi.Vector3f(dr.gather(mi.Point3f, dr.detach(end), second, rounds)) for end in self.ends)
            k.x = mi.Vector3f(k.b)
            # Of limbs and rims those of round ones; what they have in fact comes with the point.
            x2, y2, z2 = (dr.squared_norm(v) for v in (k.x, k.y, k.z))
            rim = dr.two_pi * dr.sqrt((x2 + y2) / 2)
            k.length = dr.select(rounds, rim, k.length)
            k.length = dr.select(k.kind == BALL, dr.two_pi * dr.sqrt((x2 + y2 + z2) / 3), k.length)
            k.length = dr.select(_is_tube(k.kind), dr.sqrt(z2), k.length)
        if self.topology.has_twins:
            k.length *= dr.select(k.flags & TWIN != 0, 0.5, 1)
        return k

    def pick(self, density: EdgeDensity, x: Any, u: Any) -> Local:
        """Draw an edge and a place along it.

        Args:
            density: :attr:`of_moving` or :attr:`by_length`.
            x, u: uniform numbers for the row and the place.

        Returns:
            ``e``, ``pmf`` (probability of the row), ``u``, ``a, b`` (ends, or origin and first axis), ``length``;
            ``ball``: the point of a limb depends on the viewer; ``near``: the point, of limbs one inside the shape.
        """
        e, pmf = density.sample(x)
        with dr.suspend_grad():
            k = self._row(e)
            k.pmf = pmf
            self._place(k, u)
        return k

    def _place(self, k: Any, u: Any) -> None:
        """Set the place of ``k``."""
        k.u, k.ball, k.near = u, mi.Bool(False), dr.lerp(k.a, k.b, u)
        if self.topology.rounds:
            sin, cos = dr.sincos(u * dr.two_pi)
            k.ball = (k.kind == BALL) | _is_tube(k.kind)
            near = k.a + dr.select(_is_tube(k.kind), k.z * u, dr.select(k.kind == BALL, 0, k.x * cos + k.y * sin))
            k.near = dr.select(k.kind == EDGE, k.near, near)

    def _pick_around(self, density: EdgeDensity, around: Any, x: Any, u: Any) -> Local:
        """Pick as :meth:`pick` does, but of the edges around a face for viewers on it."""
        spokes = self.topology.spokes
        with dr.suspend_grad():
            e, _ = density.sample(x)
            own, forward = spokes.draw(around, x)
            k = self._row(dr.select(around.active, own, e))
            k.pmf = dr.gather(mi.Float, density.weight, k.e) / mi.Float(density.total)
            self._place(k, dr.select(around.active, spokes.place(around, k, forward, u), u))
        return k

    def _faces(self, k: Any, p: Any, t: Any, d: Any) -> tuple[Any, Any, Any, Any]:
        """Return unit vectors in both faces at ``p``, across the edge of unit tangent ``t``; masks ``two``, ``beside``.

        ``two``: there are two faces; ``beside``: they are next to each other seen along ``d``.
        """
        wa, wb = (dr.gather(mi.Point3f, third, k.e) - p for third in self.third)
        two, beside = k.flags & TWO != 0, mi.Bool(True)
        if self.topology.rounds:
            wa = dr.select(k.kind == DISK_RIM, k.a - p, dr.select(k.kind == TUBE_RIM, k.z, wa))
        ha, hb = _across(wa, t), _across(wb, t)
        if self.topology.has_gaps:
            # The first face is followed by the other one, around the edge, with the viewer in between.
            beyond = lambda x, y: dr.dot(t, dr.cross(x, y)) > 0  # noqa: E731
            narrow = beyond(ha, -d) & beyond(-d, hb)
            between = dr.select(beyond(ha, hb), narrow, ~(beyond(hb, -d) & beyond(-d, ha)))
            beside = (k.flags & GAP == 0) | between
        return ha, hb, two, beside

    def choose(
        self, density: EdgeDensity, sampler: Any, V: Any, at: Any, active: Any, candidates: int, worth: Any
    ) -> Local:
        """Return one of several picks, which cost no rays, in proportion to its worth (resampling, Talbot et al. 2005).

        Args:
            density: density of the candidates.
            V: viewer, Point3f.
            at: (PreliminaryIntersection3f of ``V``, mask of those that lie on it); on a mesh, half of the candidates
                are edges around the face there.
            candidates: number of picks.
            worth: function ``worth(d, dist, crease)`` of direction, distance and mask of creases, which is multiplied
                by the span of an outline, of a crease by less, the flatter it is.
        """
        if candidates == 1:
            return self.pick(density, sampler.next_1d(), sampler.next_1d())
        best, total, own = None, mi.Float(0), mi.Float(1)
        spokes = self.topology.spokes
        around = None if spokes is None else spokes.around(at[0], V, active & at[1])
        for i in range(candidates):
            numbers = sampler.next_1d(), sampler.next_1d()
            if around is None:
                k = self.pick(density, *numbers)
            else:
                k = self._pick_around(density, around, *numbers) if i % 2 else self.pick(density, *numbers)
                # Of both ways to draw it.
                mixed = 0.5 * (k.pmf + spokes.density(around, k) * dr.norm(k.b - k.a))
                k.pmf = dr.select(around.active, mixed, k.pmf)
            d = k.near - mi.Point3f(V)
            dist = dr.norm(d)
            d /= dist
            t = self._tangent(k)
            across = dr.cross(d, t)
            ha, hb, two, beside = self._faces(k, k.near, t, d)
            same = ~two | (dr.dot(across, ha) * dr.dot(across, hb) > 0)
            span = dr.norm(across) * dr.select(same, 1, _bend(k, ha, hb))
            q = dr.select(k.ball, 1, dr.select(beside, span, 0)) * worth(d, dist, ~same)
            w = dr.select(active & (k.pmf > 0) & (q > 0), q * k.length / k.pmf, 0)
            total += w
            take = sampler.next_1d() * total < w
            own = dr.select(take, w, own)
            if best is None:
                best = k
            else:
                for name, value in vars(k).items():
                    setattr(best, name, dr.select(take, value, getattr(best, name)))
        # So that one over the density by length is the mean of the candidates over what the chosen one is worth.
        best.pmf = dr.select(total > 0, best.pmf * own * candidates / total, 0)
        return best

    def _tangent(self, k: Any) -> Any:
        """Return the unit tangent at the point of an edge or rim."""
        t = k.b - k.a
        if self.topology.rounds:
            sin, cos = dr.sincos(k.u * dr.two_pi)
            t = dr.select(k.kind == EDGE, t, k.y * cos - k.x * sin)
        return dr.normalize(mi.Vector3f(t))

    def seen_from(self, k: Any, V: Any, active: Any) -> Local:
        """Return the point of a picked row as seen from a viewer.

        Args:
            k: result of :meth:`pick` or :meth:`choose`.
            V: viewer, Point3f.

        Returns:
            ``p, d, dist``: the point, direction and distance of it; ``n``: out of the hiding shape, across edge and
            line of sight; ``sin`` between these two; ``inv_pdf``: one over the density by length; ``crease``: a face
            begins where another one ends; ``valid``: there is an outline or a crease; ``beside``: where to look past
            the edge from, a little before it; ``within``: the same on the inside, along the hiding shape; ``inner``:
            the face that hides, as intersection of the ray along ``d_in``; ``facing``: the other face of a crease,
            along ``d``; ``limb``: the place in the space of a limb.
        """
        t, p, length, outside = self._tangent(k), k.near, k.length, mi.Bool(True)
        local, limb_n = mi.Point3f(0), mi.Vector3f(0)
        if self.topology.rounds:
            local, along, limb_n, outside = self._limb(k, V)
            rounds, p_limb = k.kind != EDGE, k.a + self._from_local(k, local)
            p, length = dr.select(rounds, p_limb, p), dr.select(rounds, dr.norm(along), length)
            t = dr.select(rounds, dr.normalize(along), t)
        dist = dr.norm(p - V)
        d = (p - V) / dist
        across = dr.cross(d, t)
        s = dr.norm(across)
        ha, hb, two, between = self._faces(k, p, t, d)
        n = across / s
        # An open face has no outline where it is seen edge-on.
        shows = two | k.ball | (dr.abs(dr.dot(n, ha)) > _ON_EDGE * (1 + dr.max(dr.abs(p)) / dist))
        n = dr.select(k.ball, limb_n, dr.select(dr.dot(n, ha) > 0, -n, n))
        a_in, b_in = -dr.dot(n, ha), -dr.dot(n, hb)
        crease = two & (b_in < 0)
        # Across the edge, since third corners lie anywhere along it: the nearer face hides.
        other = two & ~crease & (dr.dot(hb, d) * a_in < dr.dot(ha, d) * b_in)
        scale = BESIDE * (1 + dr.max(dr.abs(p)))
        valid = active & (k.pmf > 0) & (s > 1e-4) & (dist > scale) & outside & between & shows
        valid &= dr.max(dr.abs(n)) > 0
        q = p
        if self.topology.rounds:
            inwards = dr.select(k.kind == DISK_RIM, k.a - p, dr.select(k.kind == TUBE_RIM, k.z, 0))
            q = dr.select(k.ball, k.a + self._from_local(k, self._tilted(k, local, d)), p + inwards * INSET)
        t_in = dr.norm(q - V)
        off = dr.select(crease, 0, mi.Vector3f(n)) * scale
        beside = p - d * dr.minimum(BEFORE * scale, 0.5 * dist) + off
        within = p - d * dr.clip(BEFORE * scale, WELL_BEFORE * dist, 0.5 * dist) - off
        inverse = dr.select(k.pmf > 0, length / k.pmf, 0)
        return Local(
            k=k, V=V, p=p, d=d, dist=dist, n=mi.Vector3f(n), sin=s, inv_pdf=inverse, crease=crease, valid=valid,
            beside=beside, within=within, d_in=(q - V) / t_in, limb=local, inner=self._leg(k, other, t_in, valid),
            facing=self._leg(k, mi.Bool(True), dist, valid & crease),
        )  # fmt: skip

    def _leg(self, k: Any, other: Any, t: Any, valid: Any) -> Any:
        """Return the intersection at the point in its first face, or in the ``other`` one."""
        top = self.topology
        face, owner = (
            dr.select(other, *(dr.gather(mi.UInt32, each, k.e) for each in reversed(pair)))
            for pair in (top.faces, top.owners)
        )
        place = dr.gather(mi.UInt32, top.place, k.e)
        place = dr.select(other, place >> 4, place)
        corner = lambda i: mi.Point2f(dr.select(i == 1, 1.0, 0.0), dr.select(i == 2, 1.0, 0.0))  # noqa: E731
        uv = dr.lerp(corner(place & 3), corner((place >> 2) & 3), k.u)
        # Paths that start exactly on concave creases leak, or are shaded by what the edge lies on.
        uv += (mi.Point2f(1 / 3) - uv) * INSET
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid, pi.t, pi.prim_index, pi.prim_uv = valid, t, face, dr.select(k.kind == EDGE, uv, 0)
        pi.shape, pi.instance = (
            dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, each, owner)) for each in (top.shape, top.instance)
        )
        pi.shape_index = dr.gather(mi.UInt32, top.index, owner)
        return pi

    def moving(self, b: Any) -> Any:
        """Return the point of an outline ``b`` (:meth:`seen_from`), attached to the shape that it is an edge of."""
        k = b.k
        a, c = (dr.gather(mi.Point3f, end, k.e, b.valid) for end in self.ends)
        p = dr.lerp(a, c, k.u)
        if not self.topology.rounds:
            return p
        rounds = k.kind != EDGE
        y, z = (dr.gather(mi.Point3f, end, k.e + self.topology.rounds, b.valid & rounds) for end in self.ends)
        return dr.select(rounds, a + c * b.limb.x + y * b.limb.y + z * b.limb.z, p)

    # ----------------------------------------------------------------------- balls, disks and tubes, in unit spaces

    def _from_local(self, k: Any, v: Any) -> Any:
        return k.x * v.x + k.y * v.y + k.z * v.z

    def _to_local(self, k: Any, w: Any) -> Any:
        """Return a vector in the space of a limb, and the axes that bring normals back."""
        across = dr.cross(k.y, k.z), dr.cross(k.z, k.x), dr.cross(k.x, k.y)
        volume = dr.dot(k.x, across[0])
        return mi.Vector3f(*[dr.dot(c, w) / volume for c in across]), [c * dr.sign(volume) for c in across]

    def _limb(self, k: Any, V: Any) -> tuple[Any, Any, Any, Any]:
        """Return (place in the unit space, derivative of the point by ``u``, normal of a limb, whether ``V`` sees one).
        """
        v, across = self._to_local(k, V - k.a)
        ball, tube = k.kind == BALL, _is_tube(k.kind)
        sin, cos = dr.sincos(k.u * dr.two_pi)
        # Balls: the circle in which a cone touches.
        D = dr.norm(v)
        axis = v / D
        fx, fy = mi.coordinate_system(axis)
        ring = dr.safe_sqrt(1 - dr.square(dr.rcp(D)))
        on_ball = axis * dr.rcp(D) + (fx * cos + fy * sin) * ring
        # Tubes: the two lines in which planes touch.
        ρ = dr.norm(mi.Point2f(v.x, v.y))
        c = mi.Point2f(v.x, v.y) / ρ
        side = dr.select(k.kind == TUBE_LEFT, 1, -1) * dr.safe_sqrt(1 - dr.square(dr.rcp(ρ)))
        on_tube = mi.Vector3f(c.x / ρ - c.y * side, c.y / ρ + c.x * side, k.u)
        local = dr.select(ball, on_ball, dr.select(tube, on_tube, mi.Vector3f(cos, sin, 0)))
        turning = dr.select(ball, (fy * cos - fx * sin) * ring, mi.Vector3f(-sin, cos, 0)) * dr.two_pi
        along = dr.select(tube, k.z, self._from_local(k, turning))
        n = dr.normalize(local.x * across[0] + local.y * across[1] + dr.select(ball, local.z, 0) * across[2])
        return mi.Point3f(local), along, n, dr.select(ball, D, dr.select(tube, ρ, dr.inf)) > 1

    def _tilted(self, k: Any, local: Any, d: Any) -> Any:
        """Return a place a little towards the viewer, from where a limb shows its lit side."""
        towards, _ = self._to_local(k, d)
        towards.z = dr.select(k.kind == BALL, towards.z, 0)
        turned = local - dr.normalize(towards) * TILT
        turned.z = dr.select(k.kind == BALL, turned.z, 0)
        turned = dr.normalize(mi.Vector3f(turned))
        turned.z = dr.select(k.kind == BALL, turned.z, local.z)
        return turned


def _is_tube(kind: Any) -> Any:
    return (kind == TUBE_LEFT) | (kind == TUBE_RIGHT)


def _across(w: Any, t: Any) -> Any:
    """Return unit vectors along ``w``, across the edge with unit tangent ``t``."""
    return dr.normalize(mi.Vector3f(w - t * dr.dot(w, t)))


def _bend(k: Any, ha: Any, hb: Any) -> Any:
    """Return the weight of a crease, from 0, flat, to 1; two bodies may differ where they are flat."""
    return dr.select(k.flags & SEAM != 0, 1, 0.5 * dr.norm(ha + hb))
