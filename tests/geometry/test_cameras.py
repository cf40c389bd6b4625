"""Cameras against the rays that Mitsuba draws, and distances, points and normals against the labels of a render."""

from __future__ import annotations

import contextlib
import itertools

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from tools.small_room import VARIANT, make_room
from torchtransient import geometry
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.rendering.cameras import camera_of
from torchtransient.rendering.labels import scene_labels
from torchtransient.scenes import look_at, rotate, scale, translate

POSE = look_at([1.0, 2.0, 3.0], [0.2, 0.5, 0.0])
OFFSET = (0.1, -0.07)
CROP = {"crop_width": 4, "crop_height": 3, "crop_offset_x": 1, "crop_offset_y": 2}


def sensor_rays(axis, size, crop, offset, kind="perspective", pose=POSE):
    """Directions (3, H, W) and origins of Mitsuba's rays through the centres of pixels."""
    (height, width), more = size, CROP if crop else {}
    film = {"type": "hdrfilm", "width": width, "height": height, **more}
    sensor = mi.load_dict(
        {
            "type": kind, "fov": 50.0, "fov_axis": axis, "to_world": mi.ScalarTransform4f(pose), "film": film,
            **({"aperture_radius": 0.1, "focus_distance": 2.0} if kind == "thinlens" else
               {"principal_point_offset_x": offset[0], "principal_point_offset_y": offset[1]}),
        }
    )  # fmt: skip
    width, height = (int(n) for n in sensor.film().crop_size())
    v, u = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    position = mi.Point2f((u.ravel() + 0.5) / width, (v.ravel() + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    return np.array(ray.d).reshape(3, height, width), np.array(ray.o).reshape(3, height, width)


@together("axis", ["x", "y", "diagonal", "smaller", "larger"])
@together("size", [(6, 8), (9, 5)])
@together("crop", [False, True])
@together("offset", [(0.0, 0.0), OFFSET])
def test_intrinsics_are_mitsubas_rays(axis, size, crop, offset):
    with mi.variant_context(VARIANT):
        directions, origins = sensor_rays(axis, size, crop, offset)
    window = (CROP["crop_offset_x"], CROP["crop_offset_y"]) if crop else (0, 0)
    matrix = geometry.intrinsics(50.0, size, fov_axis=axis, principal_point_offset=offset, crop_offset=window)
    found = geometry.ray_directions(matrix, directions.shape[1:], POSE)
    np.testing.assert_allclose(found, directions, atol=2e-6)
    # Kornia's own camera goes from the points of these rays to the pixels.
    points = torch.tensor(origins + 3 * directions, dtype=torch.float64)
    camera = geometry.pinhole_camera(matrix.double(), POSE, directions.shape[1:])
    pixels = camera.project(points.reshape(1, 3, -1).mT)[0].mT.reshape(2, *directions.shape[1:])
    v, u = torch.meshgrid(*(torch.arange(float(n)) for n in directions.shape[1:]), indexing="ij")
    assert torch.allclose(pixels.float(), torch.stack([u, v]), atol=1e-5 * 50)
    # And back, to points 1 m away along the axis.
    back = camera.unproject(pixels.reshape(1, 2, -1).mT, torch.ones(1, 1, 1).double())[0].mT.reshape(points.shape)
    known = POSE[:3, 3, None, None] + directions / np.einsum("ahw,a->hw", directions, POSE[:3, 2])
    np.testing.assert_allclose(back, known, atol=1e-5)


def test_thinlens_has_the_same_middle_rays():
    with mi.variant_context(VARIANT):
        directions, _ = sensor_rays("x", (6, 8), False, (0.0, 0.0), "thinlens")
    found = geometry.ray_directions(geometry.intrinsics(50.0, (6, 8)), (6, 8), POSE)
    np.testing.assert_allclose(found, directions, atol=2e-6)


def test_extrinsics_there_and_back():
    matrix = torch.tensor(POSE)
    outside = geometry.extrinsics(matrix)
    assert torch.allclose(outside @ geometry.camera_to_world(matrix), torch.eye(4).double(), atol=1e-14)
    assert torch.allclose(geometry.to_world_from_extrinsics(outside), matrix, atol=1e-14)
    ahead = outside @ torch.tensor([*(POSE[:3, 3] + 2 * POSE[:3, 2]), 1.0])
    up_and_left = outside @ torch.tensor([*(POSE[:3, 3] + POSE[:3, 1] + POSE[:3, 0]), 1.0])
    assert torch.allclose(ahead, torch.tensor([0.0, 0, 2, 1]).double(), atol=1e-14)
    assert torch.allclose(up_and_left, torch.tensor([-1.0, -1, 0, 1]).double(), atol=1e-14)


def test_gradients():
    fov, offset = torch.tensor([40.0, 50.0]).double(), torch.tensor([[0.1, 0.0], [0.0, -0.2]]).double()
    leaves = (fov.requires_grad_(), offset.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda fov, offset: geometry.intrinsics(fov, (6, 8), fov_axis="y", principal_point_offset=offset), leaves
    )
    distance = torch.linspace(1.0, 3.0, 12).double().reshape(3, 4).requires_grad_()
    matrix = geometry.intrinsics(50.0, (3, 4)).double()
    index = torch.linspace(1.0, 1.5, 12).double().reshape(3, 4).requires_grad_()
    setting = {"camera_matrix": matrix, "to_world": POSE, "light": [0.3, 0.1, 2.0]}
    assert torch.autograd.gradcheck(lambda n: geometry.opl_from_distance(distance, **setting, index=n), index)
    assert torch.autograd.gradcheck(lambda n: geometry.opl_from_distance(distance, index=n), index)
    for function in (
        lambda d: geometry.normals_from_distance(d, matrix),
        lambda d: geometry.opl_from_distance(d, matrix, POSE, light=[0.3, 0.1, 2.0]),
        lambda d: geometry.distance_from_opl(d + 4, matrix, POSE, light=[0.3, 0.1, 2.0]),
        lambda d: geometry.points_from_distance(geometry.distance_from_z_depth(d, matrix), matrix, POSE),
    ):
        assert torch.autograd.gradcheck(function, (distance,))


# ----------------------------------------------------------------------------------------------- against the labels


@pytest.fixture(scope="module")
def seen():
    """A tilted wall and a sphere before it: a renderer, its camera, its labels."""
    scene = make_room()
    scene["sensor"].update(
        {"fov": 35.0, "principal_point_offset_x": 0.05, "to_world": look_at([0.4, 0.3, 4.0], [0.1, 0.0, 0.0])}
    )
    scene["sensor"]["film"].update({"width": 32, "height": 24})
    scene["wall"]["to_world"] = translate([0.0, 0.0, -0.5]) @ rotate([0.3, 1.0, 0.0], 20.0) @ scale(6.0)
    scene["box"] = {"type": "sphere", "center": [0.2, 0.1, 1.0], "radius": 0.5}
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), ["sensor.x_fov", "sensor.to_world"], spp=4)
    names = ("depth", "z_depth", "position", "normals", "shape")
    return renderer, camera_of(renderer), scene_labels(renderer, names=names)


