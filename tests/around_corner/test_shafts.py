"""Shafts: what is called clear is never hidden, and leaving out its rays changes no number."""

import time

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import torchtransient.plugins.around_corner.exhaustive as exhaustive
from support.hidden_shapes import ball, folded_plates, join, mannequin, mesh, plate, scene_of, wall_grid
from support.third_bounce_runs import captured, film_of, table_of, wall_of
from torchtransient.errors import ShapeError
from torchtransient.plugins.around_corner import shafts
from torchtransient.plugins.around_corner.shafts import ScanRegion, clear_elements, spare_rays
from torchtransient.plugins.around_corner.third_bounce import ThirdBounce
from torchtransient.plugins.sampling.shared_samples import draw_samples

VARIANT = "llvm_ad_mono"


def relay_wall(cells=1):
    v, f = plate(2, 2, (0, 0, 0), cells)
    return mesh("wall", (v, f[:, ::-1]))


def ridge(height=0.1, cells=12):
    """A wall that is not plane."""
    v, f = plate(2, 2, (0, 0, 0), cells)
    v[:, 2] = height * np.cos(3 * v[:, 0])
    return mesh("wall", (v, f[:, ::-1]))


def moved(arrays, offset):
    return arrays[0] + np.asarray(offset), arrays[1]


# Hidden shapes, other shapes, and between which shares of the samples are clear.
CASES = {
    "plate": (lambda: [mesh("a", plate(1, 1, (0.3, 0, 1), 4))], lambda: [relay_wall()], (1.0, 1.0)),
    "two-sided plate": (
        lambda: [mesh("a", plate(1, 1, (0, 0, 1), 4), two_sided=True)],
        lambda: [relay_wall(20)],
        (1.0, 1.0),
    ),
    "plates behind each other": (
        lambda: [mesh("a", plate(0.5, 0.5, (0, 0, 0.8), 4)), mesh("b", plate(2, 2, (0, 0, 1.2), 12))],
        lambda: [relay_wall()],
        (0.3, 0.95),
    ),
    "V and plate": (lambda: [mesh("a", folded_plates(), two_sided=True)], lambda: [relay_wall()], (0.3, 0.75)),
    "body": (lambda: [mesh("a", mannequin(3))], lambda: [relay_wall()], (0.6, 0.8)),
    "body before a sphere": (
        lambda: [mesh("a", mannequin(2))],
        lambda: [relay_wall(), mi.load_dict({"type": "sphere", "center": [0.3, 0, 0.6], "radius": 0.1})],
        (0.0, 0.6),
    ),
    "leaning plate, far from the middle": (
        lambda: [mesh("a", rotated(plate(1, 1, (0, 0, 0), 4), 1.2, (1.5, 0.4, 1.0)))],
        lambda: [relay_wall(), mesh("b", plate(0.3, 0.3, (0.7, 0.2, 0.5)))],
        (0.05, 0.95),
    ),
    "edge towards the wall": (
        lambda: [mesh("a", rotated(plate(1, 1, (0, 0, 0), 4), 1.5708, (0, 0, 0.8)))],
        lambda: [relay_wall()],
        (0.9, 1.0),
    ),
    "wall that bends": (lambda: [mesh("a", plate(1, 1, (0.3, 0, 1), 4))], lambda: [ridge()], (0.0, 1.0)),
    "interpolated normals": (
        lambda: [mesh("a", ball((0, 0, 1), 0.4, 2), vertex_normals=True)],
        lambda: [relay_wall()],
        (0.1, 0.9),
    ),
}


def rotated(arrays, angle, offset):
    c, s = np.cos(angle), np.sin(angle)
    return arrays[0] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + np.asarray(offset), arrays[1]


