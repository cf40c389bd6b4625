"""Lines between hidden points and points of the wall, and the tables that hold both ends, against numpy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import folded_plates, mesh, plate, scene_of, wall_grid
from torchtransient.errors import ShapeError
from torchtransient.plugins.around_corner import geometry
from torchtransient.plugins.around_corner import shared_light as late_density
from torchtransient.plugins.around_corner.geometry import WallPoints, points_of
from torchtransient.plugins.around_corner.third_bounce import SampleTable
from torchtransient.plugins.around_corner.third_bounce_gradients import Ends, ends_of_points, ends_of_samples, leaves
from torchtransient.plugins.cache import Cache
from torchtransient.plugins.sampling.hidden_elements import HiddenElements
from torchtransient.plugins.sampling.shared_samples import draw_samples
from torchtransient.plugins.transport.strategy import Local

VARIANT = "llvm_ad_mono"


def draw(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


# -------------------------------------------------------------------------------------------------------------- lines


def test_cosines_and_distances_of_a_line():
    """Signed at the sample, by its shading and by its geometric normal; zero behind the wall."""
    x, m, g, p, n = draw(1, 5, 3, 16)
    sample = Local(p=mi.Point3f(x), n=mi.Vector3f(m), geometric_n=mi.Vector3f(g))
    line, d = geometry.span(sample, mi.Point3f(p), mi.Vector3f(n)), p - x
    r = np.linalg.norm(d, axis=0)
    wall = -(n * d).sum(0) / r
    assert 2 < (wall > 0).sum() < 14
    expected = {"d": d, "r": r, "cos": (m * d).sum(0) / r, "geometric_cos": (g * d).sum(0) / r,
                "wall_cos": np.maximum(wall, 0), "inverse_square": r**-2.0}  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(np.array(getattr(line, name)), value, rtol=1e-4, atol=1e-6, err_msg=name)
    sample.geometric_n = sample.n
    line = geometry.span(sample, mi.Point3f(p), mi.Vector3f(n))
    np.testing.assert_array_equal(np.array(line.geometric_cos), np.array(line.cos))
    factor = late_density._factor(mi.Point3f(x), mi.Vector3f(m), mi.Point3f(p), mi.Vector3f(n))
    cosines = np.maximum((m * d).sum(0), 0) * np.maximum(wall * r, 0)
    np.testing.assert_allclose(np.array(factor), cosines / r**4, rtol=1e-4)


def test_the_geometric_normal_of_the_side_that_scatters():
    n, m = draw(2, 2, 3, 9)
    si = dr.zeros(mi.SurfaceInteraction3f, 9)
    si.n, si.sh_frame.n = mi.Normal3f(n), mi.Normal3f(m)
    expected = n * np.sign((n * m).sum(0))
    assert (expected != n).any()
    np.testing.assert_array_equal(np.array(geometry.front_normal(si)), expected)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_what_stands_between_two_points(scale):
    """Points of one plane do not see each other, nor points that turn their backs; a sheet hides what lies farther
    behind it than rays start off a surface, seen from either side of the first point.
    """
    sheet = mesh("sheet", plate(0.4 * scale, 0.4 * scale, (0, 0, 0.5 * scale)))
    scene = scene_of(sheet)
    offset = geometry.OFFSET * 0.5 * scale
    ends = np.array([[0.1, 0, 0], [0.9, 0, 0], [0.1, 0, 1], [0.1, 0, 1], [0.9, 0.1, 1]]) * scale
    ends[2, 2] = 0.5 * scale + 0.2 * offset  # above the sheet, nearer than that
    # Towards the first point, towards it in its plane, towards it twice, and away.
    normals = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 0, -1], [0, 0, 1.0]])
    start = Local(p=mi.Point3f(0, 0, 0), geometric_n=mi.Vector3f(0, 0, 1))
    seen = geometry.sees(scene, start, mi.Point3f(ends.T), mi.Vector3f(normals.T), mi.Bool([True] * 5))
    assert np.array(seen).tolist() == [False, False, True, False, False]
    free = np.array([[0.9, 0.1, 1], [0.9, 0.1, 1], [0.9, 0.1, -1]]) * scale
    normals = np.array([[0, 0, -1], [0, 0, -1], [0, 0, 1.0]])
    active = mi.Bool([True, False, True])
    seen = geometry.sees(scene, start, mi.Point3f(free.T), mi.Vector3f(normals.T), active)
    assert np.array(seen).tolist() == [True, False, True]


# --------------------------------------------------------------------------------------------------- points of a wall


def test_points_of_a_wall_have_one_number_or_one_each():
    p = draw(3, 3, 4)
    points = WallPoints(mi.Point3f(p), mi.Normal3f(0, 0, 1), 0.25, mi.Float64([1, 2, 3, 5]))
    assert points.width == 4
    found = points.take(mi.UInt32([3, 0, 2]), mi.Bool([True, True, False]))
    np.testing.assert_array_equal(np.array(found[0]), p[:, [3, 0, 2]] * [1, 1, 0])
    assert np.array(found[1])[2].tolist() == [1, 1, 0]
    assert np.array(found[2]).ravel().tolist() == [0.25, 0.25, 0]
    assert np.array(found[3]).tolist() == [5, 1, 0]
    each = WallPoints(mi.Point3f(p), mi.Normal3f(p), mi.UnpolarizedSpectrum(mi.Float([2, 3, 5, 7])))
    found = each.take(mi.UInt32([1, 3]))
    np.testing.assert_array_equal(np.array(found[1]), p[:, [1, 3]])
    assert np.array(found[2]).ravel().tolist() == [3, 7] and not np.array(found[3]).any()


@pytest.mark.parametrize("name", ["n", "value", "leg"])
def test_points_of_a_wall_with_other_numbers_than_points(name):
    given = {"n": mi.Normal3f(0, 0, 1), "value": 0.5, "leg": 0.0} | {
        name: {"n": mi.Normal3f(draw(4, 3, 3)), "value": mi.UnpolarizedSpectrum(mi.Float([1, 2, 3])),
               "leg": mi.Float64([1, 2, 3])}[name]
    }  # fmt: skip
    with pytest.raises(ShapeError, match=f"expected one {name} or 4, as there are points, got 3"):
        WallPoints(mi.Point3f(draw(3, 3, 4)), **given)


def test_what_a_wall_makes_of_light_from_either_side():
    """One-sided and two-sided, from before and from behind, and where nothing is met."""
    bsdf = {"type": "diffuse", "reflectance": 0.3}
    two = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([5, 0, 0]),
           "bsdf": {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 0.6}}}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "one": {"type": "rectangle", "bsdf": bsdf}, "two": two})
    before = np.array([1, -1, 1, -1, 1])
    o = mi.Point3f([0.5, 0.5, 5.5, 5.5, 20], 0.25, mi.Float(2.0 * before))
    si = scene.ray_intersect(mi.Ray3f(o, mi.Vector3f(0, 0, mi.Float(-1.0 * before))))
    si.p = dr.select(si.is_valid(), si.p, 7)
    along = dr.copy(si)
    along.wi = mi.Vector3f(1, 0, 0)
    assert not np.array(points_of(along, mi.UnpolarizedSpectrum(0.5), mi.Float(1)).value).any()
    wall = points_of(si, mi.UnpolarizedSpectrum(0.5), mi.Float([2, 3, 5, 7, 11]))
    np.testing.assert_allclose(np.array(wall.value).ravel(), [0.15, 0, 0.3, 0.3, 0], rtol=1e-6)
    np.testing.assert_allclose(np.array(wall.n), [[0] * 5, [0] * 5, [1, 1, 1, -1, 1]], atol=1e-6)
    np.testing.assert_allclose(np.array(wall.p), [[0.5, 0.5, 5.5, 5.5, 0], [0.25] * 4 + [0], [0] * 5], atol=1e-5)
    assert np.array(wall.leg).tolist() == [2, 3, 5, 7, 0]


# -------------------------------------------------------------------------------------------------------------- tables


def samples_of(smooth, channels):
    """Three samples of each of two tiles."""
    numbers = draw(5, 11 + 2 * channels, 6)
    p, n, g = numbers[:3], numbers[3:6], numbers[6:9]
    front, back = numbers[9 : 9 + channels], numbers[9 + channels : 9 + 2 * channels]
    return Local(count=3, tiles=2, smooth=smooth, p=mi.Point3f(p), n=mi.Normal3f(n), geometric_n=mi.Normal3f(g),
                 front=spectrum(front), back=spectrum(back), weight=mi.Float(numbers[-1]))  # fmt: skip


def spectrum(rows):
    return mi.UnpolarizedSpectrum(*(mi.Float(row) for row in rows))


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_table_gives_samples_back(channels, smooth):
    """What they scatter times their weight; lit by a spot, what is handed over, and the way to it."""
    with mi.variant_context("llvm_ad_rgb" if channels == 3 else VARIANT):
        s, index = samples_of(smooth, channels), np.array([4, 0, 5])
        table = SampleTable(s)
        assert (table.count, table.lit, table.packets) == (3, False, 2 + (channels > 1) + smooth)
        found = table.load(mi.UInt32(index), mi.Bool([True, True, False]))
        weight, kept = np.array(s.weight), [1, 1, 0]
        geometric = s.geometric_n if smooth else s.n
        expected = {"p": s.p, "n": s.n, "geometric_n": geometric}
        expected |= {"front": s.front * s.weight, "back": s.back * s.weight}
        for name, value in expected.items():
            np.testing.assert_allclose(np.array(getattr(found, name)), np.array(value)[:, index] * kept, rtol=1e-6)
        front, n, delay = spectrum(draw(6, channels, 6)), mi.Vector3f(draw(7, 3, 6)), mi.Float(draw(8, 6))
        lit = SampleTable(s, front, n, delay)
        found = lit.load(mi.UInt32(index))
        assert lit.lit
        expected = {"p": s.p, "n": n, "geometric_n": s.geometric_n if smooth else n, "front": front, "delay": delay}
        for name, value in expected.items():
            np.testing.assert_array_equal(np.array(getattr(found, name)), np.array(value)[..., index])
        assert weight.std() > 0


def test_fields_of_samples_without_their_derivatives():
    """Read number by number, of one or of all; attached where the scene is, and not while derivatives are suspended."""
    numbers = draw(9, 5, 3)
    x = mi.Float(numbers[0])
    dr.enable_grad(x)
    fields = {"p": mi.Point3f(x, mi.Float(numbers[1]), mi.Float(numbers[2])), "n": mi.Vector3f(2, 3, 5),
              "value": mi.UnpolarizedSpectrum(mi.Float(numbers[3])), "leg": mi.Float(numbers[4])}  # fmt: skip
    ends = Ends(3, fields)
    assert (ends.attached, ends.rows, ends.size[0]) == (["p"], 2, 3)
    with dr.suspend_grad():
        assert ends.attached == []
    found = ends.load(mi.UInt32([2, 0]))
    assert not dr.grad_enabled(found.p)
    np.testing.assert_array_equal(np.array(found.p), numbers[:3, [2, 0]])
    np.testing.assert_array_equal(np.array(found.n), [[2, 2], [3, 3], [5, 5]])
    np.testing.assert_array_equal(np.array(found.value).ravel(), numbers[3, [2, 0]])
    np.testing.assert_array_equal(np.array(found.leg), numbers[4, [2, 0]])
    plain = ends.detached()
    assert (plain.attached, plain.count) == ([], 3)
    np.testing.assert_array_equal(np.array(plain.load(mi.UInt32([1])).p).ravel(), numbers[:3, 1])
    assert Ends(3, {}).flat is None
    dr.set_grad(x, mi.Float([7, 11, 13]))
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    tangents = ends.tangents()
    assert list(tangents.fields) == ["p"]
    np.testing.assert_array_equal(np.array(tangents.load(mi.UInt32([2, 0])).p), [[13, 7], [0, 0], [0, 0]])


def test_adjoints_of_samples_go_on_to_the_scene():
    """What one number stands for all samples of, gets the sum."""
    x, y, z = mi.Float([1, 2, 3]), mi.Vector3f(1, 2, 3), mi.Float(5)
    dr.enable_grad(x, y, z)
    ends = Ends(3, {"p": mi.Point3f(x, 2 * x, 0), "n": y * 2, "leg": z * 3})
    adjoints = {"p": mi.Point3f([1, 2, 3], [4, 5, 6], 7), "n": mi.Vector3f([1, 2, 3], [10, 20, 30], [5, 5, 5]),
                "leg": mi.Float([1, 2, 4])}  # fmt: skip
    ends.hand_on(adjoints)
    assert (list(np.array(dr.grad(x))), dr.grad(z)[0]) == ([9, 12, 15], 21)
    assert np.array(dr.grad(y)).ravel().tolist() == [12, 120, 30]


def test_leaves_of_a_lane():
    """As wide as the lanes, with tangents in forward mode; what is not named stays."""
    p, kept = mi.Point3f(1, 2, 3), mi.Float(4)
    local = Local(p=p, leg=mi.Float(5), still=kept)
    found = leaves(local, ["p", "leg"], 3, Local(p=mi.Vector3f(7, 8, 9), leg=mi.Float([1, 2, 3])))
    assert list(found) == ["p", "leg"] and local.p is found["p"] and local.still is kept
    assert (dr.width(local.p), dr.width(local.leg)) == (3, 3) and not dr.grad_enabled(p)
    assert np.array(local.p).tolist() == [[1] * 3, [2] * 3, [3] * 3]
    assert np.array(dr.grad(local.p)).tolist() == [[7] * 3, [8] * 3, [9] * 3]
    assert np.array(dr.grad(local.leg)).tolist() == [1, 2, 3]
    again = leaves(Local(leg=mi.Float(5)), ["leg"], 2)["leg"]
    dr.backward(again * mi.Float([2, 3]))
    assert np.array(dr.grad(again)).tolist() == [2, 3]


def test_scanned_points_with_their_laser():
    """What wall and spot scatter, times the energy, and both legs."""
    sensors = WallPoints(mi.Point3f(draw(3, 3, 3)), mi.Normal3f(0, 0, 1), spectrum([[2, 3, 5]]), mi.Float64([1, 2, 3]))
    laser = WallPoints(mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1), 7.0, 10.0)
    ends = ends_of_points(sensors, laser, mi.UnpolarizedSpectrum(11))
    found = ends.load(mi.UInt32([2, 1]))
    assert ends.count == 3 and np.array(found.value).ravel().tolist() == [385, 231]
    assert np.array(found.leg).tolist() == [13, 12]


def test_samples_that_a_spot_lights():
    """What arrives on the side that faces the spot, and what that side scatters of it; nothing where a sheet is in the
    way, or a side scatters nothing.
    """
    v, f = plate(1.2, 1.2, (0, 0, 1), 3)
    turned = v * [0.5, 0.5, 1] + [1.5, 0, 0.2], f[:, ::-1]
    shapes = [mesh("both", (v, f), 0.7, two_sided=True), mesh("away", turned, 0.6), mesh("away, both", (
        turned[0] - [3, 0, 0], turned[1]), 0.5, two_sided=True)]  # fmt: skip
    sheet = mesh("sheet", plate(0.4, 2, (0.3, 0, 0.5)))
    table = HiddenElements(shapes, *wall_grid(3))
    samples = draw_samples(table, 256, 1)
    laser = WallPoints(mi.Point3f(0.05, 0.02, 0), mi.Normal3f(0, 0, 1), 0.25)
    ends = ends_of_samples(scene_of(*shapes, sheet), table, samples, None, laser)
    found = ends.load(mi.UInt32(np.arange(256)))
    p, n, weight = (np.array(each, dtype=float) for each in (samples.p, samples.n, samples.weight))
    to = np.array([[0.05], [0.02], [0]]) - p
    r = np.linalg.norm(to, axis=0)
    cos = (n * to).sum(0) / r
    scattered = np.where(cos > 0, np.array(samples.front)[0], np.array(samples.back)[0]) * weight
    crossing = 0.05 + (p[0] - 0.05) * 0.5 / p[2]
    expected = np.where((crossing > 0.1) & (crossing < 0.5), 0, scattered * np.abs(cos) * (p[2] / r) / r**2)
    clear = np.abs(np.abs(crossing - 0.3) - 0.2) > 1e-3
    assert 20 < (expected == 0).sum() < 200 and (cos[expected > 0] < 0).any() and (cos[expected > 0] > 0).any()
    np.testing.assert_allclose(np.array(found.front)[0][clear], expected[clear], rtol=1e-4, atol=1e-9)
    lit = (crossing < 0.1) | (crossing > 0.5)
    np.testing.assert_allclose(np.array(found.delay)[clear], np.where(lit, r, 0)[clear], rtol=1e-5)
    np.testing.assert_allclose(np.array(found.n), n * np.sign(cos), atol=1e-6)
    plain = ends_of_samples(scene_of(*shapes, sheet), table, samples, None).load(mi.UInt32(np.arange(256)))
    np.testing.assert_allclose(np.array(plain.front)[0], np.array(samples.front)[0] * weight, rtol=1e-5)
    np.testing.assert_allclose(np.array(plain.back)[0], np.array(samples.back)[0] * weight, rtol=1e-5)


# ----------------------------------------------------------------------------------------------- where chains begin


def test_pilots_of_chains_see_what_is_scattered_twice(monkeypatch):
    """In a V that opens towards the wall, and not beside each other in one plane, nor from black sides."""
    squares = []
    monkeypatch.setattr(late_density, "_smoothed", lambda elements, square, *others: squares.append(square) or (
        elements.probabilities))  # fmt: skip
    points, normals = wall_grid(3)  # the middle one in the origin, where rays that meet nothing seem to end
    cases = [mesh("V", folded_plates()), mesh("V", folded_plates(), two_sided=True),
             mesh("flat", plate(1, 1, (0, 0, 1))), mesh("black", folded_plates(), 0.0)]  # fmt: skip
    v, f = folded_plates()
    cases += [mesh("away", (v, f[:, ::-1])), mesh("away, both", (v, f[:, ::-1]), two_sided=True),
              mesh("black there", (v, f), 0.0, two_sided=True, back=0.5)]  # fmt: skip
    for shape in cases:
        late_density.late_density(scene_of(shape), HiddenElements([shape], points, normals), points, normals)
    shares = [(square > 0).mean() for square in squares]
    assert np.isfinite(squares).all()
    assert shares[0] > 0.1 and shares[1] > 0.1 and shares[2] == shares[3] == shares[4] == shares[6] == 0
    np.testing.assert_allclose([shares[5], squares[5].sum()], [shares[1], squares[1].sum()], rtol=0.05)


def test_where_pilots_of_chains_start():
    """Off the side that faces the scan, by the size of the hidden scene, into its half space."""
    v, f = plate(0.6, 0.4, (0, 0, 0))
    upright = mesh("a", (np.stack([0 * v[:, 0], v[:, 1] - 0.7, v[:, 0] + 1.5], 1), f), two_sided=True)
    points, normals = wall_grid(3)
    elements = HiddenElements([upright], points, normals)
    rays = []

    def met(ray, coherent, active):
        rays.append((np.array(ray.o, dtype=float), np.array(ray.d)))
        raise StopIteration

    scene = Local(ray_intersect_preliminary=met)
    for side in (1, -1):
        with pytest.raises(StopIteration):
            late_density.late_density(scene, elements, points + np.array([4 * side, 1, 0]), normals)
        o, d = rays[-1]
        reach = np.abs(o[1:]).max(0) + np.linalg.norm(o - [[4 * side], [1], [0]], axis=0)
        np.testing.assert_allclose(o[0], side * mi.math.RayEpsilon * reach, rtol=1e-4)
        assert (d[0] * side > 0).all() and abs(np.abs(d[0]).mean() - 2 / 3) < 0.01


def test_weights_of_elements_from_samples_of_neighbours(monkeypatch):
    """Root mean squares by area over some samples in a row, times the area; the rest goes as before."""
    monkeypatch.setattr(late_density, "_BUCKET", 4)
    element = np.array([0, 0, 1, 2, 2, 2, 2, 3, 5, 5])
    square, area = (np.random.default_rng(seed).uniform(0.2, 2, 10) for seed in (1, 2))

    class Sizes:
        area = np.array([1.0, 2.0, 0.5, 3.0, 0.7, 1.3])

        def __len__(self):
            return 6

    before = np.array([1.0, 4.0, 2.0, 3.0, 5.0, 7.0])
    elements = Local(elements=Sizes(), probabilities=[before])
    found = late_density._smoothed(elements, square, area, element)
    # Elements 0 to 2 begin within the first four samples, 3 within the next four, 4 and 5 behind eight.
    mean = [np.sqrt((square[some] * area[some]).sum() / area[some].sum()) for some in ([*range(7)], [7], [8, 9])]
    learned = np.array([mean[k] for k in (0, 0, 0, 1, 2, 2)]) * Sizes.area
    assert found.shape == (1, 6)
    np.testing.assert_allclose(found[0], 0.6 * learned / learned.sum() + 0.4 * before / before.sum(), rtol=1e-12)
    # Nothing is drawn of the last ones, behind a row that is full.
    none = late_density._smoothed(elements, square[:4], area[:4], np.zeros(4, dtype=int))
    learned = np.array([1, 0, 0, 0, 0, 0]) * Sizes.area
    np.testing.assert_allclose(none[0], 0.6 * learned + 0.4 * before / before.sum(), rtol=1e-12)
    dark = late_density._smoothed(elements, 0 * square, area, element)
    np.testing.assert_allclose(dark[0], 0.4 * before / before.sum(), rtol=1e-12)


def test_densities_of_one_scene_are_made_once():
    """As long as what scatters light is the same, and the elements are those that were kept."""
    shapes = [mesh("a", plate(1, 1, (0, 0, 1)))]
    scene, memory, wall = scene_of(*shapes), Cache(), wall_grid(2)
    kept = HiddenElements.cached(memory, shapes, *wall)
    first = late_density.late_density(scene, kept, *wall, memory)
    assert late_density.late_density(scene, kept, *wall, memory) is first
    assert late_density.late_density(scene, kept, *wall) is not first
    loose = HiddenElements(shapes, *wall)
    assert late_density.late_density(scene, loose, *wall, memory) is not late_density.late_density(
        scene, loose, *wall, memory
    )
    params = mi.traverse(scene)
    params["shape0.bsdf.reflectance.value"] = 0.0
    params.update()
    assert late_density.late_density(scene, kept, *wall, memory) is not first
