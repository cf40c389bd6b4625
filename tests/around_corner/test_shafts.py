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
