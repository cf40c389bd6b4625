"""Scenes in which edges move, with one scalar unknown each: what derivatives by it have to be compared with.

Plain data, lengths in metres: descriptions for ``tt.load`` with films of 8 x 8 pixels. The unknown x enters one
parameter as ``value + x * direction(value)``, so that a mesh, a pose, an angle and a point move by the same rule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.scenes import look_at, rotate, scale, translate

Array = NDArray[np.float64]
Description = dict[str, Any]
Direction = Callable[[Array], Array]
MONO, RGB, SPECTRAL, POLARIZED = "llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized"


@dataclass(frozen=True)
class Expected:
    """Figures of an earlier measurement: of the interior term alone, and (value, standard error) of the derivative and
    of central differences. None where none was kept.
    """

    interior: float | None = None
    total: tuple[float, float | None] | None = None
    differences: tuple[float, float | None] | None = None


@dataclass(frozen=True)
class MovingEdge:
    """One unknown of a scene.

    ``key``: the parameter that it enters, as ``value + x * direction(value)``. ``step``: of central differences, in
    units of x. ``weights``: what the loss is made of: ``"random"`` or ``"even"`` weights of pixels times the sine of
    three times the path length, or ``"arrival"``, the mean arrival of the light in metres, ``"sine"``, the mean of that
    sine over the light. ``left_out``: why the derivative is known to lack something, "" where it is to be right.
    """

    scene: Callable[[], Description]
    key: str
    direction: Direction
    step: float
    expected: Expected = Expected()
    variant: str = MONO
    weights: str = "random"
    left_out: str = ""


_GLASS: Description = {"type": "dielectric", "int_ior": 1.3}
_MIRROR: Description = {"type": "twosided", "b": {"type": "conductor", "material": "none"}}

# --------------------------------------------------------------------------------------------------- the unknown


def moved(*by: float) -> Direction:
    """Translation by ``by`` (3,), of poses (4, 4) and points (3,)."""

    def direction(value: Array) -> Array:
        if value.shape != (4, 4):
            return np.broadcast_to(np.asarray(by, np.float64), value.shape)
        change = np.zeros((4, 4))
        change[:3, 3] = by
        return change

    return direction


def turned(*axis: float) -> Direction:
    """Rotation of a pose about an axis of its own, degrees times the length of the axis."""
    x, y, z = np.radians(axis)
    about = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0.0]])
    return lambda value: value @ about


def grown(value: Array) -> Array:
    """Scaling of a pose about its own origin."""
    return value @ np.diag([1.0, 1.0, 1.0, 0.0])


def widened(value: Array) -> Array:
    """A number that grows by x."""
    return np.ones_like(value)


def one_corner(value: Array) -> Array:
    """All vertices (V, 3) at the corner that is foremost and rightmost."""
    far = np.argmax(value[:, 2] + 0.5 * value[:, 0])
    return np.outer(np.linalg.norm(value - value[far], axis=1) < 1e-4, [1.0, 0.3, 0.4])


def sheared(center: float) -> Direction:
    """Vertices (V, 3) shifted sideways in proportion to their height over ``center``: parts move against each other."""
    return lambda value: np.outer(value[:, 2] - center, [1.5, 5.0, 0.0])


# ------------------------------------------------------------------------------------------------------- parts


def histograms(start: float = 3.0, rfilter: str = "box") -> Description:
    """160 bins of 4 cm through a tent."""
    bins = {"temporal_bins": 160, "start_opl": start, "bin_width_opl": 0.04, "temporal_filter": "tent"}
    return {"type": "transient_hdr_film", "width": 8, "height": 8, "rfilter": {"type": rfilter}, **bins}


def phasors() -> Description:
    frequencies = {"frequency_first": 0.3, "frequency_step": 0.2, "frequency_count": 4, "start_opl": 3.0}
    return {"type": "phasor_hdr_film", "width": 8, "height": 8, "rfilter": {"type": "box"}, **frequencies}


def gated() -> Description:
    gates = {"gates": "gaussian 7.0 0.6; gaussian 8.0 0.5; gaussian 9.0 1.0", "start_opl": 3.0}
    return {"type": "gated_hdr_film", "width": 8, "height": 8, "rfilter": {"type": "box"}, **gates}


def camera(fov: float = 40.0, film: Description | None = None, **more: Any) -> Description:
    """Four metres before the wall."""
    pose = look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0])
    own = film or histograms()
    return {"type": "perspective", "fov": fov, "near_clip": 0.01, "to_world": pose, "film": own, **more}


def lens() -> Description:
    return camera() | {"type": "thinlens", "aperture_radius": 0.12, "focus_distance": 2.6}


def parallel() -> Description:
    more: Description = {"type": "orthographic", "to_world": look_at([0, 0, 4], [0, 0, 0]) @ scale([1.4, 1.4, 1])}
    return {key: value for key, value in camera().items() if key != "fov"} | more


def paint(reflectance: float | Description) -> Description:
    return {"type": "twosided", "b": {"type": "diffuse", "reflectance": reflectance}}


def metal(alpha: float = 0.25) -> Description:
    return {"type": "roughconductor", "alpha": alpha, "eta": 1.5, "k": 3.0}


def checks(number: int = 16, filter_type: str = "nearest") -> Description:
    """A checkerboard of ``number`` x ``number`` texels."""
    y, x = np.mgrid[0:number, 0:number]
    image = np.where((x + y) % 2 == 0, 0.9, 0.1).astype(np.float32)[..., None].repeat(3, 2)
    return paint({"type": "bitmap", "data": image, "raw": True, "filter_type": filter_type})


def rectangle(pose: Array, surface: Description) -> Description:
    return {"type": "rectangle", "to_world": pose, "bsdf": surface}


def scene(depth: int, light: Description | None = None, fov: float = 40.0, /, **parts: Description) -> Description:
    """A wall of 6 m at z = 0 before a camera, under a point light unless another one is given; ``parts`` join or
    replace what is there.
    """
    return {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": depth, "rr_depth": 100},
        "sensor": camera(fov),
        "light": light or {"type": "point", "position": [0.8, 0.5, 3.0], "intensity": 10.0},
        "wall": rectangle(scale(3.0), paint(0.6)),
        **parts,
    }


def lamp(at: Sequence[float], angle: float, size: float, radiance: float) -> Description:
    """A square area light that faces along -z, turned about y by ``angle`` - 180 degrees."""
    pose = translate(at) @ rotate([0, 1, 0], angle) @ scale(size)
    return {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": radiance}}


def area() -> Description:
    return lamp([0.6, 0.4, 2.8], 180, 0.3, 20.0)


def far_area() -> Description:
    return lamp([1.6, 0.7, 3.0], 205, 0.25, 30.0)


def side_area() -> Description:
    return lamp([0.9, 0.0, 2.2], 120, 0.3, 30.0)


def point(*position: float) -> Description:
    return {"type": "point", "position": list(position), "intensity": 10.0}


def far_point() -> Description:
    return point(1.6, 0.7, 3.0)


def bulb() -> Description:
    return {"type": "sphere", "center": [1.6, 0.7, 3.0], "radius": 0.3, "emitter": {"type": "area", "radiance": 30.0}}


def spot() -> Description:
    pose = look_at([1.6, 0.7, 3.0], [0.2, 0.0, 0.0])
    return {"type": "spot", "to_world": pose, "intensity": 10.0, "cutoff_angle": 40.0, "beam_width": 30.0}


def sun() -> Description:
    return {"type": "directional", "direction": [-0.5, -0.15, -1.0], "irradiance": 3.0}


def sunny_sky() -> Description:
    return {"type": "sunsky", "sun_direction": [0.5, 0.15, 1.0], "sun_scale": 0.1, "sky_scale": 0.1}


def even_sky() -> Description:
    return {"type": "constant", "radiance": 1.0}


def sky() -> Description:
    """An environment map with a bright spot."""
    u, v = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(16) + 0.5) / 16)
    image = 0.3 + 0.7 * np.sin(2 * np.pi * u) ** 2 * np.sin(np.pi * v)
    image += 2 * np.exp(-((u - 0.3) ** 2 + (v - 0.4) ** 2) / 0.02)
    return {"type": "envmap", "bitmap": np.repeat(image[..., None], 3, 2).astype(np.float32)}


# ---- what moves


def plate() -> Description:
    """Before the wall."""
    pose = translate([-0.2, 0.1, 1.2]) @ rotate([0, 1, 0], 25) @ rotate([0, 0, 1], 20) @ scale([0.5, 0.35, 1])
    return rectangle(pose, paint(0.4))


def cube() -> Description:
    pose = translate([-0.2, 0.1, 1.0]) @ rotate([0, 1, 0], 30) @ rotate([1, 0, 0], 20) @ scale(0.35)
    return {"type": "cube", "to_world": pose, "bsdf": paint(0.5)}


def sphere() -> Description:
    return {"type": "sphere", "center": [-0.2, 0.1, 1.0], "radius": 0.5, "bsdf": paint(0.5)}


def hidden_plate() -> Description:
    """Between a light beside the view and the wall, out of the narrow view."""
    pose = translate([0.9, 0.35, 1.6]) @ rotate([0, 1, 0], 20) @ rotate([0, 0, 1], 15) @ scale([0.25, 0.3, 1])
    return rectangle(pose, paint(0.4))


def blocker() -> Description:
    """Between the wall and the panel beside it."""
    return rectangle(translate([1.0, 0.0, 0.7]) @ rotate([0, 1, 0], 80) @ scale([0.3, 0.4, 1]), paint(0.3))


def side() -> Description:
    """A panel beside the view."""
    return rectangle(translate([1.8, 0, 1.2]) @ rotate([0, 1, 0], -70), paint(0.8))


def box_on_wall() -> Description:
    """A cube of which one face is a centimetre before the wall."""
    pose = translate([0.1, 0.05, 0.31]) @ rotate([0, 0, 1], 20) @ scale(0.3)
    return {"type": "cube", "to_world": pose, "bsdf": paint(0.7)}


def mesh(vertices: Any, faces: Any, surface: Description) -> Description:
    given = {"vertices": np.asarray(vertices, np.float32), "faces": np.asarray(faces)}
    return {"type": "mesh_arrays", **given, "face_normals": True, "bsdf": surface}


def torus(center: Sequence[float] = (0.0, 0.0, 0.0), size: float = 1.0) -> Description:
    """A bumpy torus of 2304 triangles, which hides parts of itself from camera and light."""
    nu, nv, wide, thin = 48, 24, 0.42, 0.16
    u, v = np.meshgrid(np.arange(nu) * 2 * np.pi / nu, np.arange(nv) * 2 * np.pi / nv, indexing="ij")
    tube = thin * (1 + 0.25 * np.sin(5 * u) * np.cos(3 * v))
    ring = wide + tube * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], -1).reshape(-1, 3)
    vertices = vertices @ (rotate([0, 1, 0], 20) @ rotate([1, 0, 0], 65))[:3, :3].T + [-0.1, 0.1, 1.0]
    i, j = np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij")

    def at(di: int, dj: int) -> NDArray[np.int64]:
        return np.ravel((i + di) % nu * nv + (j + dj) % nv)

    halves = [np.stack([at(0, 0), at(1, 0), at(1, 1)], 1), np.stack([at(0, 0), at(1, 1), at(0, 1)], 1)]
    return mesh(vertices * size + center, np.concatenate(halves), paint(0.5))


def hidden_torus() -> Description:
    """The torus where the plate out of view is, smaller."""
    return torus((0.93, 0.32, 1.2), 0.4)


def hills(number: int = 20, height: float = 0.12) -> Description:
    """A field of hills that fills the picture: creases alone."""
    y, x = np.mgrid[0 : number + 1, 0 : number + 1] / number * 6 - 3
    vertices = np.stack([x, y, height * np.sin(2.1 * x + 0.3) * np.cos(1.7 * y)], -1).reshape(-1, 3)
    i, j = np.mgrid[0:number, 0:number]
    a = (i * (number + 1) + j).ravel()
    b, c, d = a + 1, a + number + 1, a + number + 2
    return mesh(vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]), paint(0.6))


def star(n: int = 24, m: int = 16) -> Description:
    """A bumpy sphere with hollows."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, m + 1)[1:-1], np.arange(n) * 2 * np.pi / n, indexing="ij")
    r = 0.5 * (1 + 0.25 * np.sin(3 * phi) * np.sin(theta) ** 2)
    round_ = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    vertices = [*(r[..., None] * round_).reshape(-1, 3), [0, 0.5, 0], [0, -0.5, 0]]
    top, bottom = (m - 1) * n, (m - 1) * n + 1

    def at(i: int, j: int) -> int:
        return i * n + j % n

    faces = [[top, at(0, j + 1), at(0, j)] for j in range(n)]
    faces += [[bottom, at(m - 2, j), at(m - 2, j + 1)] for j in range(n)]
    for i in range(m - 2):
        for j in range(n):
            faces += [[at(i, j), at(i, j + 1), at(i + 1, j)], [at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]]
    return mesh(vertices, faces, paint(0.6))


