"""Values of augmented samples are true: what the library knows to be a place is refused, and all that is not known."""

from __future__ import annotations

import inspect

import mitsuba as mi
import numpy as np
import pytest
import torch
from kornia.augmentation import RandomAffine, RandomRotation

from support.sweeps import together
from tools.every_plugin import every_plugin
from torchtransient import plugins
from torchtransient.data import Affine, Augment, Crop, Flip, PixelMap, QuarterTurn
from torchtransient.data.scene_values import OF_DEVICES, UNAFFECTED, stays_true
from torchtransient.errors import SceneError
from torchtransient.plugins.parameter_effect import ANY_KEY, all_rows
from torchtransient.plugins.parameters import ParameterTracker, can_carry_gradients
from torchtransient.sensing.devices import KINDS

N = 6
OPERATIONS = {
    "flip": Flip(p=1.0),
    "turn": QuarterTurn(1),
    "crop": Crop((3, 3), (0, 1)),
    "shift": Affine(RandomAffine(0.0, (0.2, 0.2), p=1.0)),
    "tilt": Affine(RandomRotation((20.0, 20.0), p=1.0)),
    "zoom": Affine(RandomAffine(0.0, scale=(1.5, 1.5), p=1.0)),
}
NEVER, ALWAYS = "", " ".join(OPERATIONS)
CAMERA_STAYS = "crop shift zoom"
WORLD_STAYS = f"turn tilt {CAMERA_STAYS}"
# key -> under which operations it stays; what the camera is called is not said
STAYS = {
    **dict.fromkeys(
        ("box.bsdf.reflectance.value", "red.reflectance.data", "lamp.emitter.radiance.value", "light.intensity.value",
         "metal.alpha.value", "metal.eta.value", "glass.eta", "glass.int_ior", "glow.lifetime", "ball.radius",
         "fog.sigma_t.value.value", "fog.albedo.data", "fog.phase_function.g", "tiles.reflectance.color0.value",
         "cam.aperture_radius", "sky.turbidity", "skin.specular", "device.PhotonBudget.ambient_rate_hz"),
        ALWAYS,
    ),
    **dict.fromkeys(
        ("sky.sun_direction", "beads.data", "map.data", "pol.theta.value", "pol.left_handed", "light.position",
         "ball.center", "box.vertex_positions", "hair.control_points", "bumps.normalmap.data", "flakes.S.data",
         "beamer.irradiance.data", "sdf.grid", "letter.filename", "wall.bsdf", "paint.value", "albedo.data"),
        WORLD_STAYS,
    ),
    **dict.fromkeys(("box.to_world", "cam.to_world", "sensor.to_world"), CAMERA_STAYS),
    **dict.fromkeys(("cam.x_fov", "sensor.fov"), "flip turn shift tilt"),
    "cam.principal_point_offset_x": NEVER,
    **dict.fromkeys(
        ("cam.film.crop_offset", "meter.sensor.points", "scene", "scan", "letter", "$pose", "box.unheard_of", "sensor",
         "device.LensBlur.fwhm_px", "device.linear_analyzers.angles_deg", "to_world", "reflectance"),
        NEVER,
    ),
}  # fmt: skip


def augmented(operation, key, **options):
    sample = {"depth": torch.ones(N, N), "values": {key: torch.ones(3)}}
    return Augment(operation, **options)(sample)


@together("key", STAYS)
@together("name", OPERATIONS)
def test_what_stays(key, name):
    if name in STAYS[key].split():
        assert augmented(OPERATIONS[name], key)["values"][key].tolist() == [1, 1, 1]
    else:
        with pytest.raises(SceneError, match="is not true of the augmented sample, or is not known to be"):
            augmented(OPERATIONS[name], key)
    assert augmented(OPERATIONS[name], key, kept_values=[key])["values"][key].tolist() == [1, 1, 1]


@together(
    "key, stays",
    {
        "cam.to_world": f"flip {CAMERA_STAYS}", "box.to_world": WORLD_STAYS, "box.unheard_of": WORLD_STAYS,
        "cam.unheard_of": NEVER, "other.film.size": NEVER, "other.x_fov": "flip turn shift tilt",
        "camera.to_world": WORLD_STAYS, "left.sensor.to_world": f"flip {CAMERA_STAYS}", "cam": NEVER,
    }.items(),
)  # fmt: skip
def test_where_the_camera_is_named(key, stays):
    for name, operation in OPERATIONS.items():
        if name in stays.split():
            augmented(operation, key, sensor=["cam", "left.sensor"])
        else:
            with pytest.raises(SceneError, match="is not true"):
                augmented(operation, key, sensor=["cam", "left.sensor"])


def test_values_that_are_none():
    augment = Augment(Flip(p=1.0))
    assert augment({"depth": torch.ones(2, 2), "values": None})["values"] is None
    with pytest.raises(SceneError, match="values as a dictionary"):
        augment({"depth": torch.ones(2, 2), "values": [3.0]})
    # Nothing is drawn: nothing is false.
    assert augmented(Flip(p=0.0), "box.to_world")["values"]["box.to_world"].tolist() == [1, 1, 1]


# ------------------------------------------------------------------------------------- against the table of parameters

