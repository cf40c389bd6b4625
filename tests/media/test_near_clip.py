"""A medium around a camera reaches to the camera itself: its near clip plane hides surfaces, and nothing of the fog."""

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.accuracy import z_test
from torchtransient.scenes import scale, translate

VARIANT = "llvm_ad_mono"
# Metres from the camera: a black shield that is clipped away, the clip plane, a lamp without end.
SHIELD, CLIP, LAMP = 0.5, 1.0, 2.0
AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.1, num_bins=400)


def facing(distance, size):
    """A square that faces the camera."""
    return translate((0, 0, distance)) @ scale((-size, size, -1))


def scene(sensor, sigma_t, albedo, max_depth, **objects):
    """Objects in fog that fills everything, before a camera in the origin that looks along z."""
    kind = "homogeneous" if isinstance(sigma_t, float) else "heterogeneous"
    camera = {
        "type": sensor, "near_clip": CLIP, "to_world": np.eye(4), "medium": {"type": "ref", "id": "fog"},
        "film": {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}},
    }  # fmt: skip
    return tt.load(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": max_depth},
            "fog": {"type": kind, "albedo": albedo, "sigma_t": sigma_t},
            "sensor": camera if sensor == "orthographic" else camera | {"fov": 2.0},
            "shield": {"type": "rectangle", "to_world": facing(SHIELD, 0.2), "bsdf": {"type": "diffuse"}},
        }
        | objects,
        variant=VARIANT,
    )


def grid(sigma_t):
    cells = np.full((2, 2, 2, 1), sigma_t, dtype=np.float32)
    place = translate((-20, -20, -20)) @ scale(40.0)
    return {"type": "gridvolume", "data": cells, "raw": True, "to_world": place}


def render(scene, keys=(), spp=1024, count=6):
    """Independent (steady image, mean arrival, derivative of the image by the sum of every key), in the mean over the
    pixels.
    """
    renderer = tt.TransientRenderer(scene, parameters=list(keys), time_axis=AXIS, spp=spp)
    values, arrivals, slopes = [], [], []
    for seed in range(count):
        out = renderer(seed=seed)
        values.append(out.steady.mean().item())
        light = out.transient.detach().sum((0, 2, 3)).double()
        arrivals.append(float((light * AXIS.centers_opl).sum() / light.sum()))
        if keys:
            slopes.append(torch.autograd.grad(out.steady.mean(), [renderer.values[key] for key in keys]))
    return np.array(values), np.array(arrivals), slopes


@pytest.mark.parametrize(
    ("sensor", "sigma_t", "key", "moves"),
    [
        ("perspective", 1.0, "fog.sigma_t.value.value", False),
        pytest.param("perspective", 1.0, "fog.sigma_t.value.value", True, marks=pytest.mark.slow),
        pytest.param("orthographic", grid(1.0), "fog.sigma_t.data", True, marks=pytest.mark.soak),
    ],
)
def test_light_is_attenuated_up_to_the_camera(sensor, sigma_t, key, moves):
    """exp(-2) after two metres of fog of 1 / m, a metre of which lies before the clip plane; it falls by twice that
    with the extinction, and by once with a step back of the camera. An open boundary lies on the way.
    """
    described = scene(
        sensor, sigma_t, 0.0, 2,
        lamp={"type": "rectangle", "to_world": facing(LAMP, 9.0), "emitter": {"type": "area", "radiance": 1.0}},
        window={
            "type": "rectangle", "to_world": facing(1.5, 9.0), "bsdf": {"type": "null"},
            "interior": {"type": "ref", "id": "fog"}, "exterior": {"type": "ref", "id": "fog"},
        },
    )  # fmt: skip
    values, arrivals, slopes = render(described, [key, "sensor.to_world"] if moves else [key])
    # Angles of the view: path lengths differ by less than a thousandth.
    assert z_test(values, np.exp(-LAMP), rounding=1e-3).passed
    np.testing.assert_allclose(arrivals, LAMP, atol=0.06)
    derivatives = [([float(slope[0].sum()) for slope in slopes], -LAMP * np.exp(-LAMP))]
    if moves:
        derivatives.append(([float(slope[1][2, 3]) for slope in slopes], np.exp(-LAMP)))
    for found, expected in derivatives:
        result = z_test(np.array(found), expected, rounding=1e-3)
        assert result.passed, (str(result), np.mean(found), expected)


def test_fog_scatters_light_before_the_clip_plane():
    """White fog in light from all sides is as bright as the light, wherever a clip plane lies."""
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    inside = {"type": "ref", "id": "fog"}
    described = scene(
        "perspective", 1.0, 1.0, 40,
        sky={"type": "constant", "radiance": 1.0},
        room={"type": "cube", "to_world": scale(1.5), "bsdf": {"type": "null"}, "interior": inside},
        shield={"type": "rectangle", "to_world": facing(SHIELD, 0.2), "bsdf": white},
    )  # fmt: skip
    values, _, _ = render(described)
    result = z_test(values, 1.0)
    assert result.passed, (str(result), values.mean())


def test_a_batch_has_fog_before_the_clip_planes_of_its_cameras():
    """Beside a radiance meter, which has no clip plane, in one batch."""
    fog = {"type": "ref", "id": "fog"}
    film = {"type": "hdrfilm", "height": 2, "rfilter": {"type": "box"}}
    one = film | {"width": 1, "height": 1}
    described = tt.load(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 2},
            "fog": {"type": "homogeneous", "albedo": 0.0, "sigma_t": 1.0},
            "sensor": {
                "type": "batch", "medium": fog, "film": film | {"width": 4},
                "camera": {"type": "perspective", "fov": 2.0, "near_clip": CLIP, "to_world": np.eye(4), "film": one},
                "meter": {"type": "radiancemeter", "to_world": np.eye(4), "film": one},
            },
            "lamp": {"type": "rectangle", "to_world": facing(LAMP, 9.0), "emitter": {"type": "area", "radiance": 1.0}},
        },
        variant=VARIANT,
    )  # fmt: skip
    renderer = tt.TransientRenderer(described, time_axis=AXIS, spp=1024)
    images = torch.stack([renderer(seed=seed).steady[0] for seed in range(6)]).double().numpy()
    for columns in ((0, 1), (2, 3)):
        result = z_test(images[..., columns].mean((1, 2)), np.exp(-LAMP), rounding=1e-3)
        assert result.passed, str(result)
