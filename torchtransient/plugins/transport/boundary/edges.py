"""Where one thing may begin to hide another: edges of meshes and rectangles, instances of them, limbs of spheres.

One table for a scene and a job: laid out with numpy outside of kernels, its ends attached to what they come from, so
that reverse mode scatters to one small array. Creases count, too: interior derivatives hold the points of each face on
the rays that found them, and where a face ends under them light jumps from one face to the next.
"""

from __future__ import annotations

import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.around_corner.edges import FLAT, _edge_keys, _joined
from torchtransient.plugins.host_numbers import host_numbers
from torchtransient.plugins.mitsuba_compat import is_instance, is_sphere
from torchtransient.plugins.node_walk import objects_below, objects_of
from torchtransient.plugins.transport.strategy import Local

# Stretches of an edge that a pilot tells apart; share of the samples that it leaves as they were.
CELLS, DEFENSIVE = 16, 0.25
# How far beside an edge one looks past it, in parts of the largest coordinate. Ten times as far, what a fine mesh hides
# of its own outlines is missed: 5 % of the shadow of a torus of 2304 triangles.
BESIDE = 1e-5
# How far inside of its faces paths start at a crease, in parts of the face.
INSET = 1e-3
_BARY = np.array([[0, 0], [1, 0], [0, 1]], float)
# Corners of Mitsuba's rectangle, which counts as two triangles that share the flat diagonal.
_SQUARE, _HALVES = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float), np.array([[0, 1, 2], [2, 3, 0]])


