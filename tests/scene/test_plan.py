"""Decisions of a plan from the description alone: it overlooks nothing in a scene and pays for nothing else."""

import numpy as np
import pytest

import torchtransient as tt
from support import plan_scenes
from torchtransient.errors import GradientError, SceneError

VARIANT = "llvm_ad_rgb"


def static(scene, outputs=("transient",), **settings):
    return tt.plan(scene, outputs, pilot=False, time_axis=tt.TimeAxis(0.0, 0.1, 100), **settings)


# ----------------------------------------------------------------------------------------------------------- colour


def test_a_grey_scene_takes_one_channel():
    plan = static(plan_scenes.grey_room())
    assert plan.variant == "llvm_ad_mono"
    assert plan.integrator == "transient_path"
    assert plan.film == "transient"


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def spectrum(*pairs):
    return {"type": "spectrum", "value": list(pairs)}


def wall(reflectance):
    return {"wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}}


def light(intensity):
    return {"light": {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": intensity}}


BANDS = spectrum((450.0, 0.0), (460.0, 1.0), (470.0, 0.0), (640.0, 0.0), (650.0, 1.0), (660.0, 0.0))
SALMON = {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.4)}
PIXELS = np.random.default_rng(1).random((2, 2, 3))
FLAT = spectrum((300.0, 0.5), (900.0, 0.5))
DYE = {"type": "delayed", "lifetime": 0.1, "bsdf": plan_scenes.GREY, "excitation": FLAT, "emission": FLAT}
COLOURED = {
    "surface": wall(rgb(0.5, 0.5, 0.4)),
    "hidden surface": {"extra": plan_scenes.hidden({"type": "twosided", "bsdf": SALMON})},
    "checkerboard": wall({"type": "checkerboard", "color0": rgb(1.0, 0.0, 0.0)}),
    "pixels": wall({"type": "bitmap", "data": PIXELS, "raw": True}),
    "mesh attribute": wall({"type": "mesh_attribute", "name": "vertex_color"}),
}
MEASURED = {
    "reflectance": wall(BANDS),
    "gold": {"extra": plan_scenes.hidden({"type": "roughconductor", "material": "Au"})},
    "fluorescence": {"extra": plan_scenes.hidden(DYE)},
    "black body": {"light": {"type": "constant", "radiance": {"type": "blackbody", "temperature": 3000.0}}},
    "flat table that ends in the visible": light(spectrum((500.0, 1.0), (600.0, 1.0))),
}


@pytest.mark.parametrize("name", COLOURED)
def test_colour_takes_three_channels(name):
    assert static(plan_scenes.grey_room(**COLOURED[name])).variant == "llvm_ad_rgb"


@pytest.mark.parametrize("name", MEASURED)
def test_data_over_wavelength_take_wavelengths(name):
    plan = static(plan_scenes.grey_room(**MEASURED[name]))
    assert plan.variant == "llvm_ad_spectral"
    assert "wavelengths" in plan.reasons[0]


def test_a_flat_table_over_the_visible_is_grey():
    scene = plan_scenes.grey_room(**wall(spectrum((300.0, 0.5), (900.0, 0.5))))
    assert static(scene).variant == "llvm_ad_mono"


@pytest.mark.parametrize("coloured", [True, False])
def test_pictures_are_looked_at(tmp_path, coloured):
    file = plan_scenes.picture(tmp_path, "texture.exr", coloured=coloured)
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": file}}
    plan = static(plan_scenes.grey_room(wall={"type": "rectangle", "bsdf": bsdf}))
    assert plan.variant == ("llvm_ad_rgb" if coloured else "llvm_ad_mono")
    assert not coloured or "texture.exr" in plan.reasons[0]


def test_a_coloured_picture_of_roughness_is_no_colour(tmp_path):
    file = plan_scenes.picture(tmp_path, "texture.exr", coloured=True)
    mask = {"type": "mask", "opacity": {"type": "rgb", "value": [0.1, 0.2, 0.3]}, "bsdf": plan_scenes.GREY}
    assert static(plan_scenes.grey_room(wall={"type": "rectangle", "bsdf": mask})).variant == "llvm_ad_mono"
    mask = {"type": "mask", "opacity": {"type": "bitmap", "filename": file, "raw": True}, "bsdf": plan_scenes.GREY}
    # A nested picture is taken as a colour: that costs time, never light.
    assert static(plan_scenes.grey_room(wall={"type": "rectangle", "bsdf": mask})).variant == "llvm_ad_rgb"


def test_bands_of_the_film():
    scene = plan_scenes.grey_room()
    scene["sensor"]["film"]["green"] = {"type": "spectrum", "value": [(500.0, 0.0), (550.0, 1.0), (600.0, 0.0)]}
    assert static(scene).variant == "llvm_ad_spectral"
    assert static(scene, ("bands",)).variant == "llvm_ad_spectral"
    with pytest.raises(SceneError, match="response curves"):
        static(plan_scenes.grey_room(), ("bands",))


def test_what_is_declared_and_not_used_costs_nothing():
    scene = plan_scenes.grey_room(
        red={"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 0.0, 0.0]}},
        gold={"type": "conductor", "material": "Au"},
        filter={"type": "polarizer"},
        fog={"type": "homogeneous", "sigma_t": 1.0},
    )
    plan = static(scene)
    assert (plan.variant, plan.integrator) == ("llvm_ad_mono", "transient_path")
    assert any("declared" in line and "polarizer" in line and "homogeneous" in line for line in plan.reasons)


# ----------------------------------------------------------------------------------------------------- polarization

POLARIZER = {"type": "polarizer", "theta": 30.0}
HIDING = {
    "behind the wall": plan_scenes.hidden(POLARIZER),
    "in a blend": plan_scenes.hidden({"type": "blendbsdf", "weight": 0.01, "a": plan_scenes.GREY, "b": POLARIZER}),
    "two-sided": plan_scenes.hidden({"type": "twosided", "a": plan_scenes.GREY, "b": {"type": "pplastic"}}),
    "in a group": {"type": "shapegroup", "inner": plan_scenes.hidden(POLARIZER)},
    "on a light": {**plan_scenes.hidden(POLARIZER), "emitter": {"type": "area", "radiance": 1.0}},
}  # fmt: skip


@pytest.mark.parametrize("where", HIDING)
def test_a_polarizing_element_is_found(where):
    plan = static(plan_scenes.grey_room(extra=HIDING[where]))
    assert plan.variant == "llvm_ad_mono_polarized"
    assert "polarizer" in plan.reasons[0] or "pplastic" in plan.reasons[0]


def test_stokes_vectors_take_a_polarized_variant():
    assert static(plan_scenes.grey_room(), ("stokes",)).variant == "llvm_ad_mono_polarized"
    assert static(tt.scenes.cornell_box(4), ("transient", "stokes")).variant == "llvm_ad_spectral_polarized"


def test_a_scene_that_measures_stokes_vectors_keeps_them():
    scene = plan_scenes.grey_room(integrator={"type": "stokes", "nested": {"type": "path", "max_depth": 4}})
    plan = static(scene, max_depth="scene")
    assert (plan.variant, plan.integrator, plan.max_depth) == ("llvm_ad_mono_polarized", "transient_path", 4)
    assert plan.renderer()(seed=0, spp=1).transient.shape[:2] == (4, 1)


def test_light_between_smooth_surfaces():
    """Two polarizing reflections in a row change the intensity: carried when strict, and said when not."""
    one = plan_scenes.grey_room(wall={"type": "rectangle", "bsdf": {"type": "dielectric"}})
    assert static(one).variant == static(one, strict=True).variant == "llvm_ad_mono"
    assert not any("approximation" in line for line in static(one).reasons)
    several = {
        "curved": {"wall": {"type": "sphere", "bsdf": {"type": "dielectric"}}},
        "two": {
            "wall": {"type": "rectangle", "bsdf": {"type": "conductor", "material": "none"}},
            "extra": plan_scenes.hidden({"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}),
        },
    }
    for more in several.values():
        scene = plan_scenes.grey_room(**more)
        loose, strict = static(scene), static(scene, strict=True)
        assert loose.variant == "llvm_ad_mono"
        assert any(line.startswith("approximation") for line in loose.reasons)
        assert strict.variant == "llvm_ad_mono_polarized"
        assert not any(line.startswith("approximation") for line in strict.reasons)


# ------------------------------------------------------------------------------------------------------------ media

FOG = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}


def _mediums(tmp_path) -> dict:
    bottle = {"type": "obj", "filename": plan_scenes.cube_mesh(tmp_path), "bsdf": {"type": "null"}}
    sensor = plan_scenes.grey_room()["sensor"]
    inner = {**bottle, "interior": FOG}
    copy = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    density = {"type": "gridvolume", "grid": np.ones((2, 2, 2, 1))}
    cloud = {"type": "heterogeneous", "albedo": 0.5, "sigma_t": density}
    return {
        "in a mesh file": {"extra": inner},
        "by reference": {"fog": FOG, "extra": {**bottle, "interior": {"type": "ref", "id": "fog"}}},
        "in a group": {"group": {"type": "shapegroup", "inner": inner}, "copy": copy},
        "around the sensor": {"sensor": {**sensor, "medium": FOG}},
        "in glass": {"extra": {**bottle, "bsdf": {"type": "roughdielectric"}, "interior": cloud}},
    }


@pytest.mark.parametrize("where", ["in a mesh file", "by reference", "in a group", "around the sensor", "in glass"])
def test_a_medium_is_found(tmp_path, where):
    plan = static(plan_scenes.grey_room(**_mediums(tmp_path)[where]))
    assert plan.integrator == "transient_prbvolpath"
    assert any("medium" in line for line in plan.reasons)
    assert plan.variant == "llvm_ad_mono"


# -------------------------------------------------------------------------------------------------------------- XML


def test_parameters_and_includes_of_a_file(tmp_path):
    (tmp_path / "part.xml").write_text(
        '<scene version="3.0.0"><bsdf type="twosided" id="lens"><bsdf type="$kind"/></bsdf></scene>', encoding="utf-8"
    )
    inside = '<include filename="part.xml"/><shape type="sphere"><ref id="lens"/></shape>'
    file = tmp_path / "scene.xml"
    file.write_text(plan_scenes.xml_room(inside, '<default name="kind" value="diffuse"/>'), encoding="utf-8")
    assert static(str(file)).variant == "llvm_ad_mono"
    assert static(tt.load(file, kind="pplastic")).variant == "llvm_ad_mono_polarized"


# ------------------------------------------------------------------------------------------------ depth and overrides


def test_depth_follows_from_the_largest_albedo():
    plan = static(plan_scenes.grey_room(), tail=1e-3)
    assert plan.max_depth == 11  # ten bounces: 0.5^10 < 1e-3 <= 0.5^9, and one more segment
    white = plan_scenes.grey_room(
        extra=plan_scenes.hidden({"type": "twosided", "b": {"type": "diffuse", "reflectance": 0.9}})
    )
    assert static(white, tail=1e-2).max_depth == 45
    mirror = static(plan_scenes.grey_room(extra=plan_scenes.hidden({"type": "conductor", "material": "none"})))
    assert mirror.max_depth is None
    assert any("not bounded" in line for line in mirror.reasons)


def test_every_choice_can_be_taken_over():
    axis = tt.TimeAxis(1.0, 0.5, 7)
    plan = tt.plan(
        plan_scenes.grey_room(),
        pilot=False,
        variant="llvm_ad_rgb",
        integrator="transient_prbvolpath",
        max_depth=3,
        time_axis=axis,
        temporal_filter="tent",
    )
    chosen = (plan.variant, plan.integrator, plan.max_depth, plan.time_axis, plan.temporal_filter)
    assert chosen == ("llvm_ad_rgb", "transient_prbvolpath", 3, axis, "tent")
    assert sum("as asked for" in line for line in plan.reasons) == 5
    assert "llvm_ad_mono" in plan.reasons[0]  # what the plan itself would have taken
    renderer = plan.renderer()
    assert renderer.scene.variant == "llvm_ad_rgb"
    assert renderer.axis == axis
    assert renderer(seed=0, spp=1).stats.integrator == "transient_prbvolpath"
    assert plan.renderer(time_axis=tt.TimeAxis(0.0, 1.0, 2), temporal_filter="box").axis.num_bins == 2


def test_the_scene_s_own_axis_and_depth():
    plan = tt.plan(plan_scenes.grey_room(), pilot=False, time_axis="scene", max_depth="scene")
    assert plan.time_axis == tt.TimeAxis(7.0, 0.05, 64)
    assert plan.max_depth == 6


def test_temporal_filter_follows_the_parameters():
    scene = tt.load(plan_scenes.grey_room())
    assert static(scene, parameters=["wall.bsdf.reflectance.value"]).temporal_filter == "box"
    moving = static(scene, parameters=["wall.to_world"])
    assert moving.temporal_filter == "tent"
    assert moving.renderer().effective_filter == "tent"
    with pytest.raises(GradientError, match="slope"):
        static(scene, parameters=["wall.to_world"], temporal_filter="box")
    pulsed = static(scene, parameters=["wall.to_world"], pulse=tt.Pulse.gaussian(0.1))
    assert pulsed.temporal_filter == "box"
