"""Values of augmented samples are true: what the library knows to be a place is refused, and all that is not known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.augmentation import RandomAffine, RandomRotation

from support.sweeps import together
from torchtransient.data import Affine, Augment, Crop, Flip, QuarterTurn
from torchtransient.data.augmented_values import OF_THE_WORLD, UNAFFECTED
from torchtransient.errors import SceneError
from torchtransient.plugins.parameter_effect import ANY_KEY, all_rows

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
    # Nothing is drawn: nothing is false.
    assert augmented(Flip(p=0.0), "box.to_world")["values"]["box.to_world"].tolist() == [1, 1, 1]


def test_no_name_that_stays_is_a_place_in_the_table_of_parameters():
    """But for the disk of a lens and where it focuses, which are the same in a mirror and in a window."""
    for cls, key, row in all_rows():
        if key not in ("aperture_radius", "focus_distance", ANY_KEY):
            assert row.effect.role not in ("shape", "normal", "emitter", "sun") or key not in UNAFFECTED, f"{cls}.{key}"
            assert row.effect.role != "sensor" or key not in UNAFFECTED | OF_THE_WORLD, f"{cls}.{key}"


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