def grooves(angle: float = 30.0) -> Description:
    """V-grooves along y at z = -0.8, 6 m wide."""
    pitch, n = 0.5, 24
    x = (np.arange(n + 1) - n / 2) * pitch / 2
    z = np.where(np.arange(n + 1) % 2 == 0, 0.0, pitch / 2 * np.tan(np.radians(angle))) - 0.8
    vertices = [[p, y, q] for y in (-3.0, 3.0) for p, q in zip(x, z, strict=True)]
    a = np.arange(n)
    b = a + n + 1
    return mesh(vertices, np.concatenate([np.stack([a, a + 1, b], 1), np.stack([a + 1, b + 1, b], 1)]), paint(0.8))


# ---- whole scenes


def shadow(light: Description, depth: int = 2, /, **parts: Description) -> Description:
    """Shadow of a plate that is out of view."""
    return scene(depth, light, 22.0, **(parts or {"hid": hidden_plate()}))


def indirect(light: Description | None = None) -> Description:
    """Panel hidden from the wall by a part that is out of view."""
    panel = rectangle(translate([1.9, 0, 1.0]) @ rotate([0, 1, 0], -80), paint(0.9))
    return scene(4, light or side_area(), 22.0, blk=blocker(), side=panel)


def plate_and_side(light: Description | None = None, /, **parts: Description) -> Description:
    return scene(4, light, **{"plate": plate(), "side": side(), **parts})


