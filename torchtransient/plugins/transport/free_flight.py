"""From a vertex along a straight line to the next event: a collision in a medium, a surface, or nothing.

Homogeneous media are sampled analytically, heterogeneous ones by delta tracking (Woodcock et al. 1965): collisions at
the rate of a majorant, each real with some probability and null otherwise. A line passes null collisions and open
boundaries without bending, so its optical length is the distance between its ends times one index, whatever it passed.

Colours share one sample. The channel that chooses a distance is drawn in proportion to the light it carries, and the
weight divides by the mean of the densities under the same probabilities: the sum over the channels is kept exactly
where nothing is absorbed, and no channel's weight can grow beyond that sum.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.sampling.rays import past, shortest
from torchtransient.plugins.transport.scene_contents import is_open
from torchtransient.plugins.transport.surface_interactions import distance_to

# Streams of random numbers that start from the same number must differ.
WALK, SHADOW = 0x9E3779B9, 0x85EBCA6B


class FreeFlight:
    """End of a free flight; a plain object that only lives within one iteration.

    Args:
        pi: the next surface, counted from the ray's origin.
        scatter: mask of flights that end in a medium; others end at ``pi``, or nowhere if that is not valid.
        t: distance of the end from the ray's origin, metres.
        medium: MediumPtr that the walk ended in.
        weight: transmittance over the probability density of the sample, without the scattering coefficient.
        entry: the last boundary that was passed, if ``media.keeps_entry``.
    """

    def __init__(self, pi, scatter, t, medium, weight, entry):
        self.pi, self.scatter, self.t, self.medium, self.weight, self.entry = pi, scatter, t, medium, weight, entry


def _generator(numbers, lanes, stream):
    """Random numbers of one straight line, a function of the sampler's ``numbers`` and of the lane."""
    bits = mi.UInt32(stream)
    for number in numbers:
        bits ^= dr.reinterpret_array(mi.UInt32, number)
        bits *= 0x2C1B3C6D
        bits ^= bits >> 15
    low, high = mi.sample_tea_32(bits, lanes)
    rng = mi.PCG32()
    # Any state is a good one; the increment has to be odd.
    rng.state = mi.UInt64(low) | (mi.UInt64(high) << 32)
    rng.inc = (mi.UInt64(lanes) << 1) | 1
    rng.next_uint32()
    return rng


def medium_interaction(ray, medium, t):
    """Return the point on a ray inside a medium, a MediumInteraction3f.

    Args:
        ray: Ray3f.
        medium: MediumPtr.
        t: distance along the ray, metres.
    """
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.t = t
    mei.p = ray(t)
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    mei.medium = medium
    return mei


def _channel_probabilities(carried):
    """Probability of each channel, in proportion to the light it carries."""
    total = dr.sum(carried)
    return dr.select(total > 0, carried / total, 1 / len(carried))


def _value_of_channel(spectrum, probabilities, u):
    """Return the entry of a channel drawn by ``u``."""
    value, below = spectrum[0], probabilities[0]
    for c in range(1, len(spectrum)):
        value = dr.select(u >= below, spectrum[c], value)
        below = below + probabilities[c]
    return value


def _attenuation(rate, stretch):
    """``exp(-rate stretch)`` per channel, 1 where the rate is zero, however long the stretch is."""
    return dr.exp(-dr.select(rate > 0, rate * stretch, 0))


def _stretch_inside(media, medium, ray, t, t_end, inside):
    """(begin, end) of the part of ``[t, t_end]`` where the medium can have density."""
    if not media.heterogeneous:
        return t, t_end
    hits, near, far = medium.intersect_aabb(ray)
    begin = dr.maximum(t, dr.select(inside & hits, near, t))
    end = dr.minimum(t_end, dr.select(hits, far, begin))
    return begin, dr.maximum(begin, end)


