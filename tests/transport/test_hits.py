"""Hit points that are attached here: the tables behind them follow what is installed."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.spatial.transform

from support.gradient_cases.cases_curves import file_of
from support.marks import long
from support.walks import attached_distance, attached_interaction

VARIANT = "llvm_ad_mono"
POINTS = np.array(
    [[-3, 0.3, -0.2, 0.9], [-1, 0.1, 0.4, 1.0], [1, -0.2, 0.1, 1.2], [3, 0.3, 0.5, 0.8], [5, 0.0, 0.3, 0.8]]
)


# ------------------------------------------------------------------------------------------------- all kinds, together

# Centre, semi-axes, quaternion: of three extents each, turned about an axis of its own.
ELLIPSOIDS = np.array(
    [
        [-1.2, 0.3, 0.2, 0.35, 0.2, 0.25, 0.1, 0.2, 0.3, 0.92],
        [0.1, -0.4, -0.3, 0.2, 0.3, 0.4, -0.2, 0.4, 0.1, 0.88],
        [1.3, 0.2, 0.4, 0.3, 0.15, 0.2, 0.3, -0.1, 0.2, 0.92],
    ],
    dtype=np.float32,
)
ELLIPSOIDS[:, 6:] /= np.linalg.norm(ELLIPSOIDS[:, 6:], axis=1, keepdims=True)
OPACITIES = np.array([[0.9], [0.6], [0.75]], dtype=np.float32)
LINES = np.array([[-2, 0.3, -0.2, 0.5], [-0.6, 0.1, 0.4, 0.7], [0.5, -0.2, 0.1, 0.4], [2.0, 0.3, 0.5, 0.55]])
ASIDE = np.array([0, 4, 0])  # where the second shape of each kind lies


def curve_of(kind, name, points):
    return {"type": kind, "filename": file_of(name, "\n".join(" ".join(map(str, point)) for point in points))}


def ellipsoids_of(extent, aside, **arguments):
    data = ELLIPSOIDS.copy()
    data[:, :3] += aside
    return {"type": "ellipsoids", "data": mi.TensorXf(data), "extent": extent, **arguments}


def two_of_each(kind):
    """Two shapes of a kind, and a wall that is none of them."""
    if kind == "ellipsoids":
        faded = {"extent_adaptive_clamping": True, "opacities": mi.TensorXf(OPACITIES)}
        first, second = ellipsoids_of(1.4, 0), ellipsoids_of(1.3, ASIDE, **faded)
    else:
        points = POINTS if kind == "bsplinecurve" else LINES
        first = curve_of(kind, f"first {kind}.txt", points)
        second = curve_of(kind, f"second {kind}.txt", points[::-1] * [1, 1, 1, 0.9] + [*ASIDE, 0])
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 8, 0])}
    return {"first": first, "second": second, "wall": wall}


TARGETS = np.array(
    [[-1.1, 0.35, 0.2], [0.15, -0.3, -0.3], [1.2, 0.1, 0.4], [-1.1, 4.3, 0.2], [0.1, 3.7, -0.3], [1.35, 4.2, 0.4],
     [0.3, 8.2, 0.0], [30.0, 0.0, 0.0], [0.15, -0.3, -0.3], [-2.3, 0.4, -0.1]]
)  # fmt: skip
# Behind those of the shapes: the wall, beyond everything, what is not asked for, and the round end of a line.
ACTIVE = [True] * 8 + [False, True]


def moved_rays(x):
    """(origins, directions) of a ray from beside each target, which ``x`` moves and turns."""
    rng = np.random.default_rng(3)
    start = TARGETS + rng.normal(size=TARGETS.shape) * 0.2 + [0, 0, 4]
    turned, moved = rng.normal(size=(2, *TARGETS.shape))
    along = TARGETS - start + x * turned
    return (start + x * moved).T, (along / np.linalg.norm(along, axis=1, keepdims=True)).T


def rays_to_targets(x):
    """The same in single precision, attached to ``x``."""
    (o, d), (o1, d1) = moved_rays(0.0), moved_rays(1e-6)
    d_rate = mi.Vector3f((d1 - d) / 1e-6)
    return mi.Ray3f(mi.Point3f(o) + mi.Vector3f((o1 - o) / 1e-6) * x, dr.normalize(mi.Vector3f(d) + d_rate * x))


def read_fields(scene, ray, fields):
    pi = scene.ray_intersect_preliminary(dr.detach(ray))
    si = attached_interaction(scene, pi, ray, mi.RayFlags.All, ACTIVE)
    found = {"t": si.t, "n": si.n, "shading": si.sh_frame.n, "s": si.sh_frame.s, "uv": si.uv, "dp_du": si.dp_du}
    return [dr.select(si.is_valid(), found[name], 0) for name in fields]


STEP = 1e-3


def directions_of(start):
    """Some motion of parameters, by key; quaternions stay of length one."""
    rng = np.random.default_rng(5)
    found = {key: rng.normal(size=dr.width(value)) * (4 if "opacit" in key else 0.4) for key, value in start.items()}
    for key in found:
        if key.endswith("data"):
            turned, q = found[key].reshape(-1, 10)[:, 6:], np.array(start[key]).reshape(-1, 10)[:, 6:]
            turned -= q * (turned * q).sum(1, keepdims=True)
    return found


def slopes_of(scene, keys, fields):
    """(derivatives, central differences) of the fields of hits."""
    params = mi.traverse(scene)
    start = {key: mi.Float(getattr(params[key], "array", params[key])) for key in keys}
    directions = {key: mi.Float(direction) for key, direction in directions_of(start).items()}

    def fields_at(x):
        for key in keys:
            params[key] = start[key] + directions[key] * (x + 0)
        params.update()
        return read_fields(scene, rays_to_targets(x), fields)

    above, below = (numbers(fields_at(mi.Float(x))) for x in (STEP, -STEP))
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    attached = fields_at(x)
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    differences = [(a - b) / (2 * STEP) for a, b in zip(above, below, strict=True)]
    return numbers([dr.grad(part) for part in attached]), differences


def numbers(parts):
    """Arrays of one kernel."""
    dr.eval(parts)
    return [np.array(part) for part in parts]


def ellipsoid_hits(keys, x):
    """(distances, normals) in double precision: of what stands still or moves as in :func:`slopes_of`."""
    data = ELLIPSOIDS.astype(np.float64).ravel()
    start = {"first.data": data, "second.data": data, "second.opacities": OPACITIES.astype(np.float64).ravel()}
    directions = directions_of({key: mi.Float(start[key]) for key in keys})
    now = {key: value + x * directions.get(key, 0.0) for key, value in start.items()}
    stretched = np.sqrt(2 * np.log(now["second.opacities"] / 0.01)) / 3
    t, n = np.zeros(6), np.zeros((3, 6))
    start_points, d = moved_rays(x)
    for lane in range(6):
        row = now["first.data" if lane < 3 else "second.data"].reshape(-1, 10)[lane % 3]
        axes = row[3:6] * (1.4 if lane < 3 else 1.3 * stretched[lane - 3])
        turn = scipy.spatial.transform.Rotation.from_quat(row[6:]).as_matrix().T
        center = row[:3] + (ASIDE if lane >= 3 else 0)
        o, v = turn @ (start_points[:, lane] - center) / axes, turn @ d[:, lane] / axes
        half, rest = o @ v / (v @ v), (o @ o - 1) / (v @ v)
        t[lane] = -half - np.sqrt(half**2 - rest)
        out = turn.T @ ((o + t[lane] * v) / axes)
        n[:, lane] = out / np.linalg.norm(out)
    return t, n


KEYS = {"ellipsoids": "data", "linearcurve": "control_points", "bsplinecurve": "control_points"}


@pytest.mark.parametrize("kind", long(KEYS, ["ellipsoids", "bsplinecurve"]))
def test_hits_follow_shapes_and_rays(kind):
    scene = mi.load_dict({"type": "scene", **two_of_each(kind)}, optimize=False)
    keys = [f"second.{KEYS[kind]}"] + ["second.opacities"] * (kind == "ellipsoids")
    fields = ("t", "n", "shading", "uv", "s", "dp_du") if kind == "bsplinecurve" else ("t", "n", "shading", "uv")
    found, expected = slopes_of(scene, keys, fields)
    if kind == "ellipsoids":  # Mitsuba's distances are good to some 1e-5: too little for differences
        (above, n_above), (below, n_below) = (ellipsoid_hits(keys, x) for x in (1e-6, -1e-6))
        expected = [(above - below) / 2e-6, (n_above - n_below) / 2e-6]
        found = [part[..., :6] for part in found]
    for one, other in zip(found, expected, strict=False):
        np.testing.assert_allclose(one, other, rtol=4e-3, atol=4e-3)


def test_slopes_backwards_are_finite():
    """What no ray meets, or is not asked for, leaves no NaN behind."""
    kind = "bsplinecurve"
    scene = mi.load_dict({"type": "scene", **two_of_each(kind)}, optimize=False)
    params, key = mi.traverse(scene), f"first.{KEYS[kind]}"
    dr.enable_grad(params[key])
    params.update()
    t, n, uv = read_fields(scene, rays_to_targets(0.0), ("t", "n", "uv"))
    dr.backward(dr.sum(t) + dr.sum(n.x) + dr.sum(uv.y))
    slope = np.array(dr.grad(params[key]))
    assert np.isfinite(slope).all() and slope.any()


@pytest.mark.parametrize("kind", ["ellipsoids", "linearcurve"])
def test_a_ray_along_a_surface_has_no_slope(kind):
    """Where it touches the shape, nothing is divided by zero."""
    if kind == "ellipsoids":
        data = mi.TensorXf(np.array([[0, 0, 0, 1, 2, 1, 0, 0, 0, 1.0]], dtype=np.float32))
        shape = {"type": kind, "data": data, "extent": 1.0}
    else:
        shape = curve_of(kind, "tube.txt", np.array([[0, -1.0, 0, 1], [0, 1.0, 0, 1]]))
    scene = mi.load_dict({"type": "scene", "shape": shape}, optimize=False)
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    pi.t, pi.prim_uv, pi.shape, pi.valid = 2, mi.Point2f(0.5, 0), mi.ShapePtr(scene.shapes()[0]), True
    x = mi.Float(0)
    dr.enable_grad(x)
    ray = mi.Ray3f(mi.Point3f(1 + x, 0, -2), mi.Vector3f(0, 0, 1))
    found = attached_interaction(scene, pi, ray, mi.RayFlags.All)
    assert found.t[0] == 2
    dr.backward(found.t)
    assert dr.grad(x)[0] == 0


@pytest.mark.parametrize("copied", [False, True])
def test_distance_of_where_a_ray_leaves(copied):
    """Of the far side of a sphere, alone or in an instance, for a ray that starts before the near one:
    sqrt(r^2 - x^2) + 3, by x and by r.
    """
    ball, key = {"type": "sphere", "radius": 1.5}, "copy.to_world" if copied else "ball.to_world"
    objects = {"ball": ball}
    if copied:
        copy = {"type": "instance", "group": {"type": "ref", "id": "group"}}
        objects = {"group": {"type": "shapegroup", "ball": ball}, "copy": copy}
    scene = mi.load_dict({"type": "scene", **objects}, optimize=False)
    x, scale = mi.Float(0.9), mi.Float(1.0)
    pi = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(x, 0, 0), mi.Vector3f(0, 0, 1)))
    pi.t += 3
    dr.enable_grad(x, scale)
    params = mi.traverse(scene)
    params[key] = mi.AffineTransform4f(params[key]) @ mi.AffineTransform4f().scale(mi.Vector3f(scale))
    params.update()
    t = attached_distance(scene, pi, mi.Ray3f(mi.Point3f(x, 0, -3), mi.Vector3f(0, 0, 1)))
    dr.backward(t)
    assert dr.grad(x)[0] == pytest.approx(-0.9 / 1.2, rel=1e-5)
    assert dr.grad(scale)[0] == pytest.approx(1.5 * 1.5 / 1.2, rel=1e-5)


def test_idle_lanes_reach_no_pose():
    """What nothing was met by may hold what is no number, or lie at the ray's start: the poses, which all lanes share,
    and its own ray hear nothing of it.
    """
    group, copy = {"type": "shapegroup", "ball": {"type": "sphere"}}, {"type": "ref", "id": "group"}
    objects = {"group": group, "copy": {"type": "instance", "group": copy}}
    scene, x = mi.load_dict({"type": "scene", **objects}, optimize=False), mi.Float(0)
    params = mi.traverse(scene)
    dr.enable_grad(x)
    params["copy.to_world"] = mi.AffineTransform4f().translate(mi.Vector3f(0.1, 0.2, 0.3) * x)
    params.update()
    ray = mi.Ray3f(mi.Point3f([0.1, 0.2, 5, 6], 0.3, -4), mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, 4))
    pi = scene.ray_intersect_preliminary(ray)
    missed, lane = ~pi.is_valid(), dr.arange(mi.UInt32, 4)
    ray.o = dr.select(missed, dr.select(lane == 2, 0, mi.Float(np.nan)), ray.o)
    ray.d = dr.select(lane == 3, np.nan, ray.d)
    dr.enable_grad(ray.o)
    si = attached_interaction(scene, pi, ray, mi.RayFlags.All | mi.RayFlags.FollowShape)
    dr.backward(dr.sum(si.t + si.n.x + si.p.z))
    slope = np.array(dr.grad(ray.o))
    # Distance and place of each of the two hits are carried along.
    assert dr.grad(x)[0] == pytest.approx(2 * (0.3 + 0.3), rel=1e-5) and np.isfinite(slope).all() and slope.any()
    assert np.array(missed).sum() == 2 and not slope[:, np.array(missed)].any()
