"""Reduction of scenes to plain data that differs for every number, and objects without a description."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import GREY, make_room
from torchtransient.errors import SceneError

VARIANT = "llvm_ad_rgb"


# ------------------------------------------------------------------------------------------------------ dictionaries


def test_tensors_of_three_rows_are_no_colours_or_points(capfd):
    """Pixels, voxels and distances arrive as they are, and without a line of nanobind for each kind tried."""
    rng = np.random.default_rng(0)
    pixels = rng.random((3, 4, 3), dtype=np.float32)
    voxels = rng.random((3, 3, 2, 1), dtype=np.float32) - np.float32(0.5)
    grid = {"type": "gridvolume", "data": voxels, "raw": True}
    paint = {
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {
            "type": "bitmap", "data": pixels, "raw": True}}},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {
            "type": "volume", "volume": grid}}},
        "ball": {"type": "sdfgrid", "grid": torch.from_numpy(voxels)},
    }  # fmt: skip
    scene = tt.load({"type": "scene", **paint}, variant=VARIANT)
    values = {key: info.value for key, info in scene.parameters().items()}
    assert np.array_equal(np.array(values["wall.bsdf.reflectance.data"]), pixels)
    assert np.array_equal(np.array(values["floor.bsdf.reflectance.volume.data"]), voxels)
    assert np.array_equal(np.array(values["ball.grid"]).ravel(), voxels.ravel())
    assert capfd.readouterr().err == ""


# --------------------------------------------------------------------------------------------------------------- XML


def test_files_in_files_count_their_levels(tmp_path):
    outer = f"<s>{'<b>' * 3}<include filename='d.xml'/>{'</b>' * 3}</s>"
    (tmp_path / "c.xml").write_text(outer, encoding="utf-8")
    for levels, deep in ((59, False), (60, True)):
        (tmp_path / "d.xml").write_text("<b>" * levels + "</b>" * levels, encoding="utf-8")
        if deep:
            with pytest.raises(SceneError, match=r"d\.xml: expected elements at most 64 levels deep"):
                tt.load(tmp_path / "c.xml")
        else:
            tt.load(tmp_path / "c.xml")


# --------------------------------------------------------------------------------------------------------- of a call


def test_samples_over_seconds():
    """The rate counts all pixels of all films, each with its number of samples."""
    room = make_room()
    scene = tt.load(room, variant=VARIANT)
    stats = tt.render(scene, {GREY: torch.rand(3) * 0.5}, spp=4, seed=0).stats
    film = room["sensor"]["film"]
    assert stats.samples_per_second * stats.seconds == pytest.approx(3 * 4 * film["width"] * film["height"])
    assert len(stats.seeds) == 3 and 0 < stats.seconds < 100


def test_values_with_gradients_are_saved(tmp_path):
    """The numbers of a renderer's own parameters, few of them and many."""
    room = make_room()
    pixels = np.linspace(0.1, 0.9, 108, dtype=np.float32).reshape(6, 6, 3)
    room["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "raw": True, "data": pixels}
    keys = ["wall.bsdf.reflectance.data", "wall.to_world"]
    renderer = tt.TransientRenderer(tt.load(room, variant=VARIANT), parameters=keys, temporal_filter="tent")
    with torch.no_grad():
        renderer.values[keys[0]].mul_(0.5)
        renderer.values[keys[1]][0, 3] += 0.25
    path = renderer.scene.save(tmp_path / "scene.xml", renderer.values)
    assert sorted(os.listdir(tmp_path)) == ["scene.xml", "scene_files"]
    again = tt.TransientRenderer(tt.load(path, variant=VARIANT), parameters=keys, temporal_filter="tent")
    for key in keys:
        torch.testing.assert_close(again.values[key], renderer.values[key], rtol=1e-5, atol=1e-6)
    # And taken as the start of another renderer, which has numbers of its own.
    other = tt.TransientRenderer(renderer.scene, parameters=dict(renderer.values), temporal_filter="tent")
    with torch.no_grad():
        renderer.values[keys[0]].zero_()
    torch.testing.assert_close(other.values[keys[0]], again.values[keys[0]], rtol=1e-5, atol=1e-6)
    assert other.values[keys[0]].is_leaf
