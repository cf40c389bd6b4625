"""Three bounces from shared hidden samples: closed forms, brute force, and what the film counts."""

import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball, folded_plates, join, mannequin, mesh, plate, scene_of
from support.third_bounce_runs import WALL_ALBEDO, BruteForce, confocal, film_of, single, table_of
from torchtransient.plugins.sampling.shared_samples import draw_samples

VARIANT = "llvm_ad_mono"
UP = (0.0, 0.0, 1.0)


def test_a_plane_in_closed_form():
    """Confocal, bins within 0.3 % rms at 2^16 samples: pi K z^4 / 3 (r_a^-6 - r_b^-6)."""
    z, radius, albedo = 1.0, 2.0, 0.7
    film = film_of(1, 1, start=2.0, bins=130, bin_width=0.02)
    place = mi.ScalarTransform4f().translate([0, 0, z]).rotate([0, 1, 0], 180).scale([radius, radius, 1])
    shape = mi.load_dict({"type": "disk", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": albedo}})
    steady, cube = confocal([shape], [(0, 0, 0)], [UP], film, 1 << 16)
    K = WALL_ALBEDO**2 * albedo / np.pi**3
    r = np.clip((2 + 0.02 * np.arange(131)) / 2, z, np.hypot(z, radius))
    expected = np.pi * K * z**4 / 3 * (r[:-1] ** -6 - r[1:] ** -6)
    error = cube[0, 0, :, 0] - expected
    assert cube.sum() == pytest.approx(expected.sum(), rel=3e-4)
    assert steady[0, 0, 0] == pytest.approx(cube.sum(), rel=1e-6)
    assert np.sqrt(np.mean(error**2)) < 3e-3 * expected.mean()


def test_a_patch_in_closed_form():
    x, s, spot = np.array([0.2, -0.1, 1.1]), np.array([0.3, 0.1, 0]), np.array([-0.4, 0.2, 0])
    shape, side = mesh("patch", plate(0.001, 0.001, x), 0.7), 0.001
    film = film_of(1, 1, bins=400, bin_width=0.01)
    steady, cube = single([shape], [s], [UP], ([spot], [UP]), film, 64)
    r1, r2 = np.linalg.norm(x - spot), np.linalg.norm(x - s)
    expected = WALL_ALBEDO**2 * 0.7 / np.pi**3 * 1.1**4 / r1**4 / r2**4 * side**2
    # Over the patch the distance changes by 1e-3 at most, linearly, which leaves the square of it.
    assert steady[0, 0, 0] == pytest.approx(expected, rel=1e-5)
    assert np.flatnonzero(cube[0, 0, :, 0]).tolist() == [int((r1 + r2) / 0.01)]


SCENES = {
    "plane": lambda: [mesh("a", plate(1, 1, (0.1, 0, 1.0)))],
    "two plates": lambda: [mesh("a", plate(0.6, 0.6, (0, 0, 0.8))), mesh("b", plate(1, 1, (0.1, 0, 1.2)))],
    "body": lambda: [mesh("a", mannequin(2))],
    "V and plate": lambda: [mesh("a", folded_plates(), two_sided=True)],
    "sphere and disk": lambda: [
        mi.load_dict({"type": "sphere", "center": [0, 0, 0.8], "radius": 0.2, "bsdf": DIFFUSE}),
        mi.load_dict({"type": "disk", "to_world": mi.ScalarTransform4f(DISK), "bsdf": DIFFUSE}),
    ],
}
DIFFUSE = {"type": "diffuse", "reflectance": 0.7}
DISK = [[-0.5, 0, 0, 0], [0, 0.7, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]
SENSORS = np.array([(-0.4, -0.3, 0), (0.1, 0.45, 0), (0.4, 0, 0)])


ROWS = [("plane", "single"), ("two plates", "confocal"), ("body", "single"), ("V and plate", "confocal"),
        ("sphere and disk", "single")]  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), ROWS)
def test_brute_force(name, kind):
    """Totals and times of three points, within three standard errors of the brute force and of twelve seeds."""
    shapes, spot = SCENES[name](), np.array([-0.2, 0.1, 0])
    brute = BruteForce(shapes, 1 << 18)
    film = film_of(3, 1, start=0.9, bins=40, bin_width=0.1)
    normals = [UP] * 3
    if kind == "confocal":
        runs = [confocal(shapes, SENSORS, normals, film, 1 << 10, seed)[1] for seed in range(12)]
    else:
        runs = [single(shapes, SENSORS, normals, ([spot], [UP]), film, 1 << 10, seed)[1] for seed in range(12)]
    runs = np.array(runs)[:, 0, :, :, 0]
    for i, point in enumerate(SENSORS):
        value, length, error = brute.events((point if kind == "confocal" else spot, UP), (point, UP))
        total = runs[:, i].sum(-1)
        error = np.hypot(error, total.std(ddof=1) / 12**0.5)
        assert abs(total.mean() - value.sum()) < 3 * error, name
        bins = np.floor((length - 0.9) / 0.1).astype(int)
        bins_ok = (bins >= 0) & (bins < 40)
        expected, square = (np.bincount(bins[bins_ok], v[bins_ok], 40) for v in (value, value**2))
        errors = np.sqrt(square + runs[:, i].var(0, ddof=1) / 12)
        # One of the 12 288 samples weighs up to ten times their mean: bins of a few samples are not normal.
        assert np.all(np.abs(runs[:, i].mean(0) - expected) <= 5 * errors + 1e-3 * expected.sum()), name


def test_curved_walls_and_bodies_have_no_acne():
    """A finely tessellated ball before a wall that is a tessellated ball itself: every point that faces is seen."""
    body = ball((0, 0, 0), 0.3, 4)
    wall = ball((0, 0, -2), 1.0, 5)
    v, f = wall
    centers = v[f].mean(1)
    front = np.flatnonzero(centers[:, 2] > -1.02)[::40]
    n = np.cross(v[f][:, 1] - v[f][:, 0], v[f][:, 2] - v[f][:, 0])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    points, normals = centers[front], n[front]
    for scale in (1e-3, 1.0, 1e3):
        shapes = [mesh("body", (body[0] * scale, body[1])), mesh("wall", (wall[0] * scale, wall[1]))]
        film = film_of(len(front), 1, bins=1, bin_width=10 * scale)
        steady = confocal_of_first(shapes, points * scale, normals, film)[0][0, :, 0]
        bare = confocal_of_first(shapes[:1], points * scale, normals, film)[0][0, :, 0]
        # The ball is convex and the wall too: what faces is visible, but for the limb's last 2e-4.
        unhidden = unoccluded(shapes[0], points * scale, normals)
        assert np.all(np.abs(steady / unhidden - 1) < 1e-3), scale
        assert np.all(np.abs(bare / unhidden - 1) < 1e-3), scale


def test_a_curved_wall_that_hides():
    """A wall with a ridge in it, as brute force sees it; normals are those of its triangles."""
    v, f = plate(2, 2, (0, 0, 0), 24)
    v[:, 2] = 0.7 * np.exp(-((v[:, 0] / 0.2) ** 2)) + 0.1 * v[:, 1] ** 2
    wall, body = mesh("wall", (v, f[:, ::-1]), 0.9), mesh("body", join(mannequin(1), plate(0.8, 0.8, (-0.6, 0, 0.5))))
    corners = v[f[:, ::-1]]
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    places = np.array([(0.4, 0.0), (-0.5, 0.2), (0.8, -0.3)])
    chosen = [np.linalg.norm(corners.mean(1)[:, :2] - place, axis=1).argmin() for place in places]
    points, normals = corners[chosen].mean(1), n[chosen] / np.linalg.norm(n[chosen], axis=1, keepdims=True)
    film = film_of(3, 1, bins=1, bin_width=10)
    scene = scene_of(body, wall)
    runs = [confocal([body], points, normals, film, 1 << 10, seed, scene)[0] for seed in range(12)]
    runs = np.array(runs)[:, 0, :, 0]
    brute, free = BruteForce([body], 1 << 18, others=[wall]), BruteForce([body], 1 << 12)
    hidden = []
    for i, (point, normal) in enumerate(zip(points, normals, strict=True)):
        value, _, error = brute.events((point, normal), (point, normal))
        error = np.hypot(error, runs[:, i].std(ddof=1) / 12**0.5)
        assert abs(runs[:, i].mean() - value.sum()) < 3 * error
        hidden.append(1 - value.sum() / free.events((point, normal), (point, normal))[0].sum())
    assert max(hidden) > 0.1


def test_interpolated_normals_are_those_of_a_path_from_the_sensor():
    """Towards the laser by the shading normal, towards the scan point by that of the triangle."""
    shape = mesh("a", ball((0, 0, 1), (0.4, 0.3, 0.2), 1), vertex_normals=True)
    p, spot = np.array([0.3, 0.1, 0]), np.array([-0.4, 0.2, 0])
    film = film_of(1, 1, bins=1, bin_width=10)
    steady, _ = single([shape], [p], [UP], ([spot], [UP]), film, 1 << 12)
    s = draw_samples(table_of([shape]), 1 << 12, 0)
    x, n, flat = (np.array(a, float).T for a in (s.p, s.n, s.geometric_n))
    f = np.array(s.front, float).ravel() * np.array(s.weight, float)
    total = 0
    for end, normal in ((spot, n), (p, flat)):
        d = end - x
        r2 = (d * d).sum(1)
        # In front by both normals, nothing of a convex body is hidden.
        seen = ((n * d).sum(1) > 0) & ((flat * d).sum(1) > 0)
        f = f * seen * (normal * d).sum(1) * -d[:, 2] / r2**2
    total = f.sum() * (WALL_ALBEDO / np.pi) ** 2
    assert steady[0, 0, 0] == pytest.approx(total, rel=1e-4)


def confocal_of_first(shapes, points, normals, film):
    return confocal(shapes[:1], points, normals, film, 1 << 12, scene=scene_of(*shapes))


def unoccluded(shape, points, normals):
    """The same samples without visibility, in double precision."""
    s = draw_samples(table_of([shape]), 1 << 12, 0)
    x, n = np.array(s.p, float).T, np.array(s.n, float).T
    f = np.array(s.front, float).ravel() * np.array(s.weight, float)
    total = []
    for p, m in zip(points, normals, strict=True):
        d = p - x
        r = np.linalg.norm(d, axis=1)
        g = np.maximum((n * d).sum(1), 0) * np.maximum(-d @ m, 0) / r**4
        total.append((f * g * g).sum() * (WALL_ALBEDO / np.pi) ** 2)
    return np.array(total)
