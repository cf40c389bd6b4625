"""Recipes of `dataset.py`, the scene file that y-tal renders the same captures from, and who hears of samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torchtransient as tt
from torchtransient.scenes import look_at

BOXES, COLOURS = ("small-box", "large-box"), ("red", "green", "white")
VARIANT = "llvm_ad_mono"
# Metres of path that the bins of a Cornell box hold.
START, LENGTH = 2.0, 10.0
LETTER = "letter"


def undisturbed(*message: Any) -> None:
    """Take the messages of a worker, and stop at a failure."""
    if message[0] == "retry" or (message[0] == "end" and message[3] is not None):
        raise RuntimeError(f"sample {message[2]} failed: {message[3]}")


def room(resolution: int, bins: int, spp: int) -> dict[str, Any]:
    return tt.scenes.cornell_box(
        resolution, num_bins=bins, bin_width_opl=LENGTH / bins, start_opl=START, spp=spp
    )


def moving_boxes(resolution: int, bins: int, spp: int) -> tt.data.Recipe:
    """A Cornell box whose two solids move and turn and whose three colours change."""
    colours = {f"{name}.reflectance.value": tt.data.Uniform(0.05, 0.9) for name in COLOURS}
    moves = tt.data.Compose([tt.data.Turn([0, 1, 0], 0, 360), tt.data.Offset([-0.2, 0, -0.5], [0.2, 0, 0.5])])
    vary: dict[str, Any] = {**colours, **{f"{name}.to_world": moves for name in BOXES}}
    return tt.data.Recipe(room(resolution, bins, spp), vary, variant=VARIANT)


def described(film: list[int], drawn: dict[str, Any]) -> dict[str, Any]:
    """The box with what a sample has drawn, as it would be written down by hand for that sample."""
    scene = room(*film)
    for name in COLOURS:
        value = float(drawn[f"{name}.reflectance.value"])
        scene[name] = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": value}}
    for name in BOXES:
        scene[name] = scene[name] | {"to_world": drawn[f"{name}.to_world"]}
    return scene


def several_views(views: int, resolution: int, bins: int, spp: int) -> tt.data.Recipe:
    """The same with a camera for each view."""
    scene = room(resolution, bins, spp)
    camera = scene.pop("sensor")
    for k in range(views):
        pose = look_at([0.7 * (k / max(1, views - 1) - 0.5), 0, 3.9], [0, 0, 0])
        scene[f"view{k}"] = camera | {"to_world": pose}
    return tt.data.Recipe(scene, moving_boxes(resolution, bins, spp).vary, sensors="all", variant=VARIANT)


# ----------------------------------------------------------------------------------------------------- y-tal's captures


def write_letter(path: Path) -> None:
    """Z of one metre in the plane of its origin, seen from below."""
    bars = [
        [(-0.5, 0.3), (0.5, 0.3), (0.5, 0.5), (-0.5, 0.5)],
        [(-0.5, -0.5), (0.5, -0.5), (0.5, -0.3), (-0.5, -0.3)],
        [(-0.5, -0.3), (-0.25, -0.3), (0.5, 0.3), (0.25, 0.3)],
    ]
    points = [f"v {0.6 * x:g} {0.6 * y:g} 0" for bar in bars for x, y in bar]
    faces = [f"f {4 * k + 1} {4 * k + c} {4 * k + b}" for k in range(len(bars)) for b, c in ((2, 3), (3, 4))]
    path.write_text("\n".join(points + faces) + "\n", encoding="ascii")


def tal_scene(
    mesh: Path, place: list[float], scan: int, bins: int, spp: int, width: float = 0.01
) -> str:
    """A confocal capture of the letter as `tal render` takes it: a wall of one metre, light of three bounces.

    The laser is far away, and sees the wall past the letter: y-tal's is a projector, whose light on a spot falls off
    with the distance, where a beam brings the same energy everywhere.
    """
    x, y, z = place
    return f"""
name: capture
mitsuba_variant: {VARIANT}
integrator_max_depth: 3
integrator_discard_direct_paths: true
integrator_nlos_hidden_geometry_sampling: true
integrator_nlos_hidden_geometry_sampling_includes_relay_wall: false
sample_count: {spp}
num_bins: {bins}
bin_width_opl: {width}
start_opl: 1.0
scan_type: confocal
sensor_x: -200.0
sensor_z: 100.0
laser_x: -200.0
laser_z: 100.0
sensor_width: {scan}
sensor_height: {scan}
laser_width: {scan}
laser_height: {scan}
geometry:
- name: {LETTER}
  mesh: {{type: obj, filename: '{mesh}'}}
  displacement_x: {x!r}
  displacement_y: {y!r}
  displacement_z: {z!r}
  material: {{id: white}}
- name: relay_wall
  mesh: {{type: rectangle}}
  displacement_x: 0.0
  displacement_y: 0.0
  displacement_z: 0.0
  scale_x: 0.5
  scale_y: 0.5
  scale_z: 1.0
  material: {{id: white}}
relay_wall: relay_wall
"""


def captures(scene_file: Path) -> tt.data.Recipe:
    """Captures of such a scene whose hidden mesh is elsewhere in each."""
    setup = tt.nlos.read_setup(scene_file)
    given = {key: setup[key] for key in ("scan", "time_axis", "spp", "bounces", "energy", "variant")}
    vary = {f"{LETTER}.to_world": tt.data.Offset([-0.2, -0.2, -0.15], [0.2, 0.2, 0.15])}
    return tt.data.Recipe(setup["hidden"], vary, **given)
