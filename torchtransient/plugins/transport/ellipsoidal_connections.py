"""Ellipsoidal connections: light that arrives while a gate is open, drawn by when it arrives.

From a vertex x, at the optical length l of the path so far, a point e of a light and an arrival τ in the window are
drawn. The vertex w between them lies where ``|xw| + |we| = s = (τ - l) / η``, on an ellipsoid with the foci x and e.

- Surfaces (:class:`EllipsoidalSurface`). The plane of each face of the scene meets the ellipsoid in an ellipse, on
  which an angle φ is drawn. Of the points within faces one is chosen, by the light that it would bring if nothing were
  in the way. With the gradient of s in the plane, the density per area is ``p(τ) η / 2π |grad s| / |dw / dφ|``.
- Media (:class:`EllipsoidalMedium`). Along the ray that left x in the direction ω, the ellipsoid lies at
  ``t = (s^2 - d^2) / (2 (s - ω.(e - x)))`` with ``d = |e - x|``, and the density of t is ``p(τ) η ds/dt``.
- The last segment (:class:`WindowedEmitterSampled`). Points of lights are drawn from the part that the window sees.

Paths find the same vertices w. Of the light that is connected to at w they keep the share ``a^2 / (a^2 + p^2)``, with
the densities ``a`` of their own and ``p`` of ellipsoidal connections, which take the rest. The choice among faces is
not part of ``p``: any weights that sum to one are right. Light that is run into keeps its weight beside connections,
whose density counts more than once there (:data:`PREFERENCE`): it rarely arrives in the window.

Source: Pediredla, Veeraraghavan, Gkioulekas, "Ellipsoidal path connections for time-gated rendering", 2019, who choose
triangles by a hierarchy. Arguments that all methods share are explained in :mod:`.strategy`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.polarized import product
from torchtransient.plugins.sampling.flat_faces import FlatFaces, LightFaces
from torchtransient.plugins.transport.emitter_connections import EmitterSampled, is_light
from torchtransient.plugins.transport.free_flight import medium_interaction, transmittance
from torchtransient.plugins.transport.media import lane_numbers, medium_behind
from torchtransient.plugins.transport.scene_contents import emits_by_place
from torchtransient.plugins.transport.strategy import Connection, Event, Local, Proposal

# Angles that are drawn on each ellipse.
ANGLES = 2
# Factor on the density of connections in the weights beside light that is run into: of little, and it is what few paths
# bring; of much, and the noise near lights in media is that of connections.
PREFERENCE = 32
# Distance, relative to the length of a ray, within which it has found a point.
_FOUND = 1e-3
# Excess of s over the distance of the foci, relative to it, below which nothing is connected.
_LEAST = 1e-5
# Weight in the choice among faces of what only translucent surfaces and lights on both sides would bring.
_BEHIND = 1e-3


def why_not(contents, film):
    """Return the reason why a scene admits no ellipsoidal connections, with a remedy; None if it does.

    Args:
        contents: :class:`~.scene_contents.SceneContents` of the scene.
        film: film of this library.
    """
    if mi.is_polarized:
        return f"the variant {mi.variant()} is polarized; load the scene in one without"
    if film.arrivals() is None:
        return (
            f"expected a film that counts light of a window alone, got {film.plugin} which counts light of all times; "
            "take gates, or a histogram with steady=False"
        )
    if contents.delays is not None:
        return "a surface scatters late, and when depends on a number that is drawn there; take it out"
    if contents.refraction is not None:
        return "a rough surface refracts, behind which paths run in another index of refraction; make it smooth"
    if contents.media is not None and not contents.media.emitter_sampling:
        return "a medium has sample_emitters = false; set it to true"
    return None


# --------------------------------------------------------------------------------------------------------------------
# Tables, kept as long as no shape moves. Derivatives, which are those of ordinary connections, have none.

def flat_faces(scene, contents):
    """Return the :class:`~..sampling.flat_faces.FlatFaces` that can be connected to lights.

    Args:
        scene: Mitsuba scene.
        contents: its :class:`~.scene_contents.SceneContents`, which keeps them.
    """
    shapes = [shape for shape in scene.shapes() if _scatters(shape)]
    numbers = tuple(map(registry_number, shapes))
    return _as_they_stand(scene, contents).get("flat faces", numbers, lambda: FlatFaces(shapes))


def _light_faces(scene, contents):
    """Return the :class:`~..sampling.flat_faces.LightFaces` of a scene."""
    weights = tuple(emitter.sampling_weight() for emitter in scene.emitters())
    return _as_they_stand(scene, contents).get("light faces", weights, lambda: LightFaces(scene, emits_by_place))


def _as_they_stand(scene, contents):
    return contents.memory.get("memory of faces", 0, lambda: Cache(scene.shapes()))


# --------------------------------------------------------------------------------------------------------------------
# The last segment.

class WindowedEmitterSampled(EmitterSampled):
    """Connection to a point of a light that the window sees, where ellipsoidal connections leave it light.

    Lights that are not flat or not alike everywhere are sampled as without a window.
    """

    # Connections that take a share of the light.
    beside: tuple = ()

    def prepare(self, context):
        super().prepare(context)
        self.faces = _light_faces(context.scene, context.contents)
        if not self.faces.count:
            raise SceneError(
                "connections='ellipsoidal': expected an area light on a mesh or rectangle without texture, found none. "
                "Add one, or leave the ordinary connections."
            )

    def density(self, context, ref, ds, active):
        pdf = super().density(context, ref, ds, active)
        return dr.select(self.faces.lists(ds.emitter), PREFERENCE, 1) * pdf

    def propose(self, context, path, vertex, sampler):
        active = context.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        u, window = sampler.next_2d(), context.window
        listed = mi.Mask(True)
        if not self.faces.holds_all:
            other, other_weight = self.sample(context, vertex.at, u, active)
            number, _, _ = context.scene.sample_emitter(u.x, active)
            listed = self.faces.lists(dr.gather(mi.EmitterPtr, context.scene.emitters_dr(), number, active))
            u = sampler.next_2d()
        ends = (mi.Float(mi.Float64(end) - vertex.scattered_τ) / vertex.η for end in (window.first, window.last))
        e = self.faces.sample_between(mi.Point3f(vertex.at.p), *ends, u, active & listed)
        ds = _towards(vertex.at, e)
        cos = dr.abs_dot(e.n, ds.d)
        lit = active & listed & (e.pdf > 0) & (cos > 0)
        # The density by which the weights beside light that is run into go.
        ds.pdf = dr.select(lit, self.density(context, vertex.at, ds, lit), 0)
        weight = e.emitter.eval_direction(vertex.at, ds, lit) * dr.select(lit, cos / (e.pdf * dr.square(ds.dist)), 0)
        if not self.faces.holds_all:
            ds, weight = dr.select(listed, ds, other), dr.select(listed, weight, other_weight)
        return Proposal(d=ds.d, active=active & (ds.pdf > 0), ds=ds, weight=weight, u=u, sampler=sampler)

    def connect(self, context, path, vertex, proposal, answer, zeros):
        event = super().connect(context, path, vertex, proposal, answer, zeros)
        taken = event.active & self.faces.lists(proposal.ds.emitter)
        for connection in self.beside:
            share = connection.share_of_paths(context, path, vertex, proposal.ds)
            event.value *= dr.select(taken & dr.isfinite(share), share, 1)
        return event


def _towards(ref, e):
    """Return the DirectionSample3f of a :class:`~..sampling.flat_faces.LightPoint`, seen from an interaction."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.time, ds.emitter = e.p, e.n, ref.time, e.emitter
    ds.dist = dr.norm(e.p - ref.p)
    ds.d = (e.p - ref.p) / ds.dist
    return ds


