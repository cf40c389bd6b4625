"""Labels: closed forms of planes and spheres, every sensor, and the same scene as the transient beside them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient.data import first_return, label_names, scene_labels
from torchtransient.errors import SceneError
from torchtransient.scenes import look_at, rotate, scale, translate

FLOATS = ["depth", "z_depth", "position", "normals", "uv", "albedo", "velocity", "radial_velocity"]
NUMBERED = ["shape", "primitive", "material"]
LABELS = FLOATS + NUMBERED
DISTANCE, RADIUS = 5.0, 1.25
W, H, FOV = 8, 6, 40.0
DOWN_Z = look_at([0.0, 0.0, DISTANCE], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])


def film(width=W, height=H, **more):
    return {
        "type": "transient_hdr_film", "width": width, "height": height, "rfilter": {"type": "box"},
        "temporal_bins": 64, "start_opl": 0.0, "bin_width_opl": 0.25, **more,
    }  # fmt: skip


def camera(kind="perspective", to_world=DOWN_Z, of_film=None, **more):
    return {"type": kind, "to_world": to_world, "film": of_film or film(), **more}


def plane(**more):
    return {"type": "rectangle", "to_world": scale(20.0), **more}


def grey(value):
    return {"type": "diffuse", "reflectance": value}


def scene_of(sensor, **contents):
    light = {"type": "point", "position": [0.0, 0.0, DISTANCE], "intensity": 10.0}
    integrator = {"type": "transient_path", "max_depth": 2}
    return {"type": "scene", "integrator": integrator, "sensor": sensor, "light": light, **contents}


def renderer_of(sensor, variant=VARIANT, parameters=(), options=None, **contents):
    loaded = tt.load(scene_of(sensor, **contents), variant=variant)
    return tt.TransientRenderer(loaded, parameters=parameters, spp=16, physics="ignore", **options or {})


def pinhole_directions(width=W, height=H, fov=FOV):
    """(3, H, W) unit directions of a camera that looks along -z with y up: x of the film runs to the right."""
    reach = np.tan(np.radians(fov) / 2)
    x = ((np.arange(width) + 0.5) / width * 2 - 1) * reach
    y = ((np.arange(height) + 0.5) / height * 2 - 1) * reach * height / width
    x, y = np.meshgrid(x, -y)
    found = np.stack([x, y, -np.ones_like(x)])
    return found / np.linalg.norm(found, axis=0)


def close(found, expected, atol=2e-5):
    np.testing.assert_allclose(found.numpy(), expected, rtol=2e-5, atol=atol)


# -------------------------------------------------------------------------------------------------- closed forms


def test_plane_before_a_pinhole():
    colour = [0.2, 0.5, 0.7]
    paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
    labels = scene_labels(renderer_of(camera(fov=FOV), wall=plane(bsdf=paint)), names=LABELS)
    d = pinhole_directions()
    close(labels["depth"], DISTANCE / -d[2])
    close(labels["z_depth"], np.full((H, W), DISTANCE))
    p = np.array([0, 0, DISTANCE])[:, None, None] + d * DISTANCE / -d[2]
    close(labels["position"], p)
    close(labels["normals"], np.broadcast_to(np.array([0, 0, 1.0])[:, None, None], (3, H, W)))
    close(labels["uv"], p[:2] / 40 + 0.5)
    close(labels["albedo"], np.broadcast_to(np.array(colour)[:, None, None], (3, H, W)))
    for name in NUMBERED:
        assert labels[name].dtype == torch.int32 and labels[name].shape == (H, W)
    assert (labels["shape"] == 0).all() and (labels["material"] == 0).all()
    for name in FLOATS:
        assert labels[name].dtype == torch.float32 and not labels[name].requires_grad


def test_sphere_before_a_pinhole():
    labels = scene_labels(renderer_of(camera(fov=FOV), ball={"type": "sphere", "radius": RADIUS}), names=LABELS)
    d = pinhole_directions()
    along = DISTANCE * -d[2]
    root = along**2 - DISTANCE**2 + RADIUS**2
    hit = root > 0
    assert 0 < hit.sum() < hit.size
    t = along - np.sqrt(np.where(hit, root, 0))
    close(labels["depth"], np.where(hit, t, np.nan))
    p = np.where(hit, np.array([0, 0, DISTANCE])[:, None, None] + d * t, np.nan)
    close(labels["position"], p)
    close(labels["normals"], p / RADIUS)
    assert (labels["shape"].numpy() == np.where(hit, 0, -1)).all()
    for name in NUMBERED:
        assert (labels[name].numpy()[~hit] == -1).all()
    for name in FLOATS:
        assert torch.isnan(labels[name])[..., torch.tensor(~hit)].all()


def test_thin_lens_is_a_pinhole_in_the_middle():
    pinhole, lens = (
        scene_labels(renderer_of(camera(kind, fov=FOV, **more), wall=plane()), names=["depth", "z_depth"])
        for kind, more in (("perspective", {}), ("thinlens", {"aperture_radius": 0.2, "focus_distance": 3.0}))
    )
    for name, expected in pinhole.items():
        close(lens[name], expected.numpy())


def test_depth_counts_from_the_origin_not_from_the_near_plane():
    for kind in ("perspective", "orthographic"):
        labels = scene_labels(renderer_of(camera(kind, near_clip=2.0), wall=plane()), names=["depth", "z_depth"])
        close(labels["z_depth"], np.full((H, W), DISTANCE))
        if kind == "orthographic":
            close(labels["depth"], np.full((H, W), DISTANCE))
        else:
            assert (labels["depth"] > DISTANCE).all()


def test_batch_sensor_has_its_children_side_by_side():
    other = look_at([1.0, 0.5, 3.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    square = film(4, 4)
    batch = {
        "type": "batch", "film": film(8, 4),
        "first": camera(of_film=square), "second": camera(to_world=other, of_film=square),
    }  # fmt: skip
    names = ["depth", "z_depth", "position", "normals"]
    both = scene_labels(renderer_of(batch, wall=plane()), names=names)
    for half, pose in enumerate((DOWN_Z, other)):
        one = scene_labels(renderer_of(camera(to_world=pose, of_film=square), wall=plane()), names=names)
        for name in names:
            close(both[name][..., 4 * half : 4 * half + 4], one[name].numpy(), atol=1e-4)


def meter_scene(points=None):
    meter = {"type": "nlos_capture_meter", "film": film(4, 3), "sensor_origin": [0.5, 0.0, 2.0]}
    if points is not None:
        meter["points"] = mi.TensorXf(points)
    description = scene_of(None, wall={"type": "rectangle", "sensor": meter, "bsdf": grey(0.4)})
    del description["sensor"]
    return tt.TransientRenderer(tt.load(description, variant=VARIANT), spp=4, physics="ignore")


def test_scan_has_its_wall_points():
    labels = scene_labels(meter_scene(), names=["position", "normals", "depth", "shape", "albedo"])
    x, y = np.meshgrid((np.arange(4) + 0.5) / 2 - 1, (np.arange(3) + 0.5) / 1.5 - 1)
    p = np.stack([x, y, np.zeros_like(x)])
    close(labels["position"], p)
    close(labels["normals"], np.broadcast_to(np.array([0, 0, 1.0])[:, None, None], p.shape))
    close(labels["depth"], np.linalg.norm(p - np.array([0.5, 0, 2.0])[:, None, None], axis=0))
    assert (labels["shape"] == 0).all()
    given = np.random.default_rng(1).uniform(-0.9, 0.9, (12, 3)).astype(np.float32) * [1, 1, 0]
    close(scene_labels(meter_scene(given), names=["position"])["position"], given.T.reshape(3, 3, 4))
    with pytest.raises(SceneError, match="no optical axis"):
        scene_labels(meter_scene(), names=["z_depth"])


# ----------------------------------------------------------------------------------------------- what is looked at


@pytest.mark.parametrize("opacity, seen", [(0.4, "wall"), (0.6, "pane")])
def test_masks_are_looked_through_where_they_are_clear(opacity, seen):
    mask = {"type": "mask", "opacity": opacity, "inner": grey(0.2)}
    pane = plane(to_world=translate([0, 0, 1.0]) @ scale(20.0), bsdf=mask)
    renderer = renderer_of(camera(), pane=pane, wall=plane(bsdf=grey(0.7)))
    labels = scene_labels(renderer, names=["shape", "z_depth", "albedo"])
    expected = {"pane": (0, DISTANCE - 1, 0.2), "wall": (1, DISTANCE, 0.7)}[seen]
    assert label_names(renderer) == ("pane", "wall")
    assert (labels["shape"] == expected[0]).all()
    close(labels["z_depth"], np.full((H, W), expected[1]))
    close(labels["albedo"], np.full((3, H, W), expected[2]))


def test_boundaries_of_media_are_looked_through():
    fog = {"type": "homogeneous", "sigma_t": 0.01, "albedo": 0.5}
    box = {"type": "sphere", "radius": 2.0, "bsdf": {"type": "null"}, "interior": fog}
    sensor = camera(fov=FOV, near_clip=1.0, far_clip=100.0)
    description = scene_of(sensor, box=box, wall=plane(to_world=translate([0, 0, -3.0]) @ scale(20.0)))
    description["integrator"] = {"type": "transient_prbvolpath", "max_depth": 2}
    renderer = tt.TransientRenderer(tt.load(description, variant=VARIANT), spp=1, physics="ignore")
    labels = scene_labels(renderer, names=["depth", "z_depth", "shape"])
    assert (labels["shape"] == 1).all()
    close(labels["z_depth"], np.full((H, W), DISTANCE + 3), atol=1e-4)
    close(labels["depth"], (DISTANCE + 3) / -pinhole_directions()[2], atol=1e-4)


@pytest.mark.parametrize("hidden", [False, True])
def test_hidden_lights_are_looked_through(hidden):
    lamp = {"type": "rectangle", "to_world": translate([0, 0, 1.0]), "emitter": {"type": "area", "radiance": 1.0}}
    description = scene_of(camera(fov=10.0), lamp=lamp, wall=plane())
    description["integrator"]["hide_emitters"] = hidden
    renderer = tt.TransientRenderer(tt.load(description, variant=VARIANT), spp=1, physics="ignore")
    labels = scene_labels(renderer, names=["shape", "z_depth"])
    assert (labels["shape"] == int(hidden)).all()
    close(labels["z_depth"], np.full((H, W), DISTANCE if hidden else DISTANCE - 1), atol=1e-4)


def test_instances_are_shapes_of_their_own():
    group = {"type": "shapegroup", "part": {"type": "sphere", "radius": 0.5, "bsdf": grey(0.6)}}
    copies = {
        name: {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": translate([x, 0, 0])}
        for name, x in (("left", -1.0), ("right", 1.0))
    }
    wall = plane(to_world=translate([0, 0, -1]) @ scale(9.0))
    renderer = renderer_of(camera(fov=FOV), group=group, **copies, wall=wall)
    labels = scene_labels(renderer, names=LABELS)
    names = label_names(renderer)
    assert set(names) == {"left", "right", "wall"}
    p = labels["position"]
    for name, x in (("left", -1.0), ("right", 1.0)):
        here = labels["shape"] == names.index(name)
        assert here.sum() > 2
        away = p[:, here] - torch.tensor([x, 0.0, 0.0])[:, None]
        close(torch.linalg.norm(away, dim=0), np.full(int(here.sum()), 0.5), atol=1e-4)
        close(labels["normals"][:, here], (away / 0.5).numpy(), atol=1e-3)
        close(labels["albedo"][:, here], np.full((3, int(here.sum())), 0.6))


def test_meshes_that_renders_merge_are_told_apart():
    cubes = {f"cube_{n}": {"type": "cube", "to_world": translate([2.0 * n - 2, 0, 0]) @ scale(0.5)} for n in range(3)}
    renderer = renderer_of(camera(fov=FOV), **cubes)
    assert renderer._options.merge  # else this test would say nothing
    labels = scene_labels(renderer, names=["shape", "primitive"])
    assert label_names(renderer) == tuple(cubes)
    assert set(labels["shape"].unique().tolist()) == {-1, 0, 1, 2}
    assert labels["primitive"].max() < 12


# -------------------------------------------------------------------------------------------- values, batches, calls


def room_renderer(**more):
    return tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), physics="ignore", spp=4, **more)


def moved(x):
    pose = torch.eye(4)
    pose[2, 3] = x
    pose[0, 0] = pose[1, 1] = pose[2, 2] = 3.0
    return pose


def test_recorded_calls_say_what_traced_ones_do():
    recorded, traced = (room_renderer(parameters=[COLOUR, WALL_POSE], freeze=freeze) for freeze in (True, False))
    for n in range(5):
        values = {COLOUR: [0.1 * n, 0.5, 0.9], WALL_POSE: moved(-0.1 * n)}
        a, b = (scene_labels(renderer, values, LABELS) for renderer in (recorded, traced))
        for name in LABELS:
            assert torch.equal(a[name], b[name]), (n, name)


# ---------------------------------------------------------------------------------------------------------- means


@pytest.mark.slow
def test_means_over_pixels():
    """Of a slanted plane the mean depth of an orthographic camera is that of the centre; beside a rim it is of what is
    met.
    """
    slanted = plane(to_world=rotate([0, 1, 0], 30.0) @ scale(20.0))
    renderer = renderer_of(camera("orthographic"), wall=slanted)
    centre = scene_labels(renderer, names=FLOATS)
    mean = scene_labels(renderer, names=FLOATS, average=True, samples=256)
    for name in ("depth", "z_depth", "position", "normals", "albedo"):
        close(mean[name], centre[name].numpy(), atol=2e-3)
    alone = renderer_of(camera(fov=FOV), ball={"type": "sphere", "radius": RADIUS})
    mean, centre = (scene_labels(alone, average=average)["depth"] for average in (True, False))
    assert (mean[torch.isfinite(mean)] < DISTANCE).all()
    assert torch.isfinite(mean).sum() > torch.isfinite(centre).sum()


# -------------------------------------------------------------------------------------------- beside the transient


def test_depth_lies_in_the_peak_bin():
    """A light at the pinhole: the first bounce of a pixel arrives after twice its depth, for the values of the call."""
    width, axis = 0.5, {"temporal_bins": 128, "bin_width_opl": 0.5}
    narrow = camera(fov=2.0, of_film=film(**axis))
    renderer = renderer_of(narrow, parameters=["wall.to_world"], options={"temporal_filter": "box"}, wall=plane())
    for z in (-1.35, 0.15, 1.9):
        tilted = translate([0, 0, z]) @ rotate([0, 1, 0], 20.0) @ scale(20.0)
        values = {"wall.to_world": tilted.astype(np.float32)}
        depth = scene_labels(renderer, values)["depth"]
        peak = renderer(values, seed=1).transient.detach().sum(0).argmax(0)
        assert torch.equal(peak, torch.floor(2 * depth / width).long())


# ---------------------------------------------------------------------------------------------------- first return


def test_first_return_of_given_bins():
    axis = tt.TimeAxis(1.0, 0.5, 6)
    cube = torch.zeros(2, 6, 1, 3)
    cube[0, 4, 0, 0] = cube[1, 2, 0, 0] = 1.0
    cube[1, 0, 0, 1] = 1e-3
    found = first_return(cube, axis)
    assert found.dtype == torch.float32 and found.shape == (1, 3)
    assert found[0, 0] == 2.0 and found[0, 1] == 1.0 and torch.isnan(found[0, 2])
    assert torch.isnan(first_return(cube, axis, threshold=1e-2)[0, 1])
    assert torch.equal(first_return(cube.expand(5, -1, -1, -1, -1), axis)[3, 0, :2], found[0, :2])
    stokes = torch.zeros(4, *cube.shape)
    stokes[0], stokes[1, :, 0] = cube, 1.0
    assert torch.equal(first_return(stokes, axis, polarized=True)[0, :2], found[0, :2])


# ------------------------------------------------------------------------------------------------------ velocities


def moving_renderer(motions, parameters=(), options=None, **contents):
    loaded = tt.load(scene_of(camera(fov=FOV), **contents), variant=VARIANT).moving(motions)
    return tt.TransientRenderer(loaded, parameters=parameters, spp=16, physics="ignore", **options or {})


def test_velocities_of_a_wheel_and_a_sensor():
    """A point p of the plane has v + omega x (p - c), from which the sensor's own velocity is taken along the ray."""
    linear, angular, center = (0.3, -0.2, 1.5), (0.4, 0.5, -2.0), (1.0, -1.0, 0.5)
    own = (0.5, 0.25, -1.0)
    motions = {"wall": tt.Motion(linear=linear, angular=angular, center=center), "sensor": tt.Motion(linear=own)}
    labels = scene_labels(moving_renderer(motions, wall=plane()), names=["velocity", "radial_velocity"])
    d = pinhole_directions()
    p = np.array([0, 0, DISTANCE])[:, None, None] + d * DISTANCE / -d[2]
    reach = p - np.array(center)[:, None, None]
    v = np.array(linear)[:, None, None] + np.cross(np.array(angular), reach, axis=0, axisb=0, axisc=0)
    close(labels["velocity"], v, atol=1e-4)
    close(labels["radial_velocity"], ((v - np.array(own)[:, None, None]) * d).sum(0), atol=1e-4)


def test_velocities_of_what_is_seen():
    ball = {"type": "sphere", "radius": RADIUS}
    still = scene_labels(renderer_of(camera(fov=FOV), ball=ball), names=["velocity", "radial_velocity", "shape"])
    labels = scene_labels(moving_renderer({"ball": tt.Motion(linear=(0.0, 1.0, 2.0))}, ball=ball), names=["velocity"])
    seen = still["shape"] >= 0
    assert 0 < seen.sum() < seen.numel()
    assert (still["velocity"][:, seen] == 0).all() and (still["radial_velocity"][seen] == 0).all()
    assert still["velocity"][:, ~seen].isnan().all() and labels["velocity"][:, ~seen].isnan().all()
    close(labels["velocity"][:, seen], np.broadcast_to([[0.0], [1.0], [2.0]], (3, int(seen.sum()))))
