"""What a job is split into: launches of lanes that fit, of rows and samples that sum to what was asked for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.walks import launches as launches_of
from torchtransient.errors import GradientError, SceneError, TorchTransientWarning, UnitError
from torchtransient.plugins.integrators import job as launch
from torchtransient.plugins.integrators.job import IncomingAdjoint, passes_of, seed_array, share_of
from torchtransient.plugins.transport.record import RecordLayout
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"


class Sampler:
    """One that rounds sample counts up to multiples of ``step``."""

    def __init__(self, step=1, count=8):
        self.step, self.count = step, count

    def set_sample_count(self, count):
        self.count = -(-count // self.step) * self.step

    def sample_count(self):
        return self.count


class Film:
    """``width`` pixels, in bands of (first row, rows)."""

    def __init__(self, width, bands, lasers=None, most=None):
        self.width, self.bands, self.most = width, bands, most
        self.lasers, self.exhaustive_scan = lasers, lasers is not None

    def crop_size(self):
        return (self.width, sum(rows for _, rows in self.bands))

    def laser_count(self):
        return self.lasers

    def lanes_at_most(self, most_events):
        return None if self.most is None else self.most // most_events

    def band_layout(self):
        return self.bands


def launches(film, spp, most_events=1, lanes=None, sampler=None, seed=5):
    passes, largest = passes_of(sampler or Sampler(), film, seed, spp, most_events, lanes)
    return [(p.band, p.first_row, p.rows, p.spp, p.total) for p in passes], largest


def test_one_launch_where_everything_fits():
    assert launches(Film(7, [(0, 5)]), 3) == ([(0, 0, 5, 3, 3)], 3)
    # Without a number it is the sampler's.
    assert launches(Film(7, [(0, 5)]), 0) == ([(0, 0, 5, 8, 8)], 8)
    # As many lanes as there may be, and one more.
    assert len(launches(Film(7, [(0, 5)]), 6, lanes=7 * 5 * 6)[0]) == 1
    assert launches(Film(7, [(0, 5)]), 7, lanes=7 * 5 * 6)[0] == [(0, 0, 5, 6, 7), (0, 0, 5, 1, 7)]


def test_launches_of_few_lanes_are_of_samples_then_of_rows():
    assert launches(Film(7, [(0, 5)]), 5, lanes=70)[0] == [(0, 0, 5, 2, 5), (0, 0, 5, 2, 5), (0, 0, 5, 1, 5)]
    # Less than one sample of all rows: as many rows as fit, the last ones are fewer.
    found = launches(Film(7, [(0, 5)]), 2, lanes=14)[0]
    assert found == [(0, row, rows, 1, 2) for row, rows in ((0, 2), (2, 2), (4, 1)) for _ in range(2)]
    # Every laser position is a lane of its own.
    assert launches(Film(7, [(0, 5)], lasers=3), 2, lanes=105)[0] == [(0, 0, 5, 1, 2)] * 2


def test_bands_are_launched_one_after_the_other():
    found, largest = launches(Film(3, [(0, 4), (4, 2)]), 4, lanes=24, sampler=Sampler(2))
    assert found == [(0, 0, 4, 2, 4), (0, 0, 4, 2, 4), (1, 4, 2, 4, 4)]
    assert largest == 4


def test_what_a_film_keeps_of_events_bounds_the_lanes():
    assert launches(Film(7, [(0, 5)], most=350), 4, most_events=5)[0] == [(0, 0, 5, 2, 4)] * 2
    assert launches(Film(7, [(0, 5)], most=350), 4, most_events=5, lanes=35)[0] == [(0, 0, 5, 1, 4)] * 4
    assert launches(Film(7, [(0, 5)], most=0), 4)[0] == [(0, 0, 5, 4, 4)]


@pytest.mark.parametrize(("step", "spp", "most", "counts"), [
    (4, 10, 8, [8, 4]), (4, 10, 7, [4, 4, 4]), (3, 7, 100, [9]), (16, 40, 33, [16, 16, 16]), (5, 6, 3, [5, 5]),
])  # fmt: skip
def test_samplers_that_round_up(step, spp, most, counts):
    """Each launch in numbers that the sampler takes, at most as many as fit where there are such."""
    assert launch._launch_counts(Sampler(step), spp, most) == counts


def test_rows_that_fit_with_as_many_samples_as_a_sampler_draws():
    """Of two samples it makes four: with all five rows these would be twice as many lanes as there may be."""
    found = launches(Film(7, [(0, 5)]), 5, lanes=70, sampler=Sampler(4))[0]
    assert found == [(0, row, rows, 4, 8) for row, rows in ((0, 2), (2, 2), (4, 1)) for _ in range(2)]


def test_launches_have_seeds_of_their_own():
    single = passes_of(Sampler(), Film(7, [(0, 5)]), 12, 2, 1)[0]
    assert [p.seed[0] for p in single] == [12]
    several = [passes_of(Sampler(), Film(7, [(0, 5)]), seed, 6, 1, 70)[0] for seed in (12, mi.UInt32(12), 13)]
    seeds = [[int(p.seed[0]) for p in passes] for passes in several]
    assert seeds[0] == seeds[1] == [int(mi.sample_tea_32(mi.UInt32(12), mi.UInt32(k))[0][0]) for k in range(3)]
    assert len({*seeds[0], *seeds[2]}) == 6


def test_seeds():
    assert (seed_array(7)[0], seed_array(np.int64(7))[0], seed_array(mi.UInt32(7))[0]) == (7, 7, 7)
    assert seed_array(2**32 - 1)[0] == 2**32 - 1
    for seed, counted in ((2**32, 0), (-1, 2**32 - 1), (2**33 + 3, 3)):
        with pytest.warns(TorchTransientWarning, match=f"counts as {counted}"):
            assert seed_array(seed)[0] == counted
    with pytest.raises(UnitError, match="whole number"):
        seed_array(1.5)


def test_records_need_room_for_a_row():
    launches(Film(7, [(0, 5)]), 1, lanes=7)
    with pytest.raises(GradientError, match=r"those of 6 paths at once: .* got 7\."):
        launches(Film(7, [(0, 5)]), 1, lanes=6)
    with pytest.raises(GradientError, match=r"got 21\."):
        launches(Film(7, [(0, 5)], lasers=3), 1, lanes=20)


def test_progress_of_a_part():
    said = []
    share_of(said.append, 1, 4)(0.5)
    share_of(said.append, 3, 4)(1.0)
    assert said == [0.375, 1.0]
    assert share_of(None, 1, 4) is None


# ------------------------------------------------------------------------------------------------- adjoints of films


class AdjointFilm:
    laser_scan_width = 3

    def cube_shape(self):
        return (2, 3, 5, 4)

    def channel_count(self):
        return 4

    def create_adjoint_block(self, transient, base, steady, match):
        return Local(transient=transient, base=base, steady=steady, match=match)


def test_where_an_adjoint_is_read():
    """Tensors of the film's shape, or flat arrays with an offset and strides; that of a pair by its laser position."""
    rays = Local(row=mi.UInt32([1, 0]), column=mi.UInt32([2, 1]), laser=None)
    steady = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    cube = mi.TensorXf(np.zeros((2, 3, 5, 4), dtype=np.float32))
    block = IncomingAdjoint(AdjointFilm(), mi.TensorXf(steady), cube).block(rays, mi.UInt32([5, 1]), "match")
    assert [list(np.array(c)) for c in block.steady] == [[steady[1, 2, c], steady[0, 1, c]] for c in range(4)]
    assert (list(np.array(block.base)), block.transient[1:], block.match) == ([1 * 60 + 2 * 20, 20], (4, 1), "match")
    bare = IncomingAdjoint(AdjointFilm(), None, (cube.array, 7, (1000, 100, 10, 2, 3, 5))).block(
        Local(row=mi.UInt32([1, 2]), column=mi.UInt32([2, 3]), laser=mi.UInt32([7, 5])), None, None
    )
    assert list(np.array(bare.base)) == [7 + 1000 + 200 + 2 * 10 + 1 * 2, 7 + 2000 + 300 + 1 * 10 + 2 * 2]
    assert (bare.transient[1:], [c[0] for c in bare.steady]) == ((3, 5), [0] * 4)
    none = IncomingAdjoint(AdjointFilm(), mi.TensorXf(steady), None).block(rays, mi.UInt32([5, 1]), None)
    assert none.transient is None and none.base[0] == 0