class _Group:
    """The edges of one shape: a function that gives attached points for numbers of corners, and rows of the table."""

    def __init__(self, shape, instance, points, corners, faces, uv, index):
        self.shape, self.instance, self.points, self.index = shape, instance, points, index
        joined = _joined(corners.astype(np.float32), faces)
        key, proper = _edge_keys(joined)
        order = np.argsort(key, kind="stable")
        order = order[proper[order]]
        new = np.flatnonzero(np.diff(key[order], prepend=-1))
        count = np.diff(new, append=len(order))
        # The first and the last face at an edge: of three and more, two are chosen.
        a, b = order[new], order[new + count - 1]
        n = np.cross(corners[faces[:, 1]] - corners[faces[:, 0]], corners[faces[:, 2]] - corners[faces[:, 0]])
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
        kept = (count == 1) | (np.abs((n[a // 3] * n[b // 3]).sum(1)) < 1 - FLAT)
        a, b, self.two = a[kept], b[kept], count[kept] > 1
        at = faces.ravel()
        start, stop = a, a // 3 * 3 + (a + 1) % 3
        self.ends = at[start], at[stop]
        self.third = [corners[at[x // 3 * 3 + (x + 2) % 3]] for x in (a, b)]
        # The other face sees the edge the other way round where it is wound alike.
        turned = joined.ravel()[a] != joined.ravel()[b]
        b0, b1 = b, b // 3 * 3 + (b + 1) % 3
        b0, b1 = np.where(turned, b1, b0), np.where(turned, b0, b1)
        place = (lambda x: uv[at[x]]) if uv is not None else (lambda x: _BARY[x % 3])
        self.uv = [place(x) for x in (start, stop, b0, b1)]
        self.faces = [(x // 3 if uv is None else 0 * x) for x in (a, b)]
        self.positions = [corners[e] for e in self.ends]


def _matrix(shape):
    return mi.Matrix4f(mi.AffineTransform4f(mi.traverse(shape)["to_world"]).matrix)


def _moved(M, p):
    return mi.Point3f(*[M[i, 0] * p.x + M[i, 1] * p.y + M[i, 2] * p.z + M[i, 3] for i in range(3)])


def _members(scene, instance):
    """The shapes of the group of an instance. Mitsuba shows it in words alone."""
    name = re.search(r'name = "(.*?)"', str(instance)).group(1)
    group = next(s for s in objects_below(scene, mi.Shape) if "ShapeGroup" in s.class_name() and s.id() == name)
    return [one for _, one in objects_of(group) if isinstance(one, mi.Shape)]


def _groups_of(scene, shape, instance=None, M=None, index=0xFFFFFFFF):
    """The edges of a shape; ``M``: attached matrix of the instance that it belongs to."""
    if is_instance(shape):
        parts, M = _members(scene, shape), _matrix(shape)
        return [g for k, one in enumerate(parts) for g in _groups_of(scene, one, shape, M, k)]
    if shape.is_mesh():
        buffer = shape.vertex_positions_buffer()
        local, uv = host_numbers(buffer, np.float32).reshape(-1, 3).astype(float), None
        faces = np.array(shape.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        own = lambda i: dr.gather(mi.Point3f, buffer, mi.UInt32(i.astype(np.uint32)))  # noqa: E731
    elif shape.class_name() == "Rectangle":
        local, faces, uv, R = _SQUARE, _HALVES, _SQUARE[:, :2], _matrix(shape)
        own = lambda i: _moved(R, mi.Point3f(*_SQUARE[i].T.astype(np.float32)))  # noqa: E731
    else:
        return []  # cylinders, disks, curves, SDFs: not in this prototype
    points = own if M is None else (lambda i: _moved(M, own(i)))
    with dr.suspend_grad():
        corners = np.array(points(np.arange(len(local)))).T.astype(float)
    return [_Group(shape, instance, points, corners, faces, uv, index)]


class Silhouettes:
    """``moving``: addresses of the shapes that move, whose edges get half of the samples; ``alone``: only they do."""

    def __init__(self, scene: Any, moving: frozenset[Any], alone: bool) -> None:
        shapes = scene.shapes()
        balls = [s for s in shapes if is_sphere(s)]
        with dr.resume_grad():
            groups = [g for s in shapes if not is_sphere(s) for g in _groups_of(scene, s)]
            groups = [g for g in groups if len(g.two)]
            ends = [[g.points(g.ends[i]) for g in groups] for i in (0, 1)]
            for s in balls:
                M = _matrix(s)
                ends[0].append(mi.Point3f(M[0, 3], M[1, 3], M[2, 3]))
                ends[1].append(mi.Point3f(dr.norm(mi.Vector3f(M[0, 0], M[1, 0], M[2, 0])), 0, 0))
            # Attached: ends of segments; centers of balls, and their radii in x.
            self.ends = [mi.Point3f(*[dr.concat([mi.Float(p[k]) for p in e]) for k in range(3)]) for e in ends]
        zero = [np.zeros((len(balls), 3))]

        def stacked(of, type_=mi.Point3f, width=3):
            rows = np.concatenate([of(g) for g in groups] + [np.zeros((len(balls), width))])
            return type_(*np.ascontiguousarray(rows.T.astype(np.float32)))

        owners = [(g.shape, g.instance, g.index, len(g.two)) for g in groups] + [(s, None, 0xFFFFFFFF, 1) for s in balls]
        owner = np.repeat(np.arange(len(owners)), [n for *_, n in owners])
        self.third = [stacked(lambda g, i=i: g.third[i]) for i in (0, 1)]
        self.uv = [stacked(lambda g, i=i: g.uv[i], mi.Point2f, 2) for i in range(4)]
        ids = [np.concatenate([g.faces[i] for g in groups] + [np.zeros(len(balls), int)]) for i in (0, 1)]
        self.faces = [mi.UInt32(i.astype(np.uint32)) for i in ids]
        two = np.concatenate([g.two for g in groups] + [np.ones(len(balls), bool)])
        self.count = len(owner)
        ball = np.arange(self.count) >= self.count - len(balls)
        self.flags = mi.UInt32((two + 2 * ball).astype(np.uint32))
        self.owner = mi.UInt32(owner.astype(np.uint32))
        none = dr.zeros(mi.ShapePtr)
        numbers = lambda which: mi.UInt32(np.array([  # noqa: E731
            0 if o[which] is None or (which == 0 and o[1] is not None) else int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(o[which]))[0]) for o in owners
        ], np.uint32))
        self.shape, self.instance = numbers(0), numbers(1)
        self.index = mi.UInt32(np.array([o[2] for o in owners], np.uint32))
        # ---- density
        e = [np.array(dr.detach(p)).T.astype(float) for p in self.ends]
        length = np.where(ball, 2 * np.pi * e[1][:, 0], np.linalg.norm(e[1] - e[0], axis=1))
        ptr = np.array([(s if i is None else i).ptr for s, i, *_ in owners])
        group_ptr = np.array([s.ptr for s, *_ in owners])
        moves = (np.isin(ptr, list(moving)) | np.isin(group_ptr, list(moving)))[owner]
        p = length / length.sum()
        if moves.any():
            m = np.where(moves, length, 0)
            p = m / m.sum() if alone else 0.5 * p + 0.5 * m / m.sum()
        self.by_length = mi.DiscreteDistribution(mi.Float(np.repeat(p / CELLS, CELLS).astype(np.float32)))
        dr.eval(self.ends, self.third, self.uv, self.faces, self.flags, self.owner, self.shape, self.instance)

    def guided(self, value, cell):
        """The density by the root mean square of a pilot's values in every cell."""
        old = self.by_length
        squares, count = (dr.zeros(mi.Float, self.count * CELLS) for _ in range(2))
        dr.scatter_reduce(dr.ReduceOp.Add, squares, dr.select(dr.isfinite(value), dr.square(value), 0), cell)
        dr.scatter_reduce(dr.ReduceOp.Add, count, mi.Float(1), cell)
        pmf = old.pmf * old.normalization()
        wish = pmf * dr.sqrt(squares / dr.maximum(count, 1))
        total = dr.sum(wish)
        return old if total[0] == 0 else mi.DiscreteDistribution(DEFENSIVE * pmf + (1 - DEFENSIVE) * wish / total)

    def pick(self, density, x, u):
        """An edge and a place along it; the point of a limb waits for who looks at it."""
        cell, pmf = density.sample_pmf(x)
        e = cell // CELLS
        with dr.suspend_grad():
            a, b = (dr.gather(mi.Point3f, dr.detach(end), e) for end in self.ends)
        ball = (dr.gather(mi.UInt32, self.flags, e) & 2) != 0
        along = (mi.Float(cell - e * CELLS) + u) / CELLS
        near = dr.select(ball, a, dr.lerp(a, b, along))
        return Local(cell=cell, pmf=pmf * CELLS, e=e, a=a, b=b, ball=ball, u=along, near=near)

    def choose(self, density, sampler, V, active, candidates, worth):
        """Of several picks, which cost no rays, the one that is seen from ``V`` in proportion to what it may be
        ``worth(d, dist)``: an outline times its span, a crease less, the flatter it is. (Resampling, Talbot et al. 2005.)
        """
        best, total, own = None, mi.Float(0), mi.Float(1)
        for _ in range(candidates):
            k = self.pick(density, sampler.next_1d(), sampler.next_1d())
            if candidates == 1:
                return k
            V_ = mi.Point3f(V)
            d = k.near - V_
            dist = dr.norm(d)
            d /= dist
            third = [dr.gather(mi.Point3f, t, k.e) - k.near for t in self.third]
            across = dr.cross(d, dr.normalize(k.b - k.a))
            same = dr.dot(across, third[0]) * dr.dot(across, third[1]) > 0
            t = dr.normalize(k.b - k.a)
            ha, hb = (dr.normalize(w - t * dr.dot(w, t)) for w in third)
            span = dr.norm(across) * dr.select(same, 1, 0.5 * dr.norm(ha + hb))
            q = dr.select(k.ball, 1, span) * worth(d, dist)
            length = dr.select(k.ball, dr.two_pi * k.b.x, dr.norm(k.b - k.a))
            w = dr.select(active & (k.pmf > 0) & (q > 0), q * length / k.pmf, 0)
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

    def seen_from(self, k, V, active):
        """The point of the picked edge ``k`` seen from ``V``: ``p, d, dist``, ``n`` (out of what hides), ``sin``
        (between edge and line of sight), ``inv_pdf`` (by length), ``crease``, the two faces as intersections, and
        ``beside`` (a little outside).
        """
        R, D = k.b.x, dr.norm(V - k.a)
        axis, (sin, cos) = (V - k.a) / D, dr.sincos(k.u * dr.two_pi)
        fx, fy = mi.coordinate_system(axis)
        ring = dr.safe_sqrt(1 - dr.square(R / D))
        limb = axis * (R / D) + (fx * cos + fy * sin) * ring
        p = dr.select(k.ball, k.a + limb * R, k.near)
        dist = dr.norm(p - V)
        d = (p - V) / dist
        t = dr.select(k.ball, mi.Vector3f(fy * cos - fx * sin), dr.normalize(k.b - k.a))
        across = dr.cross(d, t)
        s = dr.norm(across)
        wa, wb = (dr.gather(mi.Point3f, third, k.e) - p for third in self.third)
        n = across / s
        n = dr.select(k.ball, limb, dr.select(dr.dot(n, wa) > 0, -n, n))
        two = (dr.gather(mi.UInt32, self.flags, k.e) & 1) != 0
        a_in, b_in = -dr.dot(n, wa), -dr.dot(n, wb)
        crease = two & (b_in < 0) & ~k.ball
        # Across the edge, since third corners lie anywhere along it: the nearer face hides.
        e = d - t * dr.dot(d, t)
        other = two & ~crease & ~k.ball & (dr.dot(wb, e) / b_in < dr.dot(wa, e) / a_in)
        length = dr.select(k.ball, dr.two_pi * R * ring, dr.norm(k.b - k.a))
        valid = active & (k.pmf > 0) & (s > 1e-4) & (dist > 1e-3) & (~k.ball | (R < D)) & (dr.max(dr.abs(n)) > 0)
        fa, fb = (dr.gather(mi.UInt32, f, k.e) for f in self.faces)
        ua, ub = (dr.lerp(*(dr.gather(mi.Point2f, self.uv[i + j], k.e) for j in (0, 1)), k.u) for i in (0, 2))
        # Paths that start exactly on concave creases leak: start a little inside of each face.
        ua, ub = (dr.select(crease, u + (mi.Point2f(1 / 3, 1 / 3) - u) * INSET, u) for u in (ua, ub))
        o = dr.gather(mi.UInt32, self.owner, k.e)
        shape, instance = (
            dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, x, o)) for x in (self.shape, self.instance)
        )
        index = dr.gather(mi.UInt32, self.index, o)

        def leg(face, uv, t, valid):
            pi = dr.zeros(mi.PreliminaryIntersection3f)
            pi.valid, pi.t, pi.shape, pi.instance, pi.prim_index, pi.prim_uv = valid, t, shape, instance, face, uv
            pi.shape_index = index
            return pi

        # A little towards who looks, from where the limb shows its lit side.
        tilted = k.a + dr.normalize(limb - d * 2e-3) * R
        q = dr.select(k.ball, tilted, p)
        t_in = dr.norm(q - V)
        beside = p + dr.select(crease, -d, mi.Vector3f(n)) * (BESIDE * (1 + dr.max(dr.abs(p))))
        return Local(
            k=k, V=V, p=p, d=d, dist=dist, n=mi.Vector3f(n), sin=s, inv_pdf=dr.select(k.pmf > 0, length / k.pmf, 0),
            crease=crease, valid=valid, beside=beside, d_in=(q - V) / t_in, limb=limb,
            inner=leg(dr.select(other, fb, fa), dr.select(other, ub, ua), t_in, valid),
            facing=leg(fb, ub, dist, valid & crease),
        )  # fmt: skip

    def moving(self, b):
        """The point, attached to what it is an edge of."""
        a, c = (dr.gather(mi.Point3f, end, b.k.e, b.valid) for end in self.ends)
        return dr.select(b.k.ball, a + b.limb * c.x, dr.lerp(a, c, b.k.u))
