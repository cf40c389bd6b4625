"""Kinds, shapes and numbers of parameters, as a table has them and a scene takes them. Nothing is rendered."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import SceneError, UnknownKeyError
from torchtransient.rendering.parameters import (
    ParameterInfo,
    ParameterTable,
    SlotTable,
    _placed,
    _short,
    as_mitsuba_value,
    changed_with,
    classify,
    needing_slope,
    read_value,
    unknown_key,
)

VARIANT = "llvm_ad_rgb"


@pytest.fixture(autouse=True, scope="module")
def variant():
    """One whose arrays are those of kernels."""
    mi.set_variant(VARIANT)


def cases():
    """(key, value of Mitsuba, kind, shape of the torch value, its numbers)."""
    matrix = np.arange(1.0, 17.0).reshape(4, 4)
    matrix[3] = 0, 0, 0, 1
    flat = np.array([[1.0, 2, 3], [4, 5, 6], [0, 0, 1]])
    cube = np.arange(24.0).reshape(2, 3, 4)
    rows = np.arange(6.0).reshape(2, 3)
    return {
        "transform": ("a.to_world", mi.Transform4f(matrix), "transform", (4, 4), matrix),
        "transform of a picture": ("a.to_uv", mi.Transform3f(mi.Matrix3f(flat.tolist())), "transform", (3, 3), flat),
        "plain transform": ("a.to_world", mi.ScalarTransform4f(matrix), "plain", (4, 4), matrix),
        "number": ("a.value", mi.Float(2.5), "number", (), 2.5),
        "list": ("a.values", mi.Float([1, 2, 5]), "list", (3,), [1, 2, 5]),
        "colour": ("a.value", mi.Color3f(1, 2, 5), "vector", (3,), [1, 2, 5]),
        "point": ("a.center", mi.Point2f(1, 2), "vector", (2,), [1, 2]),
        "points": ("a.somewhere", mi.Point3f([0, 3], [1, 4], [2, 5]), "points", (2, 3), rows),
        "one point of many": ("a.points", mi.Point3f(7, 8, 9), "points", (1, 3), [[7, 8, 9]]),
        "tensor": ("a.data", mi.TensorXf(cube), "tensor", (2, 3, 4), cube),
        "whole tensor": ("a.data", mi.TensorXi(np.arange(6).reshape(2, 3)), "integer", (2, 3), rows),
        "vertices": ("a.vertex_positions", mi.Float(range(6)), "vertices", (2, 3), rows),
        "normals": ("a.vertex_normals", mi.Float(range(6)), "vertices", (2, 3), rows),
        "places": ("a.vertex_texcoords", mi.Float(range(6)), "vertices", (3, 2), np.arange(6.0).reshape(3, 2)),
        "no vertices": ("a.vertex_normals", mi.Float(), "vertices", (0, 3), np.zeros((0, 3))),
        "whole numbers": ("a.faces", mi.UInt32([3, 1, 2, 5]), "integer", (4,), [3, 1, 2, 5]),
        "plain vector": ("a.size", mi.ScalarVector2f(1, 2), "plain", (2,), [1, 2]),
        "plain number": ("a.n", 3, "plain", (), 3),
        "plain truth": ("a.on", True, "plain", (), True),
        "text": ("a.text", "abc", "plain", None, "str"),
        "nothing": ("a.sigma", None, "plain", None, None),
    }


NAMES = (
    "transform", "transform of a picture", "plain transform", "number", "list", "colour", "point", "points",
    "one point of many", "tensor", "whole tensor", "vertices", "normals", "places", "no vertices", "whole numbers",
    "plain vector", "plain number", "plain truth", "text", "nothing",
)  # fmt: skip


@together("name", NAMES)
def test_kinds_shapes_and_numbers(name):
    assert tuple(cases()) == NAMES
    key, value, kind, shape, numbers = cases()[name]
    assert classify(key, value) == (kind, shape)
    found = read_value(value, shape)
    if shape is None or not isinstance(found, np.ndarray):
        assert found == numbers and type(found) is type(numbers)
    else:
        assert found.shape == shape
        np.testing.assert_array_equal(found, numbers)


@pytest.mark.parametrize("name", [*NAMES[:2], *NAMES[3:10], *NAMES[11:14]])
def test_flat_arrays_become_values_like_those_that_are_there(name):
    key, value, kind, shape, numbers = cases()[name]
    leaf = mi.Float(np.ravel(numbers).astype(np.float32) * 2)
    found = as_mitsuba_value(kind, shape, value, leaf)
    assert type(found) is type(value) and classify(key, found) == (kind, shape)
    np.testing.assert_array_equal(read_value(found, shape), 2 * np.array(numbers))


def info(key, **more):
    given = {"kind": "number", "shape": (), "value": 1.0, "differentiable": True, "moves_path_length": False,
             "reason": "has a derivative"}  # fmt: skip
    return ParameterInfo(key, **given | more)


def test_a_table_of_entries():
    entries = [info("a.b", moves_path_length=True), info("c", differentiable=False), info("d.e", value=None)]
    table = ParameterTable(entries)
    assert list(table) == ["a.b", "c", "d.e"] and len(table) == 3 and table["c"] is entries[1]
    assert table.differentiable() == ["a.b", "d.e"]
    assert needing_slope(table, ["d.e", "a.b"]) == ["a.b"] and needing_slope(table, ["c"]) == []
    head, line, *rows = str(table).splitlines()
    assert head.split() == ["key", "shape", "value", "derivative"] and set(line) == {"-"}
    assert len(line) == max(map(len, rows)) and [row.split()[0] for row in rows] == ["a.b", "c", "d.e"]
    assert rows[1].endswith("no: has a derivative") and "no:" not in rows[0] and "(large)" in rows[2]
    with pytest.raises(UnknownKeyError, match=r"no parameter 'b'. Did you mean 'a\.b'\?"):
        table["b"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "(large)"), (np.arange(5.0), "mean 2"), (np.arange(4.0), "[0., 1., 2., 3.]"), (0.1234567891, "0.123457"),
        (True, "True"), (3, "3"), ("abc", "abc"), (np.array([[1.0, 2], [3, 4.5]]), "[[1. , 2. ], [3. , 4.5]]"),
        (np.array([1 / 3, 2 / 3]), "[0.3333, 0.6667]"),
    ],
)  # fmt: skip
def test_values_in_few_letters(value, text):
    assert _short(value) == text


def test_keys_that_are_meant():
    """Those that hold what was asked for, three at most, or else those that look like it."""
    known = ["wall.bsdf.reflectance.value", "box.bsdf.alpha", "lamp.position", "x.alpha", "y.alpha", "z.alpha"]
    assert "Did you mean 'box.bsdf.alpha', 'x.alpha', 'y.alpha'? print(" in unknown_key("alpha", known)
    assert "Did you mean 'lamp.position'? print(" in unknown_key("lamp.postion", known)
    assert unknown_key("qqq", known, "my scene") == (
        "my scene has no parameter 'qqq'. print(scene.parameters()) lists all keys."
    )
    assert "Did you mean 'wall.bsdf.reflectance.value'?" in unknown_key("bsdf.reflectance", known)
    assert "Did you mean" not in unknown_key("sdf", ["wall.bsdf.reflectance.value"])


def test_maps_of_lights_follow_their_texture_coordinates():
    params = {"a.vertex_positions": 0, "a.vertex_normals": 0, "b.vertex_positions": 0}
    assert changed_with(["a.vertex_texcoords"], params) == ["a.vertex_positions", "a.vertex_normals"]
    assert changed_with(["b.vertex_texcoords", "a.vertex_positions"], params) == ["b.vertex_positions"]
    assert changed_with(["a.vertex_positions", "c.vertex_texcoords"], params) == []


def test_only_what_has_a_derivative_has_a_place():
    tracker = SimpleNamespace(location_of=lambda node, key: ("nowhere", key))
    left = info("k", differentiable=False)
    assert _placed(left, tracker, None) is left
    placed = _placed(info("k"), tracker, None)
    assert placed.place == ("nowhere", "k") and not placed.checked
    assert placed.reason.startswith("has a derivative; ")


@pytest.fixture(scope="module")
def built():
    """A mesh with normals of its own, one without, and a sphere."""
    scene = {"type": "scene", "cube": {"type": "cube", "to_world": np.diag([2.0, 3.0, 4.0, 1.0])},
             "flat": {"type": "rectangle"}, "ball": {"type": "sphere", "radius": 2.5}}  # fmt: skip
    loaded = tt.load(scene, variant=VARIANT)
    from torchtransient.rendering.build_options import BuildOptions
    from torchtransient.rendering.variant import active_variant

    with active_variant(VARIANT):
        yield loaded.built(BuildOptions())


def test_slots_of_keys(built):
    table = SlotTable(built, ("cube.to_world", "ball.to_world"))
    mesh, ball = table.slots
    assert (mesh.kind, mesh.shape, mesh.size, mesh.targets) == (
        "mesh_transform", (4, 4), 16, ["cube.vertex_positions", "cube.vertex_normals"])  # fmt: skip
    np.testing.assert_array_equal(mesh.initial, np.diag([2.0, 3.0, 4.0, 1.0]))
    assert (ball.kind, ball.targets) == ("transform", ["ball.to_world"])
    assert set(table.originals) == {"cube.vertex_positions", "cube.vertex_normals", "ball.to_world"}
    assert not mesh.loses_black()
    # Normals go back with positions, which Mitsuba computes anew.
    assert set(SlotTable(built, ("cube.vertex_positions",)).originals) == {
        "cube.vertex_positions", "cube.vertex_normals"}  # fmt: skip
    assert set(SlotTable(built, ("cube.vertex_normals",)).originals) == {"cube.vertex_normals"}
    with pytest.raises(SceneError, match=r"'cube\.vertex_positions' and 'cube\.to_world' both set 'cube\.vertex_pos"):
        SlotTable(built, ("cube.vertex_positions", "cube.to_world"))


def test_poses_of_meshes_move_points_and_turn_normals(built):
    """Points by the new pose after the old one is undone, normals by the inverse transpose, unit again."""
    table = SlotTable(built, ("cube.to_world",))
    before = {key: np.array(value).reshape(-1, 3) for key, value in table.originals.items()}
    pose = np.array([[0.0, -2, 0.5, 1], [1.5, 0, 0, -2], [0, 0.25, 3, 4], [0, 0, 0, 1]])
    relative = pose @ np.diag([1 / 2, 1 / 3, 1 / 4, 1.0])
    try:
        table.install([mi.Float(pose.ravel().astype(np.float32))])
        after = {key: np.array(built.params[key]).reshape(-1, 3) for key in before}
    finally:
        table.restore()
    points = before["cube.vertex_positions"] @ relative[:3, :3].T + relative[:3, 3]
    np.testing.assert_allclose(after["cube.vertex_positions"], points, rtol=1e-5, atol=1e-5)
    normals = before["cube.vertex_normals"] @ np.linalg.inv(relative[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(after["cube.vertex_normals"], normals, atol=1e-5)
    for key, value in before.items():
        np.testing.assert_array_equal(np.array(built.params[key]).reshape(-1, 3), value)