def test_adjoints_of_another_shape():
    with pytest.raises(GradientError, match=r"\(2, 3, 5, 4\) expected, got \(2, 3, 4, 5\)"):
        IncomingAdjoint(AdjointFilm(), None, mi.TensorXf(np.zeros((2, 3, 4, 5), dtype=np.float32)))


# --------------------------------------------------------------------------------------------------------- mistakes

LAMP = {"lamp": {"type": "point", "intensity": 1.0, "position": [0.3, 0.2, 2.0]}}


def test_mistakes_of_a_job():
    scene = load(camera(2, 2, bins=3), LAMP)
    integrator = scene.integrator()
    for index in (-1, 1):
        with pytest.raises(SceneError, match=f"has 1 sensors, got index {index}"):
            integrator.render(scene, sensor=index, spp=1)
    with pytest.raises(SceneError, match=r"kind of job, one of .*, got 'sideways'"):
        integrator.prepared(scene, spp=1, kind="sideways")
    plain = load(camera(2, 2, transient=False), LAMP)
    with pytest.raises(SceneError, match="transient_hdr_film, gated_hdr_film or phasor_hdr_film"):
        plain.integrator().render(plain, spp=1)
    pairs = camera(2, 2, bins=3)
    pairs["film"] |= {"exhaustive_scan": True, "laser_scan_width": 2, "laser_scan_height": 3}
    pairs = load(pairs, LAMP)
    with pytest.raises(SceneError, match="exhaustive_scan needs an integrator with a scanned laser"):
        pairs.integrator().render(pairs, spp=1)
    light = {"type": "rectangle", "emitter": {"type": "directionalarea", "radiance": 1.0, "id": "slide"}}
    untraceable = load(camera(2, 2, bins=3), {"screen": light})
    with pytest.raises(GradientError, match=r"'slide'.*cannot be asked for its light"):
        untraceable.integrator().render_forward(untraceable, None, spp=1)


