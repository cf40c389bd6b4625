"""``transient_nlos_path`` against brute force, closed forms and itself."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_curves import file_of
from support.marks import long, long_rows
from support.nlos_scenes import captures, film, plane, ratio, scan_scene, side, transform, worst_of_blocks
from torchtransient.errors import SceneError

VARIANT = "llvm_ad_mono"
SIGMAS = 4.0
pytestmark = pytest.mark.usefixtures("no_leftovers")


def agree(a, b, most_error=0.01):
    value, error = ratio(a, b)
    assert error < most_error
    assert abs(value - 1) < SIGMAS * error
    # Blocks of few runs: errors of their errors are some 30 %.
    assert worst_of_blocks(a, b) < 2 * SIGMAS


HIDDEN = {
    "plane": lambda: {"a": plane()},
    "plane behind a plane": lambda: {"a": plane(), "b": plane(1.2)},
    "three sizes": lambda: {
        "a": plane(1.0, 0.8), "b": plane(0.8, 0.2, 0.3, 0.2, 0.3), "c": plane(1.4, 0.3, -0.6, 0, 0.9)},
    "a corner": lambda: {"a": plane(), "b": side()},
    "a ball before a plane": lambda: {
        "a": plane(1.3), "b": {"type": "sphere", "center": [0.1, 0, 0.9], "radius": 0.2}},
    "seen from both sides": lambda: {"a": plane(1.2) | {"bsdf": {"type": "twosided", "b": {"type": "diffuse"}}},
                                     "b": side() | {"bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}},
    "rough metal": lambda: {"a": plane() | {"bsdf": {"type": "roughconductor", "alpha": 0.4}}},
    "plastic": lambda: {"a": plane() | {"bsdf": {"type": "roughplastic", "alpha": 0.3}}, "b": side()},
}  # fmt: skip


MATRIX = [
    ("three sizes", "single"), ("a corner", "confocal"), ("a ball before a plane", "single"),
    ("seen from both sides", "confocal"), ("rough metal", "single"), ("plastic", "confocal"),
]  # fmt: skip


@pytest.mark.parametrize(("hidden", "kind"), long_rows(MATRIX, [("plastic", "confocal")]))
def test_hidden_geometry_sampling_is_unbiased(hidden, kind):
    """Paths that draw points over the hidden area, against paths that follow the BSDFs alone."""
    paths = {"third_bounce": "paths", "late_light": "paths"}
    guided = captures(scan_scene(HIDDEN[hidden](), kind, max_depth=5, **paths), 1024, 8)
    brute = captures(scan_scene(HIDDEN[hidden](), kind, max_depth=5, nlos_hidden_geometry_sampling=False), 4096, 8)
    agree(guided, brute, 0.02)


FACES = "v -0.5 -0.5 0.7\nv 0.5 -0.5 1.1\nv 0.5 0.5 1.3\nv -0.2 0.4 0.9\nf 1 3 2\nf 1 4 3\n"


def test_hidden_lights_are_found_by_points_that_are_drawn_as_well():
    """A connection to a light weighs how likely that point is drawn on the hidden area, of which triangle whatever."""
    lamp = {"type": "obj", "filename": file_of("lamp of two faces.obj", FACES), "face_normals": True,
            "emitter": {"type": "area", "radiance": 1.0}}  # fmt: skip
    given = {"laser": {"type": "projector"}, "nlos_laser_sampling": False, "max_depth": 3}
    axis = film(2, start=0.0, bins=60, width=0.2)
    guided, brute = (
        captures(scan_scene({"a": lamp}, "single", axis, nlos_hidden_geometry_sampling=on, **given), 2048, 8)
        for on in (True, False)
    )
    agree(guided, brute, 0.005)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "points"), [("confocal", 4), ("single", 4), ("exhaustive", 3)])
def test_shared_samples_are_paths(kind, points):
    """Light of three bounces from shared samples, with that of more bounces from paths, is all from paths."""
    hidden = {"a": plane(), "b": side(), "c": plane(0.8, 0.2, 0.3, 0.2, 0.3)}
    runs = [
        captures(scan_scene(hidden, kind, film(points, kind=kind), max_depth=5, third_bounce=how), 2048, 8)
        for how in ("shared", "paths")
    ]
    agree(*runs, 0.02)


def test_a_plane_behind_a_plane_adds_nothing():
    """Sampling without a test of visibility makes it 1.73 to 1.81 times too bright."""
    runs = [captures(scan_scene(HIDDEN[name]()), 2**14, 8) for name in ("plane behind a plane", "plane")]
    value, error = ratio(*runs)
    assert abs(value - 1) < 1e-3 and error < 3e-4


def test_a_plane_in_closed_form():
    """Single-corner light of a plane without end, K pi z^4 / 3 (r_a^-6 - r_b^-6) in each bin, by general paths."""
    axis = {"start": 2.0, "width": 0.05, "bins": 30}
    runs = captures(scan_scene({"a": plane(1.0, 30.0)}, film=film(1, **axis), third_bounce="paths"), 2**15, 8)
    K = 0.9**2 * 0.7 / np.pi**3
    r = (axis["start"] + axis["width"] * np.arange(axis["bins"] + 1)) / 2
    exact = np.pi * K / 3 * (r[:-1] ** -6.0 - r[1:] ** -6.0)
    bins = runs.reshape(8, -1)
    error = bins.std(0, ddof=1) / 8**0.5
    assert np.abs((bins.mean(0) - exact) / error).max() < 5
    assert bins.sum(1).mean() == pytest.approx(exact.sum(), rel=4 * (error.sum() / exact.sum()))


# ------------------------------------------------------------------------------------------- parameters of the paper


@pytest.mark.slow
def test_captures_contain_each_other():
    """The diagonal of an exhaustive capture is the confocal one, and a column the single one of its spot."""
    hidden = {"a": plane(), "b": side()}
    every = captures(scan_scene(hidden, "exhaustive", film(3, kind="exhaustive"), third_bounce="paths"), 4096, 6)
    every = every.reshape(6, 9, 9, 150, 1)
    confocal = captures(scan_scene(hidden, "confocal", film(3), third_bounce="paths"), 4096, 6)
    agree(every[:, range(9), range(9)].reshape(confocal.shape), confocal, 0.02)
    # The third position of the second row: u = 5/6, v = 1/2.
    single = captures(scan_scene(hidden, "single", film(3), spot=(1 / 3, 0, 0), third_bounce="paths"), 4096, 6)
    agree(every[:, :, 5].reshape(single.shape), single, 0.02)


def test_first_and_last_leg():
    """They shift every arrival by the distances from laser to spot and from point to sensor, and change no energy."""
    axis = {"width": 1e-3, "bins": 4000, "points": 1}
    plate = {"a": plane(1.0, 0.02)}
    spot = np.array([-0.2, 0.1, 0.0])
    runs = [
        captures(scan_scene(plate, "single", film(start=1.0, **axis), tuple(spot), third_bounce="paths",
                            account_first_and_last_bounces=legs), 4096, 1)[0].reshape(-1)
        for legs in (False, True)
    ]  # fmt: skip
    times = [1.0 + 1e-3 * (np.arange(4000) + 0.5) @ run / run.sum() for run in runs]
    origin = np.array([-0.5, 0.0, 0.25])
    legs = np.linalg.norm(spot - origin) + np.linalg.norm(origin)
    assert runs[0].sum() == pytest.approx(runs[1].sum(), rel=1e-4)
    assert times[1] - times[0] == pytest.approx(legs, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("laser_sampling", long([True, False], [True]))
def test_bounces_are_counted_as_they_are_named(laser_sampling):
    """``filter_bounces = b`` keeps light of b bounces, the laser's spot the first of them."""
    hidden = {"a": plane(), "b": side()}
    # Without laser sampling a light of some size is needed that paths can find: a small lamp at the wall.
    lamp = {"type": "spot", "intensity": 5.0, "cutoff_angle": 30.0}
    base = {"nlos_laser_sampling": laser_sampling, "third_bounce": "paths"}
    if not laser_sampling:
        base["nlos_hidden_geometry_sampling"] = False
    laser = None if laser_sampling else lamp
    longest = 4 if laser_sampling else 5

    def run(**settings):
        return captures(scan_scene(hidden, "single", laser=laser, **(base | settings)), 4096, 4)

    # No path of one bounce ends at a spot, and a flat wall does not light itself.
    every = (3, 4) if laser_sampling else (1, 2, 3, 4)
    parts = [run(max_depth=longest, filter_bounces=b) for b in every]
    if not laser_sampling:
        value, error = ratio(sum(parts), run(max_depth=longest))
        assert abs(value - 1) < SIGMAS * error + 1e-6
    later = run(max_depth=longest, min_bounces=3)
    value, error = ratio(parts[-2] + parts[-1], later)
    assert abs(value - 1) < SIGMAS * error + 1e-6
    assert parts[-2].sum() > 0 and parts[-1].sum() > 0
    depth = 3 if laser_sampling else 4
    assert run(max_depth=longest, filter_depth=depth).sum() == pytest.approx(parts[-2].sum(), rel=1e-5)


