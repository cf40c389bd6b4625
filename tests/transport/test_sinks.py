"""The same walk into every sink: what the film gets, the list holds, and the adjoint weighs."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.plain_scenes import as_mitsuba
from support.walks import primary_rays, trace
from torchtransient.plugins.transport.record import Arrivals, read_ahead
from torchtransient.plugins.transport.sinks import AdjointSumSink, EventListSink, FilmSink, Sink
from torchtransient.plugins.transport.strategy import Local
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
@pytest.mark.parametrize("kind", long(["plain", "fog", "glass"], ["fog"]))
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


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "fog", "glass"])
def test_depth_of_an_event_is_that_of_the_render_that_has_it(kind):
    def sink_of(integrator, contents, film, rays, job):
        match = integrator.channel_match(contents, film, rays)
        return EventListSink(dr.width(rays.row), 32, lambda value: dr.mean(value * match.weight))

    sink, _ = traced(scene_of(kind), sink_of)
    assert int(np.array(sink.used).max()) <= 32
    depth, energy = np.array(sink.depth), np.array(sink.energy, dtype=np.float64)
    shares = []
    for most in (1, 2, 5):
        scene = scene_of(kind, depth=most)
        image = np.array(scene.integrator().render(scene, seed=SEED, spp=SPP)[0], dtype=np.float64)
        shares.append(image.sum())
        assert energy[(depth > 0) & (depth <= most)].sum() == pytest.approx(image.sum(), rel=1e-4, abs=1e-9)
    assert shares[-1] > shares[1] > 0


def test_every_event_has_a_place_in_the_list():
    """A list that is too short says so, and keeps what there was room for."""
    _, kept = traced(scene_of("plain"), lambda *_: EventListSink(5 * 5 * SPP, 1, dr.mean))
    assert int(np.array(kept["used"]).max()) > 1


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


# ------------------------------------------------------------------------------------------------------- by themselves


def event_of(value, opl, active, depth):
    value, depth = mi.Spectrum(mi.Float(value)), mi.UInt32(depth)
    return Local(value=value, opl=mi.Float64(opl), active=mi.Bool(active), depth=depth)


def test_a_list_keeps_what_fits_and_counts_what_does_not():
    """By lane and slot; what is idle or dark takes none."""
    sink = EventListSink(3, 2, lambda value: 2 * value[0])
    kept = sink.begin(None)
    sink.event(kept, event_of([3, 5, 7], [1.5, 2.5, 3.5], [True, False, True], [4, 5, 6]))
    sink.event(kept, event_of([11, 13, 0], [4.5, 5.5, 6.5], [True, True, True], [7, 8, 9]))
    sink.event(kept, event_of([17, 19, 23], [7.5, 8.5, 9.5], [True, True, True], [10, 11, 12]))
    sink.end(kept)
    assert list(np.array(sink.used)) == [3, 2, 2]
    assert list(np.array(sink.energy)) == [6, 22, 26, 38, 14, 46]
    assert list(np.array(sink.opl)) == [1.5, 4.5, 5.5, 8.5, 3.5, 9.5]
    assert list(np.array(sink.depth)) == [4, 7, 8, 11, 6, 12]


def test_a_sum_is_that_of_active_events():
    block = Local(read=lambda opl, active: (mi.Spectrum(mi.Float(opl)), None))
    sink = AdjointSumSink(block)
    kept = sink.begin(None)
    sink.event(kept, event_of([3, 5], [2, 7], [True, True], 1))
    sink.event(kept, event_of([11, np.nan], [13, 17], [True, False], 2))
    assert list(np.array(kept["sum"])) == [6 + 143, 35]


def test_a_film_s_sink_sums_up_light_and_what_a_window_missed():
    put = []

    def answer(events, opl, value, active, crowded):
        put.append((events, crowded))
        return value[0] * 0.25, value[0] * 0.5

    sink = FilmSink(Local(begin=lambda: "events", put=answer, end=put.append))
    kept = sink.begin(None)
    for value, crowded in ((4.0, True), (8.0, False)):
        event = event_of([value], [1.0], [True], 1)
        event.crowded = crowded
        sink.event(kept, event)
    sink.end(kept)
    assert (kept["L"][0][0], kept["before"][0], kept["after"][0]) == (12, 3, 6)
    assert put == [("events", True), ("events", False), "events"]
    assert FilmSink.keeps_vertices is False


class ReadTogether:
    """A film's adjoint that is the length times the number of the channel, with a slope of minus that."""

    film = Local(channel_count=lambda: 3)

    def together(self, most, with_slope):
        self.most = most
        return 4

    def read_together(self, opls, with_slope, active):
        A = [[mi.Float(opl) * (c + 1) for c in range(3)] for opl in opls]
        return A, [[-a for a in channels] for channels in A] if with_slope else None

    def as_spectra(self, A, slope):
        return A, slope


@pytest.mark.parametrize("with_slope", [pytest.param(False, marks=pytest.mark.slow), True])
def test_arrivals_of_a_path_are_read_ahead(with_slope):
    block = ReadTogether()
    block.base = dr.arange(mi.UInt32, 3)
    connections = [Local(name="found"), Local(name="sampled")]
    arrivals = Arrivals(Local(connections=connections, wanted=Local(geometry=with_slope), max_depth=3), block)
    # Two connections at three vertices, in reads of four.
    assert (block.most, arrivals.lanes, arrivals.bytes_of_path()) == (6, 3, 8 * (8 + 12 * (2 if with_slope else 1)))
    assert arrivals.fields() == {"first": mi.UInt32, "found": mi.Bool, "sampled": mi.Bool}
    kept, vertices = arrivals.allocate(), []
    lengths = [2.0, 3.0, 5.0, 7.0, 11.0, 13.0]
    masks = np.array([[1, 0, 1], [1, 1, 0], [0, 0, 0], [1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
    for k in range(3):
        events = [Local(opl=mi.Float64(lengths[2 * k + i]), active=mi.Bool(masks[2 * k + i])) for i in range(2)]
        samples = {name: Local(event=event) for name, event in zip(("found", "sampled"), events, strict=True)}
        vertices.append(arrivals.append(kept, samples))
    assert list(np.array(kept["arrivals"])) == [5, 3, 4]
    kept = read_ahead(arrivals, kept, block)
    for k, vertex in enumerate(vertices):
        for i, name in enumerate(("found", "sampled")):
            active = mi.Bool(masks[2 * k + i])
            A, slope = arrivals.adjoint(kept, block, arrivals.number(vertex, name), active)
            for c in range(3):
                expected = lengths[2 * k + i] * (c + 1) * np.array(masks[2 * k + i])
                np.testing.assert_array_equal(np.array(dr.select(active, A[c], 0)), expected)
                if with_slope:
                    np.testing.assert_array_equal(np.array(dr.select(active, slope[c], 0)), -expected)
            assert (slope is None) == (not with_slope)
