"""Shapes in groups are met as those outside of them are."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_instances import grouped
from support.gradient_cases.cases_media import block, clouds
from torchtransient import plugins


@pytest.fixture(autouse=True)
def mono():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


@pytest.mark.slow
def test_light_passes_open_boundaries_in_a_group():
    """A block of fog whose boundary has the BSDF ``null``: an instance of it was opaque."""
    images = []
    for scene in (block(clouds()), grouped(block(clouds()), "block")):
        scene = mi.load_dict(scene, optimize=False)
        images.append(np.array(scene.integrator().render(scene, seed=1, spp=64)[0]))
    assert images[0].mean() > 0
    np.testing.assert_allclose(images[1], images[0], rtol=1e-3)