class Ellipsoidal(Connection):
    """Base of connections over a vertex that is drawn by the arrival of its light.

    Args:
        lights: :class:`WindowedEmitterSampled` of the walk.
    """

    light_of_scene_alone = True
    finds_light = False

    def __init__(self, lights):
        self.lights = lights

    def prepare(self, context):
        self.first, self.width = context.window.first, context.window.last - context.window.first

    def arrival(self, u, τ, η):
        """Draw an arrival.

        Args:
            u: uniform number.
            τ: optical path length up to the first focus, minus the film's start, Float64.
            η: index of refraction behind it.

        Returns:
            (optical path length, Float64; sum of the distances to the foci that it leaves, Float).
        """
        opl = mi.Float64(self.first) + mi.Float64(u) * self.width
        return opl, mi.Float(opl - τ) / η

    def second_focus(self, x, s, u, active):
        """Draw a point of a light that is nearer to the first focus than ``s``.

        Near lights that bounds the light over the density.
        """
        e = self.lights.faces.sample_between(x, mi.Float(0), s / (1 + _LEAST), u, active)
        e.pdf = dr.select(dr.norm(e.p - x) * (1 + _LEAST) < s, e.pdf / self.lights.faces.share, 0)
        return e

    def preference(self, w, e):
        """Return the density of light points from ``w`` that the window sees, over that of all points of the light.

        About, for weights: a ring of the window's width at the distance of ``e``.
        """
        return 1 + dr.inv_two_pi * self.lights.faces.area / (self.width * dr.norm(w - e))

    def last_segment(self, context, at, e, value, pdf, active):
        """Return the light from a point of a light over its density, by the share that connections have beside light
        that is run into.

        Args:
            at: interaction at the vertex between.
            e: point of the light.
            value, pdf: scattering towards it, and its density.
        """
        ds = _towards(at, e)
        density = self.lights.density(context, at, ds, active)
        weight = self.lights.weight(context, at, ds, density, pdf, active)
        Le = mi.unpolarized_spectrum(e.emitter.eval_direction(at, ds, active))
        return Le * value * (dr.abs_dot(e.n, ds.d) / (dr.square(ds.dist) * e.pdf) * weight)

    @staticmethod
    def cleared(context, ray, length, medium, u, sampler, active):
        """Return (mask of segments that nothing is in the way of, transmittance).

        Args:
            ray: Ray3f that ends before the point that it leads to.
            length: length that attenuates, metres.
            medium: medium at its start, None in vacuum.
            u: uniform numbers that were drawn for the segment.
        """
        if context.contents.media is None:
            return active & ~context.scene.ray_test(ray, active), 1
        settings, lanes = context.segment.settings, lane_numbers(sampler)
        T, free = transmittance(context.scene, settings, ray, length, medium, u, lanes, active)
        return free, T


