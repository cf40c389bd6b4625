"""Groups of chains by themselves: their links, their numbers, and which lanes take them, against numpy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import mesh, plate, scene_of, wall_grid
from torchtransient.errors import SceneError
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner import late_light
from torchtransient.plugins.around_corner import late_light as chains
from torchtransient.plugins.around_corner.late_light import LateLanes, LateLaunch, LateLight, Tiles
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"


def vertices(rng, count, low, high, up):
    """Points in a box whose normals point up or down, by and large; every fifth one is dead."""
    n, g = (rng.normal(size=(count, 3)) * 0.5 + [0, 0, up] for _ in range(2))
    found = Local(p=rng.uniform(low, high, (count, 3)), n=n, geometric_n=g, value=rng.uniform(0.2, 2, count),
                  alive=np.arange(count) % 5 != 4, length=rng.uniform(1, 2, count))  # fmt: skip
    types = {"p": mi.Point3f, "n": mi.Vector3f, "geometric_n": mi.Vector3f, "value": mi.UnpolarizedSpectrum,
             "alive": mi.Bool, "length": mi.Float}  # fmt: skip
    given = {name: kind(np.transpose(getattr(found, name))) for name, kind in types.items() if name != "value"}
    given["value"] = mi.UnpolarizedSpectrum(mi.Float(found.value.astype(np.float32)))
    return found, Local(**given)


@pytest.mark.parametrize("smooth", [True, False])
def test_links_of_heads_and_tails(monkeypatch, smooth):
    """Every tail with the heads of its group, weighed by what all of them send there: cosines over the squared
    distance, none where one turns its back or a sheet is in between, which is asked of the others alone.
    """
    asked, occluded = [], chains.occluded
    monkeypatch.setattr(chains, "occluded", lambda *given: asked.append(np.array(given[-1])) or occluded(*given))
    rng, size, groups = np.random.default_rng(4), 4, 3
    count = size * groups
    heads, heads_in = vertices(rng, count, [-1, -1, 0], [1, 1, 0.4], 0.6)
    tails, tails_in = vertices(rng, count, [-1, -1, 1], [1, 1, 1.5], -0.6)
    density = rng.uniform(0.02, 0.3, count)
    scene = scene_of(mesh("sheet", plate(0.9, 0.7, (0.3, -0.2, 0.7))))
    table = [chains.VertexTable(each, smooth) for each in (heads_in, tails_in)]
    links = chains.Links(scene, Local(size=size), *table, mi.Float(density.astype(np.float32)))
    surface = [each.geometric_n if smooth else each.n for each in (heads, tails)]
    expected, counts, faces = {}, [0] * groups, []
    for t in range(count):
        group, q, r = t // size, np.zeros(size), np.zeros(size)
        for i in range(size):
            h = group * size + i
            d = tails.p[t] - heads.p[h]
            r[i] = np.linalg.norm(d)
            at = heads.p[h] + d * (0.7 - heads.p[h, 2]) / d[2]
            hidden = abs(at[0] - 0.3) < 0.45 and abs(at[1] + 0.2) < 0.35
            faces.append(heads.alive[h] and tails.alive[t] and tails.n[t] @ d < 0 < heads.n[h] @ d)
            if faces[-1] and not hidden:
                q[i] = max(heads.n[h] @ d, 0) * abs(surface[1][t] @ d) / r[i] ** 4 / np.pi
        drawn = 0.75 * q.sum() + size * 0.25 * density[t]
        for i in np.flatnonzero(q):
            expected[group * size + i, t] = q[i] * np.pi / drawn * heads.value[group * size + i], r[i]
            counts[group] += 1
    assert len(set(counts)) > 1 and 8 < len(expected) < 30
    assert asked[0].tolist() == faces and sum(faces) < 40
    assert np.array(links.count).tolist() == counts and links.most == max(counts)
    assert np.array(links.first).tolist() == [0, counts[0], counts[0] + counts[1]]
    rows = np.array(links.flat).reshape(-1, 4)
    assert len(rows) == len(expected) + 1 and not rows[-1].any()
    # Group by group, tail by tail.
    assert [(int(h), int(t)) for *_, h, t in rows[:-1]] == sorted(expected, key=lambda pair: pair[::-1])
    found = {(int(h), int(t)): (weight, r) for weight, r, h, t in rows[:-1]}
    for pair, numbers in expected.items():
        assert found[pair] == pytest.approx(numbers, rel=1e-4)


def test_more_chains_than_single_precision_counts():
    heads = Local(p=mi.Point3f(dr.zeros(mi.Float, 2**24 + 1), 0, 0))
    with pytest.raises(SceneError, match=r"at most 2\^24 chains at a time, got 16777217"):
        chains.Links(None, Local(size=4), heads, None, None)
    heads = Local(p=mi.Point3f(dr.zeros(mi.Float, 2**24), 0, 0))
    with pytest.raises(AttributeError, match="take"):
        chains.Links(None, Local(size=1), heads, None, None)


def test_vertices_in_memory_are_taken_by_number():
    """One that stands for all is each of them."""
    rng = np.random.default_rng(5)
    given, vertex = vertices(rng, 6, 0, 1, 1)
    vertex.length = mi.Float(0.5)
    for smooth in (True, False):
        taken = chains.VertexTable(vertex, smooth).take(mi.UInt32([4, 1]))
        for name in ("p", "n"):
            np.testing.assert_allclose(np.array(getattr(taken, name)).T, getattr(given, name)[[4, 1]], rtol=1e-6)
        surface = given.geometric_n if smooth else given.n
        np.testing.assert_allclose(np.array(taken.geometric_n).T, surface[[4, 1]], rtol=1e-6)
        assert np.array(taken.alive).tolist() == [False, True] and np.array(taken.length).tolist() == [0.5]


@pytest.mark.parametrize(("size", "groups", "stride"), [(1, 1, 1), (4, 3, 16), (4, 4, 16), (8, 5, 64), (1, 2, 2)])
def test_numbers_that_a_tile_has_for_itself(size, groups, stride):
    assert chains.ChainPlan(None, None, size, groups, 1, None).stride == stride


def test_sides_of_surfaces_that_are_drawn():
    """Nine times in ten that towards the scan where both scatter; always the front where it is the only one."""
    plan = Local(center=mi.Point3f(0.5, 0, -1))
    p, n = mi.Point3f([0, 2, 0, 0.5], 0, [1, 1, 1, 0]), mi.Vector3f([0, -1, 0, 1], 0, [-1, 0, 1, 0])
    found = chains._probability_of_front(plan, p, n, mi.Bool([True] * 4))
    np.testing.assert_allclose(np.array(found), [0.9, 0.9, 0.1, 0.1], rtol=1e-6)
    assert np.array(chains._probability_of_front(plan, p, n, mi.Bool([False] * 4))).tolist() == [1] * 4


@pytest.mark.slow
@pytest.mark.parametrize("two_sided", [True, False])
def test_points_that_are_drawn_on_a_sheet_of_two_colours(two_sided):
    """Each side with its normals, its colour and its probability: light off both adds up to that of the two."""
    v, f = plate(0.5, 0.4, (0.1, 0.2, 1.1))
    sheet = mesh("a", (v, f), 0.3, two_sided=two_sided, back=0.8 if two_sided else None)
    plan = chains.ChainPlan(HiddenElements([sheet], *wall_grid(2)), mi.Point3f(0, 0, 0), 4, 16, 1, None)
    places = np.random.default_rng(8).random((3, 64))
    places[2] = (np.arange(64) + 0.5) / 64
    places[2, 7] = 0.9  # which belongs to the back
    numbers = [mi.UInt32((row * 2.0**32).astype(np.uint32)) for row in places]
    drawn = chains._drawn(plan, numbers, (0, 1), 2)
    n, value, albedo = (np.array(each, dtype=float) for each in (drawn.n, drawn.value[0], drawn.albedo[0]))
    to_wall = n[2] < 0
    faces = np.cross(v[f[0][1]] - v[f[0][0]], v[f[0][2]] - v[f[0][0]])[2] < 0
    assert faces and np.array(drawn.alive).all()
    np.testing.assert_array_equal(to_wall, places[2] < 0.9 if two_sided else True)
    np.testing.assert_allclose(n, np.array(drawn.geometric_n))
    np.testing.assert_allclose(np.abs(n[2]), 1, rtol=1e-6)
    colour = np.where(to_wall, 0.3, 0.8)
    np.testing.assert_allclose(albedo, colour, rtol=1e-5)
    density = np.array(plan.elements.density_of(plan.elements.select_element(chains.unit_double(numbers[0]))[0]))
    chance = np.where(to_wall, 0.9, 0.1) if two_sided else 1
    np.testing.assert_allclose(value, colour / np.pi / (64 * density * chance), rtol=1e-4)
    np.testing.assert_allclose(np.array(chains.area_density(plan, drawn)), density * chance, rtol=1e-4)
    black = mesh("b", (v, f), 0.0, two_sided=two_sided, back=0.8 if two_sided else None)
    plan.elements = HiddenElements([black, sheet], *wall_grid(2))
    drawn = chains._drawn(plan, numbers, (0, 1), 2)
    np.testing.assert_array_equal(np.array(drawn.alive), np.array(drawn.albedo[0]) > 0)


@pytest.mark.parametrize("smooth", [False, True])
def test_what_a_ray_of_a_chain_meets(smooth):
    """A side that scatters, with normals on it; not the back of a sheet of one side, nor a black one, nor nothing."""
    v, f = plate(0.6, 0.6, (0, 0, 1))
    arrays = [(v + np.array([k, 0, 0]), f[:, ::-1] if k % 2 else f) for k in range(5)]
    sheets = [mesh(f"s{k}", arrays[k], (0.3, 0.4, 0.5, 0.6, 0)[k], two_sided=k > 1) for k in range(5)]
    origin = mi.Point3f([0.1, 1.1, 2.1, 3.1, 4.1, 9, 0.1, 2.1], 0.2, [0, 0, 0, 0, 0, 0, 2, 2])
    d = mi.Vector3f(0, 0, [1, 1, 1, 1, 1, 1, -1, -1])
    active = np.array([True] * 7 + [False])
    met = chains._step(scene_of(*sheets), Local(elements=Local(smooth=smooth)), origin, d, mi.Bool(active))
    assert np.array(met.alive).tolist() == [True, False, True, True, False, False, False, False]
    alive = np.array(met.alive)
    for name in ("n", "geometric_n"):
        np.testing.assert_allclose(np.array(getattr(met, name)).T[alive], [[0, 0, -1]] * 3, atol=1e-6)
    np.testing.assert_allclose(np.array(met.albedo[0])[alive], [0.3, 0.5, 0.6], rtol=1e-5)
    np.testing.assert_array_equal(np.array(met.value[0]), np.array(met.albedo[0]))
    np.testing.assert_allclose(np.array(met.p).T[alive], [[x, 0.2, 1] for x in (0.1, 2.1, 3.1)], atol=1e-5)


def test_steps_that_arrive_at_a_point_that_was_chosen(monkeypatch):
    """At its triangle, and within a thousandth of the way; a ray in any other direction arrives wherever it does."""
    sheets = [mesh(name, plate(1, 1, (0, 0, z))) for name, z in (("a", 4), ("b", 5))]
    off = np.array([0.9e-3, -0.9e-3, 1.1e-3, -1.1e-3, 0, 0, 0.5])
    shape = dr.gather(mi.ShapePtr, mi.ShapePtr(*sheets), mi.UInt32([0, 0, 0, 0, 1, 0, 0]))
    primitive = mi.UInt32([3, 3, 3, 3, 3, 2, 3])
    elements = Local(
        per_area=lambda *given: mi.Float(0), select_element=lambda x, active: (mi.UInt32(1), mi.Float(0.5)),
        point=lambda element, a, y, active: (mi.Point3f(0, 3, 4), None),
        surface=lambda element, active: (mi.ShapePtr(sheets[0]), mi.UInt32(3)),
    )  # fmt: skip
    up = mi.Vector3f(0, 0, 1)
    start = chains.Vertices(p=mi.Point3f(0, 0, 0), n=up, geometric_n=up, shape=shape, primitive=primitive,
                            alive=mi.Bool([True] * 7))  # fmt: skip

    def step(scene, plan, origin, d, active):
        p = origin + d * (5 * (1 + mi.Float(off.astype(np.float32))))
        return chains.Vertices(p=p, geometric_n=-up, shape=shape, primitive=primitive, alive=active)

    numbers = [mi.UInt32([2**31] * 6 + [4080218931]), mi.UInt32(2**31)]
    monkeypatch.setattr(chains, "_step", step)
    plan = Local(elements=elements, center=mi.Point3f(0, 0, 0))
    vertex, weight = chains._guided_step(None, plan, start, numbers, (0, 1))
    assert np.array(vertex.alive).tolist() == [True, True, False, False, False, False, True]
    assert (np.array(weight) > 0).tolist() == np.array(vertex.alive).tolist()


def test_where_rays_of_chains_start():
    """Off their surfaces, towards the side that they go to, by 2^-20 of the largest coordinate and of the distance to
    the scan.
    """
    plan = Local(center=mi.Point3f(1, -6, 3))
    p = np.array([[0, 2, -5], [0, 2, 5], [0, -0.5, 0.25]]).T
    start = Local(p=mi.Point3f(p), geometric_n=mi.Vector3f(-1, 0, 0))
    found = np.array(chains._origin(plan, start, mi.Vector3f([-0.3, 0.3, 0], 4, -5)), dtype=float)
    reach = np.abs(p).max(0) + np.linalg.norm(p - [[1], [-6], [3]], axis=0)
    np.testing.assert_allclose(found[0], -reach * 2.0**-20 * [1, -1, 1], rtol=1e-5)
    np.testing.assert_array_equal(found[1:], p[1:])


def test_every_vertex_has_numbers_of_its_own(monkeypatch):
    """Five of the head and the step to the tail, two sides, and two for each further vertex; lengths and values add up
    along the tail.
    """
    used, plan = [], Local(tail=4, seed=dr.opaque(mi.UInt32, 3), size=8, groups=1, center=mi.Point3f(0, 0, 0))

    def vertex(x, value, alive=True):
        return chains.Vertices(p=mi.Point3f(x, 0, 0), n=mi.Vector3f(0, 0, 1), value=mi.UnpolarizedSpectrum(value),
                               geometric_n=mi.Vector3f(0, 0, 1), albedo=mi.UnpolarizedSpectrum(value),
                               alive=mi.Bool(alive))  # fmt: skip

    def drawn(plan, numbers, place, side):
        used.append((place, side))
        return vertex(5, 0.5)

    def step(scene, plan, last, numbers, which):
        used.append((which, len(numbers)))
        return vertex(last.p.x + len(used), 0.5), mi.Float(0.25 if len(used) < 5 else 0)

    monkeypatch.setattr(chains, "_drawn", drawn)
    monkeypatch.setattr(chains, "_step", lambda *given: vertex(7, 0.25))
    monkeypatch.setattr(chains, "_guided_step", step)
    head, tail = chains.trace_chains(None, plan, dr.arange(mi.UInt32, 8))
    assert used == [((0, 1), 5), ((2, 3), 6), ((7, 8), 13), ((9, 10), 13), ((11, 12), 13)]
    first = np.array(tail[0].p.x)
    assert set(first) == {5, 7} and (first == 5).sum() == 2  # of eight chains in a row two begin over the area
    np.testing.assert_allclose(np.array(tail[0].value[0]), np.where(first == 5, 0.5, 0.25) / np.pi, rtol=1e-6)
    for j, (length, alive) in enumerate(((0, True), (3, True), (7, True), (12, False))):
        assert np.array(tail[j].length).max() == length and np.array(tail[j].alive).all() == alive
        np.testing.assert_allclose(np.array(tail[j].value[0]), np.array(tail[0].value[0]) * 0.125**j * alive, rtol=1e-6)
    assert head.length[0] == 0


@pytest.mark.parametrize("name", ["wall", "floor"])
def test_steps_to_what_is_hidden_weigh_its_form_factor(name):
    """From a wall, which most go to the hidden area from, and from what belongs to it."""
    wall, floor, roof = (mesh(one, (v, f[:, ::-1] if one != "roof" else f)) for one, (v, f) in (
        ("wall", plate(1, 1, (5, 0, 0.5))), ("floor", plate(1, 1, (0, 0, 0.5))), ("roof", plate(1, 0.6, (0, 0, 1.3)))
    ))  # fmt: skip
    plan = Local(elements=HiddenElements([floor, roof], *wall_grid(2)), center=mi.Point3f(0, 0, 0))
    shape = {"wall": wall, "floor": floor}[name]
    side = 64
    strata = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    places = (strata + np.random.default_rng(7).random((side**2, 2))) / side
    numbers = [mi.UInt32((places[:, i] * 2.0**32).astype(np.uint32)) for i in range(2)]
    up = mi.Vector3f(0, 0, 1)
    start = chains.Vertices(p=mi.Point3f(0, 0, 0.5), n=up, geometric_n=up, shape=dr.gather(
        mi.ShapePtr, mi.ShapePtr(shape), dr.zeros(mi.UInt32, side**2)
    ), primitive=dr.zeros(mi.UInt32, side**2), alive=dr.full(mi.Bool, True, side**2))  # fmt: skip
    vertex, weight = chains._guided_step(scene_of(floor, roof, wall), plan, start, numbers, (0, 1))
    alive, p = np.array(vertex.alive), np.array(vertex.p)
    # A quarter of a rectangle, of sides a and b in parts of its height, straight above.
    a, b = 0.5 / 0.8, 0.3 / 0.8
    quarter = sum(s / np.hypot(1, s) * np.arctan(t / np.hypot(1, s)) for s, t in ((a, b), (b, a))) / (2 * np.pi)
    assert np.array(weight).mean() == pytest.approx(4 * quarter, rel=0.02)
    np.testing.assert_allclose(p[2, alive], 1.3, rtol=1e-5)
    assert not np.array(weight)[~alive].any()
    # Most of the steps from the wall, a quarter of the others go to the hidden area, to the roof by its share.
    roofs = plan.elements.probabilities[0][plan.elements.elements.centers()[:, 2] > 1].sum()
    share = {"wall": 0.9, "floor": 0.25}[name]
    assert alive.mean() == pytest.approx(share * roofs + (1 - share) * 4 * quarter, abs=0.01)


# ------------------------------------------------------------------------------------------------- tiles and lanes


@pytest.mark.parametrize(("width", "height", "side", "tiles"), [(7, 5, 2, (4, 3)), (5, 7, 4, (2, 2)), (3, 2, 1, (3, 2)),
                                                                (4, 4, 4, (1, 1))])  # fmt: skip
def test_points_of_a_tile_lie_far_apart(width, height, side, tiles):
    """As many tiles as points of a patch; neighbours have different ones, and their ranks are near."""
    found = Tiles(width, height, side)
    across, down = tiles
    assert found.count == across * down
    of = found.numbers.reshape(height, width)
    for y in range(height):
        for x in range(width):
            assert of[y, x] == (y % down) * across + x % across
    assert np.array(found.tile_of_pixel).tolist() == found.numbers.tolist()
    rank = np.array(found.rank)
    assert sorted(rank) == list(range(across * down))
    if (across, down) == (4, 3):  # quarters of the scan come one after the other, within them row by row
        assert rank.reshape(3, 4).tolist() == [[0, 1, 4, 5], [2, 3, 6, 7], [8, 9, 10, 11]]


def test_regions_that_heads_of_a_group_come_from():
    """The lowest two bits are one for each group, and all numbers are taken once; where groups fill no four regions
    evenly numbers stay.
    """
    plan = Local(size=2, groups=8)
    row = dr.arange(mi.UInt32, 16)
    found = np.array(late_light._in_regions(row, plan)).reshape(8, 2)
    assert (found % 4).tolist() == [[k % 4] * 2 for k in range(8)]
    assert sorted(found.ravel()) == list(range(16))
    assert (found // 4).tolist() == [[0, 1]] * 4 + [[2, 3]] * 4
    assert np.array(late_light._in_regions(row, Local(size=2, groups=6))).tolist() == list(range(16))


def light_of(kind, size=(5, 3), lasers=6, bounces=(4, 6), most=None, **choices):
    film = Local(crop_size=lambda: size, lanes_at_most=lambda events: most)
    job = Local(film=film, sensors=Local(width=size[0] * size[1]))
    return LateLight(job, None, Local(width=lasers), kind, bounces, **choices)


def test_tables_of_a_group(monkeypatch):
    """Links of a group, and in exhaustive captures what every spot sees of the tails; tiles there hold more points
    until tables fit.
    """
    assert light_of(CaptureType.SINGLE, lasers=1)._entries(5) == 5 * 32 * 32
    assert light_of(CaptureType.EXHAUSTIVE)._entries(5) == 5 * 32 * 32
    many = light_of(CaptureType.EXHAUSTIVE, lasers=15)
    assert many._entries(5) == 5 * 32 * 45 and many.tiles.count == 2
    for most, tiles in ((15 * 32 * 45, 15), (15 * 32 * 45 - 1, 6), (6 * 32 * 45 - 1, 2), (2 * 32 * 45 - 1, 1), (1, 1)):
        monkeypatch.setattr(late_light, "_MOST_ENTRIES", most)
        assert light_of(CaptureType.EXHAUSTIVE, lasers=15, side=1).tiles.count == tiles
        assert light_of(CaptureType.CONFOCAL, lasers=15, side=1).tiles.count == 15


@pytest.mark.parametrize(("count", "size", "groups"), [(1, 1, 1), (3, 4, 1), (32, 32, 1), (33, 32, 2), (97, 32, 4)])
def test_chains_of_a_job_in_groups(monkeypatch, count, size, groups):
    """As many as fill a power of two, then groups that are filled up; some groups at a time, and told of."""
    blocks, launched, told = [], [], []
    light = light_of(CaptureType.SINGLE, size=(2, 3), lasers=1)
    monkeypatch.setattr(light, "_groups_at_once", lambda: 2)
    monkeypatch.setattr(light, "_launches", lambda part, band, row, rows: [(part, band, row, rows)])
    monkeypatch.setattr(light, "_launch", lambda part, launch: launched.append((part, *launch)))
    monkeypatch.setattr(late_light, "GroupBlock", lambda light, first, n: blocks.append((first, n)) or len(blocks))
    light.job.film.band_layout = lambda: [(0, 2), (2, 1)]
    light.job.done = lambda *given: told.append(given)
    light.job.sensors.p = mi.Point3f([1, 2, 6], [0, 1, -4], 2)
    light.add(count, 5)
    assert (light.plan.size, light.plan.groups, light.plan.tail) == (size, groups, 3)
    assert blocks == [(first, min(2, groups - first)) for first in range(0, groups, 2)]
    assert launched == [(k + 1, k + 1, *band) for k in range(len(blocks)) for band in ((0, 0, 2), (1, 2, 1))]
    assert told == [((first + n) / groups, band) for first, n in blocks for band in (0, 1)]
    np.testing.assert_allclose(np.array(light.plan.center).ravel(), [3, -1, 2], rtol=1e-6)
    seeds = []
    for seed in (5, 5 + 2**32, mi.UInt32(5), 6):
        light.add(count, seed)
        seeds.append(light.plan.seed[0])
    assert len(set(seeds[:3])) == 1 and len(set(seeds)) == 2
    # From version to version a seed is the same chains.
    assert seeds[0] == 1455807922


def test_groups_at_a_time(monkeypatch):
    """Lanes for all cores, no more than there are, and no larger tables than may be."""
    backend = dr.backend_v(mi.Float)
    monkeypatch.setitem(late_light._BUSY, backend, 100)

    def at_once(kind, groups, lasers=3):
        light = light_of(kind, lasers=lasers, size=(5, 3))
        light.plan = Local(groups=groups)
        return light._groups_at_once()

    assert at_once(CaptureType.CONFOCAL, 50) == 6 and at_once(CaptureType.CONFOCAL, 4) == 4
    assert at_once(CaptureType.EXHAUSTIVE, 50) == 2 and at_once(CaptureType.EXHAUSTIVE, 50, 30) == 1
    monkeypatch.setattr(late_light, "_MOST_ENTRIES", 2 * 32 * 32 * 3)
    assert at_once(CaptureType.CONFOCAL, 50) == 3
    monkeypatch.setattr(late_light, "_MOST_ENTRIES", 1)
    assert at_once(CaptureType.CONFOCAL, 50) == 1


def test_launches_of_films_that_list_events():
    """As many rows at a time as lanes fit, each lane with as many links as it has room for; one for all other films."""
    part = Local(groups=2, links=Local(most=23), lit=[None, None])
    (whole,) = light_of(CaptureType.SINGLE)._launches(part, 1, 4, 7)
    assert whole == LateLaunch(1, 4, 7, 2, 1, 23, False)
    links = late_light.EVENTS // 2
    pieces = -(-23 // links)
    rows = light_of(CaptureType.SINGLE, most=5 * 2 * pieces * 3 + 1)._launches(part, 1, 4, 7)
    assert rows == [LateLaunch(1, row, n, 2 * pieces, pieces, links, True) for row, n in ((4, 3), (7, 3), (10, 1))]
    part = Local(groups=2, links=Local(most=0), lit=[None] * (late_light.EVENTS + 1))
    rows = light_of(CaptureType.SINGLE, most=1)._launches(part, 0, 0, 2)
    assert rows == [LateLaunch(0, row, 1, 2, 1, 1, True) for row in range(2)]


@pytest.mark.parametrize("kind", [CaptureType.SINGLE, CaptureType.EXHAUSTIVE])
@pytest.mark.parametrize("listed", [True, False])
def test_numbers_of_lanes(kind, listed):
    """Every pixel with every piece of every group, and every spot in exhaustive captures: lanes of a pixel together
    where events are listed, else points of a tile.
    """
    light, launch = light_of(kind, side=2), LateLaunch(0, 1, 2, 6, 3, 9, listed)
    pixel, group, piece, laser = (np.array(each) for each in LateLanes._numbers(light, None, launch))
    spots = range(6) if kind is CaptureType.EXHAUSTIVE else range(1)
    tile = light.tiles.numbers
    rest = [(g, k) for g in range(2) for k in range(3)]
    if listed:
        expected = [(p, g, k, s) for p in range(5, 15) for g, k in rest for s in spots]
    else:
        expected = [(p, g, k, s) for g, k in rest for p in sorted(range(5, 15), key=lambda p: tile[p]) for s in spots]
    assert [tuple(row) for row in np.stack([pixel, group, piece, laser], 1).tolist()] == expected