def plates_in_line() -> Description:
    """One as large as the other as the camera sees them."""
    front, back = ([0.0, 0.0, z] for z in (1.2, 0.2))
    k = (4 - back[2]) / (4 - front[2])
    near = rectangle(translate(front) @ scale([0.4, 0.3, 1]), paint(0.2))
    return scene(2, front=near, back=rectangle(translate(back) @ scale([0.4 * k, 0.3 * k, 1]), paint(0.9)))


def coloured(description: Description) -> Description:
    def rgb(*values: float) -> Description:
        return paint({"type": "rgb", "value": list(values)})

    side, wall = description["side"] | {"bsdf": rgb(0.9, 0.4, 0.2)}, description["wall"] | {"bsdf": rgb(0.3, 0.6, 0.8)}
    return description | {"side": side, "wall": wall}


def seen_by(description: Description, film: Description) -> Description:
    """The same scene with another film."""
    return description | {"sensor": description["sensor"] | {"film": film}}


def on_wall(description: Description, surface: Description) -> Description:
    """The same scene with another surface of the wall."""
    return description | {"wall": description["wall"] | {"bsdf": surface}}


def instances() -> Description:
    """Two instances of a cube, side by side."""
    pose = rotate([0, 1, 0], 30) @ rotate([1, 0, 0], 20) @ scale(0.35)
    group = {"type": "shapegroup", "one": {"type": "cube", "to_world": pose, "bsdf": paint(0.5)}}

    def copy(pose: Array) -> Description:
        return {"type": "instance", "to_world": pose, "shapegroup": {"type": "ref", "id": "group"}}

    there = translate([0.9, -0.6, 0.6]) @ scale(0.6)
    return scene(4, area(), side=side(), group=group, copy=copy(translate([-0.2, 0.1, 1.0])), other=copy(there))


