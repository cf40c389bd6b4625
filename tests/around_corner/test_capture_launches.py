"""How a capture is split into launches and lanes: every sample meets every point, once."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.around_corner import late_light, launches, third_bounce_gradients
from torchtransient.plugins.around_corner.late_light import ChainPlan, Tiles, divmod_by
from torchtransient.plugins.around_corner.occlusion import MutualOcclusion
from torchtransient.plugins.around_corner.third_bounce_gradients import AdjointReader, Ends, Split
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"
WIDTH, BANDS, SAMPLES = 5, [(0, 3), (3, 1)], 43


def film_of(most=None, entry=None):
    return Local(crop_size=lambda: (WIDTH, 4), lanes_at_most=lambda events: most, band_layout=lambda: BANDS,
                 entries_per_pixel=lambda: 7, first_entry=lambda: entry)  # fmt: skip


def covered(found):
    """How often each pixel meets each sample."""
    times = np.zeros((WIDTH * 4, SAMPLES), dtype=int)
    for launch in found:
        pixel, first, last = (np.array(each) for each in launch.lanes())
        assert len(pixel) == launch.width * launch.rows * launch.spp and launch.chunks == launch.spp
        first, last = np.broadcast_to(first, pixel.shape), np.broadcast_to(last, pixel.shape)
        if launch.lists_events:
            assert (np.diff(pixel) >= 0).all() and (last - first.astype(int)).max() <= launches.EVENTS
        elif launch.spp > 1:
            assert (np.diff(pixel)[: launch.width * launch.rows - 1] == 1).all()
        for one, begin, end in zip(pixel, first, last, strict=True):
            times[one, begin:end] += 1
    return times


@pytest.mark.parametrize("busy", [1, 15, 64, 10**6])
def test_lanes_that_add_up(monkeypatch, busy):
    """As many for a pixel as keep all cores busy, in launches of so many connections."""
    monkeypatch.setattr(launches, "_BUSY", {dr.backend_v(mi.Float): busy})
    found = launches.launches_of(film_of(), SAMPLES)
    lanes = [min(max(1, busy // (WIDTH * rows)), SAMPLES) for _, rows in BANDS]
    expected = [(k, first, rows, first, lanes[k], 0, SAMPLES) for k, (first, rows) in enumerate(BANDS)]
    told = [(n.band, n.first_row, n.rows, n.band_first_row, n.spp, n.first, n.last) for n in found]
    assert told == expected and {(n.width, n.most_events, n.lists_events) for n in found} == {(WIDTH, 1, False)}
    assert (covered(found) == 1).all()
    monkeypatch.setattr(launches, "_CONNECTIONS", 15 * 7)
    found = launches.launches_of(film_of(), SAMPLES)
    parts = [(n.band, n.first, n.last) for n in found]
    ends = [[*range(0, SAMPLES, size), SAMPLES] for size in (7, 21)]
    assert parts == [(k, *pair) for k in (0, 1) for pair in zip(ends[k], ends[k][1:], strict=False)]
    assert (covered(found) == 1).all()


def test_few_points_have_many_lanes():
    """Some thousands in all, in one launch for a second's work."""
    found = launches.launches_of(film_of(), 2**16)
    assert len(found) == 2 and all(2**11 < n.width * n.rows * n.spp <= 2**13 for n in found)


@pytest.mark.parametrize(("most", "spp", "rows"), [
    (1, [1, 1, 1], [1] * 4), (10, [2, 1], [1] * 4), (15, [3], [1] * 4), (30, [3], [2, 1, 1]), (44, [3], [2, 1, 1]),
    (45, [3], [3, 1]), (1000, [3], [3, 1]),
])  # fmt: skip
def test_lanes_that_list_events(most, spp, rows):
    """Of at most sixteen samples each: all lanes of a row at once where they fit, several rows where these do."""
    found = launches.launches_of(film_of(most), SAMPLES)
    assert [(n.rows, n.spp) for n in found] == [(height, lanes) for height in rows for lanes in spp]
    starts = np.cumsum([0, *rows])[:-1]
    assert [n.first_row for n in found] == [row for row in starts for _ in spp]
    assert [n.band_first_row for n in found] == [3 if row == 3 else 0 for row in starts for _ in spp]
    assert {(n.most_events, n.lists_events, n.width) for n in found} == {(launches.EVENTS, True, WIDTH)}
    assert (covered(found) == 1).all()


