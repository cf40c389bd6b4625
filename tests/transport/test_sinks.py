"""The same walk into every sink: what the film gets, the list holds, and the adjoint weighs."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import as_mitsuba
from support.walks import AdjointSumSink, Sink, primary_rays, trace
from torchtransient.scenes import cornell_box

VARIANT = "llvm_ad_mono"
SPP, SEED = 8, 3


def scene_of(kind, depth=5):
    """A Cornell box, one with fog in it, or one with a body of glass."""
    result = as_mitsuba(cornell_box(resolution=5, num_bins=60, bin_width_opl=0.1, max_depth=depth))
    if kind == "fog":
        result["integrator"] = result["integrator"] | {"type": "transient_prbvolpath"}
        fog = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.8}
        result["small-box"] = result["small-box"] | {"bsdf": {"type": "null"}, "interior": fog}
    if kind == "glass":
        result["small-box"] = result["small-box"] | {"bsdf": {"type": "dielectric"}}
    return mi.load_dict(result, optimize=False)


def traced(scene, sink_of):
    """The paths of one pass: (the sink of ``sink_of(integrator, contents, film, rays, job)``, what it kept)."""
    of = primary_rays(scene, SEED, SPP)
    with dr.suspend_grad():
        sink = sink_of(of.integrator, of.contents, of.film, of.rays, of.job)
        first_opl = of.integrator.first_opl(of.film, of.rays)
        _, kept = trace(of.context, of.rays.sampler, dr.detach(of.rays.ray), first_opl, sink)
        dr.eval(kept)
        return sink, kept


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fog", "glass"])
def test_adjoint_sum_is_the_product_with_the_render(kind):
    scene = scene_of(kind)
    _, cube = scene.integrator().render(scene, seed=SEED, spp=SPP)
    weights = np.cos(0.3 * np.arange(int(np.prod(cube.shape)))).astype(np.float32)

    def sink_of(integrator, contents, film, rays, job):
        base, _ = integrator.pixel_indices(film, job, rays)
        match = integrator.channel_match(contents, film, rays)
        return AdjointSumSink(film.create_adjoint_block((mi.Float(weights), 1, 1), base, [mi.Float(0)], match))

    _, kept = traced(scene, sink_of)
    expected = float((np.array(cube, dtype=np.float64).ravel() * weights).sum())
    assert np.array(kept["sum"], dtype=np.float64).sum() == pytest.approx(expected, rel=1e-4)


def test_a_sink_of_one_s_own():
    """Sinks are told of every event, whatever strategy found it, and of every vertex."""

    class Counter(Sink):
        def begin(self, world):
            return {"events": mi.UInt32(0), "vertices": mi.UInt32(0)}

        def event(self, kept, event):
            kept["events"] = kept["events"] + dr.select(event.active, mi.UInt32(1), 0)

        def vertex(self, kept, path, samples):
            kept["vertices"] = kept["vertices"] + dr.select(path.active, mi.UInt32(1), 0)

    _, kept = traced(scene_of("plain"), lambda *_: Counter())
    vertices, events = np.array(kept["vertices"]), np.array(kept["events"])
    assert vertices.min() >= 1 and vertices.max() <= 5
    assert 0 < events.max() <= 2 * vertices.max()