def fog(description: Description) -> Description:
    """The same scene in fog."""
    ref = {"type": "ref", "id": "fog"}
    medium = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.15, "phase": {"type": "hg", "g": 0.3}}
    found = {**description, "integrator": {**description["integrator"], "type": "transient_prbvolpath"}}
    found["fog"] = medium | {"sample_emitters": True}
    found["sensor"] = description["sensor"] | {"medium": ref}
    if found["light"]["type"] == "point":
        found["light"] = found["light"] | {"medium": ref}
    for name, part in description.items():
        if isinstance(part, dict) and part["type"] in ("rectangle", "cube", "sphere"):
            found[name] = part | {"exterior": ref, "interior": ref}
    return found


def in_mirror(surface: Description) -> Description:
    """A camera that looks at a mirror, in which a plate is before a wall."""
    away = translate([2.4, 0.1, 2.2]) @ rotate([0, 1, 0], -125) @ rotate([0, 0, 1], 20) @ scale([0.5, 0.35, 1])
    wall = translate([5.0, 0, 4.0]) @ rotate([0, 1, 0], -120) @ scale(4.0)
    return scene(
        4,
        point(2.0, 1.0, 3.5),
        sensor=camera(30, histograms(8.0)),
        glass=rectangle(rotate([0, 1, 0], 25) @ scale(2.0), surface),
        wall=rectangle(wall, paint(0.6)),
        plate=rectangle(away, paint(0.3)),
    )


def shadow_in_mirror(depth: int = 3) -> Description:
    """A mirror fills the picture: it shows a plate before a wall that shines, and the plate's shadow."""
    wall = rectangle(translate([5.0, 0, 4.0]) @ rotate([0, 1, 0], -120) @ scale([4.0, 4.0, 1]), paint(0.6))
    wall |= {"emitter": {"type": "area", "radiance": 0.1}}
    pose = translate([2.4, 0.1, 2.2]) @ rotate([0, 1, 0], -125) @ rotate([0, 0, 1], 20) @ scale([0.5, 0.35, 1])
    return scene(
        depth,
        point(0.6, 0.6, 1.6),
        sensor=camera(30, histograms(9.5)),
        mirror=rectangle(rotate([0, 1, 0], 25) @ scale(2.0), _MIRROR),
        wall=wall,
        plate=rectangle(pose, paint(0.3)),
    )


def through(surface: Description) -> Description:
    """A plate before the wall, behind a slab of glass."""
    pose = translate([0, 0, 2.3]) @ rotate([0, 1, 0], 15) @ scale([0.8, 0.8, 0.08])
    slab = {"type": "cube", "to_world": pose, "bsdf": surface}
    return scene(6, point(1.8, 1.5, 2.5), 24.0, plate=plate(), slab=slab)


def slab_in_view(depth: int = 5) -> Description:
    """A plate before a wall, partly behind a slab of glass, which shows its own rims."""
    pose = translate([0, 0, 2]) @ rotate([0, 1, 0], 25) @ rotate([1, 0, 0], 10) @ scale([0.4, 0.5, 0.12])
    slab = {"type": "cube", "to_world": pose, "bsdf": _GLASS}
    return scene(depth, point(1.8, 1.5, 2.5), sensor=camera(50, histograms(4.0)), plate=plate(), slab=slab)


def shining_torus() -> Description:
    """A torus that shines evenly and reflects nothing."""
    body = torus() | {"bsdf": paint(0.0), "emitter": {"type": "area", "radiance": 1.0}}
    return scene(1, area(), torus=body, sensor=camera(film=histograms(2.0)))


