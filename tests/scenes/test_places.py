"""Where walls, lights and cameras of the scenes stand, and which way they face. Metres."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import scenes
from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.scenes import meshes
from torchtransient.scenes.bottle import PROFILE, lathe
from torchtransient.scenes.nlos import mannequin
from torchtransient.scenes.parts import diffuse, perspective, transient_film, transient_path

VARIANT = "llvm_ad_rgb"


def placed(node):
    """Centre, lengths of the two axes, and normal of a rectangle."""
    m = node["to_world"]
    lengths = np.linalg.norm(m[:3, :3], axis=0)
    return [*m[:3, 3].tolist(), *lengths[:2].tolist(), *(m[:3, 2] / lengths[2]).tolist()]


def looking(scene):
    """Place of the camera, and the direction that it looks in."""
    m = scene["sensor"]["to_world"]
    return [*m[:3, 3].tolist(), *m[:3, 2].tolist()]


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_the_cornell_box_is_mitsubas_piece_by_piece():
    mi.set_variant(VARIANT)
    ours, theirs = scenes.cornell_box((24, 16), spp=5), mi.cornell_box()
    names = [name for name, node in theirs.items() if isinstance(node, dict) and "to_world" in node]
    assert len(names) == 9
    for name in names:
        np.testing.assert_allclose(ours[name]["to_world"], np.array(theirs[name]["to_world"].matrix), atol=1e-6)
    for name in ("white", "green", "red"):
        assert ours[name]["reflectance"] == {"type": "rgb", "value": list(theirs[name]["reflectance"]["value"])}
    assert list(theirs["light"]["emitter"]["radiance"]["value"]) == ours["light"]["emitter"]["radiance"]["value"]
    assert ours["sensor"]["fov"] == theirs["sensor"]["fov"]
    assert ours["sensor"]["near_clip"] == theirs["sensor"]["near_clip"]
    film = ours["sensor"]["film"]
    assert (film["width"], film["height"], ours["sensor"]["sampler"]["sample_count"]) == (24, 16, 5)
    for name in ("floor", "ceiling", "back", "green-wall", "red-wall"):
        assert ours[name]["bsdf"]["id"] == theirs[name]["bsdf"]["id"]


def test_plates_that_face_each_other():
    scene = scenes.parallel_plates(3.0, 0.25, 2.0, half_extent=40.0)
    close(placed(scene["back"]), [0, 0, -1.5, 40, 40, 0, 0, 1])
    close(placed(scene["front"]), [0, 0, 1.5, 40, 40, 0, 0, -1])
    close(looking(scene), [0, 0, 0, 0, 0, -1])
    for name in ("back", "front"):
        assert scene[name]["bsdf"] == {"type": "diffuse", "reflectance": 0.25}
        assert scene[name]["emitter"] == {"type": "area", "radiance": 2.0}
    assert scene["sensor"]["fov"] == 0.5


def test_spheres_are_seen_from_their_middle():
    for scene in (scenes.furnace(3.0, 0.25, 2.0), scenes.integrating_sphere(3.0, 0.25, 2.0)):
        wall = scene["wall"]
        assert (wall["radius"], wall["flip_normals"], wall["bsdf"]["reflectance"]) == (3.0, True, 0.25)
        close(looking(scene), [0, 0, 0, 0, 0, -1])
        assert scene["sensor"]["fov"] == 45.0
    assert scene["light"] == {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 2.0}
    alone, sampled = scenes.furnace(3.0, 0.25, 2.0), scenes.furnace(3.0, 0.25, 2.0, emitter_sampling=True)
    assert alone["wall"]["emitter"] == {"type": "area", "radiance": 2.0, "sampling_weight": 0.0}
    assert sampled["wall"]["emitter"] == {"type": "area", "radiance": 2.0} and "dark" not in sampled
    assert alone["dark"]["intensity"] == 1e-30


def test_a_wall_that_moves_and_a_panel_beside_it():
    """The panel looks back at the wall: turned by 60 degrees out of its plane."""
    scene = scenes.moving_wall(0.7, side_panel=True, panel_reflectance=0.3, wall_reflectance=0.6, intensity=4.0)
    close(placed(scene["wall"]), [0, 0, 0.7, 1, 1, 0, 0, 1])
    close(placed(scene["side"]), [1.6, 0, 1.2, 0.4, 0.4, -np.sqrt(3) / 2, 0, 0.5])
    close(looking(scene), [0, 0, 4, 0, 0, -1])
    assert scene["light"] == {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": 4.0}
    assert scene["sensor"]["fov"] == 10.0 and "side" not in scenes.moving_wall()
    assert [scene[name]["bsdf"]["reflectance"] for name in ("wall", "side")] == [0.6, 0.3]


def test_a_light_and_a_meter_over_a_plane():
    scene = scenes.light_over_plane(2.0, 0.25, 3.0, half_extent=50.0, spp=8)
    close(placed(scene["plane"]), [0, 0, 0, 50, 50, 0, 0, 1])
    close(placed(scene["meter"]), [0, 0, 2, 2e-4, 2e-4, 0, 0, -1])
    close(scene["light"]["position"], [0, 0, 2 - 2e-4])
    assert scene["meter"]["sensor"]["sampler"]["sample_count"] == 8
    assert [scene[name]["bsdf"]["reflectance"] for name in ("plane", "meter")] == [0.25, 0.0]
    assert scene["integrator"] == {"type": "transient_path", "max_depth": 2}


def slab(scene):
    """The two faces of a slab, along its own axis, and its middle."""
    m = scene["slab"]["to_world"]
    return [*m[:3, 3].tolist(), *np.linalg.norm(m[:3, :3], axis=0).tolist()]


@pytest.mark.parametrize(("light", "place"), [("behind", [0, 0, -1, 10, 10, 0, 0, 1]),
                                              ("front", [0, 0, 2.6, 10, 10, 0, 0, -1])])  # fmt: skip
def test_a_slab_met_head_on(light, place):
    scene = scenes.etalon_slab(0.6, 1.25, light=light, radiance=2.0)
    close(slab(scene), [3, 0, 0.3, 10, 10, 0.3])
    close(placed(scene["light"]), place)
    close(looking(scene), [0, 0, 1.6, 0, 0, -1])
    assert scene["light"]["emitter"] == {"type": "area", "radiance": 2.0} and scene["sensor"]["fov"] == 0.1
    assert scene["light"]["bsdf"]["reflectance"] == 0.0
    assert scene["slab"]["bsdf"] == {"type": "dielectric", "int_ior": 1.25, "ext_ior": 1.0}


def test_a_tilted_slab():
    scene = scenes.glass_slab_before_wall(1.25, tilt_deg=30.0, wall_reflectance=0.3, intensity=4.0)
    close(slab(scene), [0, 0, 2.4, 0.8, 0.8, 0.25])
    close(scene["slab"]["to_world"][:3, 2] / 0.25, [0.5, 0, np.sqrt(3) / 2])
    close(placed(scene["wall"]), [0, 0, 0, 3, 3, 0, 0, 1])
    close(looking(scene), [0, 0, 4, 0, 0, -1])
    assert scene["light"] == {"type": "point", "position": [1.8, 0.0, 2.0], "intensity": 4.0}
    assert (scene["wall"]["bsdf"]["reflectance"], scene["slab"]["bsdf"]["int_ior"]) == (0.3, 1.25)
    assert scene["sensor"]["fov"] == 6.0


# --------------------------------------------------------------------------------------------------------- the parts

MAKE = ("cornell_box", "furnace", "integrating_sphere", "parallel_plates", "moving_wall", "etalon_slab",
        "glass_slab_before_wall")  # fmt: skip


@pytest.mark.parametrize("name", MAKE)
def test_every_scene_hands_its_numbers_on(name):
    scene = getattr(scenes, name)(resolution=(5, 3), num_bins=7, start_opl=-1.5, bin_width_opl=0.25, spp=9, max_depth=4)
    assert scene["sensor"]["film"] == {
        "type": "transient_hdr_film", "width": 5, "height": 3, "rfilter": {"type": "box"}, "temporal_bins": 7,
        "start_opl": -1.5, "bin_width_opl": 0.25,
    }  # fmt: skip
    assert scene["sensor"]["sampler"] == {"type": "independent", "sample_count": 9}
    assert scene["integrator"]["max_depth"] == 4
    has_roulette = name in ("furnace", "integrating_sphere", "parallel_plates", "etalon_slab")
    assert scene["integrator"].get("rr_depth") == (1000 if has_roulette else None)


def test_sides_of_films():
    assert [transient_film(side, 2, 0.0, 1.0)["height"] for side in (4, np.int64(4), np.array(4), [3, 4])] == [4] * 4
    for wrong in ((1, 2, 3), (4,), []):
        with pytest.raises(SceneError, match=r"resolution: expected one side in pixels or \(width, height\)"):
            transient_film(wrong, 2, 0.0, 1.0)
    for wrong in ("44", b"44", 0, (3, 0)):
        with pytest.raises(SceneError, match="resolution"):
            transient_film(wrong, 2, 0.0, 1.0)


def test_cameras_integrators_and_surfaces():
    camera = perspective(np.eye(4), 30.0, {}, 8, "stratified", 0.125)
    assert (camera["fov_axis"], camera["fov"], camera["near_clip"], camera["far_clip"]) == ("smaller", 30.0, 0.125, 100)
    assert camera["sampler"] == {"type": "stratified", "sample_count": 8}
    assert perspective(np.eye(4), 30.0, {}, 8)["near_clip"] == 1e-3
    assert transient_path(-1, 3) == {"type": "transient_path", "max_depth": -1, "rr_depth": 3}
    assert diffuse([0.1, 0.2, 0.3])["reflectance"] == {"type": "rgb", "value": [0.1, 0.2, 0.3]}
    for wrong in (-0.1, 1.1, [0.1, 0.2, 2.0]):
        with pytest.raises(UnitError, match="albedo or reflectance"):
            diffuse(wrong)


@pytest.mark.parametrize(("outline", "segments", "words"), [
    ([[0, 0], [0, 1]], 8, "N >= 3"), ([0.0, 1.0, 0.0], 8, "N >= 3"), (np.zeros((4, 3)), 8, "N >= 3"),
    ([[0.1, 0], [1, 1], [0, 2]], 8, "starts and ends at r = 0"), ([[0, 0], [1, 1], [0.1, 2]], 8, "starts and ends"),
    ([[0, 0], [1, 1], [0, 2], [1, 2], [0, 3]], 8, "positive radii between"), (PROFILE, 2, "at least 3 segments, got 2"),
])  # fmt: skip
def test_outlines_that_make_no_body(outline, segments, words):
    with pytest.raises(SceneError, match=words):
        lathe(np.array(outline), segments)
    assert lathe(np.array(PROFILE), 3)[1].shape == (3 * 2 * (len(PROFILE) - 2), 3)


def test_what_no_shape_or_no_area_is_made_of():
    almost_a_line = [[2.0, 0.6000000000000001], [-1.0, -0.2999999999999999], [-2.0, -0.5999999999999999], [2.0, 0.6]]
    with pytest.raises(SceneError, match="corners that are not all in a row"):
        meshes.sheet(almost_a_line)
    for wrong in (3, "shapes", [{"type": "sphere"}]):
        with pytest.raises(SceneError, match="bounds: expected a dictionary of shapes, got"):
            scenes.bounds(wrong)


def test_an_arm_that_touches_the_wall_is_too_long():
    reach = float(-mannequin(1.45, 1)[0][:, 2].min())
    with pytest.raises(SceneError, match=f"depth: expected more than {reach:.3g} m, the reach of the arm"):
        scenes.nlos_mannequin(depth=reach, level=1)
    assert scenes.nlos_mannequin(depth=reach + 1e-9, level=1)["body"]["vertices"][:, 2].min() > 0


@pytest.mark.parametrize(("shape", "words"), [
    ({"type": "mesh_arrays"}, "expected vertices of it as rows of three numbers"),
    ({"type": "mesh_arrays", "vertices": np.zeros((3, 2))}, "expected vertices of it as rows of three numbers"),
    ({"type": "mesh_arrays", "vertices": np.zeros((0, 3))}, "expected vertices of it as rows of three numbers"),
    ({"type": "sphere", "center": [1.0, 2.0]}, "expected center of it as rows of three numbers"),
])  # fmt: skip
def test_boxes_of_what_has_no_points(shape, words):
    with pytest.raises(ShapeError, match=f"bounds: {words}"):
        scenes.bounds({"it": shape})