# --------------------------------------------------------------------------------------------------------------------
# Surfaces.

class Section:
    """Ellipse in which an ellipsoid of revolution meets a plane: ``center + p cos φ + q sin φ``.

    Args:
        x, e: foci of the ellipsoid, Point3f.
        s: sum of the distances to the foci.
        n, o: normal and a point of the plane.

    Attributes:
        exists: mask of planes that meet the ellipsoid.
    """

    def __init__(self, x, e, s, n, o):
        d = dr.norm(e - x)
        axis = (e - x) / d
        along = dr.dot(n, axis)
        # Squares: of the half axis across, of half the distance of the foci, of the reach along the normal.
        β2, f2 = 0.25 * (s - d) * (s + d), 0.25 * dr.square(d)
        reach2 = β2 + f2 * dr.square(along)
        δ = dr.dot(n, o - x) - 0.5 * d * along
        left = 1 - dr.square(δ) / reach2
        self.exists = left > 0
        self.center = x + axis * (0.5 * d) + (n * β2 + axis * (f2 * along)) * (δ / reach2)
        across = dr.cross(n, axis)
        size = dr.norm(across)
        # Any direction of a plane across the axis, which meets the ellipsoid in a circle.
        across = dr.select(size > 1e-4, across / size, mi.Frame3f(n).s)
        reach = dr.sqrt(dr.maximum(left * β2, 0))
        self.p, self.q = across * reach, dr.cross(n, across) * (reach * dr.sqrt((β2 + f2) / reach2))

    def point(self, sin, cos):
        """Return (point at an angle φ, its derivative by φ)."""
        return self.center + self.p * cos + self.q * sin, self.q * cos - self.p * sin

    def derivative_at(self, w):
        """Return the derivative by φ at a point of the ellipse."""
        away = w - self.center
        cos, sin = dr.dot(away, self.p) / dr.squared_norm(self.p), dr.dot(away, self.q) / dr.squared_norm(self.q)
        return self.q * cos - self.p * sin


