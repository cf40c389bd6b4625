"""Which of the lines around a sensor decide what it stands in, one by one."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.hidden_shapes import ball
from torchtransient import plugins
from torchtransient.capture.wall import first_hits

VARIANT = "llvm_ad_mono"
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}


def around(**shapes):
    """Index at a camera at the origin that looks along z, and its lines in all directions."""
    mi.set_variant(VARIANT)
    plugins.sync()
    from torchtransient.plugins.sensors.surroundings import Surroundings

    camera = {"type": "perspective", "fov": 0.01, "film": {"type": "hdrfilm", "width": 1, "height": 1}}
    scene = mi.load_dict({"type": "scene", "camera": camera, **shapes}, optimize=False)
    sensor = scene.sensors()[0]
    found = Surroundings.from_scene(scene, sensor, [shape.bsdf() for shape in scene.shapes()])
    lines = np.array(found._lines(sensor).d, dtype=float)
    assert lines.shape == (3, 64) and (lines[2, ::2] > 0.999).all()
    return float(found.indices(scene)[0][0]), lines[:, 1::2]


@pytest.mark.slow
@pytest.mark.parametrize("half", [0.2, 0.87, 0.95, 2.0])
def test_more_lines_than_a_leak_has_leave_a_body(half):
    """Four of sixty-four are no more than that, five are."""
    pose = mi.ScalarTransform4f().translate([1, 0, 0]).rotate([0, 1, 0], 90).scale(half)
    index, (x, y, z) = around(pane={"type": "rectangle", "to_world": pose, "bsdf": GLASS})
    leave = int(((x > 0) & (np.abs(y) < half * x) & (np.abs(z) < half * x)).sum())
    assert (leave > 4) == (half > 0.9) and (half < 0.5 or half > 1 or leave in (4, 5))
    assert index == pytest.approx(1.5 if leave > 4 else 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("kept", [128, 98, 97, 64])
def test_nine_tenths_of_the_lines_enter_what_is_inside_out(kept):
    vertices, faces = ball((0, 0, 0), 1.0, 2)
    order = np.argsort(vertices[faces].mean(1) @ [0.3, 0.5, -0.2])
    faces = faces[order[:kept], ::-1]
    mi.set_variant(VARIANT)
    arrays = {"vertices": mi.TensorXf(np.float32(vertices)), "faces": mi.TensorXf(np.float32(faces))}
    shape = {"type": "mesh_arrays", "bsdf": GLASS, **arrays}
    index, lines = around(body=shape)
    hit = sum(int(first_hits(np.zeros((1, 3)), d, vertices[faces])[1][0] >= 0) for d in lines.T)
    assert hit == {97: 28, 98: 29}.get(kept, hit)
    assert index == pytest.approx(1 / 1.5 if hit >= 29 else 1.0)


def test_each_sensor_of_a_batch_has_its_own():
    """One far from a ball that is inside out and looks away, one in it: entered by all lines and left by none."""
    mi.set_variant(VARIANT)
    plugins.sync()
    from torchtransient.plugins.sensors.surroundings import Surroundings

    film = {"type": "hdrfilm", "width": 1, "height": 1}
    places = {f"at_{n}": mi.ScalarTransform4f().translate([0, 0, z]) for n, z in enumerate((9.0, 0.0))}
    cameras = {n: {"type": "perspective", "fov": 0.01, "film": film, "to_world": pose} for n, pose in places.items()}
    batch = {"type": "batch", "film": {**film, "width": 2}, **cameras}
    inside_out = {"type": "sphere", "flip_normals": True, "bsdf": GLASS}
    scene = mi.load_dict({"type": "scene", "batch": batch, "body": inside_out}, optimize=False)
    found = Surroundings.from_scene(scene, scene.sensors()[0], [shape.bsdf() for shape in scene.shapes()])
    assert [float(index[0]) for index in found.indices(scene)] == pytest.approx([1.0, 1 / 1.5])


@pytest.mark.parametrize(("levels", "index"), [(-1, 1 / 1.5), (1, 1.5), (2, 1.5**2), (4, 1.5**4), (5, 1.5**4)])
def test_bodies_around_each_other(levels, index):
    mi.set_variant(VARIANT)
    plugins.sync()
    from torchtransient.plugins.sensors.surroundings import _index_inside

    assert float(_index_inside(levels, mi.Float(1.5))[0]) == pytest.approx(index)
