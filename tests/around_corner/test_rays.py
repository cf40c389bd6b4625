"""What single connections bring, and which of them a ray is asked for: where there may be light, and no more."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.around_corner import exhaustive, late_light, third_bounce
from torchtransient.plugins.around_corner import late_light as chains
from torchtransient.plugins.around_corner import third_bounce_gradients as attached
from torchtransient.plugins.around_corner import third_bounce_gradients as gradients
from torchtransient.plugins.around_corner.geometry import WallPoints
from torchtransient.plugins.around_corner.third_bounce import SampleTable
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"
COUNT, START = 40, 0.5
LANES = np.arange(COUNT)


class Ends:
    """Samples in numpy and in Dr.Jit, some of which scatter nothing on a side; points of a wall, some turned away."""

    def __init__(self, seed=1, colours=1):
        rng = np.random.default_rng(seed)
        self.p, self.n, self.g = rng.uniform([-1, -1, 0.5], [1, 1, 1.5], (COUNT, 3)), *rng.normal(size=(2, COUNT, 3))
        self.n[COUNT - 1] = [0, 0, 1]  # seen edge-on
        self.g[COUNT - 1], self.p[COUNT - 1] = [1, 0, 0], [0.5, 0.5, 0]
        self.front, self.back = rng.uniform(0.2, 1, (2, colours, COUNT))
        self.front[:, ::5], self.back[:, 1::3] = 0, 0
        self.weight, self.delay, self.leg = rng.uniform(0.5, 2, (3, COUNT))
        self.q, self.m = rng.uniform(-1, 1, (COUNT, 3)) * [1, 1, 0], np.tile([0, 0, 1.0], (COUNT, 1))
        self.m[::4] *= -1
        self.m[[2, COUNT - 1]], self.q[[2, COUNT - 1]] = [0.6, 0, 0.8], [[-0.5, 0.25, 0], [-0.25, 0.75, 0]]
        if colours > 1:
            self.front[0, 3::7] = 0  # seen in the others
        self.value = rng.uniform(0.5, 2, (colours, COUNT))
        for name, array in vars(self).items():
            setattr(self, name, array.astype(np.float32).astype(np.float64))

    def samples(self, smooth=True):
        return Local(count=COUNT, tiles=1, smooth=smooth, p=mi.Point3f(self.p.T), n=mi.Normal3f(self.n.T),
                     geometric_n=mi.Normal3f(self.g.T), front=spectrum(self.front), back=spectrum(self.back),
                     weight=mi.Float(self.weight.astype(np.float32)), clear=mi.UInt32(7), has_clear=True)  # fmt: skip

    def line(self, i, j):
        """(signed cosines by both normals, cosine at the wall, distance) of samples ``i`` and points ``j``."""
        d = self.q[j] - self.p[i]
        r = np.linalg.norm(d, axis=-1)
        cos, across, wall = (((n * d).sum(-1) / r) for n in (self.n[i], self.g[i], -self.m[j]))
        return cos, across, np.maximum(wall, 0), r


def spectrum(rows):
    return mi.UnpolarizedSpectrum(*(mi.Float(row.astype(np.float32)) for row in rows))


def points_of(ends, some=slice(None)):
    return WallPoints(mi.Point3f(ends.q[some].T), mi.Normal3f(ends.m[some].T), spectrum(ends.value[:, some]),
                      mi.Float64(ends.leg[some]))  # fmt: skip


def asked_of(monkeypatch, module):
    """Masks that rays are asked for, each third of which meet something."""
    asked = []

    def occluded(scene, sample, line, p, n, active):
        asked.append(np.array(active))
        return active & (dr.arange(mi.UInt32, dr.width(active)) % 3 == 1)

    monkeypatch.setattr(module, "occluded", occluded)
    return asked


def seen_of(asked):
    return ~(asked & (np.arange(len(asked)) % 3 == 1))


WINDOW = Local(counts=lambda opl: (opl > 1.5) & (opl < 3.5))


def counts(opl):
    return (opl > 1.5) & (opl < 3.5)


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("lit", [True, False])
@pytest.mark.parametrize("window", [None, WINDOW])
def test_connections_of_samples_with_derivatives(monkeypatch, lit, smooth, window):
    ends, asked = Ends(), asked_of(monkeypatch, gradients)
    kept = {"p": mi.Point3f(ends.p.T), "n": mi.Vector3f(ends.n.T), "front": spectrum(ends.front)}
    kept |= {"geometric_n": mi.Vector3f(ends.g.T)} if smooth else {}
    kept |= {"delay": mi.Float(ends.delay.astype(np.float32))} if lit else {"back": spectrum(ends.back)}
    film = Local(start_opl=START, arrivals=lambda: window)
    job = gradients.ThirdBounceGradients(None, film, Local(fields=kept), None, mi.UInt32(7))
    point = Local(p=mi.Point3f(ends.q.T), n=mi.Vector3f(ends.m.T), value=spectrum(ends.value),
                  leg=mi.Float(ends.leg.astype(np.float32)))  # fmt: skip
    value, length, opl, arrives = job.connection(Local(**kept), point, dr.arange(mi.UInt32, COUNT))
    cos, across, wall, r = ends.line(LANES, LANES)
    across = across if smooth else cos
    if lit:
        g, side, reflected, way = np.abs(across) * wall / r**2, cos > 0, ends.front[0], r + ends.delay + ends.leg
    else:
        g, side, way = np.abs(cos * across) * (wall / r**2) ** 2, cos != 0, 2 * r + ends.leg
        reflected = np.where(cos > 0, ends.front, ends.back)[0]
    active = side & (g > 0) & (counts(way - START) if window else True)
    np.testing.assert_array_equal(asked[0], active & (LANES >= 7))
    np.testing.assert_array_equal(np.array(arrives), active & seen_of(asked[0]))
    np.testing.assert_allclose(np.array(value[0]), reflected * g * ends.value[0], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.array(length), way, rtol=1e-5)
    np.testing.assert_allclose(np.array(opl), way - START, rtol=1e-5)
    assert 4 < asked[0].sum() < COUNT - 8


@pytest.mark.parametrize("by_sample", [True, False])
def test_derivatives_of_connections(monkeypatch, by_sample):
    """In both modes, of what arrives alone: ``A df + f A' dtau``, and ``df`` and ``f dtau``; against differences."""
    ends, asked = Ends(9), asked_of(monkeypatch, gradients)
    fields = {"p": mi.Point3f(ends.p.T), "n": mi.Vector3f(ends.n.T), "front": spectrum(ends.front),
              "back": spectrum(ends.back)}  # fmt: skip
    samples, film = attached.Ends(COUNT, fields), Local(start_opl=START, arrivals=lambda: None)
    point = Local(p=mi.Point3f(ends.q.T), n=mi.Vector3f(ends.m.T), value=spectrum(ends.value),
                  leg=mi.Float(ends.leg.astype(np.float32)))  # fmt: skip
    job = gradients.ThirdBounceGradients(None, film, samples, None, mi.UInt32(0))
    k, step = dr.arange(mi.UInt32, COUNT), 1e-5
    A, slope = np.random.default_rng(4).normal(size=(2, COUNT))

    def light(name, change):
        moved = Ends(9)
        setattr(moved, name, getattr(moved, name) + change)
        cos, _, wall, r = moved.line(LANES, LANES)
        value = np.where(cos > 0, moved.front, moved.back)[0] * cos**2 * (wall / r**2) ** 2 * moved.value[0]
        return value, 2 * r + moved.leg

    def slopes(name, change):
        up, down = (light(name, sign * step * np.asarray(change)) for sign in (1, -1))
        return [(a - b) / (2 * step) for a, b in zip(up, down, strict=True)]

    place, number = ("p", "front") if by_sample else ("q", "leg")
    kept = {"p": mi.Point3f(0), "front": mi.UnpolarizedSpectrum(0)} if by_sample else {
        "p": mi.Point3f(0), "leg": mi.Float(0)}  # fmt: skip
    read = Local(block=lambda s: Local(read=lambda opl, active: (spectrum(A[None]), spectrum(slope[None]))))
    job.step_back(read, kept, Local(sample=samples.load(k), point=point, k=k, s=k), by_sample)
    cos, _, wall, _ = ends.line(LANES, LANES)
    arrives = (np.abs(cos) * wall > 0) & seen_of(asked[0])
    assert 8 < arrives.sum() < COUNT - 8
    for name, found, change in [(place, kept["p"][i], np.eye(3)[i]) for i in range(3)] + [
        (number, kept["front"][0] if by_sample else kept["leg"], 1.0)]:  # fmt: skip
        d_value, d_length = slopes(name, change)
        expected = np.where(arrives, A * d_value + slope * light("p", 0)[0] * d_length, 0)
        np.testing.assert_allclose(np.array(found), expected, rtol=2e-3, atol=2e-4)
    # Forward mode, along the first axis and by the number.
    along = {"p": mi.Vector3f(mi.Float(1), 0, 0), **({"front": spectrum([np.full(COUNT, 2)])} if by_sample else {
        "leg": mi.Float(2)})}  # fmt: skip
    tangents = attached.Ends(COUNT, along if by_sample else {})
    lane = Local(own=k, fields=point, tangent=Local(**({} if by_sample else along)))
    put, total = [], {"dL": mi.UnpolarizedSpectrum(5), "block": None}
    job.step_on(tangents, Local(put_slope=lambda *given: put.append(given)), total, lane, k)
    d_value, d_length = (a + 2 * b for a, b in zip(slopes(place, [1, 0, 0]), slopes(number, 1.0), strict=True))
    np.testing.assert_allclose(np.array(total["dL"][0]), 5 + np.where(arrives, d_value, 0), rtol=2e-3, atol=2e-4)
    _, _, of_value, of_length, there = put[0]
    np.testing.assert_array_equal(np.array(there), arrives)
    np.testing.assert_allclose(np.array(of_value[0])[arrives], d_value[arrives], rtol=2e-3, atol=2e-4)
    expected = light("p", 0)[0] * d_length
    np.testing.assert_allclose(np.array(of_length[0])[arrives], expected[arrives], rtol=2e-3, atol=2e-4)