def hidden_lines(scene, samples, points):
    """``(K, P)``: whether a line that leaves on a side where light is scattered is cut, by rays of Mitsuba's own."""
    K, P = samples.count, len(points)
    lane = dr.arange(mi.UInt32, K * P)
    k = lane // P
    si = dr.zeros(mi.Interaction3f, K * P)
    si.p = dr.gather(mi.Point3f, samples.p, k)
    si.n = dr.gather(mi.Normal3f, samples.geometric_n, k)
    end = dr.gather(mi.Point3f, mi.Point3f(points.T), lane % P)
    # Mitsuba leaves out the last thousandth: the wall.
    ray = si.spawn_ray_to(end)
    seen = dr.dot(dr.gather(mi.Normal3f, samples.n, k), end - si.p) > 0
    seen |= dr.gather(mi.Float, samples.back[0], k) > 0
    return np.array(scene.ray_test(ray) & seen).reshape(K, P)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_clear_samples_are_never_hidden(name):
    hidden, others, (least, most) = CASES[name]
    hidden, others = hidden(), others()
    scene = scene_of(*hidden, *others)
    points, normals = wall_grid(16)
    edges = np.array([[x, y, 0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)])
    points, normals = np.concatenate([points, edges]), np.tile([0.0, 0, 1], (256 + 9, 1))
    if name == "wall that bends":
        points[:, 2] = 0.1 * np.cos(3 * points[:, 0]) + 1e-3
    table = table_of(hidden)
    before = draw_samples(table, 2048, 1)
    share = spare_rays(scene, table, points, normals)
    samples = draw_samples(table, 2048, 1)
    clear = int(samples.clear[0])
    assert share == pytest.approx(clear / 2048, abs=1 / 2048)
    cut = hidden_lines(scene, samples, points)
    assert not cut[:clear].any()
    assert least <= share <= most
    # The density has not changed with the order.
    assert dr.sum(before.weight)[0] == pytest.approx(dr.sum(samples.weight)[0], rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["body", "V and plate", "plates behind each other"])
def test_numbers_do_not_change(name):
    """With rays for all of the same samples: single, confocal and exhaustive captures."""
    hidden, others, _ = CASES[name]
    hidden = hidden()
    scene = scene_of(*hidden, *others())
    points, normals = wall_grid(2)
    table = table_of(hidden)
    assert spare_rays(scene, table, points, normals) > 0.3
    samples = draw_samples(table, 512, 1)
    sensors = wall_of(points, normals)
    laser = wall_of(points[1:2], normals[1:2])
    one = film_of(2, 2)
    pairs = film_of(2, 2, exhaustive_scan=True, laser_scan_width=2, laser_scan_height=2)
    runs = [
        (one, lambda job: job.add_confocal()), (one, lambda job: job.add_single(laser)),
        (pairs, lambda job: exhaustive.add_exhaustive(job, sensors)),
    ]  # fmt: skip
    spared = [captured(film, lambda f=film, r=run: r(ThirdBounce(scene, f, samples, sensors)))[1] for film, run in runs]
    samples.has_clear, samples.clear = False, dr.opaque(mi.UInt32, 0)
    full = [captured(film, lambda f=film, r=run: r(ThirdBounce(scene, f, samples, sensors)))[1] for film, run in runs]
    for a, b in zip(spared, full, strict=True):
        assert a == pytest.approx(b, rel=1e-6, abs=1e-7 * b.max())


def test_points_outside_of_the_region_are_refused():
    hidden = [mesh("a", plate(1, 1, (0, 0, 1)))]
    scene, table = scene_of(*hidden), table_of(hidden)
    points, normals = wall_grid(2)
    spare_rays(scene, table, points, normals)
    samples, film = draw_samples(table, 64, 0), film_of(2, 2)
    film.start_render()
    ThirdBounce(scene, film, samples, wall_of(points, normals)).add_confocal()
    with pytest.raises(ShapeError, match="spare_rays"):
        ThirdBounce(scene, film, samples, wall_of(points + np.array([0, 0.1, 0]), normals))
    with pytest.raises(ShapeError, match="spare_rays"):
        ThirdBounce(scene, film, samples, wall_of(points, normals)).add_single(wall_of([[0, 0.9, 0]], [[0, 0, 1]]))