def side_panel() -> Description:
    """A panel that moves beside a wall under a point light; the view holds the wall alone."""
    film = histograms(6.0) | {"temporal_bins": 200, "bin_width_opl": 0.02, "width": 4, "height": 4}
    panel = translate([1.6, 0, 1.2]) @ rotate([0, 1, 0], -60) @ scale(0.4)
    return scene(
        5,
        point(0.5, 0.0, 4.0),
        10.0,
        sensor=camera(10.0, film),
        side=rectangle(panel, {"type": "diffuse", "reflectance": 0.8}),
        wall=rectangle(scale(1.0), {"type": "diffuse", "reflectance": 0.5}),
    )


# ----------------------------------------------------------------------------------------------------------- the table


_C, _H, _B, _L = (1.0, 0.3, 0.0), (1.0, 0.2, 0.0), (0.2, 0.5, 1.0), (1.0, 0.2, 0.3)
_PLATE, _HID, _BLK, _IN_MIRROR = moved(*_C), moved(*_H), moved(*_B), moved(0.5, 0.6, -0.5)
_JUMPS = "jumps of a texture on what moves"


def _edge(
    make: Callable[[], Description], key: str, direction: Direction, step: float, *figures: Any, **more: Any
) -> MovingEdge:
    return MovingEdge(make, key, direction, step, Expected(*figures), **more)


def _of_plate(make: Callable[[], Description], *figures: Any, **more: Any) -> MovingEdge:
    return _edge(make, "plate.to_world", _PLATE, 0.004, *figures, **more)


def _of_shadow(make: Callable[[], Description], *figures: Any, **more: Any) -> MovingEdge:
    return _edge(make, "hid.to_world", _HID, 0.004, *figures, **more)


def _of_light(make: Callable[[], Description], *figures: Any) -> MovingEdge:
    return _edge(make, "light.to_world", moved(*_L), 0.004, *figures)


def _of_blocker(make: Callable[[], Description], *figures: Any, **more: Any) -> MovingEdge:
    return _edge(make, "blk.to_world", _BLK, 0.004, *figures, **more)