def test_every_point_is_distinct():
    """For every size of a grid each pixel looks at a place of its own, the middle of its cell."""
    for width, height in ((1, 1), (2, 3), (7, 5), (33, 1), (180, 130)):
        scene = mi.load_dict(scan_scene({"a": plane()}, film=film() | {"width": width, "height": height}))
        sensor = scene.sensors()[0]
        points = np.array(sensor.targets(mi.UInt32(np.arange(width * height, dtype=np.uint32)))).T
        x = (np.arange(width) + 0.5) / width - 0.5
        y = (np.arange(height) + 0.5) / height - 0.5
        expected = np.stack([*np.meshgrid(x, y), np.zeros((height, width))], -1).reshape(-1, 3)
        assert np.abs(points - expected).max() < 1e-6
        assert len(np.unique(points.round(6), axis=0)) == width * height


@pytest.mark.slow
def test_a_projector_is_a_laser():
    """Mitsuba's projector lights its spot as mitransient says: irradiance pi / d^2 over a square metre."""
    projector = {"type": "projector", "irradiance": 2.0, "fov": 0.2}
    spot = np.array([-0.2, 0.1, 0.0])
    for how in ("shared", "paths"):
        lit = captures(
            scan_scene({"a": plane()}, "single", spot=tuple(spot), laser=projector, third_bounce=how), 4096, 1
        )
        beam = captures(scan_scene({"a": plane()}, "single", spot=tuple(spot), third_bounce=how), 4096, 1)
        to = spot - np.array([-0.5, 0.0, 0.25])
        d = np.linalg.norm(to)
        expected = 2.0 * np.pi / d**2 * abs(to[2]) / d
        assert lit.sum() / beam.sum() == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_a_curved_wall_lights_itself():
    """Light of two bounces runs from wall to wall, and hidden light comes back by way of it."""
    wall = {"type": "sphere", "center": [0, 0, 2.0], "radius": 2.05, "flip_normals": True}
    points = np.stack([*np.meshgrid([-0.3, 0.0, 0.3], [-0.3, 0.3]), np.full((2, 3), -0.01)], -1)
    points[..., 2] = 2 - np.sqrt(2.05**2 - points[..., 0] ** 2 - points[..., 1] ** 2)

    def run(spp, **settings):
        scene = scan_scene({"a": plane(1.0, 0.6)}, "confocal", film(start=0.0, bins=200) | {"width": 3, "height": 2},
                           wall=dict(wall), max_depth=4, **settings)  # fmt: skip
        scene["wall"]["sensor"] |= {"points": mi.TensorXf(points.astype(np.float32)), "sensor_origin": [0, 0, 0.4]}
        scene["laser"]["to_world"] = transform().look_at([0, 0, 0.4], [0.2, 0.1, -0.03], [0, 1, 0])
        return captures(scene, spp, 8)

    brute = run(2**14, nlos_hidden_geometry_sampling=False)
    for how in ("shared", "paths"):
        agree(run(2048, third_bounce=how), brute, 0.03)