# -------------------------------------------------------------------------------------------------------- by themselves


def random_region(seed=1):
    """Of a wall that leans: (the region, its points, generator)."""
    rng = np.random.default_rng(seed)
    w = np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9])
    points = rng.uniform(-0.5, 0.5, (12, 3))
    points -= np.outer(points @ w * 0.9, w)
    return ScanRegion(points, np.tile(w, (12, 1))), points, rng


def corners_of(region):
    low, high = region.low, region.high
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def test_the_box_of_a_scan():
    """Along its mean normal, around all of its points."""
    region, points, _ = random_region()
    np.testing.assert_allclose(region.frame @ region.frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(region.frame) == pytest.approx(1)
    np.testing.assert_allclose(region.frame[2], np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9]))
    local = points @ region.frame.T
    np.testing.assert_allclose([region.low, region.high], [local.min(0), local.max(0)])
    assert region.scale == np.abs(points).max() and region.holds(points)
    slack = shafts.ROUNDING * region.scale
    for axis in range(3):
        for end, sign in ((region.high, 1), (region.low, -1)):
            middle = (region.low + region.high) / 2
            middle[axis] = end[axis] + sign * 0.9 * slack
            assert region.holds(middle @ region.frame)
            middle[axis] = end[axis] + sign * 1.1 * slack
            assert not region.holds(np.stack([middle @ region.frame, points[0]]))
    upright = ScanRegion(points, np.tile([[0, 0, 1.0], [0, 0, -1.0]], (6, 1)))
    np.testing.assert_array_equal(upright.frame[2], [0, 0, 1])
    # What is just as far off still belongs to it.
    slack = shafts.ROUNDING * upright.scale
    ends = np.stack([upright.low - slack, upright.high + slack])
    assert upright.holds(ends @ upright.frame) and not upright.holds(ends * (1 + 1e-12) @ upright.frame)
    # A mean of normals that differ is shorter than they are.
    curved = ScanRegion(points, np.tile([[0.96, 0.0, 0.28], [-0.96, 0.28, 0.0]], (6, 1)))
    np.testing.assert_allclose(curved.frame @ curved.frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(curved.frame[2], [0, 0.5**0.5, 0.5**0.5], atol=1e-12)


@pytest.mark.parametrize(("scanned", "hidden"), [
    ([0.3, 0.2], [1000, -1000]), ([0.3, 0.2], [-1000, 1000]), ([0.3, -1000], [0.4, 0.3]), ([1000, 0.2], [0.4, 0.3]),
])  # fmt: skip
def test_elements_beside_a_scan_are_in_doubt(scanned, hidden):
    """By the rounding of the largest coordinate of the scan and of what is hidden, whatever its sign."""
    region = ScanRegion([[0, 0, 0], [*scanned, 0]], [[0, 0, 1.0]] * 2)
    rounding = 1000 * shafts.ROUNDING
    for height, clear in ((0.8 * rounding, False), (1.3 * rounding, True)):
        elements = table_of([mesh("a", plate(0.1, 0.1, (*hidden, height)))]).elements
        assert set(clear_elements([], elements, region).tolist()) == {clear}


def test_shafts_touch_what_they_hold():
    """All of an element and of the region, none of the planes across, before and behind lies farther off."""
    region, _, rng = random_region()
    corners = rng.uniform(-1.5, 1.5, (40, 3, 3))
    corners[:, :, 2] = region.high[2] + rng.uniform(0.05, 1, (40, 3))
    normal, front = rng.normal(size=(40, 3)), np.arange(40) % 2 == 0
    planes = shafts._shafts(corners, normal, front, region)
    held = np.concatenate([corners, np.tile(corners_of(region), (40, 1, 1))], 1)
    beyond = (np.einsum("epi,eki->epk", planes[:, :, :3], held) - planes[:, :, 3:]).max(2)
    assert planes.shape == (40, 11, 4)
    np.testing.assert_allclose(beyond[:, :10], 0, atol=1e-9)
    # Those across touch both, those before and behind one of them.
    for some in (slice(0, 3), slice(3, 11)):
        touched = (np.einsum("epi,eki->epk", planes[:, :8, :3], held[:, some]) - planes[:, :8, 3:]).max(2)
        np.testing.assert_allclose(touched, 0, atol=1e-9)
    assert len({tuple(np.sign(p[:2])) for p in planes[0, :8]}) == 8
    assert (planes[~front, 10] == [0, 0, 0, np.inf]).all()
    np.testing.assert_allclose(planes[front, 10, :3], -normal[front])
    np.testing.assert_allclose(planes[front, 10, 3], -(normal * corners[:, 0]).sum(1)[front])


def test_sides_of_elements():
    """Two-sided ones are turned to a region that is all behind them."""
    region, _, rng = random_region()
    p, normal = rng.uniform(-1, 1, (200, 3)), rng.normal(size=(200, 3))
    two_sided = np.arange(200) % 2 == 0
    turned, before = shafts._turned_to(region, p, normal, two_sided)
    height = np.einsum("ki,ei->ek", corners_of(region), normal) - (normal * p).sum(1)[:, None]
    behind, ahead = (height <= 0).all(1), (height >= 0).all(1)
    assert min(behind.sum(), ahead.sum()) > 20
    np.testing.assert_array_equal(before, ahead | (behind & two_sided))
    np.testing.assert_array_equal(turned, np.where((behind & two_sided)[:, None], -normal, normal))


def obstacles(rng):
    """Random triangles of a mesh, and a ball."""
    v = rng.uniform(-2, 2, (24, 1, 3)) * [1, 1, 0.3] + rng.normal(size=(24, 3, 3)) * 0.12
    v[..., 2] += 0.9
    ball = mi.load_dict({"type": "sphere", "center": [0.4, 0.3, 0.5], "radius": 0.15})
    return [mesh("some", (v.reshape(-1, 3), np.arange(72).reshape(24, 3))), ball], v.astype(np.float32).astype(float)


@pytest.mark.parametrize("slack", [1e-9, 0.05])
def test_what_is_met_in_a_shaft(slack):
    """By the tree as one by one: a triangle is outside beyond a plane of the shaft, or where its own plane has region
    and element on one side; a ball is, with its box, beyond a plane.
    """
    region, _, rng = random_region()
    shapes, v = obstacles(rng)
    v = v @ region.frame.T
    elements = rng.uniform(-2.5, 2.5, (150, 1, 3)) + rng.normal(size=(150, 3, 3)) * 0.1
    elements[:, :, 2] = region.high[2] + rng.uniform(0.3, 1.2, (150, 3))
    planes = shafts._shafts(elements, np.zeros((150, 3)), np.zeros(150, dtype=bool), region)
    tree = shafts.ObstacleTree(shapes, region, elements, slack)
    n = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    height, box = (n * v[:, 0]).sum(1), corners_of(region)
    beyond = np.einsum("epi,tki->eptk", planes[..., :3], v).min(3) >= planes[..., 3:] - slack
    out = beyond.any(1)
    for side in (1, -1):
        least = np.minimum((box @ n.T).min(0) if side > 0 else (-box @ n.T).min(0),
                           (side * np.einsum("eki,ti->ekt", elements, n)).min(1))  # fmt: skip
        out |= least >= side * height - slack
    ends = np.array([[x, y, z] for x in (0.25, 0.55) for y in (0.15, 0.45) for z in (0.35, 0.65)]) @ region.frame.T
    ball = np.array([[x, y, z] for x, y, z in np.stack(np.meshgrid(*zip(ends.min(0), ends.max(0), strict=True)), -1)
                     .reshape(-1, 3)])  # fmt: skip
    out_ball = (np.einsum("epi,ki->epk", planes[..., :3], ball).min(2) >= planes[..., 3] - slack).any(1)
    expected = ~out.all(1) | ~out_ball
    assert 20 < expected.sum() < 130 and (~out_ball).sum() > 10 and (~out.all(1) & out_ball).sum() > 10
    np.testing.assert_array_equal(shafts._met(tree, planes, elements), expected)


def test_triangles_that_hide_nothing_from_a_scan():
    """Those whose plane has all of the region and of what is hidden on one side."""
    region, _, rng = random_region()
    v = rng.uniform(-1.5, 1.5, (200, 3, 3))
    hidden = rng.uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.0], (5, 3, 3))
    n = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    low, high = hidden.min((0, 1)), hidden.max((0, 1))
    of_hidden = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    every = np.concatenate([corners_of(region), of_hidden])
    height = every @ n.T - (n * v[:, 0]).sum(1)
    expected = (height >= 0).all(0) | (height <= 0).all(0)
    assert 10 < expected.sum() < 190
    np.testing.assert_array_equal(shafts._harmless(v, region, hidden, 1e-12), expected)