CASES: dict[str, MovingEdge] = {
    # ---- seen by the camera
    "plate": _of_plate(lambda: scene(2, plate=plate()), 3.294, (1.047, 0.004), (1.063, 0.020)),
    "cube": _edge(
        lambda: scene(2, cube=cube()), "cube.vertex_positions", _PLATE, 0.001, 0.614, (-2.134, 0.013), (-2.166, 0.089)
    ),
    "sphere": _edge(
        lambda: scene(2, sphere=sphere()), "sphere.to_world", _PLATE, 0.004, -1.119, (-1.854, 0.061), (-1.929, 0.013)
    ),
    "plate4": _of_plate(plate_and_side, 3.377, (1.331, 0.014), (1.337, 0.031)),
    "plate4_area": _of_plate(lambda: plate_and_side(area()), 0.050, (-1.108, 0.005), (-1.106, 0.008)),
    "vertex4": _edge(
        lambda: scene(4, cube=cube(), side=side()), "cube.vertex_positions", one_corner, 0.001,
        -0.941, (-2.363, 0.009), (-2.347, 0.053),
    ),
    "contact4": _edge(
        lambda: scene(4, area(), cube=box_on_wall(), side=side()), "cube.vertex_positions", _PLATE, 0.001,
        -0.032, (-0.889, 0.013), (-0.904, 0.070),
    ),
    "texture_behind": _of_plate(
        lambda: on_wall(scene(2, plate=plate()), checks()), 3.294, (1.495, 0.010), (1.510, 0.024)
    ),
    "texture_on_it": _of_plate(
        lambda: plate_and_side(area(), plate=plate() | {"bsdf": checks(4)}),
        None, (-0.965, None), (-1.55, None), left_out=_JUMPS,
    ),
    "smooth_texture_on_it": _of_plate(
        lambda: plate_and_side(area(), plate=plate() | {"bsdf": checks(4, "bilinear")}),
        None, (-1.201, 0.053), (-1.194, 0.023),
    ),
    "instance4": _edge(instances, "copy.to_world", _PLATE, 0.001, -1.731, (-2.697, 0.011), (-2.691, 0.021)),
    # ---- in line with each other
    "flash": _of_plate(lambda: scene(2, point(0.0, 0.0, 4.0), plate=plate())),
    "flash_ball": _edge(
        lambda: scene(2, point(0.0, 0.0, 4.0), ball=sphere()), "ball.to_world", _PLATE, 0.004
    ),
    "flash_fog": _of_plate(lambda: fog(scene(3, point(0.0, 0.0, 4.0), plate=plate()))),
    "flash_parallel": _of_plate(
        lambda: scene(2, {"type": "directional", "direction": [0.0, 0.0, -1.0]}, sensor=parallel(), plate=plate())
    ),
    "in_line": _edge(plates_in_line, "sensor.x_fov", widened, 0.2),
    # ---- shadows
    "shadow_point": _of_shadow(lambda: shadow(far_point()), 0.0, (-7.226, 0.026), (-7.186, 0.028)),
    "shadow_area": _of_shadow(lambda: shadow(far_area()), 0.0, (-3.115, 0.012), (-3.110, 0.023)),
    "ball_shadow": _edge(
        lambda: shadow(far_area(), ball=sphere() | {"center": [0.9, 0.35, 1.6], "radius": 0.25, "bsdf": paint(0.4)}),
        "ball.to_world", _HID, 0.004, 0.0, (-2.562, 0.017), (-2.522, 0.015),
    ),
    "spot_shadow": _of_shadow(lambda: shadow(spot()), 0.0, (-7.244, 0.042), (-7.202, 0.035)),
    "sun_shadow": _of_shadow(lambda: shadow(sun()), 0.0, (-1.663, 0.031), (-1.632, 0.060)),
    "const_shadow": _of_shadow(lambda: shadow(even_sky()), 0.0, (-0.105, 0.023), (-0.095, 0.035)),
    "sky_shadow": _of_shadow(lambda: shadow(sky()), 0.0, (-0.298, 0.034), (-0.291, 0.025)),
    "sun_plate4": _of_plate(lambda: plate_and_side(sun()), 5.347, (-0.001, 0.028), (0.035, 0.054)),
    "const_plate4": _of_plate(lambda: plate_and_side(even_sky()), 3.542, (1.080, 0.025), (1.041, 0.054)),
    "sky_ball4": _edge(
        lambda: scene(4, sky(), sphere=sphere(), side=side()), "sphere.to_world", _PLATE, 0.004,
        1.068, (-0.159, 0.160), (-0.244, 0.107),
    ),
    # ---- what other surfaces see
    "indirect4": _of_blocker(lambda: indirect(point(0.9, 0.0, 2.0)), 0.028, (-0.391, 0.014), (-0.363, 0.051)),
    "indirect4_area": _of_blocker(indirect, 0.013, (-0.591, 0.007), (-0.588, 0.042)),
    "indirect4_rgb": _of_blocker(lambda: coloured(indirect()), variant=RGB),
    "side_moves": _edge(
        side_panel, "side.to_world", moved(-1.0, 0.0, 0.4), 0.005, 0.0206, (0.0277, 0.0030), (0.0265, 0.0029),
        weights="even",
    ),
    # ---- walls, lights and sensors that move
    "wall_moves": _edge(
        lambda: shadow(far_point()), "wall.to_world", moved(0.0, 0.0, 1.0), 0.004, 5.126, (3.114, 0.061), (3.116, 0.019)
    ),
    "indirect4_wall": _edge(
        indirect, "wall.to_world", moved(0.0, 0.0, 1.0), 0.004, -12.008, (-11.488, 0.057), (-11.581, 0.025)
    ),
    "sun_wall_moves": _edge(
        lambda: shadow(sun()), "wall.to_world", moved(0.0, 0.0, 1.0), 0.004, 46.590, (44.457, 0.082), (44.566, 0.038)
    ),
    "light_moves": _of_light(lambda: shadow(far_area()), -1.358, (-0.0778, 0.0008), (-0.0772, 0.0010)),
    "point_moves": _edge(
        lambda: shadow(far_point()), "light.position", moved(*_L), 0.004, -1.206, (1.856, 0.061), (1.783, 0.022)
    ),
    "bulb_moves": _of_light(lambda: shadow(bulb()), -2.798, (-0.587, 0.047), (-0.554, 0.033)),
    "spot_moves": _of_light(lambda: shadow(spot()), -1.206, (1.856, 0.061), (1.783, 0.022)),
    "sun_turns": _edge(
        lambda: shadow(sunny_sky()), "light.sun_direction", moved(*_L), 0.004,
        -0.1349, (-0.0275, 0.0056), (-0.0378, 0.0097), variant=RGB,
    ),
    "sun_turns4": _edge(
        lambda: scene(4, sunny_sky(), cube=cube(), side=side()), "light.sun_direction", moved(*_L), 0.004,
        0.5318, (0.1292, 0.0049), (0.1290, 0.0062), variant=RGB,
    ),
    "camera_moves": _edge(
        lambda: scene(2, plate=plate()), "sensor.to_world", moved(*_L), 0.004, -4.793, (-2.797, 0.011), (-2.788, 0.012)
    ),
    "camera_moves4": _edge(
        lambda: scene(4, area(), cube=cube(), side=side()), "sensor.to_world", moved(*_L), 0.002,
        0.273, (-0.920, 0.024), (-0.866, 0.029),
    ),
    "camera_turns": _edge(
        lambda: scene(2, area(), plate=plate()), "sensor.to_world", turned(0.2, 1.0, 0.3), 0.2,
        -0.019, (-0.044, None), (-0.042, None),
    ),
    "camera_zooms": _edge(
        lambda: scene(2, area(), plate=plate()), "sensor.x_fov", widened, 0.2,
        -0.1180, (-0.1820, None), (-0.1823, 0.0002),
    ),
    "thinlens_plate": _of_plate(
        lambda: scene(2, plate=plate(), sensor=lens()), 3.326, (1.077, 0.014), (1.103, 0.036)
    ),
    "thinlens_moves": _edge(
        lambda: scene(2, area(), plate=plate(), sensor=lens()), "sensor.to_world", moved(*_L), 0.004,
        -0.840, (-1.624, 0.072), (-1.618, 0.034),
    ),
    "thinlens_cube4": _edge(
        lambda: scene(4, area(), cube=cube(), side=side(), sensor=lens()), "cube.vertex_positions", _PLATE, 0.002,
        -1.680, (-2.658, 0.014), (-2.667, 0.033),
    ),
    # ---- fine meshes
    "torus4": _edge(
        lambda: scene(4, area(), torus=torus(), side=side()), "torus.vertex_positions", _PLATE, 0.0005,
        -1.476, (-2.554, 0.041), (-2.577, 0.045),
    ),
    "torus_turns": _edge(
        lambda: scene(3, area(), torus=torus()), "torus.vertex_positions", sheared(1.0), 0.0005,
        -0.447, (-4.765, 0.075), (-4.957, 0.034),
    ),
    "torus_turns2": _edge(
        lambda: scene(2, area(), torus=torus()), "torus.vertex_positions", sheared(1.0), 0.0005,
        -0.429, (-4.729, 0.020), (-4.800, 0.021),
    ),
    "torus_shines": _edge(shining_torus, "torus.vertex_positions", sheared(1.0), 0.0005),
    "torus_shines_moves": _edge(
        shining_torus, "torus.vertex_positions", _PLATE, 0.0005, 1.423, (0.955, 0.035), (0.960, 0.052)
    ),
    "torus_shadow": _edge(
        lambda: shadow(far_area(), m=hidden_torus()), "m.vertex_positions", _HID, 0.001,
        0.0, (-1.263, 0.014), (-1.246, 0.007),
    ),
    "torus_shadow_sheared": _edge(
        lambda: shadow(far_area(), m=hidden_torus()), "m.vertex_positions", sheared(1.6), 0.001,
        0.0, (1.133, 0.009), (1.137, 0.025),
    ),
    "hills_area": _edge(
        lambda: scene(2, area(), wall=hills()), "wall.vertex_positions", sheared(0.0), 0.004,
        -0.0861, (-0.0838, 0.0002), (-0.0829, 0.0005),
    ),
    "hills_point": _edge(
        lambda: scene(2, wall=hills()), "wall.vertex_positions", sheared(0.0), 0.004,
        -0.1017, (-0.0848, 0.0003), (-0.0842, 0.0006),
    ),
    # ---- media, films, surfaces
    "fog_plate": _of_plate(lambda: fog(scene(3, plate=plate())), 2.069, (0.974, 0.104), (1.011, 0.060)),
    "fog_plate4": _of_plate(lambda: fog(plate_and_side(area())), 0.278, (-0.319, 0.023), (-0.290, 0.027)),
    "fog_shadow": _of_shadow(lambda: fog(shadow(far_point(), 3)), -0.045, (-2.517, 0.014), (-2.480, 0.022)),
    "plate4_phasor": _of_plate(
        lambda: seen_by(plate_and_side(area()), phasors()), -0.357, (-0.656, 0.002), (-0.657, 0.008)
    ),
    "phasor_shadow": _of_shadow(
        lambda: seen_by(shadow(far_area()), phasors()), 0.0, (-2.115, 0.012), (-2.116, 0.007)
    ),
    "gated_plate4": _of_plate(
        lambda: seen_by(plate_and_side(area()), gated()), -0.007, (-0.468, 0.002), (-0.464, 0.005)
    ),
    "gated_shadow": _of_shadow(lambda: seen_by(shadow(far_area()), gated()), 0.0, (-0.187, 0.006), (-0.187, 0.009)),
    "blurred_plate4": _of_plate(
        lambda: seen_by(plate_and_side(area()), histograms(rfilter="gaussian")), 0.069, (-1.067, 0.016), (-1.091, 0.022)
    ),
    "blurred_shadow": _of_shadow(
        lambda: seen_by(shadow(far_area()), histograms(rfilter="gaussian")), 0.0, (-2.963, 0.039), (-3.046, 0.019)
    ),
    "metal_plate4": _of_plate(
        lambda: on_wall(plate_and_side(area()), metal()), 0.058, (-4.404, 0.016), (-4.357, 0.032)
    ),
    "polar_plate": _of_plate(
        lambda: on_wall(scene(2, area(), plate=plate() | {"bsdf": metal(0.3)}), metal()),
        -0.440, (-8.691, 0.035), (-8.665, 0.104), variant=POLARIZED,
    ),
    "polar_indirect4": _of_blocker(
        lambda: on_wall(indirect(), metal(0.4)), 0.007, (-0.440, 0.009), (-0.383, 0.036), variant=POLARIZED
    ),
    "polar_shadow4": _of_shadow(
        lambda: on_wall(shadow(far_area(), 4, hid=hidden_plate(), side=side()), metal(0.4)),
        0.003, (-3.239, 0.029), (-3.230, 0.028), variant=POLARIZED,
    ),
    "mirror_rough": _edge(
        lambda: in_mirror({"type": "twosided", "b": metal(0.15)}), "plate.to_world", _IN_MIRROR, 0.004,
        0.005, (-0.0812, 0.0018), (-0.0808, 0.0013),
    ),
    "mirror": _edge(
        lambda: in_mirror(_MIRROR), "plate.to_world", _IN_MIRROR, 0.01, 0.0, (-0.1880, 0.0005), (-0.1883, 0.0009)
    ),
    "mirror_shadow": _edge(
        shadow_in_mirror, "plate.to_world", _IN_MIRROR, 0.01, -0.0003, (-0.2104, 0.0023), (-0.2123, 0.0015)
    ),
    "mirror_moves": _edge(
        lambda: shadow_in_mirror(2), "mirror.to_world", moved(0.3, 0.1, 1.0), 0.01,
        -10.173, (-10.071, 0.007), (-10.067, 0.002),
    ),
    "mirror_camera": _edge(
        shadow_in_mirror, "sensor.to_world", moved(*_L), 0.01, 0.466, (0.4259, 0.0014), (0.4246, 0.0005)
    ),
    "glass_rough": _of_plate(
        lambda: through({"type": "roughdielectric", "int_ior": 1.3, "alpha": 0.1}),
        1.307, (-2.10, 0.45), (-2.059, 0.035),
    ),
    "glass": _edge(
        lambda: through(_GLASS), "plate.to_world", _PLATE, 0.01, 1.333, (-2.301, 0.006), (-2.296, 0.006)
    ),
    "glass_rims": _edge(slab_in_view, "plate.to_world", _PLATE, 0.01, -0.017, (-0.542, 0.005), (-0.537, 0.006)),
    "glass_moves": _edge(
        slab_in_view, "slab.vertex_positions", moved(0.0, 0.0, 1.0), 0.01, 0.019, (-0.274, 0.011), (-0.279, 0.005)
    ),
    "glass_camera": _edge(
        slab_in_view, "sensor.to_world", moved(*_L), 0.01, -0.083, (0.799, 0.050), (0.795, 0.008)
    ),
}  # fmt: skip
# What a short look takes.
QUICK = ("plate", "shadow_area", "indirect4_area", "camera_moves")