class Block:
    """A film's block that notes what is put."""

    def __init__(self):
        self.put_there = []

    def counted(self, opl):
        return opl + 0.25

    def put(self, state, opl, value, active):
        self.put_there.append((opl, value, active))
        return mi.Float(2), mi.Float(3)


def kept_before(colours=1):
    return {"L": mi.UnpolarizedSpectrum(10), "before": mi.Float(20), "after": mi.Float(30), "block": {}}


def check(block, kept, expected, way, active, number=0, total=None):
    opl, value, there = block.put_there[number]
    np.testing.assert_array_equal(np.array(there), active)
    np.testing.assert_allclose(np.array(opl, dtype=float)[active], way[active], rtol=1e-5)
    np.testing.assert_allclose(np.array(value, dtype=float)[:, active], expected[:, active], rtol=2e-4)
    total = np.where(active, expected, 0) if total is None else total
    np.testing.assert_allclose(np.array(kept["L"], dtype=float), 10 + total, rtol=1e-5)
    times = len(block.put_there)
    assert (np.array(kept["before"]).tolist(), np.array(kept["after"]).tolist()) == ([20 + 2 * times], [30 + 3 * times])


@pytest.mark.parametrize("rays", [True, False])
@pytest.mark.parametrize("lit", [True, False])
@pytest.mark.parametrize("window", [None, WINDOW])
def test_light_of_one_sample(monkeypatch, lit, rays, window):
    """Of the side that is seen; a spot's light of the lit one alone."""
    ends, asked, block = Ends(2), asked_of(monkeypatch, third_bounce), Block()
    s = ends.samples()
    delay = mi.Float(ends.delay.astype(np.float32))
    table = SampleTable(s, s.front * 2, mi.Vector3f(s.n), delay) if lit else SampleTable(s)
    lane = Local(p=mi.Point3f(ends.q.T), n=mi.Vector3f(ends.m.T), factor=spectrum(ends.value), apart=False)
    job = Local(scene=None, window=window)
    kept = kept_before()
    third_bounce.deposit(job, table, lane, block, kept, dr.arange(mi.UInt32, COUNT), rays)
    cos, across, wall, r = ends.line(LANES, LANES)
    if lit:
        light, way = np.where(cos > 0, 2 * ends.front * np.abs(across) * wall / r**2, 0), r + ends.delay
    else:
        light, way = np.where(cos > 0, ends.front, ends.back) * ends.weight, 2 * r
        light = light * np.abs(cos * across) * (wall / r**2) ** 2
    active = (light[0] > 0) & (counts(way + 0.25) if window else True)
    if rays:
        np.testing.assert_array_equal(asked[0], active)
        active &= seen_of(asked[0])
    assert len(asked) == rays and 4 < active.sum() < COUNT - 8
    check(block, kept, light * ends.value, way, active)


