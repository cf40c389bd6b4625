"""The boundary term of moving edges through the layer: its value, where it is, and what is said where it is not."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import pose
from torchtransient.errors import GradientError, GradientWarning

VARIANT = "llvm_ad_mono"
BODY, PAINT = "body.to_world", "body.bsdf.reflectance.value"
FILM = {"type": "transient_hdr_film", "width": 8, "height": 8, "rfilter": {"type": "box"}, "temporal_bins": 128,
        "start_opl": 5.5, "bin_width_opl": 0.05}  # fmt: skip
CAMERA = np.diag([-1.0, 1, -1, 1]) + pose(0, 0, 4) - np.eye(4)
PATTERN = torch.randn(1, 1, 8, 8, generator=torch.Generator().manual_seed(3))
SIDEWAYS = torch.zeros(4, 4).index_put((torch.tensor(0), torch.tensor(3)), torch.tensor(1.0))


def plate(**more):
    """A plate before a wall: shifted sideways, all of the derivative is its outline and its shadow."""
    return tt.load(described(**more), variant=VARIANT)


def described(**more):
    body = pose(0.07, -0.05, 0.8) @ np.diag([0.45, 0.35, 1, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 40, "near_clip": 1e-3, "to_world": CAMERA, "film": FILM},
        "light": {"type": "point", "position": [0.7, 0.4, 3.8], "intensity": 10.0},
        "wall": {"type": "rectangle", "to_world": pose(scale=5.0), "bsdf": {"type": "diffuse", "reflectance": 0.7}},
        "body": {"type": "rectangle", "to_world": body, "bsdf": {"type": "diffuse", "reflectance": 0.4}},
    }
    return scene | more


MIRROR = {"type": "rectangle", "to_world": pose(0, 2, 1, 0.5), "bsdf": {"type": "conductor"}}


def weighed(out):
    """The loss: a pattern of pixels times a sine of the time, so that nothing cancels."""
    times = torch.as_tensor(out.axis.centers_opl, dtype=torch.float32)
    return (out.transient * PATTERN * torch.sin(3 * times)[:, None, None]).sum()


def said(function):
    """(result, messages of derivatives that lack a part)"""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = function()
    return result, [str(one.message) for one in caught if issubclass(one.category, GradientWarning)]


def reverse(renderer, seed=0, **settings):
    renderer.zero_grad()
    weighed(renderer(seed=seed, **settings)).backward()
    return float((renderer.values[BODY].grad * SIDEWAYS).sum())


def test_both_modes_agree():
    """They draw the same samples."""
    renderer = tt.TransientRenderer(plate(), [BODY], spp=16, max_depth=2)
    expected, base = reverse(renderer), renderer.values[BODY].detach()
    assert abs(expected) > 1e-3

    def loss(shift):
        return weighed(renderer({BODY: base + shift * SIDEWAYS}, seed=0))

    _, tangent = torch.func.jvp(loss, (torch.zeros(()),), (torch.ones(()),))
    assert float(tangent) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("boundary", [pytest.param(True, marks=pytest.mark.slow), False])
def test_what_moves_as_one_has_no_derivative(boundary):
    """Scene, light and camera shifted together: zero at each seed, not on average alone."""
    facing_down = pose(0.5, 0.3, 3, 0.2) @ np.diag([1.0, -1, -1, 1])
    lamp = {"type": "rectangle", "to_world": facing_down, "emitter": {"type": "area", "radiance": 20.0}}
    facing_right = np.array([[0, 0, 1, -1.5], [0, 1, 0, 0], [-1, 0, 0, 1], [0, 0, 0, 1]])
    side = {"type": "rectangle", "to_world": facing_right}
    keys = [f"{name}.to_world" for name in ("body", "wall", "side", "light", "sensor")]
    scene = plate(light=lamp, side=side, integrator={"type": "transient_path", "max_depth": 4})
    renderer = tt.TransientRenderer(scene, keys, spp=64, boundary=boundary)
    for seed in range(3):
        renderer.zero_grad()
        said(lambda seed=seed: weighed(renderer(seed=seed)).backward())
        shifts = torch.stack([renderer.values[key].grad[:3, 3] for key in keys])
        assert (shifts.abs().amax(0) > 0.01).all()
        assert (shifts.sum(0).abs() < 1e-4 * shifts.abs().sum(0)).all()


@pytest.mark.slow
def test_every_entry_of_a_batch_has_the_term():
    renderer = tt.TransientRenderer(plate(), [BODY, PAINT], spp=16)
    alone, base = reverse(renderer), renderer.values[BODY].detach()
    shifts, paint = torch.zeros(2, 1, 1, requires_grad=True), torch.full((2,), 0.4, requires_grad=True)
    weighed(renderer({BODY: base + shifts * SIDEWAYS, PAINT: paint}, seed=[0, 0])).backward()
    torch.testing.assert_close(shifts.grad.flatten(), torch.full((2,), alone), rtol=1e-4, atol=0)


@pytest.mark.slow
def test_plate_against_finite_differences():
    """Without the term the derivative is zero but for rounding. Errors are those of 8 seeds."""
    renderer = tt.TransientRenderer(plate(), [BODY], spp=256, spp_boundary=256)
    base, h = renderer.values[BODY].detach(), 0.005
    found = [reverse(renderer, seed) for seed in range(8)]
    with torch.no_grad():
        sides = [
            [float(weighed(renderer({BODY: base + s * h * SIDEWAYS}, seed=seed, spp=4096))) for s in (1, -1)]
            for seed in range(8)
        ]
    expected = [(plus - minus) / (2 * h) for plus, minus in sides]
    error = np.hypot(np.std(found, ddof=1), np.std(expected, ddof=1)) / np.sqrt(8)
    assert np.mean(found) == pytest.approx(np.mean(expected), abs=4 * error)
    assert error < 0.25 * abs(np.mean(expected))


def test_left_out_it_is_said_once():
    scene = plate()
    renderer = tt.TransientRenderer(scene, [BODY, PAINT], spp=4, boundary=False)
    _, first = said(lambda: reverse(renderer))
    assert len(first) == 1 and repr(BODY) in first[0] and repr(PAINT) not in first[0] and "boundary" in first[0]
    assert said(lambda: reverse(renderer, 1))[1] == []
    # Told of as a finding of the scene: it is no error, since it was asked for.
    strict = tt.TransientRenderer(plate(), [BODY], spp=4, boundary=False, physics="error")
    assert len(said(lambda: reverse(strict))[1]) == 1
    for twin in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer)), renderer.variation()):
        assert twin.boundary is False and twin.spp_boundary is None


UPRIGHT = np.eye(4)
# A rotation by 60 degrees about an axis that lies in no plane of two axes.
OBLIQUE = np.array([[7, -4, 4, 0], [1, 8, 4, 0], [-8, -4, 1, 0], [0, 0, 0, 9]]) / 9
STEPS = {"type": "bitmap", "data": np.eye(4)[..., None] * 0.6 + 0.2, "raw": True, "filter_type": "nearest"}
STRIPED = {"type": "rectangle", "to_world": pose(scale=5.0), "bsdf": {"type": "diffuse", "reflectance": STEPS}}
DISTANT = {"type": "distant", "direction": [0.1, 0, -1], "film": FILM | {"width": 1, "height": 1}}
STEEP = np.array([[[0.95, 0.5, 0.72], [0.05, 0.5, 0.72]]] * 2, np.float32)  # normals at 64 degrees to both sides
TILT = np.array([[0.6, 0, 0.8, 0], [0, 1, 0, 0], [-0.8, 0, 0.6, 0], [0, 0, 0, 1]])


def mapped(normals, tilt):
    """A plate with a normal map."""
    texture = {"type": "bitmap", "data": normals, "raw": True}
    bsdf = {"type": "normalmap", "normalmap": texture, "b": {"type": "diffuse", "reflectance": 0.4}}
    return {"type": "rectangle", "to_world": pose(0, 0, 0.8) @ tilt @ np.diag([0.45, 0.35, 1, 1]), "bsdf": bsdf}


def shaded(normal, other=None):
    """A triangle that faces the camera, with one normal at its vertices; another one at its right, if it is given."""
    return {"type": "mesh_arrays", "vertices": np.array([[0, 0, 0.8], [0.4, 0, 0.8], [0, 0.4, 0.8]]),
            "faces": np.array([[0, 1, 2]]), "normals": np.array([normal, other or normal, normal], float)}  # fmt: skip


SPOT = {"type": "spot", "to_world": CAMERA, "cutoff_angle": 20}
SHORT = {"type": "perspective", "fov": 40, "far_clip": 2.5, "to_world": CAMERA, "film": FILM}
LAMP = {"type": "rectangle", "to_world": pose(0, 0, 3, 0.1) @ np.diag([1.0, -1, -1, 1]),
        "emitter": {"type": "angulararea", "cutoff_angle": 20.0}}  # fmt: skip


def box(z, tilt=UPRIGHT):
    """A cube with sides of 0.8 m, beside the plate."""
    turn = np.diag([0.4, 0.4, 0.4, 1])
    turn[:2, :2] = [[0.32, -0.24], [0.24, 0.32]]
    return {"type": "cube", "to_world": tilt @ pose(2, 0, z) @ turn}


@pytest.mark.parametrize(("more", "key", "words"), [
    ({"mirror": MIRROR}, BODY, "mirrors.*'mirror'"),
    ({"sensor": DISTANT}, BODY, "'sensor'"),
    ({"light": SPOT | {"beam_width": 20}}, BODY, "rim.*'light'"),
    ({"light": SPOT | {"texture": STEPS}}, "light.to_world", "steps in the light of 'light'"),
    ({"sensor": SHORT, "ball": {"type": "sphere", "center": [0, 0, 1.5], "radius": 0.3}}, "ball.to_world",
     "clip planes.*'ball'"),
    ({"lamp": LAMP}, BODY, "rim of the light of 'lamp'"),
    ({"wall": STRIPED}, "wall.to_world", "steps.*'wall'"),
    ({"body": mapped(STEEP, TILT)}, BODY, "normals away from the camera"),
    ({"body": mapped(STEEP, TILT)}, "body.bsdf.normalmap.data", "normals away from the camera"),
    ({"body": shaded((0.9, 0, 0.5), (0.9, 0, -0.9))}, "body.vertex_normals", "rim of 'body'"),
    ({"box": box(0.1)}, "box.vertex_positions", "where 'box' and 'wall' run into each other"),
])  # fmt: skip
def test_edges_that_are_not_followed(more, key, words):
    scene = plate(**more)
    info = scene.parameters()[key]
    assert info.biased and len(info.edges_missing) == 1 and info.edges_missing[0] in info.reason
    renderer = tt.TransientRenderer(scene, [key], spp=4)
    message = said(lambda: renderer(seed=0))[1]
    assert len(message) == 1 and repr(key) in message[0]
    with pytest.raises(GradientError, match=words):
        tt.TransientRenderer(scene, [key], spp=4, physics="error")(seed=0)


def test_what_is_called_correct(tmp_path):
    """Moving edges where all are followed, with a texture with steps on what stands still."""
    table = plate(wall=STRIPED).parameters()
    for key in (BODY, "light.position"):
        assert table[key].reason == "correct" and table[key].moves_silhouette and not table[key].biased
    # Clip planes cut what is out of view, and the light of a spot is smooth.
    beside = {"type": "sphere", "center": [3, 0, 1.5], "radius": 0.3}
    smooth = SPOT | {"texture": STEPS | {"filter_type": "bilinear"}}
    for key in ("ball.to_world", BODY, "light.to_world", "sensor.to_world"):
        assert plate(sensor=SHORT, ball=beside, light=smooth).parameters()[key].edges_missing == ()
    # Normals of which none turns away, whether flat or seen from the front.
    for body in (mapped(STEEP, np.eye(4)), mapped(0.3 * STEEP + np.float32([0.35, 0.35, 0.7]), TILT)):
        table = plate(body=body).parameters()
        assert table[BODY].edges_missing == table["body.bsdf.normalmap.data"].edges_missing == ()
    assert plate(body=shaded((0.6, 0, 0.8))).parameters()["body.vertex_normals"].edges_missing == ()
    turned = shaded((0.6, 0, 0.8)) | {"faces": np.array([[0, 2, 1]])}  # faces that turn another side out
    assert plate(body=turned).parameters()["body.vertex_normals"].edges_missing == ()
    off = plate(integrator={"type": "transient_path", "max_depth": 3, "boundary": False}).parameters()
    assert off[BODY].biased and "boundary" in off[BODY].reason and off[PAINT].reason == "correct"
    (tmp_path / "curve.txt").write_text("\n".join(f"{x} 0 1 0.1" for x in range(3)), encoding="utf-8")
    sky = tt.load(described(light={"type": "sunsky", "sun_direction": [0.2, 0.1, 1.0]}), variant="llvm_ad_rgb")
    assert sky.parameters()["light.sun_direction"].reason == "correct"
    curves = plate(curve={"type": "linearcurve", "filename": str(tmp_path / "curve.txt")}).parameters()
    assert "'curve'" in curves[BODY].reason and "'curve'" in curves["curve.control_points"].reason


def crossing(moved="wall.to_world", **parts):
    """What the derivative by a pose lacks of bodies that run into each other."""
    return [words for words in plate(**parts).parameters()[moved].edges_missing if "run into each other" in words]


def wall(tilt=UPRIGHT):
    return {"type": "rectangle", "to_world": tilt @ pose(scale=5.0)}


def ball(z, radius=0.5):
    return {"type": "sphere", "center": [2.0, 0.2, z], "radius": radius}


def several(*poses):
    """A group of a cube in several places."""
    copies = {f"copy{i}": {"type": "instance", "to_world": p, "g": {"type": "ref", "id": "group"}}
              for i, p in enumerate(poses)}  # fmt: skip
    return {"group": {"type": "shapegroup", "one": box(0.0)}} | copies


NEAR = pose(0, 0, 2.0)


@pytest.mark.parametrize(("parts", "names"), [
    ({"a": box(0.1)}, "'a' and 'wall'"),
    ({"wall": wall(OBLIQUE), "a": box(0.2, OBLIQUE)}, "'a' and 'wall'"),
    ({"a": ball(0.0)}, "'a' and 'wall'"),
    ({"a": ball(0.49)}, "'a' and 'wall'"),
    ({"a": {"type": "disk", "to_world": pose(2) @ OBLIQUE}}, "'a' and 'wall'"),
    (several(pose(0, 0, 0.2), NEAR), "'copy0' and 'wall'"),
])  # fmt: skip
def test_bodies_that_run_into_each_other(parts, names):
    """Named for what moves either one, and for the camera, which sees the line in which they meet."""
    for moved in ("wall.to_world", "sensor.to_world"):
        (words,) = crossing(moved, **parts)
        assert names in words
    for moved in (BODY, "light.position"):
        assert crossing(moved, **parts) == []


def test_meters_beside_smooth_meshes_have_a_table():
    """An irradiance meter draws rays with differentials alone."""
    meter = {"type": "irradiancemeter", "film": {"type": "transient_hdr_film", "width": 1, "height": 1}}
    ball = {"type": "sphere", "radius": 0.2, "to_world": tt.scenes.translate([0, 0, 1])}
    nodes = {"type": "scene", "floor": {"type": "rectangle", "meter": meter}, "ball": ball, "cube": {"type": "cube"}}
    table = tt.load(nodes, variant="llvm_ad_mono").parameters()
    assert table["ball.to_world"].differentiable and table["cube.vertex_positions"].differentiable