def _tentative_flight(media, medium, ray, t, t_end, carried, u, rng, inside):
    """One tentative flight from distance ``t`` on ``ray`` towards ``t_end``.

    Returns (collides, is the collision real, distance of the collision, factor on the weight).
    """
    rate = medium.get_majorant(medium_interaction(ray, medium, t), inside)
    if media.rate_floor is not None:
        rate = dr.maximum(rate, media.rate_floor)
    many = len(rate) > 1
    p = _channel_probabilities(carried)
    one = _value_of_channel(rate, p, rng.next_float32()) if many else rate[0]
    begin, end = _stretch_inside(media, medium, ray, t, t_end, inside)
    flight = dr.select(one > 0, -dr.log(1 - u) / one, dr.inf)
    t_new = begin + flight
    collides = inside & (t_new < end)
    stretch = dr.select(collides, flight, end - begin)
    factor, real = mi.UnpolarizedSpectrum(1), mi.Bool(True)
    mei = medium_interaction(ray, medium, dr.select(collides, t_new, t))
    analytic = mi.Bool(True)
    if media.heterogeneous:
        analytic = medium.is_homogeneous()
    if media.homogeneous:
        σ_t = rate
        if media.rate_floor is not None:
            σ_t = medium.get_majorant(mei, inside & analytic)
        density = _attenuation(rate, stretch)
        density = dr.sum(p * dr.select(collides, rate * density, density))
        factor = dr.select(density > 0, _attenuation(σ_t, stretch) / density, 0)
    if media.heterogeneous:
        σ_t = medium.get_scattering_coefficients(mei, collides & ~analytic)[2]
        # Forced collisions where there is little density, about one in four walks through the scene in total.
        chance = dr.sum(p * σ_t) / one
        if media.rate_floor is not None:
            chance = dr.maximum(chance, 0.25 * media.rate_floor / one)
        chance = dr.minimum(chance, 1)
        delta_real = rng.next_float32() < chance
        accept, refuse = dr.rcp(one * chance), dr.rcp(one * (1 - chance))
        tracked = dr.select(delta_real, accept, dr.maximum(rate - σ_t, 0) * refuse)
        tracked = dr.select(collides, tracked, 1)
        factor = dr.select(analytic, factor, tracked)
        real = analytic | delta_real
    return collides, real, t_new, mi.UnpolarizedSpectrum(dr.select(inside, factor, 1))


