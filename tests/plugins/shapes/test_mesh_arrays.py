"""Meshes that stand in a scene dictionary: the light of the same mesh in a file, and derivatives by vertices."""

import pickle

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.scenes import rotate, scale, translate
from torchtransient.scenes.bottle import write_ply

VARIANT = "llvm_ad_mono"
POSE = translate([0.1, 0.0, 0.0]) @ rotate([1, 2, 0], 20) @ scale([0.8, 1.1, 0.9])
OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float32)
FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int32
)
BODY = {"type": "mesh_arrays", "vertices": OCTAHEDRON, "faces": FACES}


def scene_with(*shapes):
    """A lamp beside a camera, before some shapes."""
    look = np.diag([-1.0, 1.0, -1.0, 1.0])
    look[2, 3] = 4.0
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 3},
        "light": {"type": "point", "position": [1.0, 1.0, 4.0], "intensity": 10.0},
        "sensor": {
            "type": "perspective", "fov": 40.0, "to_world": look,
            "film": {"type": "transient_hdr_film", "width": 6, "height": 6, "temporal_bins": 160, "start_opl": 2.0,
                     "bin_width_opl": 0.1, "rfilter": {"type": "box"}},
        },
        **{f"body_{number}": shape for number, shape in enumerate(shapes)},
    }  # fmt: skip


def diffuse(**shape):
    return {**BODY, "to_world": POSE, "bsdf": {"type": "diffuse", "reflectance": 0.6}, **shape}


def render(description, **keywords):
    scene = tt.load(description, variant=VARIANT)
    return tt.render(scene, spp=64, seed=1, **keywords)


def test_light_is_that_of_the_same_mesh_in_a_file(tmp_path):
    file = tmp_path / "body.ply"
    write_ply(file, OCTAHEDRON, FACES)
    in_file = {"type": "ply", "filename": str(file), "face_normals": True, "to_world": POSE}
    here = render(scene_with(diffuse())).transient
    there = render(scene_with({**in_file, "bsdf": diffuse()["bsdf"]})).transient
    assert float(here.sum()) > 0.1
    # vertices differ by the rounding of one product
    torch.testing.assert_close(here.sum((-2, -1)), there.sum((-2, -1)), rtol=2e-3, atol=2e-5)
    turned = render(scene_with(diffuse(flip_normals=True))).transient
    assert float(turned.sum()) == 0.0


def test_parameters_are_those_of_meshes():
    scene = tt.load(scene_with(diffuse()), variant=VARIANT)
    table = scene.parameters()
    vertices = table["body_0.vertex_positions"]
    assert vertices.shape == (6, 3) and vertices.differentiable and vertices.moves_path_length
    expected = OCTAHEDRON @ POSE[:3, :3].T + POSE[:3, 3]
    np.testing.assert_allclose(vertices.value, expected, atol=1e-6)
    np.testing.assert_allclose(table["body_0.to_world"].value, POSE, atol=1e-6)
    assert "body_0.bsdf.reflectance.value" in table
    for name in ("vertex_normals", "vertex_texcoords"):
        assert not table[f"body_0.{name}"].differentiable and table[f"body_0.{name}"].reason == "the mesh has none"


def test_descriptions_pickle_and_compare():
    scene = tt.load(scene_with(diffuse()), variant=VARIANT)
    copy = pickle.loads(pickle.dumps(scene))
    assert scene.same_description(copy)
    torch.testing.assert_close(tt.render(copy, spp=4, seed=1).steady, tt.render(scene, spp=4, seed=1).steady)
    other = tt.load(scene_with(diffuse(vertices=2 * OCTAHEDRON)), variant=VARIANT)
    assert not scene.same_description(other)


@pytest.mark.parametrize("count", [1, 4])
def test_arrays_of_any_number_of_rows_are_no_colours_points_or_transforms(count, capfd):
    """Three vertices make a (3, 3) array, four faces of four vertices would be transforms elsewhere."""
    vertices = np.concatenate([OCTAHEDRON[:3] + k for k in range(count)])
    faces = np.arange(3 * count).reshape(-1, 3)
    scene = tt.load(scene_with(diffuse(vertices=vertices.tolist(), faces=torch.from_numpy(faces))), variant=VARIANT)
    assert scene.parameters()["body_0.vertex_positions"].shape == (3 * count, 3)
    assert "implicit conversion" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vertices": OCTAHEDRON * np.nan}, "finite|NaN"),
        ({"faces": FACES + 1}, "from 0 to 5"),
        ({"faces": FACES + 0.5}, "whole numbers"),
        ({"vertices": OCTAHEDRON[:, :2]}, "rows of three"),
    ],
)
def test_what_is_no_mesh(changes, message):
    with pytest.raises(SceneError, match=message), mi.variant_context(VARIANT):
        tt.load(scene_with(diffuse(**changes)), variant=VARIANT).parameters()



def test_scene_files_name_a_mesh_file():
    file = '<scene version="3.0.0"><shape type="mesh_arrays"><string name="vertices" value="0 1 2"/></shape></scene>'
    words = r"vertices as an array \(N, 3\) in a scene dictionary, got str\. .*'ply'"
    with mi.variant_context(VARIANT), pytest.raises(SceneError, match=words), plugins.plugin_errors():
        mi.load_string(file)


def test_normals_and_vertices_under_a_transform():
    """Normals stay across the surface where it is stretched, of length one."""
    normals = np.array([[1.0, 2.0, -2.0], [0.0, 3.0, 4.0], [2.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0, 0, 5.0], [0, -1, 0]])
    matrix = translate([1.0, -2.0, 0.5]) @ rotate([1, 2, 0], 20) @ scale([0.5, 2.0, 3.0])
    with mi.variant_context(VARIANT):
        given = {"vertices": OCTAHEDRON, "faces": FACES, "normals": normals, "texcoords": OCTAHEDRON[:, :2] * [0.5, 2]}
        arrays = {key: mi.TensorXf(np.float32(x)) for key, x in given.items()}
        shape = mi.load_dict({"type": "mesh_arrays", **arrays, "to_world": mi.ScalarTransform4f(matrix)})
        bare = mi.load_dict({"type": "mesh_arrays", **arrays})
        params, unplaced = mi.traverse(shape), mi.traverse(bare)
        found = {key: np.array(params[key], dtype=float) for key in params.keys() if key.startswith("vertex_")}  # noqa: SIM118
        plain = np.array(unplaced["vertex_normals"]).reshape(-1, 3)
    placed = OCTAHEDRON @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(found["vertex_positions"].reshape(-1, 3), placed, atol=1e-6)
    expected = normals @ np.linalg.inv(matrix[:3, :3])
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    np.testing.assert_allclose(found["vertex_normals"].reshape(-1, 3), expected, atol=1e-6)
    np.testing.assert_allclose(found["vertex_texcoords"].reshape(-1, 2), OCTAHEDRON[:, :2] * [0.5, 2])
    np.testing.assert_allclose(plain, normals)