FLIPPED = PixelMap(np.diag([-1.0, 1, 1]), (N, N), (N, N))
WINDOW = PixelMap(np.eye(3), (N, N), (3, 3))
TURNED = QuarterTurn(1).draw((N, N), None)
PLACES = ("shape", "normal", "emitter", "sun", "sensor")
# The disk of a lens and where it focuses are the same in a mirror and in a window.
OF_A_LENS = {"aperture_radius", "focus_distance"}
# What moves nothing and is refused in a mirror all the same: frames and directions, and what lies in them.
REFUSED = (
    "theta.value", "normalmap.data", "nested_texture.data", "texture.data", "irradiance.data", "S.data",
    "vertex_texcoords", "opacities", "extent", "scale_tilt", "latitude", "longitude", "timezone", "year", "month",
    "day", "hour", "minute", "second", "window_start_time", "window_end_time", "linear", "angular", "center",
)  # fmt: skip
# And textures that stand alone: the name does not tell of what they are one.
ALONE = ("data", "value", "values", "color0.value", "color1.value", "volume.data", "value.value")


def test_no_name_that_stays_is_a_place_in_the_table():
    for cls, key, row in all_rows():
        if row.effect.role in PLACES and key not in OF_A_LENS | {ANY_KEY}:
            assert key not in UNAFFECTED, f"{cls}.{key}"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:phasor_hdr_film:torchtransient.errors.TorchTransientWarning")
def test_every_parameter_of_every_plugin(tmp_path):
    """No place stays in a mirror, nothing of a camera in a window and a turn, and what moves nothing stays in all."""
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()
    met = set()
    for name, description in every_plugin(tmp_path).items():
        plugin = mi.load_dict(description)
        tracker = ParameterTracker(plugin)
        for key, (handle, cpptype, node, flags) in mi.traverse(plugin).properties.items():
            value = handle if cpptype is None else mi.get_property(handle, cpptype, node)
            role, last = tracker.effect_of(node, key, flags).role, key.rsplit(".", 1)[-1]
            in_scene = f"thing.{key}"
            if role in PLACES and last not in OF_A_LENS:
                met.add(role)
                # An angle of view is one from the left, too.
                assert last == "x_fov" or not stays_true(in_scene, FLIPPED, ()), f"{name}: {key}"
                if role == "sensor":
                    assert last == "to_world" or not stays_true(in_scene, WINDOW, ()), f"{name}: {key}"
                    assert last == "x_fov" or not stays_true(in_scene, TURNED, ()), f"{name}: {key}"
                else:
                    assert stays_true(in_scene, TURNED, ("sensor",)) or ".sensor." in in_scene, f"{name}: {key}"
            elif can_carry_gradients(value):
                refused = key in ALONE or key.endswith(REFUSED)
                for drawn in (FLIPPED, WINDOW, TURNED):
                    assert refused or stays_true(in_scene, drawn, ()), f"{name}: {key}"
                assert not refused or not stays_true(in_scene, FLIPPED, ()), f"{name}: {key}"
    assert met == set(PLACES) - {"normal"}


# Tensors, maps of pixels, directions, sizes in pixels, and what belongs to how a device is written down.
NOT_NUMBERS_OF_A_DEVICE = {
    "axis", "bin_width_s", "grad", "learnable", "oversampling", "boundary", "method", "border", "size", "within_bin",
    "rows", "codes", "counts", "align", "gain_map", "offset_map_e", "angles_deg", "responses", "response",
    "code", "optics", "diagonal_ratio", "fwhm_px", "spatial_fwhm_px", "phosphor_fwhm_px", "code_widths",
    "sliding_scale", "dither", "num_bins", "seed", "values", "harmonics_of_one_tap", "num_taps", "num_codes",
    "albedo", "illumination", "gates", "knots", "shifts", "make", "stages", "psf", "radius_px", "numbers", "height",
    "width", "samples", "closed", "acts_on", "args", "kwargs", "calibration", "depth_map_m", "direction",
    "phase_map_rad",
    "phase_offset_rad", "start_s", "afterpulsing", "columns", "delays", "detector", "sensors", "weights", "which",
    "chirps", "window",
}  # fmt: skip


def test_maps_of_a_device_are_no_numbers():
    """One efficiency for all pixels stays true of a turned image, one for each pixel does not."""
    key = "device.PhotonBudget.quantum_efficiency"

    def turned(value, **options):
        return Augment(Flip(p=1.0), **options)({"depth": torch.ones(2, 2), "values": {key: value}})

    for number in (0.3, np.float32(0.3), torch.tensor([0.3, 0.4])):
        turned(number)
    for image in (torch.rand(2, 2), np.ones((1, 2, 2))):
        with pytest.raises(SceneError, match="quantum_efficiency"):
            turned(image)
        turned(image, kept_values=[key])


def test_every_argument_of_a_device_is_known():
    arguments = {name for made in KINDS.values() for name in inspect.signature(made).parameters}
    assert not OF_DEVICES & NOT_NUMBERS_OF_A_DEVICE
    assert arguments == OF_DEVICES | NOT_NUMBERS_OF_A_DEVICE