def _cross_boundary(scene, ray, pi, medium, passes):
    """Behind the open boundary at ``pi``: (next surface counted from ``ray.o``, medium)."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, passes)
    changes = passes & si.is_medium_transition()
    medium = dr.select(changes, si.target_medium(ray.d), medium)
    # The search goes on along the line itself: an origin lifted off along the normal would land beside it.
    found = _surface_beyond(scene, ray, pi.t + past(si.p), passes)
    return dr.select(passes, found, pi), medium


def _surface_beyond(scene, ray, start, active, coherent=False):
    """Return the first hit along ``ray`` at a distance of ``start`` (None for 0) or more, counted from ``ray.o``."""
    if start is None:
        return scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
    onward = mi.Ray3f(ray)
    onward.o = ray(start)
    onward.maxt = ray.maxt - start
    found = scene.ray_intersect_preliminary(onward, coherent=coherent, active=active)
    found.t += start
    return found


@dr.syntax
def closed_surface(scene, media, ray, active):
    """Return the next surface along a ray that is not an open boundary, a PreliminaryIntersection3f.

    Args:
        scene: Mitsuba scene.
        media: :class:`.scene_contents.FlightSettings`, None without media.
        ray: Ray3f.
        active: mask of lanes.
    """
    pi = scene.ray_intersect_preliminary(ray, active=active)
    if dr.hint(media is not None and media.open_boundaries, mode="scalar"):
        passes = active & _lets_through(media, ray, pi, False)
        while dr.hint(passes, label="open boundaries"):
            pi, _ = _cross_boundary(scene, ray, pi, dr.zeros(mi.MediumPtr), passes)
            passes &= _lets_through(media, ray, pi, False)
    return pi


def _lets_through(media, ray, pi, hide):
    """Return a mask of open boundaries at ``pi``; with ``hide`` emitting surfaces count as such."""
    shape = pi.shape
    if media.shapes_in_groups:  # of an instance, only the interaction knows which shape of the group was met
        shape = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, pi.is_valid()).shape
    opens = pi.is_valid() & is_open(shape)
    if hide:
        opens |= pi.is_valid() & shape.is_emitter()
    return opens


@dr.syntax
def sample_free_flight(scene, media, ray, medium, carried, u, lanes, active, first=False, clip=None):
    """Walk from the start of a ray through media to the next event.

    The same arguments give the same walk.

    Args:
        scene: Mitsuba scene.
        media: :class:`.scene_contents.FlightSettings`.
        ray: Ray3f.
        medium: MediumPtr at its start.
        carried: light per channel at the start, which only steers the choice of channels.
        u: uniform number of the sampler, which chooses the first flight and starts the generator of the others.
        lanes: number of each lane, UInt32.
        active: mask of lanes.
        first: the ray comes from the sensor: it passes light sources if ``media.hide_emitters``.
        clip: distance of the near clip plane, metres: nearer surfaces are not there. None without.

    Returns:
        :class:`FreeFlight`.
    """
    rng = _generator([u], lanes, WALK)
    u = mi.Float(u)
    t = mi.Float(0)
    medium = mi.MediumPtr(medium)
    weight = mi.UnpolarizedSpectrum(1)
    scatter = mi.Bool(False)
    hide = first and media.hide_emitters
    entry = dr.zeros(mi.PreliminaryIntersection3f, dr.width(lanes))
    entry.t = dr.full(mi.Float, dr.inf, dr.width(lanes))
    pi = _surface_beyond(scene, ray, clip, active, coherent=first)
    if dr.hint(media.one_stretch and not hide, mode="scalar"):
        inside = active & (medium != None)  # noqa: E711 (a Dr.Jit comparison)
        scatter, _, t, weight = _tentative_flight(media, medium, ray, t, pi.t, carried, u, rng, inside)
    else:
        going = mi.Bool(active)
        while dr.hint(going, label="walk through media"):
            inside = going & (medium != None)  # noqa: E711
            so_far = carried * weight
            collides, real, t_new, factor = _tentative_flight(media, medium, ray, t, pi.t, so_far, u, rng, inside)
            weight *= factor
            scatter = collides & real
            passes = going & ~collides & _lets_through(media, ray, pi, hide)
            t = dr.select(collides, t_new, dr.select(passes, pi.t, t))
            if dr.hint(media.keeps_entry, mode="scalar"):
                entry = dr.select(passes, pi, entry)
            pi, medium = _cross_boundary(scene, ray, pi, medium, passes)
            going = (collides & ~real) | passes
            # A stretch of empty space leaves the number of the sampler, which is spread evenly, to the first medium.
            u = dr.select(inside, rng.next_float32(), u)
    return FreeFlight(pi, scatter, t, medium, weight, entry)


@dr.syntax
def medium_along(scene, ray, medium, active):
    """Return the medium at the end of a ray, whatever is in between.

    Args:
        scene: Mitsuba scene.
        ray: Ray3f with an end.
        medium: MediumPtr at its start.
        active: mask of lanes.
    """
    medium = mi.MediumPtr(medium)
    pi = scene.ray_intersect_preliminary(ray, active=active)
    going = active & pi.is_valid()
    while dr.hint(going, label="through boundaries"):
        pi, medium = _cross_boundary(scene, ray, pi, medium, going)
        going &= pi.is_valid()
    return medium


@dr.syntax
def transmittance(scene, media, ray, length, medium, numbers, lanes, active, hide=False):
    """Return the transmittance along a ray, and whether it is free.

    Analytic in homogeneous media; ratio tracking (Novak et al. 2014) in others.

    Args:
        scene: Mitsuba scene.
        media: :class:`.scene_contents.FlightSettings`.
        ray: Ray3f; surfaces before its ``maxt`` are in the way.
        length: length that counts, metres. Open boundaries count up to the end.
        medium: MediumPtr at its start.
        numbers: uniform numbers of the sampler, from which those of ratio tracking follow.
        lanes: number of each lane, UInt32, likewise.
        active: mask of lanes.
        hide: light sources are passed, as rays from the sensor pass them.

    Returns:
        (transmittance per channel, mask of rays that nothing is in the way of).
    """
    if dr.hint(media.one_stretch and not hide, mode="scalar"):
        visible = active & ~scene.ray_test(ray, active)
        inside = visible & (medium != None)  # noqa: E711
        σ_t = medium.get_majorant(medium_interaction(ray, medium, mi.Float(0)), inside)
        T = mi.UnpolarizedSpectrum(_attenuation(dr.select(inside, σ_t, 0), length))
    else:
        rng = _generator(numbers, lanes, SHADOW)
        medium = mi.MediumPtr(medium)
        T = mi.UnpolarizedSpectrum(1)
        visible = mi.Bool(active)
        # The ray starts a little off the surface that ``length`` counts from, and ends before an occluder at the end.
        until, last = ray.maxt, ray.maxt / (1 - mi.math.ShadowEpsilon)
        t = last - length
        ray = mi.Ray3f(ray)
        ray.maxt = last - shortest(ray(last))
        pi = scene.ray_intersect_preliminary(ray, active=active)
        going = mi.Bool(active)
        while dr.hint(going, label="transmittance through media"):
            inside = going & (medium != None)  # noqa: E711
            t_end = dr.minimum(pi.t, last)
            collides, t_new, factor = _ratio_tracking_step(media, medium, ray, t, t_end, rng, inside)
            T *= factor
            blocked = pi.is_valid() & ~_lets_through(media, ray, pi, hide)
            passes = going & ~collides & pi.is_valid() & ~blocked
            visible &= ~(going & ~collides & blocked & (pi.t < until))
            t = dr.select(collides, t_new, dr.select(passes, pi.t, t))
            pi, medium = _cross_boundary(scene, ray, pi, medium, passes)
            going = (collides | passes) & (dr.max(T) > 0)
    return T, visible


def _ratio_tracking_step(media, medium, ray, t, t_end, rng, inside):
    """One step of ratio tracking, or the whole stretch where the medium is homogeneous.

    Returns (a collision came before the end, its distance, factor on the transmittance).
    """
    majorant = medium.get_majorant(medium_interaction(ray, medium, t), inside)
    collides, t_new, factor = mi.Bool(False), t, mi.UnpolarizedSpectrum(1)
    analytic = mi.Bool(True)
    if media.heterogeneous:
        analytic = medium.is_homogeneous()
        begin, end = _stretch_inside(media, medium, ray, t, t_end, inside)
        rate = majorant[0]
        t_new = begin + dr.select(rate > 0, -dr.log(1 - rng.next_float32()) / rate, dr.inf)
        collides = inside & ~analytic & (t_new < end)
        σ_t = medium.get_scattering_coefficients(medium_interaction(ray, medium, t_new), collides)[2]
        factor = dr.select(collides, dr.maximum(1 - σ_t / rate, 0), 1)
    if media.homogeneous:
        factor = dr.select(inside & analytic, _attenuation(majorant, t_end - t), factor)
    return collides, t_new, mi.UnpolarizedSpectrum(factor)


# --------------------------------------------------------------------------------------------------------------------
# Derivatives of the transmittance along the straight legs of a path.
#
# A leg was weighed by some unbiased estimate of its transmittance ``T``. Since ``dT = -T dτ`` with the optical depth
# ``τ``, that weight times an independent estimate of ``-dτ`` is an unbiased derivative, and nothing has to be divided
# by a null probability that can be zero. Each stretch between two boundaries contributes the extinction at one random
# point of it times its length, both attached: to the medium's parameters and, where path lengths change, to the ends
# of the leg and to the shapes that bound the stretch.

# Streams of random numbers, one for each kind of leg.
ARRIVING, CONNECTING, EMITTING = 0xC2B2AE35, 0x27D4EB2F, 0x165667B1


class Leg:
    """Straight leg through media. A plain object that lives within one iteration.

    Args:
        v: :class:`.record.RecordedVertex` that it belongs to, whose numbers seed its tracking.
        x0, x1: ends, Point3f.
        d, far: direction, as the ray had it that was followed, and mask of legs without end.
        medium: medium at the start, MediumPtr.
        stream: number that tells the legs of a vertex apart.
        clip: distance from ``x0`` of the first surface at least, None for 0.
    """

    def __init__(self, v, x0, x1, d, far, medium, stream, clip=None):
        self.x0, self.x1, self.far, self.medium = mi.Point3f(x0), mi.Point3f(x1), far, medium
        self.length = dr.select(far, dr.inf, dr.norm(self.x1 - self.x0))
        self.d = dr.detach(mi.Vector3f(d))
        self.ray = mi.Ray3f(v.ray)
        self.ray.o, self.ray.d = self.x0, self.d
        self.ray.maxt = self.length - shortest(self.x1)
        self.clip, self.numbers = clip, v.numbers()
        self.lanes, self.stream = dr.arange(mi.UInt32, dr.width(v.ray.d)), stream


class Stretch:
    """Part of a leg between two boundaries: behind ``entry`` (at ``t``) up to ``pi``, in ``medium``. Plain."""

    def __init__(self, entry, t, pi, medium, u):
        self.entry, self.t, self.pi, self.medium, self.u = entry, t, pi, medium, u


def _optical_depth(media, leg, part, x0, x1, active):
    """Attached estimate of the optical depth of one stretch of a leg whose ends are ``x0, x1``."""
    inside = active & (part.medium != None)  # noqa: E711 (a Dr.Jit comparison)
    ray, ends = mi.Ray3f(leg.ray), part.pi.is_valid()
    begin, end = part.t, dr.select(ends, part.pi.t, leg.length)
    if media.geometry:
        span = dr.select(leg.far, leg.d, x1 - x0)
        ray.o, ray.d = x0, dr.normalize(span)
        end = dr.select(leg.far, end, dr.norm(span))
        if media.open_boundaries:
            passed = inside & part.entry.is_valid()
            begin = dr.select(passed, distance_to(media.surfaces, part.entry, ray, passed), 0)
            ends &= inside
            end = dr.select(ends, distance_to(media.surfaces, part.pi, ray, ends), end)
    if media.heterogeneous:
        hits, near, far = part.medium.intersect_aabb(ray)
        begin = dr.select(hits, dr.maximum(begin, near), begin)
        end = dr.select(hits, dr.minimum(end, far), begin)
    bounded = inside & (end > begin) & dr.isfinite(end)
    length = dr.select(bounded, end - begin, 0)
    mei = medium_interaction(ray, part.medium, dr.fma(part.u, length, dr.select(bounded, begin, 0)))
    return part.medium.get_scattering_coefficients(mei, bounded)[2] * length


def _first_stretch(scene, media, leg, active):
    """(random numbers, next surface, its predecessor) at the start of a leg."""
    rng = _generator(leg.numbers, leg.lanes, leg.stream)
    nothing = dr.zeros(mi.PreliminaryIntersection3f, dr.width(leg.lanes))
    nothing.t = dr.full(mi.Float, dr.inf, dr.width(leg.lanes))
    if not media.open_boundaries:
        return rng, nothing, nothing
    return rng, _surface_beyond(scene, leg.ray, leg.clip, active), nothing


@dr.syntax
def _leg_backward(scene, media, leg, g, active):
    """Reverse mode: propagate ``sum(g dlog T)`` to the medium's parameters and shapes; returns the adjoints of the
    leg's ends. ``g``: adjoint of the logarithm of the transmittance, per channel.
    """
    a0, a1 = mi.Vector3f(0), mi.Vector3f(0)
    if dr.hint(not media.extinction_changes, mode="scalar"):
        return a0, a1
    rng, pi, entry = _first_stretch(scene, media, leg, active)
    if dr.hint(not media.open_boundaries, mode="scalar"):
        part = Stretch(entry, mi.Float(0), pi, leg.medium, rng.next_float32())
        a0, a1 = _stretch_backward(media, leg, part, g, active)
    else:
        t = mi.Float(0)
        medium = mi.MediumPtr(leg.medium)
        going = mi.Bool(active)
        while dr.hint(going, label="derivative of a leg"):
            d0, d1 = _stretch_backward(media, leg, Stretch(entry, t, pi, medium, rng.next_float32()), g, going)
            a0 += d0
            a1 += d1
            going &= pi.is_valid()
            t = dr.select(going, pi.t, t)
            entry = dr.select(going, pi, entry)
            pi, medium = _cross_boundary(scene, leg.ray, pi, medium, going)
    return a0, a1


def _stretch_backward(media, leg, part, g, active):
    """One step of :func:`_leg_backward`."""
    with dr.resume_grad():
        x0, x1 = mi.Point3f(leg.x0), mi.Point3f(leg.x1)
        if media.geometry:
            dr.enable_grad(x0, x1)
        depth = _optical_depth(media, leg, part, x0, x1, active)
        if dr.grad_enabled(depth):
            dr.backward_from(dr.select(active, -dr.dot(g, depth), 0))
        if not media.geometry:
            return mi.Vector3f(0), mi.Vector3f(0)
        return mi.Vector3f(dr.grad(x0)), mi.Vector3f(dr.grad(x1))


@dr.syntax
def _leg_forward(scene, media, leg, t0, t1, active):
    """Forward mode: the derivative of the logarithm of the transmittance, where the leg's ends move by ``t0, t1``."""
    d_log = mi.UnpolarizedSpectrum(0)
    if dr.hint(not media.extinction_changes, mode="scalar"):
        return d_log
    rng, pi, entry = _first_stretch(scene, media, leg, active)
    if dr.hint(not media.open_boundaries, mode="scalar"):
        part = Stretch(entry, mi.Float(0), pi, leg.medium, rng.next_float32())
        d_log = _stretch_forward(media, leg, part, t0, t1, active)
    else:
        t = mi.Float(0)
        medium = mi.MediumPtr(leg.medium)
        going = mi.Bool(active)
        while dr.hint(going, label="derivative of a leg"):
            part = Stretch(entry, t, pi, medium, rng.next_float32())
            d_log += _stretch_forward(media, leg, part, t0, t1, going)
            going &= pi.is_valid()
            t = dr.select(going, pi.t, t)
            entry = dr.select(going, pi, entry)
            pi, medium = _cross_boundary(scene, leg.ray, pi, medium, going)
    return d_log


