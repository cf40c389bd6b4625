"""Scenes whose bodies have velocities, and readings of their rates, for tests of films of rates."""

from __future__ import annotations

import torch

import torchtransient as tt
from torchtransient.scenes import look_at, scale

RATES = tt.RateAxis(-10.0, 0.25, 80)
AXIS = tt.TimeAxis(0.0, 0.1, 100)
VARIANT = "llvm_ad_mono"
LAMP = {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1.0}


def plate(center, towards, half=1.0, bsdf=None, up=(0, 1, 0), **more):
    """A square of albedo 0.5 that faces a point."""
    matrix = look_at(center, towards, up) @ scale(half)
    return {"type": "rectangle", "to_world": matrix, "bsdf": bsdf or {"type": "diffuse", "reflectance": 0.5}, **more}


def scene(size=1, fov=0.02, depth=2, kind="transient_path", sampler="independent", **nodes):
    """A camera at the origin that looks along z; a lamp beside it unless another one is given."""
    film = {"type": "transient_hdr_film", "width": size, "height": size, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": fov, "near_clip": 1e-3, "film": film,
              "to_world": look_at((0, 0, 0), (0, 0, 1)), "sampler": {"type": sampler}}  # fmt: skip
    integrator = {"type": kind, "max_depth": depth, "rr_depth": 99}
    return {"type": "scene", "integrator": integrator, "sensor": camera, "lamp": LAMP, **nodes}


def rates_of(description, motions=None, variant=VARIANT, spp=256, seed=0, axis=AXIS, rates=RATES):
    """Light by rate and length of a scene with motions: float64 (R, T, H, W) of the first channel."""
    loaded = description if isinstance(description, tt.Scene) else tt.load(description, variant=variant)
    if motions:
        loaded = loaded.moving(motions)
    renderer = tt.TransientRenderer(loaded, rates=rates, time_axis=axis, temporal_filter="tent", spp=spp)
    out = renderer(seed=seed).rates
    return out.reshape(-1, *out.shape[-4:])[0].double()


def mean_rate(light, rates=RATES):
    """Mean rate of each pixel, (H, W), m/s. A tent keeps the mean of what is inside of the axis."""
    by_rate = light.sum(1)
    return (by_rate * rates.centers[:, None, None]).sum(0) / by_rate.sum(0)


def mean_length(light, axis=AXIS):
    """Mean optical path length of each pixel, (H, W), metres."""
    by_length = light.sum(0)
    return (by_length * axis.centers_opl[:, None, None]).sum(0) / by_length.sum(0)


def close(found, expected, tolerance=1e-4):
    """Return True where all numbers agree to the tolerance."""
    return bool((torch.as_tensor(found) - torch.as_tensor(expected)).abs().max() < tolerance)


def hidden_plate(kind, points=4):
    """A capture around a corner of a plate that faces the relay wall askew: (description, its centre, its normal)."""
    origin, spot, center = (-0.5, 0.0, 0.25), (-0.2, 0.1, 0.0), (0.1, 0.05, 1.0)
    normal = (0.2, 0.1, -1.0)
    film = {"type": "transient_hdr_film", "width": points, "height": points, "rfilter": {"type": "box"}}
    meter = {"type": "nlos_capture_meter", "sensor_origin": list(origin), "film": film}
    wall = {"type": "rectangle", "to_world": scale([0.5, 0.5, 1.0]), "sensor": meter,
            "bsdf": {"type": "diffuse", "reflectance": 0.9}}  # fmt: skip
    integrator = {"type": "transient_nlos_path", "capture_type": kind, "max_depth": 3,
                  "nlos_laser_sampling": True, "nlos_hidden_geometry_sampling": True}  # fmt: skip
    towards = tuple(c + n for c, n in zip(center, normal, strict=True))
    description = {"type": "scene", "integrator": integrator, "wall": wall,
                   "laser": {"type": "laser_beam", "to_world": look_at(origin, spot)},
                   "hidden": plate(center, towards, half=0.3)}  # fmt: skip
    return description, center, normal