def test_distances_and_points_are_the_labels(seen):
    _, camera, labels = seen
    depth, z_depth = labels["depth"], labels["z_depth"]
    assert torch.allclose(geometry.distance_from_z_depth(z_depth, camera.intrinsics), depth, atol=1e-5)
    assert torch.allclose(geometry.z_depth_from_distance(depth, camera.intrinsics), z_depth, atol=1e-5)
    points = geometry.points_from_distance(depth, camera.intrinsics, camera.to_world)
    assert torch.allclose(points, labels["position"], atol=2e-5)
    from kornia.geometry.depth import depth_to_3d_v2

    known = depth_to_3d_v2(z_depth[None], camera.intrinsics[None])[0].permute(2, 0, 1)
    assert torch.allclose(geometry.points_from_distance(depth, camera.intrinsics), known, atol=1e-5)


def test_normals_are_the_labels(seen):
    """On the wall to rounding, on the sphere to what nine pixels see of its curvature; on the rim one-sided."""
    from kornia.morphology import erosion

    _, camera, labels = seen
    found = geometry.normals_from_distance(labels["depth"], camera.intrinsics, camera.to_world)
    cosine = (found * labels["normals"]).sum(0)
    for number, worst in ((0, 1 - 1e-5), (1, 0.985)):
        whole = (labels["shape"] == number).float()[None, None]
        inside = erosion(torch.nn.functional.pad(whole, (1, 1, 1, 1)), torch.ones(3, 3))[0, 0, 1:-1, 1:-1] > 0
        assert inside.sum() > 20
        assert cosine[inside].min() > worst
    in_camera = geometry.normals_from_distance(labels["depth"], camera.intrinsics)
    rays = geometry.ray_directions(camera.intrinsics, camera.size)
    assert bool(((in_camera * rays).sum(0) < 0).all())  # turned to the camera
    depth = labels["depth"].clone()
    depth[10, 10] = torch.nan
    assert int(geometry.normals_from_distance(depth, camera.intrinsics).isnan().all(0).sum()) == 9


