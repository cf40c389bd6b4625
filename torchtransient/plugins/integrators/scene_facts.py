"""What a scene contains, looked up before tracing, so that the loops contain only what the scene calls for."""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.bsdfs.delay_table import Answer, delays_of
from torchtransient.plugins.bsdfs.refraction_table import RefractionTable, bsdfs_below, bsdfs_of_scene
from torchtransient.plugins.polarized import from_mirrored
from torchtransient.plugins.sampling.distant import DistantReference
from torchtransient.plugins.sensors.origin import shapes_of_sensors

# What moves the rays of a sensor.
SENSOR_KEYS = (
    "to_world",
    "x_fov",
    "principal_point_offset_x",
    "principal_point_offset_y",
    "aperture_radius",
    "focus_distance",
)


class SceneFacts:
    """Static choices of the kernels.

    ``bsdfs``: the outermost BSDFs. ``delta``: some BSDF has a delta lobe. ``instances``: the scene has shape
    groups. ``distant``: reference sphere of infinitely distant emitters, None when there are none. ``refraction``:
    table of the indices of transmissive rough BSDFs, None when there are none. ``media``: the participating media,
    None when there are none (or the integrator refuses them). ``delays``: table of the BSDFs that answer late, None
    when there are none. ``two_sided``: table of two-sided BSDFs in polarized variants, None when there are none.
    ``window``: which arrivals the film counts, None where its steady image counts them all.
    The remaining ones describe which gradients are asked for: ``geometry`` (path lengths change), ``light_moves``,
    ``emitter_shape_moves``, ``sphere_lights`` (path lengths change and there are spherical ones), ``sensor_moves``,
    ``index_moves``.

    A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.
    """

    def __init__(self, bsdfs: list, delta: bool, instances: bool, distant: DistantReference | None, refraction=None):
        self.bsdfs = bsdfs
        self.delta = delta
        self.instances = instances
        self.distant = distant
        self.refraction = refraction
        self.two_sided = two_sided_table(bsdfs) if mi.is_polarized else None
        self.media = None
        self.window = None
        self.light_box = None
        self.delays = None
        self.geometry = False
        self.light_moves = False
        self.emitter_shape_moves = False
        self.sphere_lights = False
        self.lobe_probability = None
        self.sensor_moves = False
        self.index_moves = False

    @property
    def refracts(self) -> bool:
        """Whether next-event estimation can pass an interface between two media."""
        return self.refraction is not None

    def unweighted(self, bsdf, bs):
        """One, with the derivative of a delta lobe's probability where :func:`lobe_probability_table` says so."""
        if self.lobe_probability is None:
            return mi.Float(1)
        number = dr.reinterpret_array(mi.UInt32, bsdf)
        hidden = dr.gather(mi.UInt32, self.lobe_probability, number, number < dr.width(self.lobe_probability)) == 1
        return dr.select(hidden, dr.relative_grad(bs.pdf), 1)

    def upright(self, bsdf, si, wo, value):
        """``value`` of a BSDF towards ``wo``, put right where :func:`two_sided_table` says so."""
        if self.two_sided is None:
            return value
        number = dr.reinterpret_array(mi.UInt32, bsdf)
        listed = dr.gather(mi.UInt32, self.two_sided, number, number < dr.width(self.two_sided)) == 1
        return from_mirrored(value, si.wi, wo, listed & (si.wi.z < 0))

    def upright_both(self, bsdf, si, wo, sampled):
        """The same for the value and the weight of what ``eval_pdf_sample`` returns."""
        val, pdf, bs, weight = sampled
        return self.upright(bsdf, si, wo, val), pdf, bs, self.upright(bsdf, si, bs.wo, weight)

    def index_towards(self, bsdf, si, wo, η):
        """Index of the medium that ``wo`` points into, where ``η`` is the one that the path arrived in."""
        if self.refraction is None:
            return η
        return η * self.refraction.relative_index(bsdf, si, wo)

    def length_to_light(self, p, ds):
        """Length of the connection from ``p`` to a sampled point or direction of a light."""
        if self.distant is None:
            return ds.dist
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        return dr.select(far, self.distant.length(p, ds.d), ds.dist)

    def numbers_for_delays(self, sampler):
        """The uniform numbers that :meth:`answer` needs at a vertex."""
        return None if self.delays is None else sampler.next_2d()

    def answer(self, bsdf, u, wavelengths) -> Answer:
        """How a surface answers a path: which BSDF takes its place, when, and with which weight."""
        return Answer(bsdf) if self.delays is None else self.delays.answer(bsdf, u, wavelengths)

    def in_time(self, active, τ, p):
        """Which paths of length ``τ`` up to the point ``p`` can still have an event that the film counts."""
        if self.window is None:
            return active
        least = τ if self.light_box is None else τ + mi.Float64(self.light_box.distance(p))
        return active & ~self.window.over(least)

    def counted(self, active, τ):
        """Which arrivals at ``τ`` the film counts."""
        return active if self.window is None else active & self.window.counts(τ)

    @property
    def ray_adjoint(self) -> bool:
        """Whether the adjoint of the ray itself is handed from vertex to vertex."""
        return self.geometry and (self.delta or self.sensor_moves)

    def with_gradients(self, scene, sensor) -> SceneFacts:
        """The same facts with the gradients that the scene's attached parameters ask for."""
        light, sensor_moves, index = False, False, False
        shapes = any(shape.parameters_grad_enabled() for shape in scene.shapes())
        # An instance does not speak of its own transformation.
        shapes |= any(_attached(s, ("to_world",)) for s in scene.shapes() if s.class_name() == "Instance")
        emitter_shape = any(s.is_emitter() and s.parameters_grad_enabled() for s in scene.shapes())
        for emitter in scene.emitters():
            if emitter.get_shape() is None:
                light |= _attached(emitter, ("position", "to_world"))
        sensor_moves = _attached(sensor, SENSOR_KEYS) or any(
            shape is not None and shape.parameters_grad_enabled() for shape in shapes_of_sensors(sensor)
        )
        for bsdf in self.bsdfs:
            index |= _attached(bsdf, ("eta",))
        if self.refraction is not None:
            index |= dr.grad_enabled(self.refraction.table)
        facts = copy.copy(self)
        late = self.delays is not None and dr.grad_enabled(self.delays.lifetimes)
        facts.geometry = shapes or light or sensor_moves or index or late
        facts.light_moves = light
        facts.emitter_shape_moves = emitter_shape
        spheres = any(s.is_emitter() and s.class_name() == "Sphere" for s in scene.shapes())
        facts.sphere_lights = facts.geometry and spheres
        facts.sensor_moves = sensor_moves
        facts.index_moves = index
        if facts.media is not None:
            facts.media = facts.media.with_gradients(facts.geometry)
            facts.media.check_spheres(facts.sphere_lights)
        facts.lobe_probability = lobe_probability_table(self.bsdfs) if facts.delta else None
        return facts


