"""A bottle of diluted milk with a laser in it: the scene in which light was first filmed on its way. Metres."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import finite, positive
from torchtransient.errors import UnitError
from torchtransient.scenes.parts import SceneDict, checked_depth, diffuse, perspective, transient_film
from torchtransient.scenes.transforms import look_at, rotate, scale, translate

# Radius and height of the bottle's outline from the middle of its base to the middle of its lid.
PROFILE = (
    (0.0, 0.000), (0.030, 0.000), (0.0335, 0.0015), (0.035, 0.005), (0.035, 0.095), (0.0335, 0.107), (0.029, 0.119),
    (0.0215, 0.132), (0.0155, 0.144), (0.013, 0.155), (0.013, 0.178), (0.0125, 0.1795), (0.0115, 0.180), (0.0, 0.180),
)  # fmt: skip
# A little milk in water, 1/m for `milk=1`: blue light scatters more, red light is absorbed more by the water.
SCATTERING = (4.6, 5.5, 6.7)
ABSORPTION = (0.30, 0.06, 0.03)
# Mitsuba takes colours of at most one here: the extinction is kept in this unit, 1/m.
EXTINCTION_UNIT = 40.0
LASER_RADIUS = 0.004


def lathe(profile: NDArray[np.float64], segments: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return a surface of revolution about the y axis, normals outward.

    Args:
        profile: (N, 2), radius and height from one pole (radius 0) to the other, going up.
        segments: corners of a ring, at least three.

    Returns:
        Vertices (V, 3) and triangles (F, 3).
    """
    angle = 2 * math.pi * np.arange(segments) / segments
    rings = profile[1:-1]
    across, up = rings[:, :1], np.repeat(rings[:, 1:], segments, axis=1)
    ring_points = np.stack([across * np.cos(angle), up, across * np.sin(angle)], axis=-1).reshape(-1, 3)
    low, high = len(ring_points), len(ring_points) + 1
    vertices = np.concatenate([ring_points, [[0.0, profile[0, 1], 0.0], [0.0, profile[-1, 1], 0.0]]])
    here, there = np.arange(segments), (np.arange(segments) + 1) % segments
    faces = [np.stack([np.full(segments, low), here, there], axis=1)]
    for ring in range(len(rings) - 1):
        a, b = ring * segments, (ring + 1) * segments
        faces.append(np.stack([a + here, b + here, b + there], axis=1))
        faces.append(np.stack([a + here, b + there, a + there], axis=1))
    last = (len(rings) - 1) * segments
    faces.append(np.stack([last + here, np.full(segments, high), last + there], axis=1))
    return vertices.astype(np.float32), np.concatenate(faces).astype(np.int32)


def write_ply(path: Path, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
    """Write a triangle mesh as a binary PLY file; the folder is made.

    Args:
        path: place of the file.
        vertices: (V, 3).
        faces: (F, 3).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(head.encode() + np.ascontiguousarray(vertices, dtype="<f4").tobytes() + rows.tobytes())


def _smooth(profile: tuple[tuple[float, float], ...], rounds: int) -> NDArray[np.float64]:
    """The outline with its corners cut (Chaikin's scheme); the two poles stay where they are."""
    points = np.array(profile)
    for _ in range(rounds):
        low, high = 0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]
        points = np.concatenate([points[:1], np.stack([low, high], axis=1).reshape(-1, 2)[1:-1], points[-1:]])
    return points


def milk_bottle(
    mesh: str | Path,
    *,
    resolution: int | tuple[int, int] = (96, 160),
    num_bins: int = 160,
    start_opl: float = 0.0,
    bin_width_opl: float = 0.004,
    spp: int = 256,
    max_depth: int = 24,
    roughness: float = 0.05,
    index: float = 1.33,
    milk: float = 2.5,
    anisotropy: float = 0.7,
    beam_degrees: float = 8.0,
) -> SceneDict:
    """Return a bottle of water with a little milk on a table, and a laser that shines up from its base.

    The bottle is one rough dielectric boundary around the liquid, which fills it. The film counts times from the laser
    to the bottle's surface (`camera_unwarp`): a picture of the bottle shows events when they happen, as the photographs
    of Velten et al. (2013) do after unwarping. The laser is a disk inside of the liquid, just above the base, since
    lights cannot be connected to through a rough boundary; and not a point, near which scattered light has no bound.

    Args:
        mesh: path of the .ply that the bottle is written to.
        resolution: one side in pixels, or (width, height).
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
        roughness: roughness of the boundary, `alpha` of `roughdielectric`.
        index: relative index of refraction of the liquid.
        milk: factor of the liquid's scattering.
        anisotropy: mean cosine g.
        beam_degrees: half opening angle of the beam, degrees.

    Returns:
        Scene dictionary with the keys `bottle.interior_medium.sigma_t.value.value` (in units of `EXTINCTION_UNIT`),
        `bottle.interior_medium.albedo.value.value`, `bottle.bsdf.alpha`.

    Raises:
        UnitError, SceneError: for numbers out of range.
    """
    beam, mean_cosine = finite("beam_degrees", beam_degrees), finite("anisotropy", anisotropy)
    if not 0 < beam < 90:
        raise UnitError(f"beam_degrees: expected an angle between 0 and 90 degrees, got {beam!r}")
    if not abs(mean_cosine) < 1:
        raise UnitError(f"anisotropy: expected a mean cosine between -1 and 1, got {mean_cosine!r}")
    vertices, faces = lathe(_smooth(PROFILE, 2), 96)
    write_ply(Path(mesh), vertices, faces)
    scattering = np.array(SCATTERING) * positive("milk", milk)
    extinction = scattering + np.array(ABSORPTION)
    if extinction.max() > EXTINCTION_UNIT:
        raise UnitError(f"milk: expected an extinction of at most {EXTINCTION_UNIT} 1/m, got {extinction.max():.3g}")
    film = transient_film(resolution, num_bins, start_opl, bin_width_opl)
    return {
        "type": "scene",
        "integrator": {
            "type": "transient_prbvolpath",
            "max_depth": checked_depth(max_depth),
            "rr_depth": 1000,
            "camera_unwarp": True,
        },
        "sensor": perspective(look_at([0.0, 0.17, 0.62], [0.0, 0.083, 0.0]), 20.0, film, spp),
        "bottle": {
            "type": "ply",
            "filename": str(mesh),
            "bsdf": {"type": "roughdielectric", "alpha": positive("roughness", roughness),
                     "int_ior": positive("index", index), "ext_ior": 1.0},
            "interior": {
                "type": "homogeneous",
                "scale": EXTINCTION_UNIT,
                "sigma_t": {"type": "rgb", "value": (extinction / EXTINCTION_UNIT).tolist()},
                "albedo": {"type": "rgb", "value": (scattering / extinction).tolist()},
                "phase": {"type": "hg", "g": mean_cosine},
            },
        },
        "laser": {
            "type": "disk",
            "to_world": translate([0.0, 0.002, 0.0]) @ rotate([1, 0, 0], -90) @ scale(LASER_RADIUS),
            "bsdf": diffuse(0.0),
            "emitter": {
                "type": "angulararea",
                "cutoff_angle": beam,
                "beam_width": 0.8 * beam,
                "radiance": {"type": "rgb", "value": [1e6, 1e6, 1e6]},
            },
        },
        "table": {
            "type": "rectangle",
            "to_world": translate([0.0, -0.0005, 0.0]) @ rotate([1, 0, 0], -90) @ scale(0.5),
            "bsdf": diffuse(0.5),
        },
    }  # fmt: skip