@pytest.mark.parametrize("turn", [1, -1])
def test_triangles_in_the_plane_of_a_scan_or_of_what_is_hidden(turn):
    """To rounding they have both on one side, whichever way round their corners are."""
    region = ScanRegion([[0, 0, 0], [0.3, 0.2, 0]], [[0, 0, 1.0]] * 2)
    hidden = np.array([[[0.1, 0.2, 1], [0.4, 0.2, 1], [0.1, 0.5, 2.0]]]) @ region.frame.T
    heights = np.array([-0.5, 0, 0.9, 1.1, 5, 1e3 - 5, 1e3 - 1.1, 1e3 - 0.9, 1e3, 2e3]) * 2e-3
    v = np.array([[-3, -3, 0], [3, -3, 0], [0, 4, 0.0]])[::turn] + heights[:, None, None] * [0, 0, 1]
    found = shafts._harmless(v @ region.frame.T, region, hidden, 2e-3)
    assert found.tolist() == [True, True, True, False, False, False, False, True, True, True]


@pytest.mark.parametrize(("rays", "worth"), [(2000, False), (2001, True)])
def test_when_shafts_are_looked_for(rays, worth):
    """For more than a thousand rays a triangle."""
    scene = scene_of(mesh("a", plate(1, 1, (0, 0, 1))), mi.load_dict({"type": "sphere"}))
    assert shafts.saves_time(scene, rays) is worth


