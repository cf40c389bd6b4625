"""What masks and blends scatter: the weighed sum of their parts, whatever they hold and are held by.

Paths that meet the mixture once see light that is linear in its weight, so that the mixture's transient is the weighed
sum of those of its parts. The bound is derived: three standard errors of independent renders.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_mixtures import (
    DIFFUSE,
    GLASS,
    METAL,
    MIRROR,
    PLASTIC,
    ROUGH_GLASS,
    blend,
    bump,
    mask,
    mirror_room,
    seen_through,
    two_sided,
)
from support.marks import long

VARIANT = "llvm_ad_mono"
SEEDS = 6


def bare(bsdf):
    return bsdf


def around_a_blend(wrapper, first=DIFFUSE, second=MIRROR, weight=0.3):
    mixture = wrapper(blend(first, second, weight))
    return mixture, [(1 - weight, wrapper(first)), (weight, wrapper(second))]


def blend_of_blends():
    inner = blend(MIRROR, METAL, 0.25)
    return blend(DIFFUSE, inner, 0.4), [(0.6, DIFFUSE), (0.3, MIRROR), (0.1, METAL)]


def masked(nested, opacity=0.7):
    return mask(nested, opacity), [(opacity, nested), (1 - opacity, {"type": "null"})]


MIXTURES = {
    "diffuse and glass": lambda: around_a_blend(bare, DIFFUSE, GLASS),
    "plastic and mirror": lambda: around_a_blend(bare, PLASTIC, MIRROR),
    "two-sided": lambda: around_a_blend(two_sided),
    "under bumps": lambda: around_a_blend(bump),
    "weight 0": lambda: around_a_blend(bare, weight=0.0),
    "blend of blends": blend_of_blends,
    "mask of plastic": lambda: masked(PLASTIC),
    "mask of a blend": lambda: masked(blend(DIFFUSE, MIRROR)),
}


THROUGH = {
    "rough glass and metal": lambda: around_a_blend(bare, ROUGH_GLASS, METAL),
    "mask of rough glass and paint": lambda: masked(blend(DIFFUSE, ROUGH_GLASS)),
    "thin sheet and paint": lambda: around_a_blend(
        bare, {"type": "principledthin", "roughness": 0.4, "spec_trans": 0.5, "diff_trans": 0.8}, DIFFUSE
    ),
}


def rows(bsdf, room=mirror_room):
    """Sums over the film of each time bin, by seed."""
    scene = room(bsdf)
    scene["integrator"]["max_depth"] = 3
    scene = mi.load_dict(scene, optimize=False)
    renders = [scene.integrator().render(scene, seed=seed, spp=512)[1] for seed in range(SEEDS)]
    return np.array([np.array(cube).sum((0, 1, 3)) for cube in renders])


# The others are the same code around other plugins.
@pytest.mark.parametrize("name", long(MIXTURES, ["blend of blends"]))
def test_mixture_is_the_weighed_sum_of_its_parts(name):
    check_sum(*MIXTURES[name]())


@pytest.mark.slow
@pytest.mark.parametrize("name", THROUGH)
def test_mixture_that_is_seen_through_is_the_weighed_sum_of_its_parts(name):
    check_sum(*THROUGH[name](), seen_through)


def check_sum(mixture, parts, room=mirror_room):
    found = rows(mixture, room).sum(1)
    # The parts use other seeds than the mixture only in that they draw other numbers; their errors count as well.
    weighed = [weight * rows(bsdf, room).sum(1) for weight, bsdf in parts if weight > 0]
    expected = sum(part.mean() for part in weighed)
    error = np.sqrt(sum(part.var(ddof=1) for part in [found, *weighed]) / SEEDS)
    assert abs(found.mean() - expected) < 3 * error + 1e-6 * expected
    assert error < 0.02 * expected


@pytest.mark.slow
def test_kinds_of_glass_that_become_different():
    """Paths behind either kind count its own index, whatever was rendered first."""
    images = []
    for first in (1.5, 1.2):
        mixture = blend(ROUGH_GLASS, {**ROUGH_GLASS, "int_ior": first}, 0.5)
        scene = mi.load_dict(seen_through(mixture), optimize=False)
        scene.integrator().render(scene, seed=0, spp=4)
        params = mi.traverse(scene)
        params["wall.bsdf.bsdf_1.eta"] = mi.Float(1.2)
        params.update()
        images.append(np.array(scene.integrator().render(scene, seed=0, spp=256)[1]))
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6 * images[0].max())