class EllipsoidalSurface(Ellipsoidal):
    """Connection over a vertex on a face of the scene.

    Args:
        lights: :class:`WindowedEmitterSampled` of the walk.
        faces: :class:`~..sampling.flat_faces.FlatFaces`, one at least.
    """

    name = "ellipsoidal_surface"

    def __init__(self, lights, faces):
        super().__init__(lights)
        self.faces = faces

    def density_between(self, x, e, w, n, along, η):
        """Return the density per area of a vertex for given foci, without the choice among faces.

        Args:
            along: derivative of w by the angle.
        """
        gradient = dr.normalize(w - x) + dr.normalize(w - e)
        gradient -= n * dr.dot(n, gradient)
        return dr.norm(gradient) / dr.norm(along) * (dr.inv_two_pi / self.width) * η

    def share_of_paths(self, context, path, vertex, ds):
        """Return the share that paths keep of a connection at ``vertex`` to the point ``ds`` of a listed light."""
        x, w, n, e = path.prev_p, vertex.si.p, vertex.si.n, ds.p
        drawn = ~path.prev_unconnected & vertex.surface & vertex.si.is_valid() & self.faces.lists(vertex.si.shape)
        r = dr.norm(w - x)
        s = r + dr.norm(w - e)
        drawn &= (dr.dot(n, x - w) * dr.dot(n, e - w) > 0) & (s > dr.norm(e - x) * (1 + _LEAST))
        a = path.prev_pdf * dr.abs_dot(n, w - x) / (r * r * r)
        p = self.density_between(x, e, w, n, Section(x, e, s, n, w).derivative_at(w), path.η)
        return dr.select(drawn, dr.square(a) / (dr.square(a) + dr.square(p)), 1)

    def propose(self, context, path, vertex, sampler):
        active = vertex.goes_on & vertex.connectable & (path.depth + 2 < context.max_depth)
        active = context.deep_enough(active, path.depth + 3)
        u, x = sampler.next_2d(), mi.Point3f(vertex.at.p)
        opl, s = self.arrival(u.x, vertex.scattered_τ, vertex.η)
        e = self.second_focus(x, s, sampler.next_2d(), active)
        active &= e.pdf > 0
        n = dr.mulsign(mi.Normal3f(vertex.si.n), -dr.dot(vertex.si.n, path.ray.d))
        n_x = dr.select(vertex.surface, n, 0)
        face, w, n, along, chance = _choose(self, x, n_x, e, s, u.y, sampler.next_1d(), mi.Mask(active))
        active &= chance > 0
        d = dr.select(active, vertex.at.spawn_ray_to(w).d, mi.Vector3f(0, 0, 1))
        ds = Local(p=w, emitter=None)
        return Proposal(
            d=d, active=active, ds=ds, e=e, face=face, w=w, n=n, along=along, chance=chance, opl=opl, u=u,
            sampler=sampler,
        )  # fmt: skip

    def connect(self, context, path, vertex, proposal, answer, zeros):
        x, w, n, e, u = mi.Point3f(vertex.at.p), proposal.w, proposal.n, proposal.e, proposal.u
        active = proposal.active & is_light(answer.value)
        active = context.counted(active, proposal.opl)
        r = dr.norm(w - x)
        # ------------------------------------------------------------------------- from x to w
        ray = vertex.at.spawn_ray(proposal.d)
        pi = context.segment.next_surface(context, ray, active)
        active &= pi.is_valid() & self.faces.is_on(proposal.face, pi, active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        active &= dr.norm(si.p - w) < _FOUND * r
        medium, T = None, 1
        if context.contents.media is not None:
            medium = medium_behind(vertex.si, ray.d, vertex.medium, vertex.surface)
            numbers = [u.x, u.y, mi.Float(1)]
            to = vertex.at.spawn_ray_to(w)
            active, T = self.cleared(context, to, r, medium, numbers, proposal.sampler, active)
            medium = context.segment.medium_at(context, w, x, medium, active)
        # ------------------------------------------------------------------------- from w to e
        to = si.spawn_ray_to(e.p)
        value, pdf = context.scattering.value_at(context, si, to.d, ray, proposal.sampler, active)
        active &= is_light(value)
        active, T_e = self.cleared(context, to, dr.norm(e.p - w), medium, [u.x, u.y], proposal.sampler, active)
        value = self.last_segment(context, si, e, value, pdf, active)
        # ------------------------------------------------------------------------- weight
        p = self.density_between(x, e.p, w, n, proposal.along, vertex.η)
        cos = dr.abs_dot(n, w - x) / (r * r * r)
        a = answer.pdf * cos
        factor = cos * p / ((dr.square(a) + dr.square(p)) * proposal.chance)
        value = product(vertex.β, answer.value) * (value * T * T_e) * dr.select(active, factor, 0)
        return Event(value=value, opl=proposal.opl, active=active, depth=path.depth + 3, crowded=True)


@dr.syntax
def _choose(connection, x, n_x, e, s, u_angle, u, active):
    """Choose a point of the faces where the sum of the distances to the foci is ``s``.

    Args:
        connection: :class:`EllipsoidalSurface`.
        x, n_x: first focus and its normal on the side of the sensor, zero in a medium.
        e: second focus, :class:`~..sampling.flat_faces.LightPoint`.
        s: sum of the distances, metres.
        u_angle, u: uniform numbers for the angles and the choice.
        active: mask of lanes.

    Returns:
        (number of a face; point of it; its normal; derivative by the angle; weight of the point over the mean that all
        weights have, 0 for none).
    """
    found, w, n, along = mi.UInt32(0), mi.Point3f(x), mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0)
    best, total = mi.Float(0), mi.Float(0)
    angles = [dr.sincos(dr.two_pi / ANGLES * (u_angle + k)) for k in range(ANGLES)]
    i, going = mi.UInt32(0), active & (connection.faces.count > 0)
    while dr.hint(going, label="faces"):
        face = connection.faces.face(i)
        w, n, along, best, total, u, taken = _among(
            face, connection, x, n_x, e, s, angles, w, n, along, best, total, u
        )
        found = dr.select(taken, i, found)
        i += 1
        going = active & (i < connection.faces.count)
    return found, w, n, along, dr.select(total > 0, best * ANGLES / total, 0)