# ------------------------------------------------------------------------------------------------------- concave shapes


def before_wall(body: Description, light: Description, start: float, width: float, **more: Any) -> Description:
    """A body before a camera, with 128 bins."""
    film = histograms(start) | {"temporal_bins": 128, "bin_width_opl": width}
    plain = {"type": "diffuse", "reflectance": 0.7}
    wall = rectangle(translate([0, 0, -0.8]) @ scale([5.0, 5.0, 1.0]), plain)
    return scene(3, light, sensor=camera(film=film), **{"wall": wall, "body": body, **more})


def groove_field(angle: float) -> Description:
    """V-grooves that fill the view."""
    light = {"type": "point", "position": [0.6, 0.3, 3.0], "intensity": 30.0}
    found = before_wall(grooves(angle), light, 5.0, 0.05)
    del found["wall"]
    found["sensor"] |= {"fov": 35.0, "near_clip": 1e-3, "to_world": look_at([0.0, 0.0, 3.0], [0.0, 0.0, 0.0])}
    return found


def plain_plate(film: Description | None = None) -> Description:
    """A plate that faces the camera, before a wall."""
    body = rectangle(translate([0.07, -0.05, 0.8]) @ scale([0.45, 0.35, 1]), {"type": "diffuse", "reflectance": 0.4})
    wall = rectangle(scale([5.0, 5.0, 1.0]), {"type": "diffuse", "reflectance": 0.7})
    found = before_wall(body, point(0.7, 0.4, 3.8), 5.5, 0.05, wall=wall)
    return found if film is None else seen_by(found, film)