def test_samples_that_a_spot_lights(monkeypatch):
    """The same with and without derivatives; the first ones need no rays in a render."""
    ends = Ends(3)
    spot = WallPoints(mi.Point3f(0.25, -0.125, 0), mi.Normal3f(0, 0, 1), 0.3)
    ends.q[:], ends.m[:] = [0.25, -0.125, 0], [0, 0, 1]
    s = ends.samples()
    cos, _, wall, r = ends.line(LANES, LANES)
    light = np.where(cos > 0, ends.front, ends.back)[0] * ends.weight * np.abs(cos) * wall / r**2
    asked = asked_of(monkeypatch, third_bounce)
    table = third_bounce.lit_by(None, s, spot).load(dr.arange(mi.UInt32, COUNT))
    np.testing.assert_array_equal(asked[0], (light > 0) & (LANES >= 7))
    np.testing.assert_allclose(np.array(table.front[0]), light * seen_of(asked[0]), rtol=1e-4, atol=1e-8)
    turned = (ends.n * np.sign(cos)[:, None])[cos != 0]
    np.testing.assert_allclose(np.array(table.n).T[cos != 0], turned, atol=1e-6)
    np.testing.assert_allclose(np.array(table.delay), r, rtol=1e-5)
    asked = asked_of(monkeypatch, attached)
    found = Local(p=s.p, n=mi.Vector3f(s.n), geometric_n=mi.Vector3f(s.geometric_n), front=s.front * s.weight,
                  back=s.back * s.weight)  # fmt: skip
    monkeypatch.setattr(attached, "material_samples", lambda *given: found)
    fields = attached.ends_of_samples(None, None, s, None, spot).fields
    np.testing.assert_array_equal(asked[0], np.abs(cos) * wall > 0)
    assert set(fields) == {"p", "n", "front", "delay", "geometric_n"}
    np.testing.assert_allclose(np.array(fields["front"][0]), light * seen_of(asked[0]), rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(np.array(fields["n"]).T[cos != 0], turned, atol=1e-6)


@pytest.mark.parametrize("colours", [1, 3])
def test_how_points_see_a_block_of_samples(monkeypatch, colours):
    with mi.variant_context("llvm_ad_rgb" if colours == 3 else VARIANT):
        ends, asked = Ends(4, colours), asked_of(monkeypatch, exhaustive)
        walls = points_of(ends, slice(0, 6)), points_of(ends, slice(6, 11))
        job = Local(scene=None, energy=mi.UnpolarizedSpectrum(1), samples=ends.samples(), sensors=walls[0])
        job.samples.clear = mi.UInt32(22)
        block = exhaustive.SampleBlock(job, walls[1], 18, 40)
        tables = [np.array(each, dtype=float).reshape(24, -1, 2) for each in (block.seen, block.lit)]
        values = None if colours == 1 else np.array(block.values, dtype=float).reshape(24, 2, 4)
    k = np.arange(18, 40)[:, None]
    for table, number, j in zip(tables, (0, 1), (np.arange(6), np.arange(6, 11)), strict=True):
        cos, across, wall, r = ends.line(k, j[None])
        side = np.where(cos > 0, ends.front[:, 18:, None], ends.back[:, 18:, None])
        g = np.abs(across if number == 0 else cos) * wall / r**2
        if colours == 1:
            g = g * np.sqrt(side[0] * ends.weight[18:, None])
        active = (g > 0) & (side.max(0) > 0)
        np.testing.assert_array_equal(asked[number].reshape(22, -1), active & (k >= 22))
        g = np.where(active & seen_of(asked[number]).reshape(22, -1), g * np.where(cos < 0, -1, 1), 0)
        np.testing.assert_allclose(table[:22, :, 0], g, rtol=1e-4, atol=1e-8)
        np.testing.assert_allclose(table[:22, :, 1], r, rtol=1e-5)
        assert not table[22:].any()
    if colours == 3:
        expected = np.stack([ends.front[:, 18:], ends.back[:, 18:]], 2) * ends.weight[18:, None]
        np.testing.assert_allclose(values[:22, :, :3], expected.transpose(1, 2, 0), rtol=1e-5)
        assert not values[22:].any() and not values[..., 3].any()


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("window", [None, WINDOW])
def test_light_of_one_sample_for_a_pair(colours, window):
    """Seen on one side by both, or by neither; the colours are those of that side."""
    rng, block = np.random.default_rng(5), Block()
    seen, lit = rng.normal(size=(5, 4)), rng.normal(size=(5, 3))
    seen[2], lit[2] = [0, 0.5, -0.4, 0.7], [0.3, -0.6, 0.8]
    ways = rng.uniform(0.5, 2, (5, 4)), rng.uniform(0.5, 2, (5, 3))
    rows, factor = rng.uniform(0.1, 1, (5, 2, 4)), rng.uniform(0.5, 2, (colours, 12))
    pixel, laser = (each.ravel() for each in np.divmod(np.arange(12), 3))
    with mi.variant_context("llvm_ad_rgb" if colours == 3 else VARIANT):
        tables = [mi.Float(np.stack([g, r], 2).ravel().astype(np.float32))
                  for g, r in zip((seen, lit), ways, strict=True)]  # fmt: skip
        values = mi.Float(rows.ravel().astype(np.float32)) if colours == 3 else None
        pairs = Local(pixel=mi.UInt32(pixel.astype(np.uint32)), laser=mi.UInt32(laser.astype(np.uint32)),
                      sensor_count=mi.UInt32(4), laser_count=mi.UInt32(3), factor=spectrum(factor))  # fmt: skip
        kept = kept_before()
        samples = Local(seen=tables[0], lit=tables[1], values=values)
        exhaustive.deposit(Local(window=window), samples, pairs, block, kept, mi.UInt32(2))
        g, way = seen[2, pixel] * lit[2, laser], ways[0][2, pixel] + ways[1][2, laser]
        active = (g > 0) & (counts(way + 0.25) if window else True)
        side = np.where(seen[2, pixel] > 0, rows[2, 0, :3, None], rows[2, 1, :3, None])
        expected = factor * g * (side if colours == 3 else 1)
        assert 2 < active.sum() < 10
        check(block, kept, expected, way, active)


@pytest.mark.parametrize("kind", ["confocal", "spots", "scanned"])
@pytest.mark.parametrize("smooth", [True, False])
def test_how_points_see_vertices_of_chains(monkeypatch, kind, smooth):
    """Scanned points those of their tile, by surfaces; spots all of them, by shading normals, with what a vertex
    scatters and the way along the tail; in confocal captures those of their tile.
    """
    ends, asked = Ends(6), asked_of(monkeypatch, late_light)
    from_laser, rows, tiles = kind != "scanned", 5, 8
    alive = LANES % 6 != 1
    vertices = chains.VertexTable(Local(p=mi.Point3f(ends.p.T), n=mi.Vector3f(ends.n.T), alive=mi.Bool(alive),
                                        geometric_n=mi.Vector3f(ends.g.T), value=spectrum(ends.value),
                                        length=mi.Float(ends.delay.astype(np.float32))), smooth)  # fmt: skip
    of = np.array([3, 0, 7, 2, 3, 6])
    light = Local(tiles=Local(count=tiles, tile_of_pixel=mi.UInt32(of.astype(np.uint32))), confocal=kind == "confocal",
                  job=Local(scene=None))  # fmt: skip
    part = Local(rows=rows, colours=1)
    found = late_light.GroupBlock._visibility(part, light, points_of(ends, slice(0, 6)), vertices, from_laser)
    point, row = np.arange(6)[None], np.arange(COUNT if kind == "spots" else rows)[:, None]
    chain = row + 0 * point if kind == "spots" else of[point] * rows + row
    cos, across, wall, r = ends.line(chain, point + 0 * chain)
    g = wall / r**2 * (cos if from_laser else np.abs(across if smooth else cos))
    active = alive[chain] & (cos > 0) & (g > 0)
    assert dr.width(found) == 2 * chain.size and 3 < active.sum() < active.size - 3
    np.testing.assert_array_equal(asked[0].reshape(active.shape), active)
    active &= seen_of(asked[0]).reshape(active.shape)
    table = np.array(found, dtype=float).reshape(*active.shape, 2)
    g = g * (ends.value[0][chain] if from_laser else 1)
    np.testing.assert_allclose(table[..., 0], np.where(active, g, 0), rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(table[..., 1], r + (ends.delay[chain] if from_laser else 0), rtol=1e-5)


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("window", [None, WINDOW])
def test_light_of_one_link(colours, window):
    """Of a head and each further vertex of its tail, seen by the lane's point and spot."""
    rng, block, lanes_count = np.random.default_rng(7), Block(), 12
    links = np.stack([rng.uniform(0.1, 1, 6), rng.uniform(0.2, 1, 6), [8, 9, 10, 11, 8, 10], [9, 8, 11, 8, 10, 9]], 1)
    seen, lit = rng.uniform(0.1, 1, (4, 3, 2)), rng.uniform(0.1, 1, (2, 4, 2, 2))
    seen[1, :, 0] = 0
    heads, tails = rng.uniform(0.1, 1, (colours, 12)), rng.uniform(0.1, 1, (2, colours, 12))
    pixel, spot, k = np.arange(12) % 3, np.arange(12) // 6, np.arange(12) % 6
    factor, opl = rng.uniform(0.5, 2, (colours, 12)), rng.uniform(0.2, 1.2, 12)
    with mi.variant_context("llvm_ad_rgb" if colours == 3 else VARIANT):
        flat = lambda array: mi.Float(np.ravel(array).astype(np.float32))  # noqa: E731
        part = Local(links=Local(flat=flat(links)), seen=flat(seen), lit=[flat(one) for one in lit], colours=colours)
        part.heads, part.tails = Local(value=spectrum(heads)), [Local(value=spectrum(one)) for one in tails]
        number = lambda array: mi.UInt32(array.astype(np.uint32))  # noqa: E731
        lanes = Local(offset=mi.UInt32(8), stride=mi.UInt32(3), pixel=number(pixel), factor=spectrum(factor),
                      spot_offset=mi.UInt32(8), spot_stride=mi.UInt32(2), spot=number(spot),
                      opl=mi.Float64(opl))  # fmt: skip
        light, kept = Local(job=Local(window=window)), kept_before()
        late_light.deposit(light, part, lanes, block, kept, number(k))
        head, tail = (links[k, i].astype(int) for i in (2, 3))
        total, found = 0, []
        for j in range(2):
            there = lit[j][tail - 8, spot]
            way = opl + seen[head - 8, pixel, 1] + links[k, 1] + there[:, 1]
            g = links[k, 0] * seen[head - 8, pixel, 0] * there[:, 0]
            active = (g > 0) & (counts(way) if window else True)
            value = factor * g * (heads[:, head] * tails[j][:, tail] if colours == 3 else 1)
            total = total + np.where(active, value, 0)
            found.append((value, way, active))
            assert 3 < active.sum() < lanes_count
        for j, each in enumerate(found):
            check(block, kept, *each, j, total)


@pytest.mark.parametrize("confocal", [True, False])
def test_what_lanes_of_late_light_know(confocal):
    """Which links, of which tile, seen by which spot, and what wall and legs make of them."""
    ends = Ends(8)
    sensors, lasers = points_of(ends, slice(0, 6)), points_of(ends, slice(10, 16) if confocal else slice(10, 12))
    film = Local(crop_size=lambda: (3, 2), start_opl=START)
    light = Local(job=Local(film=film, sensors=sensors, energy=mi.UnpolarizedSpectrum(3)), lasers=lasers,
                  confocal=confocal, exhaustive=not confocal, tiles=late_light.Tiles(3, 2, 2))  # fmt: skip
    counted = np.array([5, 0, 7, 2, 9, 4, 1, 6], dtype=np.uint32)
    first = np.cumsum(counted) - counted
    part = Local(groups=2, rows=11, links=Local(first=mi.UInt32(first), count=mi.UInt32(counted)))
    launch = late_light.LateLaunch(0, 0, 2, 6, 3, 3, True)
    found = late_light.LateLanes(light, part, launch)
    shape = (6, 2, 3, 1 if confocal else 2)
    pixel, group, piece, laser = (each.ravel() for each in np.indices(shape))
    tile = light.tiles.numbers[pixel]
    spot = pixel if confocal else laser
    number = tile * 2 + group
    begin = first[number] + 3 * piece
    expected = {"pixel": pixel, "laser": laser, "first": begin, "spot": spot, "offset": 11 * tile,
                "last": np.minimum(begin + 3, first[number] + counted[number])}  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_array_equal(np.array(getattr(found, name)) + 0 * pixel, value, err_msg=name)
    np.testing.assert_array_equal(np.array(found.spot_offset) + 0 * pixel, 11 * tile if confocal else 0)
    scattered = ends.value[0]
    np.testing.assert_allclose(np.array(found.factor[0]), scattered[pixel] * 3 * scattered[10 + spot], rtol=1e-5)
    np.testing.assert_allclose(np.array(found.opl), ends.leg[pixel] + ends.leg[10 + spot] - START, rtol=1e-6)
    assert (found.stride[0], found.spot_stride[0]) == (6, 6 if confocal else 2)