@pytest.mark.parametrize("light", [None, [-0.5, 0.25, 4.0]])
def test_optical_path_there_and_back(seen, light):
    _, camera, labels = seen
    setting = {"camera_matrix": camera.intrinsics, "to_world": camera.to_world, "light": light, "index": 1.2}
    depth = labels["depth"]
    opl = geometry.opl_from_distance(depth, **setting)
    place = camera.to_world[:3, 3] if light is None else torch.tensor(light)
    known = 1.2 * (depth + (labels["position"] - place[:, None, None]).norm(dim=0))
    assert torch.allclose(opl, known, atol=3e-5)
    assert torch.allclose(geometry.distance_from_opl(opl, **setting), depth, atol=3e-5)


def test_a_path_that_is_too_short():
    setting = {"camera_matrix": geometry.intrinsics(50.0, (2, 2)), "to_world": np.eye(4), "light": [0.0, 0.0, 3.0]}
    for opl in (2.9, 0.0, -5.0, torch.nan):
        assert geometry.distance_from_opl(torch.full((2, 2), opl), **setting).isnan().all()
    assert bool(geometry.distance_from_opl(torch.tensor([[-0.1, 0.0]])).isnan()[0, 0])
    # As long as the way itself; and longer only because light is slow: 4 m of optical path are 2.5 m of glass.
    assert geometry.distance_from_opl(torch.full((2, 2), 3.0), **setting).isnan().all()
    assert geometry.distance_from_opl(torch.full((2, 2), 4.0), **setting, index=1.6).isnan().all()
    assert not geometry.distance_from_opl(torch.full((2, 2), 5.0), **setting, index=1.6).isnan().any()


@pytest.mark.parametrize("light", [None, [0.0, 1.0, 0.0]])
def test_nothing_flows_back_from_a_path_that_is_too_short(light):
    """Also of what the camera and the light depend on; elsewhere as if those pixels were not there."""

    def slopes(opl):
        leaves = [opl, torch.tensor(50.0), torch.eye(4), torch.tensor([0.0, 1.0, 0.0]), torch.tensor(1.2)]
        leaves = [leaf.clone().requires_grad_() for leaf in leaves]
        opl, fov, pose, place, index = leaves
        given = {"light": place} if light else {}
        matrix = geometry.intrinsics(fov, (2, 3))
        geometry.distance_from_opl(opl, matrix, pose, **given, index=index).nansum().backward()
        return [torch.zeros(()) if leaf.grad is None else leaf.grad for leaf in leaves]

    short = torch.tensor([[5.0, -5.0, 0.5], [torch.nan, -1.2, 6.0]])
    if light is None:
        short[0, 2] = -0.5
    found = slopes(short)
    assert all(bool(torch.isfinite(slope).all()) for slope in found)
    assert torch.equal(found[0] != 0, torch.tensor([[True, False, False], [False, False, True]]))
    assert found[4] != 0 and (light is None or (found[1] != 0 and bool((found[3] != 0).any())))
    # The pixels that count are as if the others were long enough.
    whole = slopes(torch.where(found[0] != 0, short, 50.0))
    assert torch.equal(found[0][found[0] != 0], whole[0][found[0] != 0])


