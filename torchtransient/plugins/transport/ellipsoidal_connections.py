"""Ellipsoidal connections: the vertex between a path and a light, drawn where a gate or a window looks.

From a vertex x, at the optical length l of the path so far, a point e of a light and an arrival tau in the window are
drawn. The vertex w between them lies where |xw| + |we| = s = (tau - l) / eta: on an ellipsoid with the foci x and e. A
half-plane that begins at the axis of the foci, at the angle psi around it, cuts the ellipsoid in half an ellipse, and
that meets the flat faces of the scene in few points, in closed form. One of them is chosen, by what light it would
bring without occlusion. Faces are areas, so that the density of w is

    p(w) = p(s) p(psi) |n . (grad s x grad psi)|,    grad s = u_x + u_e,    grad psi = a x (w - x) / |a x (w - x)|^2,

with the unit vectors u from the foci to w, that of the axis a, and the normal n of the face.

Source: Pediredla, Veeraraghavan, Gkioulekas, "Ellipsoidal path connections for time-gated rendering", 2019; the
half-plane in place of their ellipse in the plane of a triangle makes the density of a vertex a function of x, w, e and
n alone, so that the ordinary connections at w know it without looking for the triangle.

Both techniques share what connections to lights have of a path (:class:`EmitterSampled`): ordinary ones keep the share
``a^2 / (a^2 + p^2)`` with the density ``a`` with which scattering at x finds w, ellipsoidal ones take the rest. Light
that is run into keeps its weight.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import PointerTable, floats, registry_number, whole_numbers
from torchtransient.plugins.mitsuba_compat import has_smooth_shape, lacks_directions
from torchtransient.plugins.polarized import product
from torchtransient.plugins.sampling.area_elements import AreaElements
from torchtransient.plugins.sampling.hidden_elements import packed
from torchtransient.plugins.transport.emitter_connections import EmitterSampled
from torchtransient.plugins.transport.scene_contents import emits_by_place
from torchtransient.plugins.transport.strategy import Connection, Event, Local, Proposal

# Faces that are looked through at every vertex.
MOST_FACES = 64
# Numbers of a face in its table.
_ROW = 16
# Relative distance within which a ray has found a point.
_FOUND = 1e-3
# Excess of the length over the distance of the foci, relative, below which nothing is connected.
_LEAST = 1e-5


class Faces:
    """Parallelograms and triangles of meshes, in a table that kernels look through.

    Args:
        shapes: shapes of the scene.

    Attributes:
        count: number of faces.
    """

    def __init__(self, shapes):
        parts, rows = [], []
        for shape in shapes:
            if shape.is_mesh():
                elements = AreaElements.from_shapes([shape])
                found = faces_of(elements)
                parts.append((elements.area.sum() / len(found), shape, found))
        self.shapes = []
        for _, shape, found in sorted(parts, key=lambda part: -part[0]):
            if len(rows) + len(found) <= MOST_FACES:
                self.shapes.append(shape)
                rows += [_row(*face) for face, _ in found]
        self.count = len(rows)
        self._listed = PointerTable.marking(self.shapes)
        self._table = packed(np.array(rows).reshape(-1, _ROW)) if rows else None

    def lists(self, shape):
        """Return a mask of pointers to shapes in the table."""
        return self._listed.lists(shape)

    def face(self, i):
        """Return face number ``i``: corner ``o``, normal ``n``, dual edges ``U``, ``V`` and the reach of ``u + v``."""
        r = [dr.gather(mi.Vector4f, self._table, i * 4 + k) for k in range(4)]
        return Local(
            o=mi.Point3f(r[0].x, r[0].y, r[0].z), n=mi.Normal3f(r[1].x, r[1].y, r[1].z),
            U=mi.Vector3f(r[2].x, r[2].y, r[2].z), V=mi.Vector3f(r[3].x, r[3].y, r[3].z), most=r[0].w,
        )  # fmt: skip


def faces_of(elements):
    """Return ((corner, edge, edge, most of the sum of coordinates), number of an element) of the faces of a mesh.

    Pairs of triangles that make up a parallelogram are one face.
    """
    faces, i = [], 0
    o, e1, e2 = (elements.axes[:, k] for k in range(3))
    while i < len(elements):
        face, step = (o[i], e1[i], e2[i], 1.0), 1
        if i + 1 < len(elements):
            whole = parallelogram([o[i], o[i] + e1[i], o[i] + e2[i]], [o[i + 1], o[i + 1] + e1[i + 1], o[i + 1] + e2[i + 1]])
            if whole is not None:
                face, step = (*whole, 2.0), 2
        if elements.area[i] > 0:
            faces.append((face, i))
        i += step
    return faces


def parallelogram(one, other):
    """Return (corner, edge, edge) of the parallelogram of two triangles, None if they are none."""
    size = np.abs(np.subtract(one[1:], one[0])).max()
    shared = [(i, k) for i in range(3) for k in range(3) if np.abs(one[i] - other[k]).max() < 1e-5 * size]
    if len(shared) != 2:
        return None
    apex = one[3 - shared[0][0] - shared[1][0]]
    far = other[3 - shared[0][1] - shared[1][1]]
    a, b = (one[i] - apex for i, _ in shared)
    return (apex, a, b) if np.abs(apex + a + b - far).max() < 1e-5 * size else None


def _row(o, e1, e2, most):
    n = np.cross(e1, e2)
    n /= np.linalg.norm(n)
    U, V = np.cross(e2, n), np.cross(n, e1)
    U, V = U / (U @ e1), V / (V @ e2)
    return [*o, most, *n, 0.0, *U, 0.0, *V, 0.0]


class LightFaces:
    """Faces of the area lights that are alike everywhere: points of them, anywhere or at a given distance.

    Args:
        context: :class:`.context.RenderContext` of the job.

    Attributes:
        count: number of faces.
        holds_all: the scene has no other lights.
    """

    def __init__(self, context):
        emitters = context.scene.emitters()
        lit = [e for e in emitters if _is_listed(e, context.contents)]
        self.emitters, self.holds_all = PointerTable.marking(lit), len(lit) == len(emitters)
        total = sum(e.sampling_weight() for e in emitters)
        rows, chances, owners = [], [], []
        for emitter in lit:
            elements = AreaElements.from_shapes([emitter.get_shape()])
            found = faces_of(elements)
            areas = np.array([_area(face) for face, _ in found])
            for (face, i), area in zip(found, areas, strict=True):
                chance = emitter.sampling_weight() / total * area / areas.sum()
                o, e1, e2, most = face
                rows.append([*o, chance / area, *e1, most, *e2, chance, *elements.normal[i], 0.0])
                chances.append(chance)
                owners.append(emitter)
        self.count = len(rows)
        if self.count:
            self._table = packed(np.array(rows))
            self._choice = mi.DiscreteDistribution(floats(np.array(chances)))
            self._numbers = whole_numbers(np.array([registry_number(owner) for owner in owners]))

    def face(self, u, active):
        """Choose a face by a number ``u``, which is returned as one that is uniform again."""
        i, u = self._choice.sample_reuse(u, active)
        r = [dr.gather(mi.Vector4f, self._table, i * 4 + k, active) for k in range(4)]
        o, e1, e2, n = (mi.Vector3f(q.x, q.y, q.z) for q in r)
        emitter = dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self._numbers, i, active))
        return Local(o=o, e1=e1, e2=e2, n=n, pdf=r[0].w, most=r[1].w, chance=r[2].w, emitter=emitter), u

    def sample(self, u, active):
        """Draw a point: ``p``, ``n``, its ``emitter`` and its density ``pdf`` per area."""
        face, v = self.face(u.x, active)
        return Local(p=self.point(face, v, u.y), n=mi.Normal3f(face.n), emitter=face.emitter, pdf=face.pdf)

    @staticmethod
    def point(face, a, b):
        """Return a point of a face, uniformly by two numbers; those beyond the diagonal of a triangle are mirrored."""
        over = a + b > face.most
        a, b = dr.select(over, 1 - a, a), dr.select(over, 1 - b, b)
        return mi.Point3f(face.o + face.e1 * a + face.e2 * b)

    def sample_between(self, x, first, last, u, active):
        """Draw a point at a distance between ``first`` and ``last`` from ``x``; ``pdf`` is 0 where that misses the light.

        In the plane of a face these are the points between two circles around the foot of x. The box of the face in
        the square of the radius and the angle is cut by those of the circles, and drawn from evenly.
        """
        face, v = self.face(u.x, active)
        n = face.n
        h = dr.dot(n, x - face.o)
        foot = x - n * h
        corners = [face.o, face.o + face.e1, face.o + face.e2]
        corners.append(dr.select(face.most > 1.5, corners[1] + face.e2, corners[1]))
        middle = dr.select(face.most > 1.5, face.e1 + face.e2, (face.e1 + face.e2) * (2 / 3)) * 0.5 + face.o
        around = [c - foot for c in corners]
        g = dr.normalize(middle - foot)
        t = dr.cross(n, g)
        angles = [dr.atan2(dr.dot(c, t), dr.dot(c, g)) for c in around]
        low, high = (f(f(angles[0], angles[1]), f(angles[2], angles[3])) for f in (dr.minimum, dr.maximum))
        squares = [dr.squared_norm(c) for c in around]
        outer = dr.maximum(dr.maximum(squares[0], squares[1]), dr.maximum(squares[2], squares[3]))
        # Edges in a ring: of a parallelogram o, o + e1, o + e1 + e2, o + e2.
        ring = [around[0], around[1], around[3], around[2]]
        inner = mi.Float(dr.inf)
        crosses = []
        for i in range(4):
            p, edge = ring[i], ring[(i + 1) % 4] - ring[i]
            size = dr.squared_norm(edge)
            along = dr.clip(-dr.dot(p, edge) / dr.maximum(size, 1e-30), 0, 1)
            inner = dr.minimum(inner, dr.squared_norm(p + edge * along))
            crosses.append(dr.dot(n, dr.cross(p, edge)))
        within = mi.Mask(True)
        left, right = mi.Mask(True), mi.Mask(True)
        for c in crosses:
            left, right = left & (c >= 0), right & (c <= 0)
        within = left | right
        inner = dr.select(within, 0, inner)
        low, high = dr.select(within, -dr.pi, low), dr.select(within, dr.pi, high)
        h2 = dr.square(h)
        begin = dr.maximum(inner * (1 - _LEAST), dr.select(first > 0, dr.square(first), 0) - h2)
        end = dr.minimum(outer * (1 + _LEAST), dr.select(last > 0, dr.square(last), 0) - h2)
        square = dr.fma(v, end - begin, begin)
        sin, cos = dr.sincos(dr.fma(u.y, high - low, low))
        p = foot + (g * cos + t * sin) * dr.sqrt(dr.maximum(square, 0))
        a, b = _coordinates(p - face.o, face.e1, face.e2)
        hit = (end > begin) & (a >= 0) & (b >= 0) & (a <= 1) & (b <= 1) & (a + b <= face.most)
        ring = 0.5 * (end - begin) * (high - low)
        pdf = dr.select(hit, face.chance / ring, 0)
        # A part that is hardly smaller than the face is drawn from as the face.
        whole = ring * face.pdf > face.chance
        p, pdf = dr.select(whole, self.point(face, v, u.y), p), dr.select(whole, face.pdf, pdf)
        return Local(p=mi.Point3f(p), n=mi.Normal3f(n), emitter=face.emitter, pdf=dr.select(active, pdf, 0))


def _coordinates(p, e1, e2):
    """Return the coordinates of a vector along two edges."""
    a, b, c = dr.squared_norm(e1), dr.dot(e1, e2), dr.squared_norm(e2)
    u, v, det = dr.dot(p, e1), dr.dot(p, e2), a * c - b * b
    return (u * c - v * b) / det, (v * a - u * b) / det


def _is_listed(emitter, contents):
    """Return True for lights on meshes whose emission is the same everywhere and known by the direction."""
    shape = emitter.get_shape()
    if shape is None or not shape.is_mesh() or emits_by_place(emitter) or lacks_directions(emitter):
        return False
    return not (has_smooth_shape(emitter) or mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta))


def _area(face):
    o, e1, e2, most = face
    return float(np.linalg.norm(np.cross(e1, e2))) * most / 2


class Section:
    """Ellipse in which an ellipsoid of revolution meets a plane: ``center + p cos(phi) + q sin(phi)``.

    Args:
        x, e: foci.
        s: sum of the distances to the foci.
        n: normal of the plane.
        o: point of the plane.
    """

    def __init__(self, x, e, s, n, o):
        D = e - x
        d = dr.norm(D)
        axis = D / d
        m = x + D * 0.5
        n_a = dr.dot(n, axis)
        # Squares of the half axes of the ellipsoid.
        α2, β2 = 0.25 * dr.square(s), 0.25 * (s - d) * (s + d)
        E2 = β2 + 0.25 * dr.square(d * n_a)
        δ = dr.dot(n, o - m)
        λ2 = 1 - dr.square(δ) / E2
        self.exists = λ2 > 0
        self.center = m + (n * β2 + axis * (0.25 * dr.square(d) * n_a)) * (δ / E2)
        across = dr.cross(n, axis)
        size = dr.norm(across)
        across = dr.select(size > 1e-4, across / size, mi.Frame3f(n).s)
        reach = dr.sqrt(dr.maximum(λ2 * β2, 0))
        self.p, self.q = across * reach, dr.cross(n, across) * (reach * dr.sqrt(α2 / E2))

    def point(self, sin, cos):
        """Return the point at an angle phi, and its derivative by phi."""
        return self.center + self.p * cos + self.q * sin, self.q * cos - self.p * sin

    def derivative_at(self, w):
        """Return the derivative of the point by phi at the point ``w``."""
        away = w - self.center
        p2, q2 = dr.squared_norm(self.p), dr.squared_norm(self.q)
        return self.q * (dr.dot(away, self.p) / p2) - self.p * (dr.dot(away, self.q) / q2)


def same_side(x, e, w, n):
    """Return a mask of foci on one side of the plane through ``w``."""
    return dr.dot(n, x - w) * dr.dot(n, e - w) > 0


class Ellipsoidal(Connection):
    """Connection over a vertex that is drawn where the window of the film looks."""

    name = "ellipsoidal"
    light_of_scene_alone = True
    finds_light = False

    def __init__(self, lights):
        self.lights = lights

    def prepare(self, context):
        import os
        self.M, self.c = int(os.environ.get("MM", 2)), float(os.environ.get("CC", 1))
        self.first, self.last = context.window.first, context.window.last
        self.faces, self.points = Faces(context.scene.shapes()), self.lights.faces
        self.works = self.faces.count > 0 and self.points.count > 0

    # ------------------------------------------------------------------------------------------------- density

    def density_of(self, x, e, w, n, along):
        """Return the density per area with which ``w`` is drawn, for given x and e.

        Args:
            along: derivative of w by the angle.
        """
        gradient = dr.normalize(w - x) + dr.normalize(w - e)
        gradient -= n * dr.dot(n, gradient)
        return self.c * dr.norm(gradient) / dr.norm(along) * (dr.inv_two_pi / (self.last - self.first))

    def share_of_others(self, context, path, vertex, ds, opl):
        """Return the share that an ordinary connection at ``vertex`` keeps."""
        x, w, n, e = path.prev_p, vertex.si.p, vertex.si.n, ds.p
        drawn = ~path.prev_unconnected & vertex.si.is_valid() & (opl >= self.first) & (opl < self.last)
        drawn &= self.lights.windowed(ds.emitter) & self.faces.lists(vertex.si.shape) & same_side(x, e, w, n)
        r = dr.norm(w - x)
        s = r + dr.norm(w - e)
        drawn &= s > dr.norm(e - x) * (1 + _LEAST)
        a = path.prev_pdf * dr.abs_dot(n, w - x) / (r * r * r)
        p = self.density_of(x, e, w, n, Section(x, e, s, n, w).derivative_at(w)) * path.η
        share = dr.square(a) / (dr.square(a) + dr.square(p))
        return dr.select(drawn & dr.isfinite(share), share, 1)

    # ------------------------------------------------------------------------------------------------- primal

    def propose(self, context, path, vertex, sampler):
        if not self.works:
            return None
        active = vertex.goes_on & vertex.connectable & (path.depth + 2 < context.max_depth)
        active = context.deep_enough(active, path.depth + 3)
        u, at = sampler.next_2d(), sampler.next_2d()
        e = self.points.sample(u, active)
        x = mi.Point3f(vertex.at.p)
        opl = mi.Float64(self.first) + mi.Float64(at.x) * (self.last - self.first)
        s = mi.Float(opl - vertex.scattered_τ) / vertex.η
        d = dr.norm(e.p - x)
        active &= s > d * (1 + _LEAST)
        n = mi.Normal3f(vertex.si.n)
        n = dr.mulsign(n, -dr.dot(n, path.ray.d))
        w, normal, along, t, total = choose(self, x, n, e, s, at.y, sampler.next_1d(), mi.Mask(active))
        active &= total > 0
        ray = vertex.at.spawn_ray_to(w)
        ds = Local(p=w, emitter=None)
        return Proposal(
            d=dr.select(active, ray.d, mi.Vector3f(0, 0, 1)), active=active, ds=ds, ray=ray, e=e, w=w, n=normal, along=along, opl=opl, s=s,
            choice=dr.select(active, total / (t * self.M), 0),
        )  # fmt: skip

    def connect(self, context, path, vertex, proposal, answer, zeros):
        if proposal is None:
            return Event(value=mi.UnpolarizedSpectrum(0), opl=vertex.τ, active=mi.Bool(False), depth=path.depth)
        x, w, e = mi.Point3f(vertex.at.p), proposal.w, proposal.e
        active = proposal.active & (dr.max(mi.unpolarized_spectrum(answer.value)) > 0)
        active = context.counted(active, proposal.opl)
        # ------------------------------------------------------------------------- to the vertex between
        ray = vertex.at.spawn_ray(proposal.d)
        pi = context.scene.ray_intersect_preliminary(ray, active=active)
        r = dr.norm(w - x)
        active &= dr.abs(pi.t - r) < _FOUND * (1 + r)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        active &= (dr.norm(si.p - w) < _FOUND * r) & (dr.abs_dot(si.n, proposal.n) > 0.999) & self.faces.lists(si.shape)
        # ------------------------------------------------------------------------- to the light
        ds = towards(si, e)
        value, pdf = context.scattering.value_at(context, si, ds.d, ray, active)
        active &= dr.max(mi.unpolarized_spectrum(value)) > 0
        active &= ~context.scene.ray_test(si.spawn_ray_to(e.p), active)
        Le = mi.unpolarized_spectrum(e.emitter.eval_direction(si, ds, active))
        # ------------------------------------------------------------------------- weight
        share = self.lights.weight(context, si, ds, self.lights.density(context, si, ds, active), pdf, active)
        p = self.density_of(x, e.p, w, proposal.n, proposal.along) * vertex.η
        cos_w = dr.abs_dot(proposal.n, w - x) / (r * r * r)
        a = answer.pdf * cos_w
        share *= dr.square(p) / (dr.square(a) + dr.square(p))
        cos_e = dr.abs_dot(e.n, ds.d) / dr.square(ds.dist)
        factor = share * cos_w * cos_e * proposal.choice * self.c / (p * e.pdf)
        value = product(vertex.β, answer.value) * value * Le * dr.select(active, factor, 0)
        return Event(value=value, opl=proposal.opl, active=active, depth=path.depth + 3, crowded=True)


@dr.syntax
def choose(connection, x, n_x, e, s, u_phi, u, active):
    """Choose a point of the faces where the sum of the distances to the foci is ``s``.

    Args:
        connection: :class:`Ellipsoidal`.
        x, n_x: first focus and the normal there, on the side of the sensor.
        e: second focus, with its normal.
        s: sum of the distances to the foci.
        u_phi, u: uniform numbers for the angle and the choice.

    Returns:
        (point, normal of its face, derivative by the angle, its weight, sum of the weights of all).
    """
    w, normal, along = mi.Point3f(x), mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0)
    best, total = mi.Float(0), mi.Float(0)
    angles = [dr.sincos(dr.two_pi / connection.M * (u_phi + m)) for m in range(connection.M)]
    i = mi.UInt32(0)
    going = mi.Mask(active)
    while dr.hint(going, label="faces"):
        face = connection.faces.face(i)
        w, normal, along, best, total, u = among(connection, face, x, n_x, e, s, angles, w, normal, along, best, total, u)
        i += 1
        going = active & (i < connection.faces.count)
    return w, normal, along, best, total


def among(connection, face, x, n_x, e, s, angles, w, normal, along, best, total, u):
    """Return the choice with the points of one more face."""
    n = face.n
    section = Section(x, e.p, s, n, face.o)
    h, h_e = dr.dot(n, face.o - x), dr.dot(n, face.o - e.p)
    meets = section.exists & (h * h_e > 0)
    for sin, cos in angles:
        p, dp = section.point(sin, cos)
        local = p - face.o
        a, b = dr.dot(local, face.U), dr.dot(local, face.V)
        inside = meets & (a > 0) & (b > 0) & (a < 1) & (b < 1) & (a + b < face.most)
        weight = dr.select(inside, connection_weight(connection, n, x, n_x, e, s, p, dp, h, h_e), 0)
        weight = dr.select(dr.isfinite(weight), weight, 0)
        total = total + weight
        share = dr.select(weight > 0, weight / total, 0)
        taken = u < share
        u = dr.select(taken, u / share, (u - share) / (1 - share))
        w, normal, along = dr.select(taken, p, w), dr.select(taken, n, normal), dr.select(taken, dp, along)
        best = dr.select(taken, weight, best)
    return w, normal, along, best, total, u


def connection_weight(connection, n, x, n_x, e, s, p, dp, h, h_e):
    """Return what light a point would bring over its density, without occlusion and colour, by Lambertian surfaces."""
    to = p - x
    r2 = dr.squared_norm(to)
    inv_r = dr.rsqrt(r2)
    length = s - r2 * inv_r
    inv = dr.rcp(length)
    ω, to_e = to * inv_r, (p - e.p) * inv
    cos_x, cos_e = facing(dr.dot(n_x, ω)), facing(dr.dot(e.n, to_e))
    cos_w = dr.abs(h) * inv_r
    gradient = ω + to_e
    # Its length in the plane, since both directions have known cosines.
    g2 = dr.squared_norm(gradient) - dr.square(h * inv_r + h_e * inv)
    p_w = dr.sqrt(dr.maximum(g2, 0) * dr.rcp(dr.squared_norm(dp))) * (connection.c * dr.inv_two_pi / (connection.last - connection.first))
    inv_r2 = dr.square(inv_r)
    a = cos_x * dr.inv_pi * cos_w * inv_r2
    return cos_x * cos_w * dr.abs(h_e) * inv * cos_e * inv_r2 * dr.square(inv) * p_w / (dr.square(a) + dr.square(p_w))


def facing(cos):
    """Return a cosine, and little on the side that is dark unless a surface is translucent."""
    return dr.select(cos > 0, cos, -1e-3 * cos)


def towards(ref, e):
    """Return the DirectionSample3f of a point of a light, seen from ``ref``."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.time, ds.emitter = mi.Point3f(e.p), e.n, ref.time, e.emitter
    away = e.p - ref.p
    ds.dist = dr.norm(away)
    ds.d = away / ds.dist
    return ds