@pytest.mark.parametrize("entry", [None, 3])
def test_where_a_pixel_begins_in_its_band(entry):
    launch = launches.Launch(1, 3, 1, 1, WIDTH, 3, 0, SAMPLES, 1, False)
    base = np.array(launch.base(film_of(entry=entry), mi.UInt32([15, 17])))
    assert base.tolist() == [0 + (entry or 0), 14 + (entry or 0)]


@pytest.mark.parametrize("busy", [1, 3, 7, 100])
def test_lanes_of_a_derivative(monkeypatch, busy):
    """Several for each sample where there are few, each with a range of the points."""
    monkeypatch.setattr(third_bounce_gradients, "BUSY", busy)
    split = Split(Ends(3, {"leg": mi.Float([2, 3, 5])}), 11)
    assert split.lanes == min(11, max(1, -(-busy // 3)))
    times = np.zeros((3, 11), dtype=int)
    for own, first, last in zip(*(np.array(each) for each in (split.own, split.first, split.last)), strict=True):
        times[own, first:last] += 1
    assert (times == 1).all()
    np.testing.assert_array_equal(np.array(split.fields.leg), np.array([2, 3, 5])[np.array(split.own)])
    value = np.arange(3.0 * split.lanes) ** 2
    found = np.array(split.reduced(mi.Float(value)))
    np.testing.assert_array_equal(found, value.reshape(split.lanes, 3).sum(0))


def test_adjoints_of_scanned_points_are_those_of_their_pixels():
    asked = []
    incoming = Local(block=lambda place, pixel, match: asked.append((place, pixel, match)))
    AdjointReader(film_of(), "match", incoming).block(mi.UInt32([0, 4, 5, 17]))
    place, pixel, match = asked[0]
    assert (np.array(place.row).tolist(), np.array(place.column).tolist()) == ([0, 0, 1, 3], [0, 4, 0, 2])
    assert (np.array(pixel).tolist(), match, place.laser) == ([0, 4, 5, 17], "match", None)


def test_points_of_edges_for_each_pixel():
    """Evenly spread over all edges, every pixel's by themselves, and along each edge; as many as a launch says."""
    ends = mi.Point3f([0, 2], [0, 0], [1, 1]), mi.Point3f([0, 5], [3, 0], [1, 5])
    asked = []

    def sample(x):
        asked.append(np.array(x))
        index = mi.UInt32(dr.select(x < 0.25, mi.UInt32(0), 1))
        return index, dr.select(index == 0, mi.Float(4), 4 / 3)

    edges = Local(sample=sample, end_points=lambda index: [dr.gather(mi.Point3f, end, index) for end in ends],
                  third_corners=lambda index: ("corners", index))  # fmt: skip
    pixel = mi.UInt32(np.repeat(np.arange(3, dtype=np.uint32), 8))
    found = MutualOcclusion(None, None, None, None, edges, None, [])._edge_point(pixel, Local(spp=8, seed=mi.UInt32(4)))
    x = asked[0].reshape(3, 8)
    np.testing.assert_array_equal(np.floor(x * 8), [np.arange(8)] * 3)
    assert len({tuple(np.round(row * 8 % 1, 6)) for row in x}) == 3
    second = x.ravel() >= 0.25
    p, t, weight = np.array(found.p, dtype=float).T, np.array(found.t).T, np.array(found.weight)
    np.testing.assert_allclose(t, np.where(second[:, None], [0.6, 0, 0.8], [0, 1, 0]), atol=1e-6)
    np.testing.assert_allclose(weight, np.where(second, 5 * 4 / 3, 3 * 4), rtol=1e-5)
    u = np.where(second, (p[:, 0] - 2) / 3, p[:, 1] / 3)
    along = t * (u * np.where(second, 5, 3))[:, None]
    np.testing.assert_allclose(p, np.where(second[:, None], [2, 0, 1], [0, 0, 1]) + along, atol=1e-5)
    assert ((u > 0) & (u < 1)).all() and (np.sort(np.floor(u.reshape(3, 8) * 8), 1) == np.arange(8)).all()
    assert found.sides[0] == "corners"


def test_points_of_a_tile_lie_as_far_apart_as_a_scan_is_wide():
    """Neighbouring tiles stand next to each other along a curve."""
    tiles = Tiles(5, 3, 2)
    assert tiles.count == 6 and tiles.numbers.tolist() == [0, 1, 2, 0, 1, 3, 4, 5, 3, 4, 0, 1, 2, 0, 1]
    assert np.array(tiles.tile_of_pixel).tolist() == tiles.numbers.tolist()
    assert np.array(tiles.rank).tolist() == [0, 1, 4, 2, 3, 5]
    one = Tiles(3, 2, 4)
    assert (one.count, one.numbers.tolist(), np.array(one.rank).tolist()) == (1, [0] * 6, [0])
    assert Tiles(4, 1, 1).numbers.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("first", "groups"), [(0, 2), (2, 3), (4, 4)])
def test_chains_of_all_tiles_are_points_of_one_set(monkeypatch, first, groups):
    """Each tile has a block of numbers of its own, by its rank, and goes on where the groups before have ended."""
    asked = []

    def traced(scene, plan, index):
        asked.append(np.array(index))
        raise StopIteration

    monkeypatch.setattr(late_light, "trace_chains", traced)
    monkeypatch.setattr(late_light, "_in_regions", lambda row, plan: row * 2)
    tiles = Tiles(7, 5, 2)
    plan = ChainPlan(None, None, 4, 9, 2, None)
    with pytest.raises(StopIteration):
        late_light.GroupBlock(Local(plan=plan, job=Local(scene=None), tiles=tiles), first, groups)
    rows = np.arange(4 * first, 4 * (first + groups))
    expected = 64 * np.array(tiles.rank)[:, None] + 2 * rows
    assert plan.stride == 64 and tiles.count == 12
    np.testing.assert_array_equal(asked[0].reshape(12, -1), expected)


def test_numbers_of_narrow_scans():
    """Squares of four tiles one after the other, also where only two rows of them are, or two columns."""
    squares = np.arange(4)[None] * 4 + np.array([[0, 1], [2, 3]])[..., None]
    wide = squares.transpose(0, 2, 1).reshape(2, 8)
    assert np.array(Tiles(8, 2, 1).rank).tolist() == wide.ravel().tolist()
    assert np.array(Tiles(7, 2, 1).rank).tolist() == [*wide[0, :6], 12, *wide[1, :6], 13]
    assert np.array(Tiles(2, 8, 1).rank).tolist() == squares.transpose(2, 0, 1).ravel().tolist()


@pytest.mark.parametrize(("exhaustive", "spp"), [(True, 1), (False, 3)])
def test_a_launch_of_late_light_in_a_band(monkeypatch, exhaustive, spp):
    """Its pixels count from the band's first row on, five a row, with the entries of their spots; all of the light, and
    what is outside, goes to their places on the film.
    """
    done, pixel, spot = [], mi.UInt32([15, 17, 19]), mi.UInt32([1, 2, 0])
    film = film_of()
    film.pixel_base = lambda base, laser: base + 100 * laser
    film.add_steady = lambda place, channels: done.append(("steady", place, channels))
    film.add_outside = lambda place, before, after: done.append(("outside", place, before, after))
    target = Local(begin=lambda: "begun", end=lambda block: done.append(block), finish=lambda: done.append("finished"))
    film.create_event_block = lambda *given, **named: done.append((*given, named)) or target
    monkeypatch.setattr(late_light, "LateLanes", lambda *given: Local(pixel=pixel, laser=spot))

    def summed(light, part, lanes, block, kept):
        assert block is target and kept["block"] == "begun"
        assert [np.array(kept[name]).ravel().tolist() for name in ("L", "before", "after")] == [[0]] * 3
        return {"L": "light", "before": "before", "after": "after", "block": "ended"}

    monkeypatch.setattr(late_light, "sum_over_links", summed)
    light = Local(job=Local(film=film, match=Local(to_channels=lambda value: [value])), exhaustive=exhaustive)
    launch = late_light.LateLaunch(1, 3, 1, spp, 1, 5, False)
    late_light.LateLight._launch(light, "part", launch)
    (asked, base, match, events, named), ended, steady, outside, finished = done
    assert asked is launch and match is light.job.match and events == late_light.EVENTS
    assert named == {"exclusive": spp == 1} and (ended, finished) == ("ended", "finished")
    assert np.array(base).tolist() == [0 + 100 * exhaustive, 14 + 200 * exhaustive, 28]
    assert (steady, outside) == (("steady", pixel, ["light"]), ("outside", pixel, "before", "after"))


def test_quotients_and_rests():
    quotient, rest = divmod_by(mi.UInt32([0, 6, 7, 20]), 7)
    assert (np.array(quotient).tolist(), np.array(rest).tolist()) == ([0, 0, 1, 2], [0, 6, 0, 6])