@pytest.mark.parametrize(
    ("function", "holes"),
    [
        (
            lambda d, matrix, pose, *_: geometry.points_from_distance(
                geometry.distance_from_z_depth(d, matrix), matrix, pose
            ),
            2,
        ),
        (lambda d, matrix, pose, *_: geometry.normals_from_distance(d, matrix, pose), 9 + 4),
        (
            lambda d, matrix, pose, place, index: geometry.opl_from_distance(d, matrix, pose, light=place, index=index),
            2,
        ),
        (lambda d, matrix, pose, place, index: geometry.opl_from_distance(d, index=index), 2),
        (
            lambda d, matrix, pose, place, index: geometry.distance_from_opl(
                d + 4, matrix, pose, light=place, index=index
            ),
            2,
        ),
    ],
)
def test_nothing_flows_back_from_pixels_that_meet_nothing(function, holes):
    """Slopes of all that it depends on are those of the sum over the other pixels."""
    depth = torch.linspace(1.0, 3.0, 48).reshape(6, 8).double()

    def slopes(depth, keep):
        leaves = [depth, geometry.intrinsics(50.0, (6, 8)), torch.tensor(POSE), torch.tensor([0.3, 0.1, 2.0]),
                  torch.tensor(1.2)]  # fmt: skip
        leaves = [leaf.clone().double().requires_grad_() for leaf in leaves]
        value = function(*leaves)
        torch.where(keep, value, 0.0).sum().backward()
        return value, [torch.zeros(()) if leaf.grad is None else leaf.grad for leaf in leaves]

    torn = depth.clone()
    torn[2, 3] = torn[0, 7] = torch.nan
    seen = ~slopes(torn, torch.tensor(True))[0].isnan()
    assert int((~seen).reshape(-1, 6, 8).any(0).sum()) == holes
    (_, found), (_, known) = slopes(torn, seen), slopes(depth, seen)
    known[0][torn.isnan()] = 0.0
    for one, other in zip(found, known, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


IMAGE = torch.ones(4, 5)


def test_batches():
    fovs = torch.tensor([30.0, 60.0])
    matrices = geometry.intrinsics(fovs, (4, 5))
    poses = torch.stack([torch.eye(4), torch.tensor(POSE, dtype=torch.float32)])
    depth = 1 + torch.rand(2, 4, 5, generator=torch.Generator().manual_seed(0))
    for function in (geometry.points_from_distance, geometry.normals_from_distance):
        together = function(depth, matrices, poses)
        for k in range(2):
            assert torch.allclose(together[k], function(depth[k], matrices[k], poses[k]), atol=1e-6)
    many = itertools.starmap(lambda k, d: geometry.z_depth_from_distance(d, matrices[k]), enumerate(depth))
    assert torch.allclose(geometry.z_depth_from_distance(depth, matrices), torch.stack(list(many)), atol=1e-6)
    camera = geometry.pinhole_camera(matrices, poses[1], (4, 5))
    assert camera.batch_size == 2
    assert camera.height.tolist() == [4, 4] and camera.width.tolist() == [5, 5]


@pytest.mark.parametrize(("dtype", "near", "far"), [(torch.float64, 4e-5, 6e-5), (torch.bfloat16, 1 / 128, 3 / 128)])
def test_motions_are_rigid_to_the_precision_they_have(dtype, near, far):
    """Axes longer than one by 1e-4 of their square, or by four steps of the precision where that is more."""
    for length in (near, far):
        matrix = torch.diag(torch.tensor([1 + length, 1.0, 1.0, 1.0], dtype=torch.float64)).to(dtype)
        with contextlib.nullcontext() if length == near else pytest.raises(UnitError):
            geometry.extrinsics(matrix)


@together("call, error", [
    (lambda: geometry.intrinsics(180.0, (4, 5)), UnitError), (lambda: geometry.intrinsics("wide", (4, 5)), ShapeError),
    (lambda: geometry.intrinsics(40.0, (4, 5), fov_axis="z"), ArgumentError),
    (lambda: geometry.intrinsics(40.0, (4, 5), principal_point_offset=(0.1,)), ShapeError),
    (lambda: geometry.extrinsics(np.eye(3)), ShapeError), (lambda: geometry.extrinsics(np.eye(4) / 0.5), UnitError),
    (lambda: geometry.extrinsics(np.diag([-1.0, 1.0, 1.0, 1.0])), UnitError),
    (lambda: geometry.extrinsics(torch.full((4, 4), torch.nan)), UnitError),
    (lambda: geometry.to_world_from_extrinsics(np.eye(4) + np.eye(4, k=1) / 9), UnitError),
    (lambda: geometry.normals_from_distance([[1.0, 2.0], [3.0, 4.0]], torch.eye(3)), ShapeError),
    (lambda: geometry.normals_from_distance(IMAGE[:1], torch.eye(3)), ShapeError),
    (lambda: geometry.z_depth_from_distance(IMAGE, torch.eye(4)), ShapeError),
    (lambda: geometry.opl_from_distance(IMAGE, light=[0, 0, 1.0]), UnitError),
    (lambda: geometry.opl_from_distance(IMAGE, torch.eye(3), np.eye(4), light=[0.0, 1.0]), ShapeError),
    (lambda: geometry.opl_from_distance(IMAGE, index=0.0), UnitError),
    (lambda: geometry.opl_from_distance(IMAGE, index=torch.ones(7)), ShapeError),
])  # fmt: skip
def test_what_is_refused(call, error):
    with pytest.raises(error):
        call()