# -------------------------------------------------------------------------------------------------- kinds of light


@pytest.mark.slow
def test_media_behind_the_corner():
    """Fog before a plane: guided paths against paths that follow BSDFs and phase functions."""
    fog = {
        "type": "cube", "to_world": transform().translate([0, 0, 0.7]).scale([0.4, 0.4, 0.15]),
        "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 1.5, "albedo": 0.8},
    }  # fmt: skip
    runs = [
        captures(scan_scene({"a": plane(), "fog": fog}, "confocal", film(3, start=0.8), max_depth=5,
                            nlos_hidden_geometry_sampling=guided), spp, 8)
        for guided, spp in ((True, 2048), (False, 8192))
    ]  # fmt: skip
    agree(*runs, 0.04)


@pytest.mark.slow
def test_polarized_light_of_diffuse_surfaces():
    """Grey things look the same as without polarization, of which they leave none."""
    hidden = {"a": plane(), "b": side()}
    grey = captures(scan_scene(hidden, max_depth=4), 2048, 4)
    mi.set_variant("llvm_ad_mono_polarized")
    runs = captures(scan_scene(hidden, max_depth=4), 2048, 4)
    assert runs.shape[-1] == 4
    assert np.abs(runs[..., 1:]).max() < 1e-6 * runs[..., 0].max()
    value, error = ratio(runs[..., 0], grey[..., 0])
    assert abs(value - 1) < SIGMAS * error


