"""What recipes tell of themselves: costs and contact sheets."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

import torchtransient as tt
from torchtransient.errors import SceneError

D = tt.data


@pytest.fixture(scope="module")
def recipe():
    scene = tt.scenes.cornell_box(resolution=16, num_bins=64, bin_width_opl=0.2, start_opl=2.0)
    vary = {
        "red.reflectance.value": D.Uniform(0.05, 0.9),
        "small-box.to_world": D.Turn(),
        "small-box.type": D.Choice(["cube", "sphere"]),
    }
    return D.Recipe(scene, vary, variant="llvm_ad_rgb", spp=4, labels=("depth", "normals"), n=1000)


@pytest.mark.slow
def test_cost(recipe):
    cost = recipe.cost(2)
    assert cost.values == ("red.reflectance.value", "small-box.to_world") and cost.exchanged == ("small-box.type",)
    assert cost.seen == 2 and [one.text for one in cost.structures] == ["small-box.type=cube", "small-box.type=sphere"]
    sample = recipe.sample(0)
    assert cost.sample_bytes == sum(array.nbytes for array in sample.arrays.values())
    assert 0 < cost.stored_bytes["rounded"] < cost.stored_bytes["exact"] < cost.sample_bytes
    # A histogram of radiances is no number of photons.
    assert cost.stored_bytes["counts"] is None
    assert cost.outside.samples == 64 and 0 <= cost.outside.mean <= cost.outside.most < 1
    assert 0 < cost.standard_error < 3 and all(one.sample_s > 0 for one in cost.structures)
    assert "built when new    small-box.type; 2 structures in 64 samples" in str(cost)


@pytest.mark.slow
def test_preview_is_a_picture(recipe, tmp_path):
    recipe.preview(4, tmp_path / "sheet.png")
    picture = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB"))
    assert min(picture.shape[:2]) > 200 and picture.std() > 20
    with pytest.raises(SceneError, match="whole number"):
        recipe.preview(0)