class OrdinarySampled(EmitterSampled):
    """Connection to a point of a light that the window sees, beside :class:`Ellipsoidal`."""

    beside = None

    def prepare(self, context):
        super().prepare(context)
        self.faces = LightFaces(context)

    def windowed(self, emitter):
        """Return a mask of the lights that are sampled where the window sees them."""
        return mi.Mask(True) if self.faces.holds_all else self.faces.emitters.lists(emitter)

    def propose(self, context, path, vertex, sampler):
        if not self.faces.count:
            return super().propose(context, path, vertex, sampler)
        active = context.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        u, window = sampler.next_2d(), context.window
        first, last = (mi.Float(mi.Float64(end) - vertex.scattered_τ) / vertex.η for end in (window.first, window.last))
        e = self.faces.sample_between(mi.Point3f(vertex.at.p), first, last, u, active)
        ds = towards(vertex.at, e)
        cos = -dr.dot(e.n, ds.d)
        lit = active & (e.pdf > 0) & (dr.abs(cos) > 0)
        # By the density of any point of the light, which the weights of others go by.
        ds.pdf = dr.select(lit, self.density(context, vertex.at, ds, lit), 0)
        inverse = dr.select(lit, dr.abs(cos) / (e.pdf * dr.square(ds.dist)), 0)
        weight = e.emitter.eval_direction(vertex.at, ds, lit) * inverse
        if not self.faces.holds_all:
            other, other_weight = self.sample(context, vertex.at, u, active)
            listed = self.windowed(other.emitter)
            ...
        active &= lit & (ds.pdf > 0)
        return Proposal(d=ds.d, active=active, ds=ds, weight=weight, u=u, sampler=sampler)

    def connect(self, context, path, vertex, proposal, answer, zeros):
        event = super().connect(context, path, vertex, proposal, answer, zeros)
        if self.beside is not None and self.beside.works:
            event.value = event.value * self.beside.share_of_others(context, path, vertex, proposal.ds, event.opl)
        return event