# Delta lobes of these return value over probability with the probability attached: a Fresnel term has cancelled itself.
# Those of the others (Mitsuba's dielectric and mask, ours) divide by the detached probability.
_CANCELLING = ("ThinDielectric", "SmoothPlastic")


def lobe_probability_table(bsdfs):
    """Which BSDFs, by their number in Dr.Jit's registry, hide the derivative of their lobes' probability; None if none
    does.

    Inside ``mask`` the opacity hides in the same place and is attached already; such nested lobes are left as they are.
    """
    numbers = []
    for bsdf in bsdfs:
        if bsdf.class_name() in _CANCELLING or (bsdf.class_name() == "TwoSidedBRDF" and _nests(bsdf)):
            numbers.append(int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]))
    if not numbers:
        return None
    table = dr.zeros(mi.UInt32, max(numbers) + 1)
    dr.scatter(table, mi.UInt32(1), mi.UInt32(numbers))
    return table


def two_sided_table(bsdfs):
    """Which BSDFs, by their number in Dr.Jit's registry, are two-sided; None if none is.

    From behind, Mitsuba's ``twosided`` evaluates what it holds for the mirror images of the directions, and returns its
    Mueller matrix as if it belonged to the directions themselves: turned, and with the hands of circular light
    exchanged.
    """
    # A description names what a mask or a blend holds, too. A path may be handed the part of a BSDF by its own pointer.
    two_sided = [bsdf for bsdf in bsdfs if "TwoSided[" in str(bsdf)]
    for bsdf in two_sided:
        two_sided += [part for part in bsdfs_below(bsdf) if "TwoSided[" in str(part)]
    numbers = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in two_sided]
    if not numbers:
        return None
    table = dr.zeros(mi.UInt32, max(numbers) + 1)
    dr.scatter(table, mi.UInt32(1), mi.UInt32(numbers))
    return table


def _nests(bsdf) -> bool:
    return any(name in str(bsdf) for name in _CANCELLING)


def _attached(plugin, names) -> bool:
    """Whether one of the parameters called ``names`` of a plugin or its children carries gradients."""
    return any(key.split(".")[-1] in names and dr.grad_enabled(value) for key, value in mi.traverse(plugin))


def scene_facts(scene, reference: DistantReference) -> SceneFacts:
    """Read the facts of a scene that do not depend on which gradients are asked for."""
    bsdfs, delays = delays_of(bsdfs_of_scene(scene))
    delta = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta) for bsdf in bsdfs)
    infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters())
    instances = any(shape.class_name() == "Instance" for shape in scene.shapes())
    facts = SceneFacts(
        bsdfs=bsdfs,
        delta=delta,
        instances=instances,
        distant=reference if infinite else None,
        refraction=RefractionTable.of(scene, bsdfs),
    )
    facts.delays = delays
    return facts
