"""Parameters: the table, and that a torch value has the effect of the same value written in the scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

import torchtransient as tt
from support.marks import long
from tools.small_room import CAMERA, GREY, VARIANT, WALL_POSE, make_room, pose

TURN = np.array([[0.8, 0, 0.6, 0], [0, 1, 0, 0], [-0.6, 0, 0.8, 0], [0, 0, 0, 1.0]])


def textured_room() -> dict:
    room = make_room()
    pixels = np.linspace(0.1, 0.9, 12, dtype=np.float32).reshape(2, 2, 3)
    room["wall"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": pixels, "raw": True}}
    room["box"]["bsdf"] = {"type": "roughconductor", "alpha": 0.4}
    room["ball"] = {"type": "sphere", "to_world": pose(-0.4, 0.2, 0.4, 0.25)}
    room["spot"] = {
        "type": "spot",
        "to_world": np.diag([1.0, -1, -1, 1]) + pose(-0.3, 0, 3) - np.eye(4),
        "intensity": 3.0,
    }
    room["lamp"] = {
        "type": "rectangle",
        "to_world": np.diag([0.2, -0.2, -0.2, 1]) + pose(0.2, 0.8, 2.5) - np.eye(4),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 5.0, 6.0]}},
    }
    return room


def set_pixels(room, value):
    room["wall"]["bsdf"]["reflectance"]["data"] = value


# key -> (new value, how the dictionary says the same)
WRITTEN = {
    "wall.bsdf.reflectance.data": (np.full((2, 2, 3), 0.35) + 0.1 * np.arange(3), set_pixels),
    "box.bsdf.alpha.value": (np.array(0.2), lambda room, v: room["box"]["bsdf"].update(alpha=float(v))),
    "wall.to_world": (pose(0.1, 0, -0.3, 3.0) @ TURN, lambda room, v: room["wall"].update(to_world=v)),
    "ball.to_world": (pose(-0.3, 0.1, 0.6, 0.3), lambda room, v: room["ball"].update(to_world=v)),
    "box.to_world": (pose(0.2, 0.1, 0.4, 0.35) @ TURN, lambda room, v: room["box"].update(to_world=v)),
    "light.position": (np.array([-0.4, 0.1, 3.5]), lambda room, v: room["light"].update(position=v.tolist())),
    "spot.to_world": (
        np.diag([1.0, -1, -1, 1]) + pose(0.3, 0.1, 3.2) - np.eye(4),
        lambda room, v: room["spot"].update(to_world=v),
    ),
    "lamp.emitter.radiance.value": (
        np.array([1.0, 2.0, 3.0]),
        lambda room, v: room["lamp"]["emitter"]["radiance"].update(value=v.tolist()),
    ),
    "lamp.to_world": (
        np.diag([0.3, -0.3, -0.3, 1]) + pose(0.1, 0.7, 2.4) - np.eye(4),
        lambda room, v: room["lamp"].update(to_world=v),
    ),
    "sensor.to_world": (CAMERA + pose(0.05, 0.1, 0.2) - np.eye(4), lambda room, v: room["sensor"].update(to_world=v)),
    "sensor.x_fov": (np.array(15.0), lambda room, v: room["sensor"].update(fov=float(v))),
}


@pytest.fixture(scope="module")
def textured():
    return tt.load(textured_room(), variant=VARIANT)


ON_SENSOR = [key for key in WRITTEN if key.startswith("sensor")]


@pytest.mark.parametrize("keys", [[key for key in WRITTEN if key not in ON_SENSOR], ON_SENSOR], ids=["scene", "sensor"])
@torch.no_grad()
def test_values_have_the_effect_of_the_same_values_in_the_scene(textured, keys):
    settings = {"parameters": keys, "spp": 16, "temporal_filter": "tent"}
    renderer = tt.TransientRenderer(textured, **settings)
    before = renderer(seed=2).transient
    values = {key: torch.tensor(WRITTEN[key][0], dtype=torch.float32) for key in keys}
    for key, value in values.items():
        change = (renderer({key: value}, seed=2).transient - before).abs().max()
        assert change > 1e-3, f"{key} has no effect: the test would not notice anything"
    given = renderer(values, seed=2).transient
    room = textured_room()
    for key in keys:
        WRITTEN[key][1](room, WRITTEN[key][0])
    written = tt.TransientRenderer(tt.load(room, variant=VARIANT), **settings)(seed=2).transient
    # A few samples graze an edge and land on its other side when a matrix is rounded differently.
    assert torch.isclose(given, written, rtol=1e-3, atol=1e-4).float().mean() > 0.99
    torch.testing.assert_close(given.sum(), written.sum(), rtol=1e-3, atol=0)
    assert torch.equal(renderer(seed=2).transient, before)


@pytest.mark.parametrize("keys", [
    ("wall.to_world", "ball.to_world", "spot.to_world", "box.to_world", "lamp.to_world"),
    ("sensor.x_fov", "box.vertex_normals"),
])  # fmt: skip
@torch.no_grad()
def test_start_values_are_the_scene_and_the_scene_is_restored(textured, keys):
    plain, posed = (
        tt.TransientRenderer(textured, parameters=names, spp=8, temporal_filter="tent")
        for names in (["wall.bsdf.reflectance.data"], keys)
    )
    expected = plain(seed=1).transient
    close = torch.isclose(posed(seed=1).transient, expected, rtol=1e-3, atol=1e-4)
    assert close.float().mean() > 0.99
    assert torch.equal(plain(seed=1).transient, expected)


# Together, since each set of keys has kernels of its own.
TOGETHER = [
    ("wall.bsdf.reflectance.data", "box.to_world", "ball.to_world", "spot.to_world", "lamp.emitter.radiance.value"),
    ("wall.to_world", "lamp.to_world", "light.position", "box.vertex_normals", "box.bsdf.alpha.value"),
    ("sensor.to_world", "sensor.x_fov"),
    ("wall.bsdf.reflectance.data", "lamp.emitter.radiance.value"),
]


@pytest.mark.parametrize("keys", long(TOGETHER, TOGETHER[-1:]), ids=" ".join)
def test_forward_and_reverse_mode_agree_and_restore_the_scene(textured, room_scene, keys):
    # The plain room for the sensor: its kernels carry the adjoint of the ray and take long to compile.
    scene = room_scene if keys[0].startswith("sensor") else textured
    renderer = tt.TransientRenderer(scene, parameters=list(keys), spp=64, grad_seed="same", temporal_filter="tent")
    generator = torch.Generator().manual_seed(11)
    out = renderer(seed=3).transient
    weights = torch.rand(out.shape, generator=generator).cumsum(-3)
    (out * weights).sum().backward()
    # Every key has the same share of what is compared.
    tangents = {key: torch.randn(renderer.values[key].shape, generator=generator) for key in keys}
    shares = {key: tangents[key] * renderer.values[key].grad for key in keys}
    scales = {key: float(share.abs().sum()) for key, share in shares.items()}
    assert min(scales.values()) > 0
    with forward_ad.dual_level():
        duals = {key: forward_ad.make_dual(renderer.values[key].detach(), tangents[key] / scales[key]) for key in keys}
        pushed = renderer(duals, seed=3).transient
        along = forward_ad.unpack_dual((pushed * weights).sum()).tangent.item()
    assert torch.equal(renderer(seed=3).transient, out)
    assert along == pytest.approx(sum(float(share.sum()) / scales[key] for key, share in shares.items()), abs=2e-3)


@pytest.mark.slow
def test_a_pattern_that_shifts_over_a_light_is_sampled_where_it_is(tmp_path):
    """Mitsuba samples patterns by a map that it keeps when texture coordinates alone change."""
    pixels = np.linspace(0.1, 9.0, 16, dtype=np.float32).reshape(4, 4, 1).repeat(3, axis=2)
    corners = np.array([[0.1, 0.1], [0.6, 0.1], [0.6, 0.6], [0.1, 0.6]])

    def lit_by(name, uv):
        lines = [f"v {x} {y} 0" for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))] + [f"vt {u} {v}" for u, v in uv]
        (tmp_path / name).write_text("\n".join([*lines, "f 1/1 2/2 3/3", "f 1/1 3/3 4/4", ""]))
        radiance = {"type": "bitmap", "data": pixels, "raw": True}
        room = make_room()
        room["lamp"] = {
            "type": "obj",
            "filename": str(tmp_path / name),
            "to_world": np.diag([0.5, -0.5, -0.5, 1]) + pose(0.2, 0.6, 2.0) - np.eye(4),
            "emitter": {"type": "area", "radiance": radiance},
        }
        return tt.TransientRenderer(
            tt.load(room, variant=VARIANT), parameters=["lamp.vertex_texcoords"], spp=64, temporal_filter="tent"
        )

    moved = corners + np.array([0.3, 0.25])
    before, written = lit_by("before.obj", corners), lit_by("moved.obj", moved)
    expected = written(seed=1).transient.detach()
    # The loader of these files turns the second coordinate over.
    uv = before.values["lamp.vertex_texcoords"].detach()
    uv = uv + torch.tensor([0.3, -0.25]).repeat(4).reshape_as(uv)
    given = before({"lamp.vertex_texcoords": uv}, seed=1).transient.detach()
    torch.testing.assert_close(given.sum(), expected.sum(), rtol=1e-4, atol=0)
    assert (before(seed=1).transient.sum() - expected.sum()).abs() > 0.01 * expected.sum()


@pytest.mark.slow
def test_mesh_pose_keeps_authored_normals(tmp_path):
    import mitsuba as mi

    add_normals = tmp_path / "smooth.ply"
    mesh = mi.Mesh("tri", 3, 1, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [-1, -1, 0, 1, -1, 0, 0, 1, 0]
    params["faces"] = [0, 1, 2]
    params.update()
    params["vertex_normals"] = [0.6, 0, 0.8, -0.6, 0, 0.8, 0, 0.6, 0.8]
    params.update()
    mesh.write_ply(str(add_normals))
    room = make_room()
    room["box"] = {"type": "ply", "filename": str(add_normals), "to_world": pose(0, 0, 0.5, 0.5)}
    scene = tt.load(room, variant=VARIANT)
    plain = tt.TransientRenderer(scene, parameters=[GREY], spp=16, temporal_filter="tent")(seed=0).transient.detach()
    posed = tt.TransientRenderer(scene, parameters=["box.to_world"], spp=16)(seed=0).transient.detach()
    torch.testing.assert_close(posed, plain, rtol=1e-3, atol=1e-4)


def test_table_says_what_is_differentiable(textured):
    table = textured.parameters()
    assert table[WALL_POSE].differentiable
    assert table["light.position"].differentiable and table["light.position"].moves_path_length
    assert not table["lamp.emitter.radiance.value"].moves_path_length
    assert not table["box.faces"].differentiable
    assert not table["sensor.near_clip"].differentiable
    assert table["wall.bsdf.reflectance.data"].shape == (2, 2, 3)
    assert table["box.vertex_positions"].shape == (24, 3)
    assert table["ball.to_world"].shape == (4, 4)
    np.testing.assert_allclose(table["box.to_world"].value, pose(0.4, 0.0, 0.5, 0.3))
    text = str(table)
    assert all(word in text for word in ("box.to_world", "(24, 3)", "no: ", "correct"))
    assert "sensor.near_clip" not in table.differentiable() and "box.to_world" in table.differentiable()


def test_table_says_what_moves(textured):
    table = textured.parameters()
    for key in (WALL_POSE, "box.to_world", "box.vertex_positions", "light.position", "sensor.x_fov"):
        assert table[key].moves_path_length and table[key].moves_silhouette and not table[key].moves_medium
        assert table[key].reason.startswith("correct")
    for key in ("lamp.emitter.radiance.value", "box.bsdf.alpha.value", "wall.bsdf.reflectance.data"):
        assert not (table[key].moves_path_length or table[key].moves_silhouette or table[key].biased)


def test_normals_of_a_mirror_take_a_filter_with_a_slope():
    bumps = {"type": "bitmap", "raw": True, "data": np.full((2, 2, 3), 0.5, dtype=np.float32)}
    key = "box.bsdf.normalmap.data"
    for nested, filter_name in (("conductor", "tent"), ("diffuse", "box")):
        room = make_room()
        room["box"]["bsdf"] = {"type": "normalmap", "normalmap": bumps, "nested": {"type": nested}}
        renderer = tt.TransientRenderer(tt.load(room, variant=VARIANT), parameters=[key], spp=4)
        assert renderer.effective_filter == filter_name
        assert renderer.has_slope_for([key])


def test_extinction_is_told_from_albedo():
    room = make_room()
    room["box"]["bsdf"] = {"type": "null"}
    room["box"]["interior"] = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 0.3}
    room["integrator"]["type"] = "transient_prbvolpath"
    table = tt.load(room, variant=VARIANT).parameters()
    moving = [key for key, info in table.items() if info.moves_medium and info.differentiable]
    assert moving == ["box.interior_medium.sigma_t.value.value"]
    assert table["box.interior_medium.albedo.value.value"].differentiable


def test_unknown_key_suggests_the_right_one(room_scene):
    with pytest.raises(tt.errors.SceneError, match=r"box\.bsdf\.reflectance\.value"):
        tt.TransientRenderer(room_scene, parameters=["box.bsdf.reflectanse.value"])
    for part in ("box", "bsdf", "reflectance"):
        with pytest.raises(tt.errors.SceneError, match=r"Did you mean .*box\.bsdf\.reflectance\.value"):
            tt.TransientRenderer(room_scene, parameters=[part])


def test_key_without_derivative(room_scene):
    with pytest.raises(tt.errors.GradientError, match=r"near_clip.*no derivative"):
        tt.TransientRenderer(room_scene, parameters=["sensor.near_clip"])


# ------------------------------------------------------------------------------------------- index of refraction


def glass_room(plugin: str, **settings) -> dict:
    room = make_room()
    room["integrator"]["max_depth"] = 6
    room["slab"] = {
        "type": "cube",
        "to_world": np.diag([0.7, 0.7, 0.1, 1.0]) + pose(0, 0, 1.6) - np.eye(4),
        "bsdf": {"type": plugin, "int_ior": 1.5, "ext_ior": 1.0, **settings},
    }
    return room


GLASS = [("dielectric", {}), ("roughdielectric", {"alpha": 0.3})]


@pytest.mark.parametrize(("plugin", "settings"), GLASS)
def test_index_of_refraction_becomes_differentiable(plugin, settings):
    scene = tt.load(glass_room(plugin, **settings), variant=VARIANT)
    info = scene.parameters()["slab.bsdf.eta"]
    assert info.differentiable and info.moves_path_length and f"diff_{plugin.replace('rough', 'rough_')}" in info.reason
    renderer = tt.TransientRenderer(scene, parameters=["slab.bsdf.eta"])
    assert renderer.effective_filter == "tent"
    assert float(renderer.values["slab.bsdf.eta"].detach()) == pytest.approx(1.5)
