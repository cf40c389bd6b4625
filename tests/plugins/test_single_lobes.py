"""A lobe that is asked for alone is drawn whatever number decides, and the other one never is."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from support.surface_samples import start

SURFACES = {
    "diff_plastic": {"int_ior": 1.4},
    "diff_rough_plastic": {"int_ior": 1.4, "alpha": 0.2},
    "diff_dielectric": {"int_ior": 1.4},
    "diff_rough_dielectric": {"int_ior": 1.4, "alpha": 0.2},
    "retroreflector": {"share": 0.4, "alpha": 0.3},
}


@pytest.fixture(autouse=True)
def mono(request):
    start(request, "llvm_ad_mono")


@pytest.mark.parametrize("number", [0.0, 1 - 2.0**-24])
@pytest.mark.parametrize("plugin", SURFACES)
def test_only_it_is_drawn(plugin, number):
    bsdf = mi.load_dict({"type": plugin, **SURFACES[plugin]})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0.28, 0, 0.96)
    for component in (0, 1):
        ctx = mi.BSDFContext()
        ctx.component = component
        bs, weight = bsdf.sample(ctx, si, mi.Float(number), mi.Point2f(0.4, 0.3))
        assert list(bs.sampled_component) == [component] and weight[0][0] > 0 and bs.pdf[0] > 0