def _stretch_forward(media, leg, part, t0, t1, active):
    """One step of :func:`_leg_forward`. Attached values die on return."""
    with dr.resume_grad():
        x0, x1 = mi.Point3f(leg.x0), mi.Point3f(leg.x1)
        if media.geometry:
            dr.enable_grad(x0, x1)
            dr.set_grad(x0, t0)
            dr.set_grad(x1, t1)
        depth = _optical_depth(media, leg, part, x0, x1, active)
        if not dr.grad_enabled(depth):
            return mi.UnpolarizedSpectrum(0)
        slope = dr.forward_to(depth, flags=dr.ADFlag.ClearEdges)
        return mi.UnpolarizedSpectrum(dr.select(active, -slope, 0))


class LogTransmittance(dr.CustomOp):
    """Zero with the derivative of the logarithm of a leg's transmittance, per channel.

    Its derivatives are loops of their own along the leg, which reach the medium's parameters by themselves. ``hook`` is
    anything attached: without an attached input Dr.Jit would leave the operation out.
    """

    def eval(self, x0, x1, hook, scene, media, leg, active):
        self.scene, self.media, self.leg, self.active = scene, media, leg, active
        return mi.UnpolarizedSpectrum(dr.zeros(mi.Float, dr.width(leg.lanes)))

    def backward(self):
        g = self.grad_out()
        with dr.suspend_grad():  # the loops attach what they need by themselves
            a0, a1 = _leg_backward(self.scene, self.media, self.leg, g, mi.Bool(self.active))
        self.set_grad_in("x0", mi.Point3f(a0))
        self.set_grad_in("x1", mi.Point3f(a1))

    def forward(self):
        t0, t1 = mi.Vector3f(self.grad_in("x0")), mi.Vector3f(self.grad_in("x1"))
        with dr.suspend_grad():
            t = _leg_forward(self.scene, self.media, self.leg, t0, t1, mi.Bool(self.active))
        self.set_grad_out(mi.UnpolarizedSpectrum(t))

    def name(self):
        return "log transmittance"


def with_log_slope(scene, media, leg, x0, x1, hook, active):
    """Return one, with the derivative of the logarithm of a leg's transmittance.

    Args:
        scene: Mitsuba scene.
        media: :class:`.scene_contents.FlightSettings`.
        leg: detached :class:`Leg`.
        x0, x1: its attached ends.
        hook: attached value that keeps the operation in the AD graph.
        active: mask of lanes.
    """
    if not media.extinction_changes:
        return 1
    return 1 + dr.custom(LogTransmittance, mi.Point3f(x0), mi.Point3f(x1), hook, scene, media, leg, mi.Bool(active))