def _among(face, connection, x, n_x, e, s, angles, w, n, along, best, total, u):
    """Return the choice among the points of one more face, by weights (a reservoir of one)."""
    section = Section(x, e.p, s, face.n, face.o)
    h, h_e = dr.dot(face.n, face.o - x), dr.dot(face.n, face.o - e.p)
    meets, is_here = section.exists & (h * h_e > 0), mi.Mask(False)
    for sin, cos in angles:
        point, derivative = section.point(sin, cos)
        a, b = dr.dot(point - face.o, face.U), dr.dot(point - face.o, face.V)
        inside = meets & (a > 0) & (b > 0) & (a < 1) & (b < 1) & (a + b < face.most)
        weight = _unoccluded(connection.width, x, n_x, e, s, point, derivative, h, h_e)
        weight = dr.select(inside & dr.isfinite(weight), weight, 0)
        total = total + weight
        share = dr.select(weight > 0, weight / total, 0)
        taken = u < share
        # What is left of the number is uniform again.
        u = dr.select(taken, u / share, (u - share) / (1 - share))
        w, n, along = dr.select(taken, point, w), dr.select(taken, face.n, n), dr.select(taken, derivative, along)
        best, is_here = dr.select(taken, weight, best), is_here | taken
    return w, n, along, best, total, u, is_here


def _unoccluded(width, x, n_x, e, s, w, along, h, h_e):
    """Return the share of light by a point that ellipsoidal connections take, over its density.

    Of Lambertian surfaces without colour and with nothing in the way.

    Args:
        width: width of the window, metres.
        h, h_e: distances of the foci from the plane of the point, with a sign.
    """
    inv_r = dr.rsqrt(dr.squared_norm(w - x))
    inv_r_e = dr.rcp(s - dr.rcp(inv_r))
    ω, to_w = (w - x) * inv_r, (w - e.p) * inv_r_e
    cos_x = dr.select(dr.all(n_x == 0), 0.25, _facing(dr.dot(n_x, ω)))
    cos_w, cos_w_e = dr.abs(h) * inv_r, dr.abs(h_e) * inv_r_e
    gradient2 = dr.squared_norm(ω + to_w) - dr.square(h * inv_r + h_e * inv_r_e)
    p = dr.sqrt(dr.maximum(gradient2, 0) / dr.squared_norm(along)) * (dr.inv_two_pi / width)
    a = cos_x * dr.inv_pi * cos_w * dr.square(inv_r)
    light = cos_x * cos_w * cos_w_e * _facing(dr.dot(e.n, to_w)) * dr.square(inv_r * inv_r_e)
    return light * p / (dr.square(a) + dr.square(p))