@pytest.mark.slow
def test_polarized_light_of_a_glossy_surface():
    """What a metal plate sends back is polarized, and its power is that of the same scene without polarization."""
    plate = {"a": plane(1.0, 0.6, 0.4) | {"bsdf": {"type": "roughconductor", "alpha": 0.3, "material": "Al"}}}
    plain = captures(scan_scene(plate, "single", film(2)), 2**13, 6)
    mi.set_variant("llvm_ad_mono_polarized")
    stokes = captures(scan_scene(plate, "single", film(2)), 2**13, 6)
    agree(stokes[..., :1], plain, 0.02)


# ---------------------------------------------------------------------------------------------------------- errors

WRONG = {
    "capture_type": ({"capture_type": "confokal"}, "single, confocal, exhaustive or pairs"),
    "a film for pairs": ({"capture_type": "exhaustive"}, "exhaustive_scan = true"),
    "two filters": ({"filter_bounces": 3, "filter_depth": 4}, "give one"),
    "a filter that leaves nothing": ({"filter_bounces": 4}, "max_depth"),
    "min_bounces that leaves nothing": ({"min_bounces": 4}, "black"),
    "a filter of what is left out": ({"filter_bounces": 1, "discard_direct_paths": True}, "discard_direct_paths"),
    "camera_unwarp": ({"camera_unwarp": True}, "account_first_and_last_bounces"),
    "shares without guides": ({"third_bounce": "shared", "nlos_hidden_geometry_sampling": False}, "third_bounce"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_parameters(name):
    settings, words = WRONG[name]
    with pytest.raises((SceneError, RuntimeError), match=words):
        captures(scan_scene({"a": plane()}, film=film(), **settings), 4, 1)


FOG = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
INSTANCE = {
    "group": {"type": "shapegroup", "inner": {"type": "rectangle"}},
    "copy": {"type": "instance", "ref": {"type": "ref", "id": "group"}},
}
HALF = {"type": "mask", "opacity": 0.5, "b": {"type": "diffuse"}}
NOT_SHARED = {
    "metal": (lambda: {"b": plane(0.8, 0.3) | {"bsdf": {"type": "conductor"}}}, "not all surfaces are diffuse"),
    "a mask": (lambda: {"b": plane() | {"bsdf": HALF}}, "mixtures"),
    "fog": (lambda: {"b": FOG}, "media"),
    "instances": (lambda: INSTANCE, "cannot be drawn on copy"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", NOT_SHARED)
def test_what_cannot_be_shared_says_why(name):
    """It is an error where it was asked for; otherwise the same reason leaves it to paths."""
    make, words = NOT_SHARED[name]
    with pytest.raises(SceneError, match=words):
        captures(scan_scene({"a": plane()} | make(), third_bounce="shared"), 4, 1)
    if name == "fog":
        assert captures(scan_scene({"a": plane()} | make()), 64, 1).sum() > 0


def test_variants_that_cannot_be_shared():
    mi.set_variant("llvm_ad_mono_polarized")
    with pytest.raises(SceneError, match="llvm_ad_mono_polarized"):
        captures(scan_scene({"a": plane()}, third_bounce="shared"), 4, 1)


def test_a_beam_is_seen_by_its_own_integrator_alone():
    scene = scan_scene({"a": plane()})
    scene["integrator"] = {"type": "transient_path"}
    with pytest.raises(SceneError, match="laser_beam"):
        captures(scene, 4, 1)


def test_lasers_that_miss_or_are_two():
    scene = scan_scene({"a": plane()}, "single")
    scene["laser"]["to_world"] = transform().look_at([-0.5, 0, 0.25], [-5, 0, 0.25], [0, 1, 0])
    with pytest.raises(SceneError, match="laser meets nothing"):
        captures(scene, 4, 1)
    with pytest.raises(SceneError, match="one emitter"):
        captures(scan_scene({"a": plane(), "other": {"type": "laser_beam"}}), 4, 1)


def test_nothing_is_hidden():
    with pytest.raises(SceneError, match="expected a surface to draw points on"):
        captures(scan_scene({}), 4, 1)
