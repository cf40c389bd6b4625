"""``diff_principled`` and ``diff_principled_thin`` against Mitsuba's, and weights of lobes at their ends."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import area_light, glass_slab, room
from support.marks import long
from support.surface_samples import start
from support.sweeps import together
from torchtransient.errors import GradientError

TWINS = {"principled": "diff_principled", "principledthin": "diff_principled_thin"}
MANY = {
    "principled": {
        "spec_trans": 0.5, "sheen": 0.3, "sheen_tint": 0.4, "clearcoat": 0.5, "metallic": 0.2, "anisotropic": 0.5,
        "flatness": 0.3, "spec_tint": 0.2, "eta": 1.4, "clearcoat_sampling_rate": 2.0,
    },
    "principledthin": {"spec_trans": 0.5, "diff_trans": 0.8, "sheen": 0.3, "eta": 1.4, "flatness": 0.2},
}  # fmt: skip
SETTINGS = [
    *((kind, {}) for kind in TWINS),
    *((kind, many) for kind, many in MANY.items()),
    ("principled", {"spec_trans": 1.0, "roughness": 0.2, "specular": 0.3}),
    ("principled", {"metallic": 1.0, "spec_trans": 0.0}),
    ("principledthin", {"diff_trans": 2.0}),
]
# (plugin, slot, end, other settings, wi, wo): directions of which the lobe scatters one into the other.
GRAZING, ABOVE, BEHIND = (0.9, 0.0, 0.3), (-0.5, 0.2, 0.6), (-0.35, 0.05, -0.9)
ENDS = [
    ("principled", "clearcoat", 0.0, {}, GRAZING, ABOVE),
    ("principled", "sheen", 0.0, {}, GRAZING, ABOVE),
    ("principled", "spec_trans", 0.0, {"eta": 1.4}, ABOVE, (0.4, -0.1, -0.8)),
    ("principled", "spec_trans", 1.0, {"eta": 1.4}, GRAZING, ABOVE),
    ("principled", "metallic", 1.0, {}, GRAZING, ABOVE),
    ("principledthin", "sheen", 0.0, {}, GRAZING, ABOVE),
    ("principledthin", "spec_trans", 0.0, {"eta": 1.4}, ABOVE, (0.4, -0.1, -0.8)),
    ("principledthin", "spec_trans", 1.0, {"eta": 1.4}, GRAZING, ABOVE),
    ("principledthin", "diff_trans", 0.0, {}, ABOVE, BEHIND),
    ("principledthin", "diff_trans", 2.0, {}, GRAZING, ABOVE),
]


@pytest.fixture(autouse=True)
def mono(request):
    start(request, "llvm_ad_mono")


def interactions(count):
    rng = mi.PCG32(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    return si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())


@together("kind, settings", SETTINGS)
@pytest.mark.parametrize(
    "variant", long(["llvm_ad_mono", "llvm_ad_mono_polarized"], ["llvm_ad_mono"])
)
def test_values_densities_and_samples_are_those_of_mitsuba(kind, settings, variant):
    theirs, ours = (mi.load_dict({"type": name, **settings}) for name in (kind, TWINS[kind]))
    assert [theirs.flags(i) for i in range(theirs.component_count())] == [
        ours.flags(i) for i in range(ours.component_count())
    ]
    si, u, v = interactions(20000)
    ctx, wo = mi.BSDFContext(), mi.warp.square_to_uniform_sphere(v)
    (a, weight_a), (b, weight_b) = (bsdf.sample(ctx, si, u, v) for bsdf in (theirs, ours))
    counts = dr.max(mi.unpolarized_spectrum(weight_a)) > 0
    pairs = [(weight_a, weight_b), (a.wo, b.wo), (dr.select(counts, a.pdf, 0), b.pdf)]
    pairs += zip(theirs.eval_pdf(ctx, si, wo), ours.eval_pdf(ctx, si, wo), strict=True)
    dr.eval(pairs)  # in one kernel
    for one, other in pairs:
        np.testing.assert_allclose(np.array(other), np.array(one), rtol=1e-5, atol=1e-7)


def attached(number):
    """An attached value: sampling looks after the lobes of these."""
    x = mi.Float(number)
    dr.enable_grad(x)
    return x


def at(direction):
    return dr.normalize(mi.Vector3f(*direction))


@pytest.mark.parametrize(("kind", "slot", "end", "others", "wi", "wo"), ENDS)
def test_slopes_at_the_ends(kind, slot, end, others, wi, wo):
    """The one-sided slope of the value, and samples in the direction of the lobe."""
    bsdf = mi.load_dict({"type": TWINS[kind], slot: {"type": "uniform", "value": end}, "roughness": 0.6, **others})
    params, si = mi.traverse(bsdf), dr.zeros(mi.SurfaceInteraction3f)
    si.wi = at(wi)

    def value(x):
        params[f"{slot}.value"] = x
        params.update()
        return mi.Float(bsdf.eval(mi.BSDFContext(), si, at(wo))[0])

    x = attached(end)
    here = value(x)
    dr.backward(here)
    inwards = 0.02 if end == 0 else -0.02
    there, further = (float(value(mi.Float(end + k * inwards))[0]) for k in (1, 2))
    difference = (4 * there - 3 * float(here[0]) - further) / (2 * inwards)
    assert abs(difference) > 1e-3
    assert float(dr.grad(x)[0]) == pytest.approx(difference, rel=1e-2)
    theirs = mi.load_dict({"type": kind, slot: {"type": "uniform", "value": end}, "roughness": 0.6, **others})
    assert float(here[0]) == float(theirs.eval(mi.BSDFContext(), si, at(wo))[0][0])
    value(attached(end))
    assert float(bsdf.pdf(mi.BSDFContext(), si, at(wo))[0]) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "slot", "end"), [entry[:3] for entry in ENDS[2::3]])
def test_samples_at_the_ends_fit_their_density(kind, slot, end):
    """Share of the samples in each of two times two parts of the sphere, against the integral of the density."""
    bsdf = mi.load_dict({"type": TWINS[kind], slot: {"type": "uniform", "value": end}, "roughness": 0.6})
    params = mi.traverse(bsdf)
    params[f"{slot}.value"] = attached(end)
    params.update()
    count = 400000
    si, u, v = interactions(count)
    si.wi = at((0.3, 0.2, 0.8))
    bs, _ = bsdf.sample(mi.BSDFContext(), si, u, v)
    wo = mi.warp.square_to_uniform_sphere(v)
    density = np.array(bsdf.pdf(mi.BSDFContext(), si, wo)) * 4 * np.pi
    for side in (1, -1):
        for half in (1, -1):
            drawn = np.array((bs.pdf > 0) & (bs.wo.z * side > 0) & (bs.wo.x * half > 0)).mean()
            integral = np.array(dr.select((wo.z * side > 0) & (wo.x * half > 0), 1, 0)) * density
            assert drawn == pytest.approx(integral.mean(), abs=0.005 + 4 * integral.std() / np.sqrt(count))


def test_what_is_not_asked_for_is_sampled_as_by_mitsuba():
    """A derivative by one weight does not change how the other lobes are drawn."""
    settings = {"clearcoat": {"type": "uniform", "value": 0.0}, "sheen": {"type": "uniform", "value": 0.0}}
    names = ("principled", "diff_principled")
    theirs, ours = (mi.load_dict({"type": name, **settings}, optimize=False) for name in names)
    params = mi.traverse(ours)
    params["sheen.value"] = attached(0)
    params.update()
    si, u, v = interactions(1000)
    directions = [np.array(bsdf.sample(mi.BSDFContext(), si, u, v)[0].wo) for bsdf in (theirs, ours)]
    np.testing.assert_array_equal(*directions)


def test_a_described_surface_is_built_anew():
    paint = {"type": "principled", "base_color": 0.6}
    scene = tt.load(room(bsdf={"type": "twosided", "nested": paint}, light=area_light()), variant="llvm_ad_mono")
    table = scene.parameters()
    key = "wall.bsdf.brdf_0.clearcoat.value"
    assert table[key].differentiable and not table[key].biased and "diff_principled" in table[key].reason
    assert not table["wall.bsdf.brdf_0.base_color.value"].substitute


def arrival(image):
    """Mean time bin of the light."""
    light = image.sum((-1, -2)).flatten().double()
    return float((light * torch.arange(len(light))).sum() / light.sum())


@pytest.mark.slow
@pytest.mark.parametrize("around", ["nothing", "twosided"])
def test_a_lobe_of_transmission_that_is_asked_for_refracts(around):
    """Light behind the surface counts with its index, although the description lacks the lobe."""

    def scene(**more):
        glass = {"type": "principled", "eta": 1.4, "roughness": 0.3, "base_color": 0.9, **more}
        wrapped = {
            "nothing": glass,
            "twosided": {"type": "twosided", "allow_transmission": True, "nested": glass},
        }
        return tt.load(glass_slab(wrapped[around]), variant="llvm_ad_mono")

    axis = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.05, num_bins=300)
    described, asked = scene(spec_trans=0.9), scene()
    table = asked.parameters()
    keys = {slot: next(key for key in table if key.endswith(f"{slot}.value")) for slot in ("spec_trans", "sheen")}
    # What another renderer looked up before does not matter.
    tt.TransientRenderer(asked, parameters=[keys["sheen"]], time_axis=axis, spp=4)(seed=0)
    renderer = tt.TransientRenderer(asked, parameters=[keys["spec_trans"]], time_axis=axis, spp=20000)
    found = renderer(values={keys["spec_trans"]: torch.tensor(0.9)}, seed=0).transient
    expected = tt.TransientRenderer(described, time_axis=axis, spp=20000)(seed=0).transient
    assert arrival(found.detach()) == pytest.approx(arrival(expected), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("between", ["blendbsdf of a bumpmap", "reference"])
def test_a_lobe_of_transmission_deep_inside_two_sides(between):
    """Mitsuba refuses transmission under ``twosided`` unless it is told that it is meant."""
    paint = {"type": "principled", "base_color": 0.6}
    heights = {"type": "bitmap", "raw": True, "data": np.full((2, 2, 1), 0.5, dtype=np.float32)}
    bumpy = {"type": "bumpmap", "heights": heights, "nested": paint}
    nested = {
        "blendbsdf of a bumpmap": {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": bumpy},
        "reference": {"type": "bumpmap", "heights": heights, "nested": {"type": "ref", "id": "paint"}},
    }[between]
    more = {"paint": paint} if between == "reference" else {}
    scene = tt.load({**more, **room(bsdf={"type": "twosided", "nested": nested})}, variant="llvm_ad_mono")
    key = next(key for key in scene.parameters() if key.endswith("spec_trans.value"))
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=16)
    renderer(seed=0).steady.sum().backward()
    assert float(renderer.values[key].grad) < 0


@pytest.mark.parametrize(("kind", "slot"), [("principled", "spec_trans"), ("principledthin", "diff_trans")])
def test_lost_lobes_of_mitsubas_own_are_refused(kind, slot):
    scene = mi.load_dict(glass_slab({"type": kind, slot: 0.0}, "rectangle"), optimize=False)
    params = mi.traverse(scene)
    value = mi.Float(0)
    dr.enable_grad(value)
    params[f"slab.bsdf.{slot}.value"] = value
    params.update()
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    with pytest.raises(GradientError, match="diff_principled"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=4)