def at_depth(description: Description, depth: int) -> Description:
    return description | {"integrator": description["integrator"] | {"max_depth": depth}}


def _noisy(
    make: Callable[[], Description], key: str, direction: Direction, step: float, **more: Any
) -> Callable[[int], MovingEdge]:
    return lambda depth: MovingEdge(lambda: at_depth(make(), depth), key, direction, step, **more)


# By depth: shapes whose parts see each other from near by.
CONCAVE: dict[str, Callable[[int], MovingEdge]] = {
    "grooves15": _noisy(lambda: groove_field(15.0), "body.to_world", moved(0.0, 0.0, 1.0), 0.005, weights="even"),
    "grooves30": _noisy(lambda: groove_field(30.0), "body.to_world", moved(0.0, 0.0, 1.0), 0.005, weights="even"),
    "torus": _noisy(CASES["torus4"].scene, "torus.vertex_positions", _PLATE, 0.0005),
    "star": _noisy(
        lambda: before_wall(star(), point(0.7, 0.4, 3.8), 5.0, 0.06), "body.to_world", moved(1.0, 0.0, 0.0), 0.005
    ),
    "corner": _noisy(CASES["vertex4"].scene, "cube.vertex_positions", one_corner, 0.001),
    "contact": _noisy(CASES["contact4"].scene, "cube.vertex_positions", _PLATE, 0.001),
}
