"""Scattering by the BSDFs of surfaces. Arguments that all methods share are explained in :mod:`.strategy`."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.bsdfs.delay_table import DelaySample
from torchtransient.plugins.bsdfs.lambertian import is_lambertian, scatters_behind
from torchtransient.plugins.polarized import (
    from_mirrored_frames,
    product,
    rotate_mueller,
    rotation_from_light,
    rotation_to_sensor,
    scatter_unpolarized,
)
from torchtransient.plugins.transport.carry import Carry, slope_only
from torchtransient.plugins.transport.geometry_terms import EDGE_ON
from torchtransient.plugins.transport.strategy import Answer, Local, Scattering, Step

# Number of a triangle where any will do.
_ANY = 0xFFFFFFFF


class Surface(Scattering):
    """Scattering at surfaces; vertices in media are those of :class:`.medium_scattering.SurfaceOrMedium`.

    Args:
        guides: list of :class:`~.strategy.Guide`, whose shares sum to less than one.

    Raises:
        SceneError: if a share is not positive, or if they sum to one and more.
    """

    # Whether light scatters alike around the normal, whatever the tangents are.
    turns_freely = False

    def __init__(self, guides=()):
        self.guides = list(guides)
        if sum(guide.share for guide in self.guides) >= 1 or any(guide.share <= 0 for guide in self.guides):
            shares = ", ".join(str(guide.share) for guide in self.guides)
            raise SceneError(f"guides: expected positive shares that sum to less than one, got {shares}.")

    def own_share(self, depth):
        """Return the share of the next directions that the scattering samples itself, at vertices number ``depth``."""
        return 1 - sum(guide.share_at(depth) for guide in self.guides)

    def prepare(self, context):
        contents = context.contents
        self.refraction = None if contents.refraction is None else contents.refraction.read()
        self.delays = None if contents.delays is None else contents.delays.read()
        self.mixtures = None if contents.mixtures is None else contents.mixtures.read(context.wanted)
        for guide in self.guides:
            guide.prepare(context)

    def start(self, context, rays):
        self.strata = rays.strata
        for guide in self.guides:
            guide.start(context, rays)

    def tables(self):
        tables = [] if self.delays is None else self.delays.attached()
        tables += [] if self.refraction is None else [self.refraction.table]
        return tables + [table for guide in self.guides for table in guide.tables()]

    # ------------------------------------------------------------------------------------------------- primal

    def arrive(self, context, path, vertex, sampler):
        vertex.u_delay = None if self.delays is None else sampler.next_2d()
        vertex.u_part = None if self.mixtures is None else sampler.next_1d()
        vertex.delay = self.delay(vertex.si.bsdf(path.ray), vertex.u_delay, path.ray.wavelengths)
        if self.mixtures is not None:
            self.mixtures.take_part(vertex.delay, vertex.si, vertex.u_part, vertex.si.is_valid())
        vertex.bsdf = vertex.delay.bsdf
        vertex.scattered_si, vertex.at = self.with_shifted_wavelengths(vertex.delay, vertex.si, vertex.at)
        vertex.connectable = self.connectable(context, vertex)

    def delay(self, bsdf, u, wavelengths):
        """Sample the delay of a surface.

        Args:
            bsdf: BSDFPtr.
            u: two uniform numbers, None without delays.
            wavelengths: wavelengths of the segment.

        Returns:
            :class:`~..bsdfs.delay_table.DelaySample`: the delay, the BSDF that scatters with it, and its weight.
        """
        return DelaySample(bsdf) if self.delays is None else self.delays.sample(bsdf, u, wavelengths)

    @staticmethod
    def with_shifted_wavelengths(delay, *interactions):
        """Return copies of interactions with the wavelengths beyond a surface that fluoresces.

        Args:
            delay: :class:`~..bsdfs.delay_table.DelaySample` of the surface.
            interactions: interactions at the vertex, on the sensor's side.
        """
        if delay.wavelengths is None:
            return interactions
        copies = {id(i): dr.copy(i) for i in interactions}
        delay.shift_wavelengths(*copies.values())
        return tuple(copies[id(i)] for i in interactions)

    def connectable(self, context, vertex):
        """Return a mask of vertices with a smooth lobe, which can be connected to lights."""
        return mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)

    def scatter(self, context, path, vertex, proposals, sampler):
        ctx, si, bsdf = mi.BSDFContext(), vertex.scattered_si, vertex.bsdf
        u_lobe, u_dir = sampler.next_1d(), sampler.next_2d()
        answers, sample = [], None
        for p in proposals:
            if p is None:
                answers.append(None)
                continue
            wo = si.to_local(p.d)
            if sample is None:
                value, pdf, *sample = bsdf.eval_pdf_sample(ctx, si, wo, u_lobe, u_dir, vertex.goes_on)
            else:
                value, pdf = bsdf.eval_pdf(ctx, si, wo, p.active)
            value = self.correct_two_sided(context, bsdf, si, wo, vertex.delay.scaled(value))
            answers.append(Answer(value=value, pdf=pdf, eta=self.relative_index(bsdf, si, wo), wo=wo))
        bs, weight = sample or self.sample(bsdf, si, u_lobe, u_dir, vertex.goes_on)
        weight = self.correct_two_sided(context, bsdf, si, bs.wo, vertex.delay.scaled(weight))
        step = Step(
            out=si.to_world(bs.wo), wo=bs.wo, weight=weight, pdf=bs.pdf, eta=bs.eta, u_lobe=u_lobe, u_dir=u_dir,
            u_delay=vertex.u_delay, u_part=vertex.u_part,
            delta=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta),
        )  # fmt: skip
        step.unconnected = step.delta
        if context.wanted is not None and context.contents.glossy:
            step.pdf = dr.select(_is_black(weight) & is_on_wrong_side(si.wi, bs), 0, step.pdf)
        self.scatter_in_volume(context, vertex, proposals, answers, step)
        rotation = rotation_to_sensor(si, path.ray.d)
        for p, answer in zip(proposals, answers, strict=True):
            if answer is not None:
                answer.matrix = rotate_mueller(answer.value, rotation, rotation_from_light(si, answer.wo, p.d))
                answer.value = scatter_unpolarized(answer.value, rotation)
        step.weight = rotate_mueller(step.weight, rotation, rotation_from_light(si, step.wo, step.out))
        if self.guides:
            self._follow_guides(context, path, vertex, step, sampler)
            for p, answer in zip(proposals, answers, strict=True):
                if p is not None:
                    answer.pdf = self.mixture(context, path.depth, vertex.at.p, p.ds, answer.pdf, p.active)
        return answers, step

    def sample(self, bsdf, si, u_lobe, u_dir, active):
        """Sample a direction and its weight where no connection has proposed one.

        Args:
            bsdf: BSDFPtr.
            si: SurfaceInteraction3f.
            u_lobe, u_dir: uniform numbers, Float and Point2f.

        Returns:
            (BSDFSample3f, value over density).
        """
        return bsdf.sample(mi.BSDFContext(), si, u_lobe, u_dir, active)

    def scatter_in_volume(self, context, vertex, proposals, answers, step):
        """Replace answers and step at vertices in a medium; a surface leaves them.

        Args:
            proposals, answers, step: proposals of the connections, their answers and the next step, see
                :meth:`~.strategy.Scattering.scatter`.
        """

    # ------------------------------------------------------------------------------------------------- guides

    def _follow_guides(self, context, path, vertex, step, sampler):
        """Let guides draw some of the next vertices: ``step.guided``, at ``step.point``.

        One sample is used, of the scattering or of one guide. At the first vertex the samples of a pixel are stratified
        over guides and points: they vary less, and neighbouring lanes look at neighbouring places, where their rays
        traverse the same boxes and triangles.
        """
        u = mi.Float64(sampler.next_1d())
        if self.strata is not None:
            number, count = self.strata
            u = dr.select(path.depth == 0, (mi.Float64(number) + u) / mi.Float64(count), u)
        below, own = 0.0, self.own_share(path.depth)
        step.guided, step.point = u < 1 - own, mi.Point3f(vertex.at.p)
        step.shape, step.primitive = dr.zeros(mi.ShapePtr), mi.UInt32(_ANY)
        for guide in self.guides:
            share = guide.share_at(path.depth)
            chosen = (u >= below) & (u < below + share)
            # What is left of the number that has chosen is uniform again.
            x = dr.clip((u - below) / mi.Float64(share), 0, 1 - dr.epsilon(mi.Float64))
            drawn = guide.draw(context, vertex, x, step.u_dir.y)
            step.point, step.shape = dr.select(chosen, drawn.p, step.point), dr.select(chosen, drawn.shape, step.shape)
            step.primitive = dr.select(chosen, _ANY if drawn.primitive is None else drawn.primitive, step.primitive)
            below += share
        # Of one guide all is known; where several could have drawn a point, a ray has to find it.
        step.target = drawn if len(self.guides) == 1 and drawn.n is not None else None
        # Rays start beside the surface, from where a near point lies in another direction.
        step.out = dr.select(step.guided, vertex.at.spawn_ray_to(step.point).d, step.out)
        step.delta, step.unconnected = step.delta & ~step.guided, step.unconnected & ~step.guided
        step.weight = dr.select(step.delta, step.weight / own, step.weight)

    def mixture(self, context, depth, p, ds, pdf, active):
        """Return the density of the walk, guides included, towards a point of a light (Float).

        Args:
            depth: number of the vertex, UInt32.
            p: vertex, Point3f.
            ds: point of the light.
            pdf: density of the scattering towards it.
        """
        if not self.guides:
            return pdf
        if ds.emitter is None:  # a light that lies on no shape
            return self.own_share(depth) * pdf
        active = active & ~ds.delta
        guided = self.guided_density(context, depth, p, ds, ds.emitter.get_shape(), active)
        return self.own_share(depth) * pdf + dr.select(active, guided, 0)

    def guided_density(self, context, depth, p, to, shape, active, primitive=None):
        """Return the density per solid angle with which guides draw a point, shares included (Float).

        Args:
            depth: number of the vertex that the point is drawn from, UInt32.
            p: position of that vertex, Point3f.
            to: point, with ``p`` and ``n``.
            shape: ShapePtr of the point.
            primitive: number of its triangle, None if unknown.
        """
        return sum(g.share_at(depth) * g.density(context, p, to.p, to.n, shape, active, primitive) for g in self.guides)

    def weigh(self, context, path, vertex, step, ray, leg):
        smooth = vertex.goes_on & ~step.delta
        pi, reached = context.segment.surface_of(leg)
        reached = smooth & reached & pi.is_valid()
        found = context.segment.interaction_of(leg, ray, mi.RayFlags.Minimal, reached)
        # From the vertex itself to what was found, not from beside it, where the ray starts.
        p, to = vertex.at.p, dr.select(reached, found.p - vertex.at.p, ray.d)
        value, pdf = self.value_towards(context, path, vertex, to * dr.rsqrt(dr.squared_norm(to)), smooth)
        guided = self.guided_density(context, path.depth, p, found, pi.shape, reached, pi.prim_index)
        pdf = self.own_share(path.depth) * pdf + dr.select(reached, guided, 0)
        # A guided sample stands for the point that was drawn, and for no other that its ray runs into before: nor for
        # one just above it, where a surface lies below another one.
        way = dr.norm(step.point - vertex.at.p)
        arrived = reached & (pi.shape == step.shape) & ((step.primitive == _ANY) | (pi.prim_index == step.primitive))
        arrived &= (dr.norm(found.p - step.point) < 1e-3 * way) & (guided > 0)
        pdf = dr.select(step.guided & ~arrived, 0, pdf)
        kept = step.guided | ~_is_black(step.weight)
        step.weight = dr.select(smooth, dr.select((pdf > 0) & kept, value / pdf, 0), step.weight)
        step.pdf = dr.select(smooth, pdf, step.pdf)
        wo = vertex.scattered_si.to_local(step.out)
        step.eta = dr.select(smooth, self.relative_index(vertex.bsdf, vertex.scattered_si, wo), step.eta)

    def value_towards(self, context, path, vertex, out, active):
        """Return the scattering towards a world direction ``out``.

        Returns:
            (value between the frames of both segments, density).
        """
        si = vertex.scattered_si
        wo = si.to_local(out)
        value, pdf = vertex.bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
        value = self.correct_two_sided(context, vertex.bsdf, si, wo, vertex.delay.scaled(value))
        return rotate_mueller(value, rotation_to_sensor(si, path.ray.d), rotation_from_light(si, wo, out)), pdf

    def value_at(self, context, si, out, ray, sampler, active):
        """Return the scattering at a surface that no path has walked to, unpolarized.

        Args:
            si: SurfaceInteraction3f.
            out: direction of the light in world space.
            ray: Ray3f that found it.
            sampler: Mitsuba sampler of the lanes, which chooses a part of a mixture as paths do.

        Returns:
            (value, density).
        """
        bsdf, weight = si.bsdf(ray), 1
        if self.mixtures is not None:
            bsdf, weight = self.mixtures.part_of(bsdf, si, sampler.next_1d(), active)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(out), active)
        return value * weight, pdf

    # ---------------------------------------------------------------------------------------- scene contents

    @staticmethod
    def correct_two_sided(context, bsdf, si, wo, value):
        """Return the value of a BSDF in the right frames where Mitsuba's two-sided BSDFs mirror them.

        Args:
            bsdf: BSDFPtr.
            si: SurfaceInteraction3f.
            wo: local direction of ``value``.
            value: Mueller matrix, or a spectrum, which passes.
        """
        two_sided = context.contents.two_sided
        if two_sided is None:
            return value
        return from_mirrored_frames(value, si.wi, wo, two_sided.lists(bsdf) & (si.wi.z < 0))

    def relative_index(self, bsdf, si, wo):
        """Return the index of refraction on the side of ``wo`` over that on the side of ``si.wi``."""
        return mi.Float(1) if self.refraction is None else self.refraction.relative_index(bsdf, si, wo)

    @staticmethod
    def lobe_probability(context, bsdf, bs):
        """Return one, with the derivative of a delta lobe's probability where the BSDF's weight hides it.

        Args:
            bsdf: BSDFPtr.
            bs: BSDFSample3f of the lobe.
        """
        hidden = context.contents.hidden_probability
        return 1 if hidden is None else dr.select(hidden.lists(bsdf), dr.relative_grad(bs.pdf), 1)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        fields = {"delta": mi.Bool} | ({"black": mi.Bool} if context.contents.glossy else {})
        if context.contents.delta:
            fields |= {"u_lobe": mi.Float, "u_dir": mi.Point2f}
        if self.delays is not None:
            fields["u_delay"] = mi.Point2f
        if self.mixtures is not None:
            fields["u_part"] = mi.Float
        return fields | ({"pdf": mi.Float} if self.guides else {})

    def record(self, step):
        return vars(step) | {"black": _is_black(step.weight)}

    # ----------------------------------------------------------------------------------------------- attached

    def look_up_attached(self, context, vertex, wanted):
        v, si = vertex.v, vertex.si
        vertex.rotation = rotation_to_sensor(si, vertex.carry.w)
        u = v.record_of(self.name).get("u_delay")
        vertex.delay = self.delay(vertex.sid.bsdf(v.ray), u, v.ray.wavelengths)
        if self.mixtures is not None:
            u_part = v.record_of(self.name)["u_part"]
            self.mixtures.take_part(vertex.delay, si, u_part, vertex.sid.is_valid())
        vertex.bsdf = vertex.delay.bsdf
        (vertex.scattered_si,) = self.with_shifted_wavelengths(vertex.delay, si)
        vertex.scattered_slope, vertex.scattered_opl = vertex.slope, vertex.delay.after(v.τ)
        if wanted.geometry and vertex.delay.delay is not None:
            vertex.scattered_slope = vertex.slope + slope_only(vertex.delay.delay)

    def evaluate(self, context, vertex, out, active, sampled=False, ds=None):
        si = vertex.scattered_si
        wo = si.to_local(out)
        value, pdf = self.eval_pdf(vertex, wo, out, active, sampled)
        if ds is not None:
            pdf = self.mixture(context, vertex.v.k, si.p, ds, pdf, active)
        value = self.correct_two_sided(context, vertex.bsdf, si, wo, vertex.delay.scaled(value))
        return Local(value=value, pdf=pdf, wo=wo, eta=self.relative_index(vertex.bsdf, si, wo))

    def eval_pdf(self, vertex, wo, out, active, sampled):
        """Return value and density of an attached vertex towards a direction.

        Args:
            wo, out: local and world direction.
            sampled: the scattering sampled the direction itself.
        """
        return vertex.bsdf.eval_pdf(mi.BSDFContext(), vertex.scattered_si, wo, active)

    def attached(self, context, vertex, wanted):
        v, si, r, following = vertex.v, vertex.scattered_si, vertex.v.record_of(self.name), vertex.v.next
        smooth, mirrored = v.goes_on & ~r["delta"], v.goes_on & r["delta"]
        ahead = smooth & following.valid
        out, J, drag = mi.Vector3f(following.d), mi.Float(1), mi.Vector3f(0)
        if wanted.geometry:
            motion = context.segment.motion(context, vertex, following, ahead)
            out, J, drag = motion.d, motion.J, motion.drag
        towards = self.evaluate(context, vertex, out, smooth, sampled=True)
        pdf = r["pdf"] if self.guides else dr.detach(towards.pdf)
        counts = smooth & (pdf > 0)
        if context.contents.glossy:
            # Some BSDFs throw samples away (the facet that was drawn mirrors to behind the surface): their weight is
            # zero, though other lobes have a value and a density there.
            counts &= ~r["black"] | _is_black(towards.value)
        inv_pdf = dr.select(counts, v.rr / pdf, 0)
        weight = rotate_mueller(towards.value, vertex.rotation, rotation_from_light(si, towards.wo, out, following.d))
        if wanted.geometry:
            # Of a cosine that was sampled the value changes by one over it, which is rounding edge-on.
            weight = dr.select(dr.abs(dr.detach(towards.wo.z)) < EDGE_ON, dr.detach(weight), weight)
        weight = dr.select(smooth, weight * (inv_pdf * J), 0)
        eta = dr.select(smooth, towards.eta, 1)
        o, d, w = mi.Point3f(drag), mi.Vector3f(0), dr.select(ahead, out, 0)
        if context.contents.delta:
            bs, delta_weight = vertex.bsdf.sample(mi.BSDFContext(), si, r["u_lobe"], r["u_dir"], mirrored)
            delta_weight = self.correct_two_sided(context, vertex.bsdf, si, bs.wo, vertex.delay.scaled(delta_weight))
            d_out = si.to_world(bs.wo)
            from_light = rotation_from_light(si, bs.wo, d_out, following.d)
            delta_weight = rotate_mueller(delta_weight, vertex.rotation, from_light)
            delta_weight *= self.lobe_probability(context, vertex.bsdf, bs) * (v.rr / self.own_share(v.k))
            weight = dr.select(mirrored, delta_weight, weight)
            eta = dr.select(mirrored, bs.eta, eta)
            o, d, w = dr.select(mirrored, si.p, o), dr.select(mirrored, d_out, 0), dr.select(mirrored, d_out, w)
        η = dr.select(v.goes_on, vertex.carry.η * eta, 0)
        slope = vertex.scattered_slope
        if wanted.geometry:
            # What the other end adds when it moves or slides is counted where it is attached.
            longer = dr.select(ahead, motion.longer(), 0)
            if context.contents.distant is not None:
                far_away = slope_only(context.contents.distant.length(si.p, following.d))
                longer = dr.select(smooth & ~ahead, far_away, longer)
            slope = slope + η * longer
        rate = mi.Float(0)
        if wanted.rate:
            leaving = dr.select(mirrored, d_out, out) if context.contents.delta else out
            rate = vertex.rate_slope - slope_only(dr.select(v.goes_on, η * dr.dot(vertex.velocity, leaving), 0))
        p, n = (motion.p, motion.n) if "p" in context.carried else (mi.Point3f(0), mi.Normal3f(0))
        carry = Carry(
            β=product(vertex.carry.β, weight), slope=slope, η=η, o=o, d=d, x=dr.select(v.goes_on, si.p, 0), w=w, p=p,
            n=n, rate=rate,
        )  # fmt: skip
        return Local(carry=carry, inv_pdf=inv_pdf, ahead=ahead)


def is_on_wrong_side(wi, bs):
    """Return a mask of samples of reflection that cross the surface, and of transmission that do not.

    BSDFs throw such samples away (weight zero); their lobes have a density in that direction, and may be black there.

    Args:
        wi: local direction towards the sensor, Vector3f.
        bs: BSDFSample3f.
    """
    reflects = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Reflection)
    transmits = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Transmission)
    crosses = wi.z * bs.wo.z < 0
    return (reflects & ~transmits & crosses) | (transmits & ~reflects & ~crosses)


def _is_black(weight):
    """Return a mask of weights of zero."""
    return dr.max(mi.unpolarized_spectrum(weight)) == 0


# --------------------------------------------------------------------------------------------------------------------
# Scattering where every surface is Lambertian: cosines instead of virtual calls.

class Lambertian(Surface):
    """Scattering where every surface is Lambertian (:meth:`fits`): cosines instead of virtual calls.

    Args:
        guides: list of :class:`~.strategy.Guide`, whose shares sum to less than one.
        draws_lobe: draw the number that chooses a lobe, so that a seed gives the same paths as :class:`Surface`.
    """

    turns_freely = samples_all = True

    def __init__(self, guides=(), draws_lobe=False):
        super().__init__(guides)
        self.draws_lobe = draws_lobe

    @staticmethod
    def fits(contents):
        """Return True if all scattering is Lambertian, in unpolarized light."""
        special = (contents.delays, contents.mixtures, contents.refraction, contents.media, contents.hidden_probability)
        return not mi.is_polarized and all(s is None for s in special) and all(is_lambertian(b) for b in contents.bsdfs)

    def arrive(self, context, path, vertex, sampler):
        si = vertex.si
        vertex.u_delay = vertex.u_part = None
        vertex.bsdf = si.bsdf(path.ray)
        vertex.delay, vertex.scattered_si = DelaySample(vertex.bsdf), si
        vertex.connectable = mi.Bool(True)

    def scatter(self, context, path, vertex, proposals, sampler):
        u_lobe = sampler.next_1d() if self.draws_lobe else mi.Float(0)
        u_dir = sampler.next_2d()
        # After the lights were asked, as BSDFs are: kernels of a scene are then the same whatever was rendered before.
        vertex.side = _side(vertex.bsdf, vertex.si)
        vertex.ρ = _albedo(vertex.bsdf, vertex.si, vertex.goes_on)
        answers = [None if p is None else self._towards(vertex, p.d) for p in proposals]
        wo = mi.warp.square_to_cosine_hemisphere(u_dir)
        pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        lit = vertex.side != 0
        wo.z *= vertex.side
        step = Step(
            out=vertex.si.to_world(wo), wo=wo, weight=dr.select(lit, vertex.ρ, 0), pdf=dr.select(lit, pdf, 0),
            eta=mi.Float(1), u_lobe=u_lobe, u_dir=u_dir, u_delay=None, u_part=None, delta=mi.Bool(False),
            unconnected=mi.Bool(False),
        )  # fmt: skip
        if self.guides:
            self._follow_guides(context, path, vertex, step, sampler)
            for p, answer in zip(proposals, answers, strict=True):
                if p is not None:
                    answer.pdf = self.mixture(context, path.depth, vertex.at.p, p.ds, answer.pdf, p.active)
        return answers, step

    @staticmethod
    def _towards(vertex, d):
        """Return the :class:`~.strategy.Answer` towards the world direction ``d``."""
        cos = dr.dot(vertex.si.sh_frame.n, d) * vertex.side
        pdf = dr.select(cos > 0, cos, 0) * dr.inv_pi
        value = vertex.ρ * pdf
        return Answer(value=value, matrix=value, pdf=pdf, eta=mi.Float(1))

    def value_towards(self, context, path, vertex, out, active):
        answer = self._towards(vertex, out)
        return answer.value, answer.pdf

    def value_at(self, context, si, out, ray, sampler, active):
        bsdf = si.bsdf(ray)
        vertex = Local(si=si, side=_side(bsdf, si), ρ=_albedo(bsdf, si, active))
        answer = self._towards(vertex, out)
        return dr.select(active, answer.value, 0), answer.pdf

    # ----------------------------------------------------------------------------------------------- attached

    def look_up_attached(self, context, vertex, wanted):
        super().look_up_attached(context, vertex, wanted)
        vertex.side = _side(vertex.bsdf, vertex.sid)
        vertex.ρ = _albedo(vertex.bsdf, vertex.si, vertex.v.active & vertex.sid.is_valid())

    def eval_pdf(self, vertex, wo, out, active, sampled):
        towards = self._towards(vertex, out)
        return dr.select(active, towards.value, 0), dr.select(active, towards.pdf, 0)


def _side(bsdf, si):
    """Return 1 where light comes from the front, -1 from the back, 0 on the back of one-sided surfaces."""
    return dr.select(si.wi.z > 0, 1, dr.select(scatters_behind(bsdf) & (si.wi.z < 0), -1, 0))


def _albedo(bsdf, si, active):
    return dr.select(active, mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, active)), 0)
