"""Cameras of renderers: pixels, poses and what has none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import VARIANT, make_room, pose
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.rendering.cameras import camera_of

POSE = pose(0.3, -0.2, 2.5, 1.0)
KEYS = ["eye.x_fov", "eye.principal_point_offset_x", "eye.principal_point_offset_y", "eye.to_world"]
FILM = {"type": "transient_hdr_film", "width": 8, "height": 6, "crop_width": 5, "crop_height": 3, "crop_offset_x": 2,
        "crop_offset_y": 1, "temporal_bins": 4, "bin_width_opl": 2.0}  # fmt: skip


@pytest.fixture(scope="module")
def renderer():
    """Of three sensors, and their numbers."""
    room = make_room()
    del room["sensor"]
    room["flat"] = {"type": "orthographic", "film": FILM}
    room["eye"] = {"type": "perspective", "fov": 40.0, "fov_axis": "x", "principal_point_offset_x": 0.125,
                   "principal_point_offset_y": -0.25, "to_world": POSE, "film": FILM}  # fmt: skip
    room["lens"] = {"type": "thinlens", "fov": 60.0, "fov_axis": "x", "aperture_radius": 0.1, "focus_distance": 2.0,
                    "film": FILM}  # fmt: skip
    scene = tt.load(room, variant=VARIANT)
    made = tt.TransientRenderer(scene, parameters=KEYS, sensors=[1, 0], temporal_filter="tent")
    names = [sensor.id() for sensor in scene.built(made._options).scene.sensors()]
    return made, {name: names.index(name) for name in ("flat", "eye", "lens")}


def expected(fov):
    """Of a film of 8 x 6 pixels, of which a window begins at (2, 1); whole numbers are their middles."""
    f = 4 / np.tan(np.radians(fov) / 2)
    return [[f, 0, 3.5 - 2], [0, f, 2.5 - 1], [0, 0, 1]]


def test_cameras_in_pixels(renderer):
    made, number = renderer
    with pytest.raises(SceneError, match=r"a perspective or thinlens sensor, got 'flat' \(OrthographicCamera\)"):
        camera_of(made, sensor=number["flat"])
    eye, lens = (camera_of(made, sensor=number[name]) for name in ("eye", "lens"))
    assert eye.size == lens.size == (3, 5)
    np.testing.assert_allclose(eye.to_world.detach().numpy(), POSE, atol=1e-6)
    np.testing.assert_allclose(lens.intrinsics.detach().numpy(), expected(60.0), rtol=1e-5)
    shown = eye.intrinsics.detach().numpy()
    assert shown[0, 0] == pytest.approx(expected(40.0)[0][0], rel=1e-5) and shown[1, 1] == shown[0, 0]
    np.testing.assert_allclose(abs(shown[:2, 2] - [1.5, 1.5]), [8 * 0.125, 6 * 0.25], rtol=1e-5)


def test_values_of_a_call_count_with_their_gradients(renderer):
    made, number = renderer
    fov = torch.tensor(50.0, requires_grad=True)
    turned = torch.tensor(np.array(POSE), dtype=torch.float32) + 1
    found = camera_of(made, {"eye.x_fov": fov, "eye.to_world": turned}, sensor=number["eye"])
    assert torch.equal(found.to_world, turned)
    found.intrinsics[0, 0].backward()
    half = np.radians(50.0) / 2
    assert fov.grad.item() == pytest.approx(-4 / np.sin(half) ** 2 * np.pi / 360, rel=1e-5)
    with pytest.raises(ArgumentError, match="expected values without a batch, got one of 2; call it for each entry"):
        camera_of(made, {"eye.x_fov": torch.tensor([40.0, 50.0])}, sensor=number["eye"])


def test_sensors_by_number(renderer):
    made, number = renderer
    other = tt.TransientRenderer(made.scene, sensors=[number["lens"], number["eye"]])
    assert torch.equal(camera_of(other).intrinsics, camera_of(made, sensor=number["lens"]).intrinsics)
    for wrong in (-1, 3, 1.5, "eye"):
        with pytest.raises(ArgumentError, match="expected a sensor from 0 to 2, got"):
            camera_of(made, sensor=wrong)