def _scatters(shape):
    """Return True for shapes that can be connected to lights."""
    return shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Smooth)


def _facing(cos):
    """Return a cosine, and little of it on the other side."""
    return dr.select(cos > 0, cos, -_BEHIND * cos)


# --------------------------------------------------------------------------------------------------------------------
# Media.

class EllipsoidalMedium(Ellipsoidal):
    """Connection over a vertex in a medium, on the segment that led to the vertex of the walk."""

    name = "ellipsoidal_medium"

    def density_between(self, ω, w, e, η):
        """Return the density of the distance along the segment for a given light point."""
        return (1 + dr.dot(ω, dr.normalize(w - e))) * (η / self.width)

    def draws_on(self, context, path):
        """Return a mask of segments on which vertices are drawn."""
        if context.hide_emitters or context.camera_unwarp or context.segment.clip is not None:
            return path.active & (path.depth > 0)
        return path.active

    def share_of_paths(self, context, path, vertex, ds):
        """Return the share that paths keep of a connection at ``vertex`` to the point ``ds`` of a listed light."""
        a = _collision_density(vertex.mei, vertex.scatter) * self.preference(vertex.at.p, ds.p)
        p = self.density_between(path.ray.d, vertex.at.p, ds.p, path.η)
        drawn = vertex.scatter & self.draws_on(context, path)
        return dr.select(drawn, dr.square(a) / (dr.square(a) + dr.square(p)), 1)

    def propose(self, context, path, vertex, sampler):
        active = self.draws_on(context, path) & (path.depth + 1 < context.max_depth)
        active = context.deep_enough(active, path.depth + 2)
        u = sampler.next_2d()
        opl, s = self.arrival(u.x, path.τ, path.η)
        e = self.second_focus(path.prev_p, s, sampler.next_2d(), active)
        active &= e.pdf > 0
        # The direction is that of the segment, for which nothing is asked.
        return Proposal(
            d=mi.Vector3f(0, 0, 1), active=mi.Mask(False), ds=Local(p=mi.Point3f(0), emitter=None), drawn=active, e=e,
            opl=opl, s=s, u=u, sampler=sampler,
        )  # fmt: skip

    def connect(self, context, path, vertex, proposal, answer, zeros):
        sampler = proposal.sampler
        x, ω, e, u = path.prev_p, path.ray.d, proposal.e, proposal.u
        d2 = dr.squared_norm(e.p - x)
        t = (dr.square(proposal.s) - d2) / (2 * (proposal.s - dr.dot(ω, e.p - x)))
        active = context.counted(proposal.drawn, proposal.opl) & (t > 0)
        w = x + ω * t
        # ------------------------------------------------------------------------- from x to w
        ray = mi.Ray3f(path.ray)
        ray.maxt = t
        begin = vertex.leg["begin"]
        active, T = self.cleared(context, ray, t, begin, [u.x, u.y, mi.Float(1)], sampler, active)
        medium = context.segment.medium_at(context, w, ray.o, begin, active)
        active &= medium != None  # noqa: E711 (a Dr.Jit comparison)
        mei = medium_interaction(ray, medium, t)
        mei.p = w
        # ------------------------------------------------------------------------- from w to e
        value, pdf = context.scattering.value_in_medium(mei, dr.normalize(e.p - w), vertex.u_phase, active)
        active &= is_light(value)
        to = mei.spawn_ray_to(e.p)
        active, T_e = self.cleared(context, to, dr.norm(e.p - w), medium, [u.x, u.y], sampler, active)
        value = self.last_segment(context, mei, e, value, pdf, active)
        # ------------------------------------------------------------------------- weight
        a, p = _collision_density(mei, active) * self.preference(w, e.p), self.density_between(ω, w, e.p, path.η)
        factor = p / (dr.square(a) + dr.square(p))
        value = mi.unpolarized_spectrum(path.β) * (value * T * T_e) * dr.select(active, factor, 0)
        return Event(value=value, opl=proposal.opl, active=active, depth=path.depth + 2, crowded=True)


def _collision_density(mei, active):
    """Return the density of collisions that weights go by: that of the majorant, without the attenuation before."""
    return dr.mean(mi.unpolarized_spectrum(mei.medium.get_majorant(mei, active)))
