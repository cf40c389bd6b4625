"""Scenes for the tests of plans: a grey room with one wall, to which each test adds what must not be overlooked."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchtransient.scenes import look_at, rotate, scale, translate

GREY = {"type": "diffuse", "reflectance": 0.5}


def grey_room(**more: object) -> dict:
    """A grey wall at z = 0 under a camera and a point light at z = 4; `more` are further children of the scene."""
    scene = {
        "type": "scene",
        "integrator": {"type": "transient_path"},
        "sensor": {
            "type": "perspective",
            "fov": 10.0,
            "to_world": look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0]),
            "sampler": {"type": "independent", "sample_count": 16},
            "film": {
                "type": "transient_hdr_film",
                "width": 4,
                "height": 4,
                "rfilter": {"type": "box"},
                "temporal_bins": 64,
                "start_opl": 7.0,
                "bin_width_opl": 0.05,
            },
        },
        "light": {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": 10.0},
        "wall": {"type": "rectangle", "bsdf": dict(GREY)},
    }
    scene.update(more)
    return scene


def hidden(bsdf: dict) -> dict:
    """A small square under the wall, where no camera ray goes at first."""
    return {"type": "rectangle", "to_world": translate([0.0, 0.0, -1.0]) @ scale(0.1), "bsdf": bsdf}


def picture(folder: Path, name: str, *, coloured: bool) -> str:
    """A 4 x 4 RGB picture in a file."""
    import torchtransient as tt  # isort: skip
    import mitsuba as mi

    pixels = np.full((4, 4, 3), 0.5, dtype=np.float32)
    if coloured:
        pixels[2, 1] = [0.5, 0.5, 0.4]
    with tt.threads(2):
        mi.Bitmap(pixels).write(str(folder / name))
    return str(folder / name)


def cube_mesh(folder: Path) -> str:
    """A closed box as a mesh file."""
    corners = [(x, y, z) for x in (-0.3, 0.3) for y in (-0.3, 0.3) for z in (0.5, 0.9)]
    sides = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in sides]
    path = folder / "box.obj"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


def xml_room(inside: str, defaults: str = "") -> str:
    """The grey room as XML, with more elements inside it."""
    return f"""<scene version="3.0.0">
  {defaults}
  <integrator type="transient_path"/>
  <sensor type="perspective">
    <float name="fov" value="10"/>
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="transient_hdr_film"><integer name="width" value="4"/><integer name="height" value="4"/></film>
  </sensor>
  <emitter type="point"><point name="position" x="0.5" y="0" z="4"/>
    <spectrum name="intensity" value="10"/></emitter>
  <shape type="rectangle"><bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></shape>
  {inside}
</scene>
"""


def mirror_chain(bounces: int) -> dict:
    """A camera that sees a light over `bounces` reflections between two parallel mirrors, and nothing else.

    The mirrors are the planes x = 0 and x = 1, light runs at 45 degrees between them and crosses z by one metre from
    mirror to mirror. The light is a small square across the beam, black on its back.
    """
    length = bounces + 1.0
    mirror = {"type": "conductor", "material": "none"}
    half = length / 2 + 1.0

    def side(x: float, angle: float) -> dict:
        to_world = translate([x, 0.0, length / 2]) @ rotate([0, 1, 0], angle) @ scale([half, 1.0, 1.0])
        return {"type": "rectangle", "to_world": to_world, "bsdf": mirror}

    slope = 1.0 if bounces % 2 == 0 else -1.0
    light_to_world = translate([0.5, 0.0, 0.5 + bounces]) @ _facing([-slope, 0.0, -1.0]) @ scale(0.1)
    scene = grey_room(
        wall={
            "type": "sphere",
            "center": [0.0, 50.0, 0.0],
            "radius": 0.1,
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
        },
        left=side(0.0, 90.0),
        right=side(1.0, -90.0),
        light={
            "type": "rectangle",
            "to_world": light_to_world,
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": 1.0},
        },
    )
    scene["sensor"]["fov"] = 0.2
    scene["sensor"]["to_world"] = look_at([0.5, 0.0, 0.5], [1.0, 0.0, 1.0])
    return scene


def _facing(direction: list[float]) -> np.ndarray:
    return look_at([0.0, 0.0, 0.0], direction)