def test_a_record_has_room_for_32_masks():
    """One of them is that of the walk."""

    def layout(count):
        fields = dict.fromkeys((f"mask {k}" for k in range(count)), mi.Bool) | {"u": mi.Float}
        many = Local(name="many", fields=lambda world: fields)
        return RecordLayout(Local(index_changes=False, strategies=lambda: [many]))

    assert sorted(layout(31).bits.values()) == [2**k for k in range(32)]
    assert set(layout(31).types) == {("walk", "β"), ("walk", "τ"), ("walk", "rr"), ("many", "u")}
    with pytest.raises(SceneError, match=r"at most 32 masks of all strategies, got 33\."):
        layout(32)


def test_a_shutter_spreads_the_moments_of_rays():
    scene = load(camera(4, 3, bins=3, shutter_open=2.0, shutter_close=5.0), LAMP)
    still = load(camera(4, 3, bins=3, shutter_open=2.0, shutter_close=2.0), LAMP)
    times = []
    for one in (scene, still):
        integrator = one.integrator()
        with dr.suspend_grad():
            sensor, film = integrator.resolve(one, 0)
            contents = integrator.contents(one, sensor)
            job = launches_of(integrator.render_context(one, contents), sensor, film, 3, 64)[0]
            times.append(np.array(integrator.start(one, contents, sensor, film, job).ray.time))
    assert times[0].min() >= 2 and times[0].max() < 5
    np.testing.assert_allclose(np.quantile(times[0], [0.25, 0.5, 0.75]), [2.75, 3.5, 4.25], atol=0.15)
    assert (times[1] == 2).all()


def test_a_lent_array_is_added_to_from_its_first_entry_on():
    scene = load(camera(3, 2, bins=5, bin_width=2.0), {**LAMP, "wall": {"type": "rectangle"}})
    film, integrator = scene.sensors()[0].film(), scene.integrator()
    expected = np.array(integrator.render(scene, seed=2, spp=8)[1]).ravel()
    storage = dr.zeros(mi.Float, 7 + expected.size + 4)
    film.lend((storage, 7))
    try:
        integrator.render(scene, seed=2, spp=8, develop=False)
        found = np.array(film.band_array(0))
    finally:
        film.lend(None)
    assert expected.sum() > 0
    np.testing.assert_allclose(found[7:-4], expected, rtol=1e-5)
    assert not found[:7].any() and not found[-4:].any()


def test_what_samples_count_for_in_channels_is_no_function_of_the_scene():
    """Derivatives by the rays are taken where light arrives, not again where it is counted."""
    weight = mi.UnpolarizedSpectrum(0.5)
    dr.enable_grad(weight)
    rays = Local(ray=dr.zeros(mi.Ray3f), weight=weight, scale=mi.Float(3.0), seen=None)
    integrator = load(camera(1, 1), {}).integrator()
    match = integrator.channel_match(Local(observer=None), Local(curves=None), rays)
    (channel,) = match.to_channels(mi.UnpolarizedSpectrum(2.0))
    assert float(channel[0]) == 3.0 and not dr.grad_enabled(channel)