@pytest.mark.slow
def test_time_grows_with_the_triangles_not_with_their_square():
    """200 000 triangles in seconds; four times as many triangles at most eight times the time."""
    points, normals = wall_grid(4)
    region = ScanRegion(points, normals)
    seconds = []
    for level in (4, 5):
        body = mesh("a", join(mannequin(level), moved(mannequin(level), (0.2, 0, 0.5))))
        table = table_of([body])
        clear_elements([relay_wall(), body], table.elements, region)
        start = time.perf_counter()
        clear = clear_elements([relay_wall(), body], table.elements, region)
        seconds.append(time.perf_counter() - start)
        assert 0.1 < clear.mean() < 0.9
    assert len(table.elements) > 90_000 and seconds[1] < 20 and seconds[1] < 8 * seconds[0]


def test_planes_that_cross_a_scan_are_in_doubt_where_normals_are_interpolated():
    """Points there are seen from behind, too."""
    region = ScanRegion([[0, 0, 0], [0.5, 0.25, 0]], [[0, 0, 1.0]] * 2)
    v, f = plate(0.25, 0.25, (0, 0, 0))
    upright = np.stack([0 * v[:, 0] + 0.25, v[:, 1], v[:, 0] + 1], 1), f
    for arrays, across in ((upright, True), ((v + np.array([0, 0, 1]), f), False)):
        elements = table_of([mesh("a", arrays)]).elements
        assert clear_elements([], elements, region).all()
        assert set(clear_elements([], elements, region, smooth=True).tolist()) == {not across}
