"""``transient_path``: time-resolved path tracing over surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins._registry import register
from torchtransient.plugins.integrators.base import TransientIntegrator
from torchtransient.plugins.integrators.legs import (
    arrive,
    carried_on,
    connect,
    connectable,
    first_leg,
    next_leg,
    unconnected,
)
from torchtransient.plugins.integrators.media.leg_record import write_leg
from torchtransient.plugins.integrators.media.medium_vertex import scatter_in_medium
from torchtransient.plugins.integrators.path_record import allocate, write_vertex
from torchtransient.plugins.integrators.push import push as forward_push
from torchtransient.plugins.integrators.sweep import sweep as reverse_sweep
from torchtransient.plugins.integrators.vertex import mis_weight
from torchtransient.plugins.polarized import (
    column,
    intensity,
    light_type,
    product,
    scattered,
    scattering,
    transported,
    turn_in,
    turn_out,
)


class TransientPath(TransientIntegrator):
    r"""Time-resolved path tracer (:monosp:`transient_path`).

    Next-event estimation with multiple importance sampling over surfaces; monochromatic, RGB and spectral variants, and
    the polarized ones, where every event is a Stokes vector in the frame of the sensor.
    Parameters as in :class:`TransientIntegrator`. The optical path length is counted from the sensor's origin, segment
    by segment between hit points, each times the index of refraction it runs through; light from environment and
    directional emitters arrives as plane waves that leave the sphere around the scene at t = 0 (see
    ``plugins/sampling/distant.py``).

    Gradients: reverse mode walks every path backwards over a record in thread-local memory, forward mode carries
    tangents along; both include the time of flight. Visibility changes are not differentiated (no boundary term).

    Not supported: participating media (``SceneError``).
    """

    def __init__(self, props):
        super().__init__(props)
        self.hide_emitters_ = bool(self.hide_emitters)

    @dr.syntax
    def trace(self, scene, sampler, ray, first_opl, lane, facts, record=False):
        """Trace the paths of one pass.

        Primal: every event is put on ``lane``; returns the sums (steady radiance, energy before, energy after the
        window). With ``record=True`` nothing is written to the film: the path goes to thread-local memory and
        ``(number of vertices, record)`` comes back.
        """
        primal = not record
        ctx = mi.BSDFContext()

        # ------------------------------------------------------------------- loop state
        ray = mi.Ray3f(ray)                               # Current ray
        depth = mi.UInt32(0)                              # Vertices so far
        L = light_type()(0)                               # Steady radiance
        before, after = mi.Float(0), mi.Float(0)          # Energy outside the window
        β = mi.Spectrum(1)                                # Throughput before the current vertex
        η = mi.Float(1)                                   # Index of the medium of the current ray
        τ = mi.Float64(first_opl)                         # Optical path length minus start_opl
        prev = dr.zeros(mi.Interaction3f)                 # Previous vertex
        prev.p = ray.o
        prev_pdf = mi.Float(1)
        prev_delta = mi.Bool(True)
        active = mi.Bool(self.max_depth > 0)
        media = facts.media
        pi, place = first_leg(scene, media, ray, sampler, self.hide_emitters_)
        β = carried_on(β, place)
        store = allocate(self.max_depth, facts) if record else {}
        events = {} if record else lane.begin()           # What the film carries along

        while dr.hint(active, max_iterations=self.max_depth, label="transient_path"):
            active_next = mi.Bool(active)
            here = arrive(pi, ray, place)
            si, at, valid = here.si, here.at, here.valid

            # ---------------------------------------------------------- length of the segment
            length = dr.norm(at.p - prev.p)
            if dr.hint(facts.distant is not None, mode="scalar"):
                length = dr.select(valid, length, facts.distant.length(prev.p, ray.d))
            if dr.hint(self.camera_unwarp, mode="scalar"):
                length = dr.select(depth == 0, 0, length)
            τ += mi.Float64(length * η)

            # ------------------------------------------------------------------ emission found
            seen = mi.Bool(here.surface)
            if dr.hint(self.hide_emitters_, mode="scalar"):
                seen &= (depth > 0) | valid
            if dr.hint(self.discard_direct_light, mode="scalar"):
                seen &= depth > 0
            emitter = si.emitter(scene)
            hit = (emitter != None) & seen  # noqa: E711 (a Dr.Jit comparison)
            ds = mi.DirectionSample3f(scene, si=si, ref=prev)
            em_pdf = scene.pdf_emitter_direction(prev, ds, hit & ~prev_delta)
            mis = dr.select(hit, mis_weight(prev_pdf, em_pdf), 0)
            if dr.hint(primal, mode="scalar"):
                Le = column(β) * mis * mi.unpolarized_spectrum(emitter.eval(si, hit))
                L += Le
                low, high = lane.put(events, τ, Le, hit)
                before += low
                after += high

            # -------------------------------------------------------- emitter and BSDF sampling
            active_next &= (depth + 1 < self.max_depth) & valid
            active_next = facts.in_time(active_next, τ, at.p)
            u_late = facts.numbers_for_delays(sampler)
            late = facts.answer(si.bsdf(ray), u_late, ray.wavelengths)
            bsdf = late.bsdf
            late.move(si, at)
            active_em = active_next & connectable(media, here, mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
            u_em = sampler.next_2d()
            u_lobe = sampler.next_1d()
            u_dir = sampler.next_2d()
            ds, em_weight = scene.sample_emitter_direction(at, u_em, False, active_em)
            active_em &= ds.pdf != 0
            wo = si.to_local(ds.d)
            sampled = late.scaled_both(bsdf.eval_pdf_sample(ctx, si, wo, u_lobe, u_dir, active_next))
            sampled = facts.upright_both(bsdf, si, wo, sampled)
            bsdf_val, bsdf_pdf, bs, bsdf_weight, out = scatter_in_medium(
                media, here, ds.d, u_lobe, u_dir, active_next, active_em,
                (*sampled, si.to_world(sampled[2].wo)),
            )  # fmt: skip
            mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, bsdf_pdf))
            turn = turn_out(si, ray.d)
            Lr = transported(β, mis_em, scattered(bsdf_val, turn)) * mi.unpolarized_spectrum(em_weight)
            # Shadow rays only where they can matter; the derivative of a zero may matter.
            if dr.hint(primal, mode="scalar"):
                active_em &= dr.max(dr.abs(intensity(Lr))) > 0
            τ_em = late.after(τ) + mi.Float64(facts.length_to_light(at.p, ds) * facts.index_towards(bsdf, si, wo, η))
            active_em = facts.counted(active_em, τ_em)
            visible, T_em = connect(scene, media, here, ds, u_em, sampler, active_em)
            Lr *= T_em
            active_em &= visible
            if dr.hint(primal, mode="scalar"):
                Lr = dr.select(active_em, Lr, 0)
                L += Lr
                low, high = lane.put(events, τ_em, Lr, active_em)
                before += low
                after += high

            # ----------------------------------------------------------------- to the next vertex
            β_before, η_before = mi.Spectrum(β), mi.Float(η)
            ray_before, pi_before, is_delta = mi.Ray3f(ray), pi, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            β = product(β, scattering(bsdf_weight, turn, turn_in(si, bs.wo, out)))
            η *= bs.eta
            ray = at.spawn_ray(out)
            prev.p, prev.n, prev.time, prev.wavelengths = at.p, at.n, at.time, at.wavelengths
            prev_pdf = bs.pdf
            prev_delta = unconnected(media, here, is_delta)

            # --------------------------------------------------------------------------- roulette
            β_max = dr.max(mi.unpolarized_spectrum(β))
            if dr.hint(primal, mode="scalar"):
                active_next &= β_max != 0
            else:
                # The derivative of a product with one factor of zero needs the light beyond it: go on past the first
                # black surface.
                weight_max = dr.max(mi.unpolarized_spectrum(bsdf_weight))
                first_black = (weight_max == 0) & (dr.max(mi.unpolarized_spectrum(β_before)) > 0) & (bs.pdf > 0)
                active_next &= (weight_max > 0) | first_black
                β_max = dr.select(β_max == 0, 1, β_max)
            rr_prob = dr.minimum(β_max * dr.square(η), 0.95)
            rr_active = depth >= self.rr_depth
            rr = dr.select(rr_active, dr.rcp(rr_prob), 1)
            β *= rr
            rr_continue = sampler.next_1d() < rr_prob
            active_next &= ~rr_active | rr_continue

            if dr.hint(record, mode="scalar"):
                write_vertex(
                    store, depth, active, facts,
                    ray_before, pi_before, β_before, τ, η_before, mis, rr, u_em, u_lobe, u_dir,
                    active_em, is_delta, active_next, u_late,
                )
                write_leg(store, depth, active, place, T_em)
            τ = late.after(τ)
            pi, place = next_leg(scene, media, ray, here, β, sampler, active_next)
            β = carried_on(β, place)
            depth += 1
            active = active_next

        if dr.hint(primal, mode="scalar"):
            lane.end(events)
        return (depth, store) if record else (L, before, after)

    def sweep(self, scene, sampler, ray, first_opl, lane, facts):
        """Record the paths of one pass and walk them backwards, see :mod:`.sweep`."""
        count, store = self.trace(scene, sampler, ray, first_opl, None, facts, record=True)
        return reverse_sweep(self, scene, count, store, lane, facts, ray)

    def push(self, scene, sampler, ray, first_opl, lane, facts, t_ray, d_first, t_turn=None):
        """Record the paths of one pass and carry tangents along them, see :mod:`.push`."""
        count, store = self.trace(scene, sampler, ray, first_opl, None, facts, record=True)
        return forward_push(self, scene, count, store, lane, facts, ray, *t_ray, d_first, t_turn)


register("integrator", "transient_path", TransientPath)
