"""The captures around a corner of the sweep: a relay wall at z = 0, and what it sees beyond the corner.

Here the outline of what is hidden lies in view and moves: hidden points follow their shapes in derivatives, and where
one thing hides another, the boundary term is computed. That is the case of bent meshes and of a plate before a plate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from tools.gradient_sweep.bsdfs import METAL, picture, rgb
from tools.gradient_sweep.shapes import grid_mesh
from tools.gradient_sweep.stages import Description, Matrix, film, look, matte, move, stretch, turn

KINDS = ("single", "confocal", "exhaustive")
# Scanned points along each side of the wall; of an exhaustive scan laser positions, too.
ACROSS, ACROSS_PAIRS = 4, 2
KEYS = ("wall.", "laser.", "plate.", "back.", "panel.")
# Attributes that nothing reads.
UNREAD = ("plate.vertex_texcoords", "back.vertex_texcoords")
# What is lit and seen, half of the wall's width; the sensor and the laser stand before the wall.
_HALF = 0.6
_SENSOR, _LASER, _SPOT = (0.3, 0.2, 0.7), (-0.35, 0.1, 0.6), (-0.2, 0.1, 0.0)
PAINT = {"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)}
TWO_SIDED = {"type": "twosided", "nested": PAINT}
ROUGH_METAL = {"type": "roughconductor", "alpha": 0.4, **METAL}


def facing_wall(x: float = 0.05, y: float = -0.1, z: float = 0.9, half: float = 0.35, tilt: float = 12.0) -> Matrix:
    """The pose of a plate that faces the wall."""
    return move(x, y, z) @ turn(1, 180.0 + tilt) @ stretch(half, half, 1.0)


# With its back to the wall; before another one, and behind it.
AWAY, BEFORE, BEHIND = facing_wall(tilt=195.0), facing_wall(0.15, 0.0, 0.6, 0.15), facing_wall(z=1.0)


def plate(bsdf: Description = PAINT, pose: Matrix | None = None) -> Description:
    return {"type": "rectangle", "to_world": facing_wall() if pose is None else pose, "bsdf": bsdf}


def flat_mesh(bsdf: Description = PAINT, pose: Matrix | None = None) -> Description:
    vertices, _, _, faces = grid_mesh()
    return plate(bsdf, pose) | {"type": "mesh_arrays", "vertices": vertices, "faces": faces}


def bent_mesh() -> Description:
    """A plate whose points may hide others of it."""
    mesh = flat_mesh()
    x, y = mesh["vertices"][:, :1], mesh["vertices"][:, 1:2]
    return mesh | {"vertices": mesh["vertices"] + [0.0, 0.0, 0.1] * (x * y + x**2)}


def panel() -> Description:
    """A plate beside the others that lights them, beyond all lines between them and the wall."""
    pose = move(0.75, 0.0, 0.45) @ turn(1, -90) @ stretch(0.25)
    return {"panel": {"type": "rectangle", "to_world": pose, "bsdf": matte(0.6)}}


# ------------------------------------------------------------------------------------------------------------ scans


def scan(kind: str, hidden: Description, legs: bool = True, tabulated: bool = False, **integrator: Any) -> Description:
    """A capture of ``hidden``, shapes by name. ``legs``: the ways from the laser and to the sensor count.
    ``tabulated``: points, laser points and the laser's origin are given, in place of a grid over the wall.
    """
    across = ACROSS_PAIRS if kind == "exhaustive" else ACROSS
    histograms = film(start=1.2, bins=150) | {"width": across, "height": across}
    if kind == "exhaustive":
        histograms |= {"exhaustive_scan": True, "laser_scan_width": across, "laser_scan_height": across}
    meter = {
        "type": "nlos_capture_meter",
        "sensor_origin": list(_SENSOR),
        "film": histograms,
        "sampler": {"type": "independent"},
    }
    if tabulated:
        meter |= {"points": points(across, 1), "laser_origin": list(_LASER)}
    if tabulated and kind != "confocal":
        meter["laser_points"] = points(across, 2) if kind == "exhaustive" else np.array([_SPOT])
    sampling = {
        "type": "transient_nlos_path",
        "capture_type": kind,
        "nlos_laser_sampling": True,
        "nlos_hidden_geometry_sampling": True,
        "account_first_and_last_bounces": legs,
        "max_depth": 3,
        "rr_depth": 100,
        "discard_direct_paths": True,
    }
    return {
        "type": "scene",
        "integrator": sampling | integrator,
        "laser": {"type": "laser_beam", "energy": rgb(10.0, 8.0, 6.0), "to_world": look(_LASER, _SPOT)},
        "wall": {"type": "rectangle", "to_world": stretch(_HALF), "bsdf": matte(0.8), "sensor": meter},
        **hidden,
    }


def points(across: int, seed: int) -> np.ndarray:
    """Points of the wall ``(N, 3)``, near those of a grid."""
    middles = ((np.arange(across) + 0.5) / across * 2 - 1) * 0.8 * _HALF
    x, y = np.meshgrid(middles, middles)
    grid = np.stack([x, y], axis=-1).reshape(-1, 2)
    grid = grid + np.random.default_rng(seed).uniform(-0.05, 0.05, grid.shape)
    return np.pad(grid, ((0, 0), (0, 1)))


@dataclass(frozen=True)
class Capture:
    """A scan of the sweep: its type, what sets it apart, and its scene. ``keys``, ``without``: beginnings of the keys
    to look at, and of those that do nothing there.
    """

    kind: str
    words: str
    make: Callable[[], Description]
    keys: tuple[str, ...] = KEYS
    without: tuple[str, ...] = ()
    variant: str = "llvm_ad_rgb"


def captures() -> Iterator[Capture]:
    """Every scan of the sweep."""
    for kind in KINDS:
        # Where the laser stands counts for where its spot is, and for the first leg.
        still = () if kind == "single" else ("laser.to_world",)
        no_legs = ("wall.sensor.sensor_origin", *still)
        yield Capture(kind, "", _of(kind, plate))
        table = _of(kind, flat_mesh if kind == "exhaustive" else bent_mesh, tabulated=True)
        yield Capture(kind, "tabulated points, mesh", table, without=("laser.to_world", *UNREAD))
        yield Capture(kind, "no legs, mesh", _of(kind, flat_mesh, legs=False), without=(*no_legs, *UNREAD))
        yield Capture(kind, "two-sided", _of(kind, lambda: plate(TWO_SIDED, AWAY), legs=False), without=no_legs)
        yield Capture(kind, "rough metal", _of(kind, lambda: plate(ROUGH_METAL)))
        yield Capture(kind, "five bounces", _of(kind, plate, panel(), legs=False, max_depth=5), without=no_legs)
        if kind == "exhaustive":
            continue
        yield Capture(kind, "paths", _of(kind, bent_mesh, third_bounce="paths"), without=UNREAD)
        hiding = _of(kind, lambda: flat_mesh(pose=BEFORE), {"back": flat_mesh(pose=BEHIND)}, legs=False)
        yield Capture(kind, "plate before a plate", hiding, without=(*no_legs, *UNREAD))
    yield from _other_light()


def _other_light() -> Iterator[Capture]:
    """Parts that do not depend on the type of the capture."""
    painted = _of("confocal", lambda: plate({"type": "diffuse", "reflectance": picture(3)}), legs=False)
    yield Capture("confocal", "texture", painted, without=("wall.sensor.", "laser."))
    metal = _of("single", lambda: plate(ROUGH_METAL), legs=False)
    origin = ("wall.sensor.sensor_origin",)
    yield Capture("single", "rough metal", metal, without=origin, variant="llvm_ad_mono_polarized")
    yield Capture("confocal", "", _of("confocal", plate), variant="llvm_ad_spectral")
    fog = {
        "type": "cube",
        "to_world": move(z=0.76) @ stretch(3.0, 3.0, 0.04),
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 4.0, "albedo": 0.6, "phase": {"type": "hg", "g": 0.3}},
    }
    # Between the plate and what stands before the wall. Outlines are not followed in media.
    thick = _of("single", plate, {"fog": fog}, max_depth=4)
    yield Capture("single", "fog", thick, ("fog.interior_medium.", "laser.energy.", "wall.bsdf.", "plate.bsdf."))
    projector = {"type": "projector", "irradiance": rgb(10.0, 8.0, 6.0), "fov": 0.2}
    yield Capture("single", "light of a projector", _of("single", plate, {"laser": projector}), ("laser.",))


def _of(kind: str, hidden: Callable[[], Description], others: Description | None = None, **changes: Any) -> Any:
    """The maker of a scan of one plate. ``others``: more of the scene, ``laser`` in place of the beam."""

    def make() -> Description:
        scene = scan(kind, {"plate": hidden()}, **changes)
        return scene | {k: v | {"to_world": v.get("to_world", look(_LASER, _SPOT))} for k, v in (others or {}).items()}

    return make
