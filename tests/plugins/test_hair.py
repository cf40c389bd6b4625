"""``diff_hair`` against Mitsuba's ``hair``, a model in double precision and its own samples."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

import torchtransient as tt
from support.gradient_cases.scenes import area_light, room
from support.hair_model import scattered
from support.surface_samples import activate
from torchtransient import plugins
from torchtransient.errors import GradientError, SceneError

RGB = "llvm_ad_rgb"
INDEX = {"int_ior": 1.55, "ext_ior": 1.0}
# (longitudinal, azimuthal) roughness, tilt of the scales, index, absorption
FIBRES = [
    ((0.3, 0.3), 2.0, 1.55, 0.5),
    ((0.1, 0.2), 5.0, 1.55, 0.2),
    ((0.7, 0.9), 2.0, 1.3, 0.1),
    ((0.05, 0.1), -3.0, 1.8, 1.0),
]
COUNT = 50000


@pytest.fixture(autouse=True)
def mono():
    activate("llvm_ad_mono")


def described(roughness, tilt, eta, sigma, plugin="diff_hair"):
    return {
        "type": plugin,
        "longitudinal_roughness": roughness[0],
        "azimuthal_roughness": roughness[1],
        "scale_tilt": tilt,
        "int_ior": eta,
        "ext_ior": 1.0,
        "sigma_a": {"type": "uniform", "value": sigma},
    }


def directions(seed=0, count=COUNT):
    drawn = np.random.default_rng(seed).normal(size=(3, count))
    return (drawn / np.linalg.norm(drawn, axis=0)).astype(np.float32)


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f, np.shape(wi)[1])
    si.wi = mi.Vector3f(wi)
    return si


def sampled(bsdf, si, seed=1):
    count = dr.width(si.wi)
    rng = mi.PCG32(count, initstate=seed)
    return bsdf.sample(mi.BSDFContext(), si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))


def towards(theta, phi):
    """One direction, by the angle to the plane across the fibre and that around it."""
    return np.array([np.cos(theta) * np.cos(phi), np.sin(theta), np.cos(theta) * np.sin(phi)])[:, None]


@pytest.mark.parametrize("fibre", FIBRES, ids=str)
def test_values_are_those_of_the_model(fibre):
    roughness, tilt, eta, sigma = fibre
    bsdf = mi.load_dict(described(*fibre))
    wi = directions()
    si = interaction(wi)
    for wo in (directions(1), np.array(sampled(bsdf, si)[0].wo)):
        expected = scattered(wi.astype(float), wo.astype(float), sigma, roughness, tilt, eta)
        found = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo)))[0]
        # Rounding of angles, over widths that are a fraction of the roughness.
        np.testing.assert_allclose(found, expected, rtol=2e-5 / roughness[0], atol=1e-6)


@pytest.mark.slow
def test_colours_are_those_of_mitsuba():
    activate("llvm_ad_spectral")
    rough = {"longitudinal_roughness": 0.7, "azimuthal_roughness": 0.6, **INDEX}  # where the Bessel function is right
    colours = [{"eumelanin": 0.4, "pheomelanin": 0.3}, {"sigma_a": {"type": "rgb", "value": [0.1, 0.3, 0.9]}}]
    for colour in colours:
        theirs, ours = (mi.load_dict({"type": plugin, **rough, **colour}) for plugin in ("hair", "diff_hair"))
        si = interaction(directions())
        si.wavelengths = type(si.wavelengths)(420, 500, 600, 700)
        for bsdf in (theirs, ours):
            assert bsdf.component_count() == 2
        assert [theirs.flags(i) for i in range(2)] == [ours.flags(i) for i in range(2)]
        (a, weight_a), (b, weight_b) = (sampled(bsdf, si) for bsdf in (theirs, ours))
        dr.eval(a, weight_a, b, weight_b)
        # But for the rest of three crossings and more.
        same = dr.norm(a.wo - b.wo) < 1e-3
        assert dr.mean(dr.select(same, 1.0, 0.0))[0] > 0.9
        pairs = [(weight_a, weight_b), *zip(*(bsdf.eval_pdf(mi.BSDFContext(), si, a.wo) for bsdf in (theirs, ours)),
                                            strict=True), (a.pdf, b.pdf)]  # fmt: skip
        for one, other in pairs:
            one, other = (dr.select(same, x, 0) for x in (one, other))
            dr.eval(one, other)
            np.testing.assert_allclose(np.array(other), np.array(one), rtol=2e-3, atol=2e-3)


# ------------------------------------------------------------------------------------------------- densities, samples

# (theta, phi) of the light: across, oblique, grazing to one side, nearly along the fibre
LIGHT = [(0.0, 1.57), (0.5, 1.0), (-0.3, 0.15), (1.3, 2.0)]
SINES, TURNS, FINE = 40, 40, 12


def grid():
    """Directions at the middles of a grid of equal solid angles, the sines' cells outermost; and their solid angle."""
    sine = (np.arange(SINES * FINE) + 0.5) / (SINES * FINE) * 2 - 1
    phi = (np.arange(TURNS * FINE) + 0.5) / (TURNS * FINE) * 2 * np.pi - np.pi
    sine, phi = (x.ravel() for x in np.meshgrid(sine, phi, indexing="ij"))
    cosine = np.sqrt(1 - sine**2)
    return np.array([cosine * np.cos(phi), sine, cosine * np.sin(phi)]), 4 * np.pi / sine.size


@pytest.mark.parametrize(("fibre", "light"), [(FIBRES[n % 3], light) for n, light in enumerate(LIGHT)], ids=str)
def test_samples_have_their_density(fibre, light):
    bsdf = mi.load_dict(described(*fibre))
    wo, solid_angle = grid()
    count = 400_000
    si = interaction(np.repeat(towards(*light), wo.shape[1], axis=1))
    density = np.array(bsdf.pdf(mi.BSDFContext(), si, mi.Vector3f(wo))).astype(float)
    assert density.sum() * solid_angle == pytest.approx(1, abs=2e-3)
    cells = density.reshape(SINES, FINE, TURNS, FINE).sum((1, 3)) * solid_angle

    bs, _ = sampled(bsdf, interaction(np.repeat(towards(*light), count, axis=1)))
    drawn = np.array(bs.wo).astype(float)
    angles = np.arctan2(drawn[2], drawn[0])
    ranges = [(-1, 1), (-np.pi, np.pi)]
    counts, _, _ = np.histogram2d(drawn[1], angles, bins=(SINES, TURNS), range=ranges)
    expected = (cells * count / cells.sum()).ravel()
    counts = counts.ravel()
    order = np.argsort(expected)
    groups = np.floor(np.cumsum(expected[order]) / 200).astype(int)
    expected, counts = (np.bincount(groups, weights=x[order]) for x in (expected, counts))
    often = expected > 20
    chi2 = (np.square(counts - expected)[often] / np.maximum(expected, 1)[often]).sum()
    assert chi2 < stats.chi2.isf(1e-5, often.sum() - 1)


@pytest.mark.parametrize(("fibre", "light"), [(FIBRES[0], LIGHT[1]), (FIBRES[1], LIGHT[3])], ids=str)
def test_nothing_is_lost_where_nothing_is_absorbed(fibre, light):
    roughness, tilt, eta, _ = fibre
    bsdf = mi.load_dict(described(roughness, tilt, eta, 0.0))
    wo, solid_angle = grid()
    value = bsdf.eval(mi.BSDFContext(), interaction(np.repeat(towards(*light), wo.shape[1], axis=1)), mi.Vector3f(wo))
    assert np.array(value).astype(float).sum() * solid_angle == pytest.approx(1, abs=2e-3)
    _, weight = sampled(bsdf, interaction(np.repeat(towards(*light), 1000, axis=1)))
    np.testing.assert_allclose(np.array(weight), 1, rtol=1e-4)


# --------------------------------------------------------------------------------------------------------- derivatives

UNKNOWNS = ["longitudinal_roughness", "azimuthal_roughness", "scale_tilt", "eta", "sigma_a.value"]


def model_with(fibre, key, x):
    """Arguments of the model with one of them replaced."""
    (along, across), tilt, eta, sigma = fibre
    given = dict(zip(UNKNOWNS, (along, across, tilt, eta, sigma), strict=True)) | {key: x}
    along, across, tilt, eta, sigma = (given[name] for name in UNKNOWNS)
    return sigma, (along, across), tilt, eta


@pytest.mark.parametrize(("fibre", "key"), [(FIBRES[n % 4], key) for n, key in enumerate(UNKNOWNS)], ids=str)
def test_derivatives_are_those_of_the_model(fibre, key):
    bsdf = mi.load_dict(described(*fibre))
    wi = directions()
    si = interaction(wi)
    wo = np.array(sampled(bsdf, si)[0].wo)
    params = mi.traverse(bsdf)
    start = dict(zip(UNKNOWNS, (*fibre[0], *fibre[1:]), strict=True))[key]
    x = mi.Float(start)
    dr.enable_grad(x)
    params[key] = x
    params.update()
    value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo))[0]
    dr.forward(x)
    slope = dr.grad(value)
    dr.eval(value, slope)  # in one kernel
    found = np.array(slope)
    step = 1e-4 * abs(start)
    far, near = (
        scattered(wi.astype(float), wo.astype(float), *model_with(fibre, key, start + s)) for s in (step, -step)
    )
    expected = (far - near) / (2 * step)
    scale = np.array(value) / abs(start) + np.abs(expected)
    # Past the ends of the fibre and at the cut of the distribution, differences look across an edge.
    error = np.abs(found - expected) / (scale + 1e-5)
    assert np.percentile(error, 99.9) < 3e-3 and np.median(error) < 1e-4
    assert abs(found.sum() - expected.sum()) < 1e-3 * np.abs(expected).sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"longitudinal_roughness": 0.0, "azimuthal_roughness": 1.0}, {"azimuthal_roughness": 0.0, "sigma_a": 0.0},
        {"longitudinal_roughness": 1.0, "int_ior": 1.0}, {"int_ior": 0.7, "sigma_a": 1e4},
    ],
)  # fmt: skip
def test_values_and_derivatives_are_finite_at_the_ends(settings):
    bsdf = mi.load_dict({"type": "diff_hair", "sigma_a": 0.3, **INDEX, **settings})
    params = mi.traverse(bsdf)
    unknowns = {key: mi.Float(params[key]) for key in UNKNOWNS}
    for key, x in unknowns.items():
        dr.enable_grad(x)
        params[key] = x
    params.update()
    axes = np.concatenate([np.eye(3), -np.eye(3)], axis=1).astype(np.float32)
    wi = np.concatenate([np.repeat(axes, 6, axis=1), directions(2, 2000)], axis=1)
    wo = np.concatenate([np.tile(axes, 6), directions(3, 2000)], axis=1)
    si = interaction(wi)
    dr.enable_grad(si.wi)
    outgoing = mi.Vector3f(wo)
    dr.enable_grad(outgoing)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, outgoing)
    bs, weight = sampled(bsdf, si)
    assert not dr.grad_enabled(pdf) and not dr.grad_enabled(bs)
    dr.backward(dr.sum(value[0]) + dr.sum(weight[0]))
    for number in (value, pdf, weight, bs.wo, bs.pdf, *map(dr.grad, (*unknowns.values(), si.wi, outgoing))):
        assert np.isfinite(np.array(number)).all()
    assert dr.mean(dr.select(bs.pdf > 0, 1.0, 0.0))[0] > 0.99


# ------------------------------------------------------------------------------------------------------- in the library


def scene_with(description, bare=False):
    activate(RGB)
    scene = room(bsdf=description, light=area_light())
    return mi.load_dict(scene, optimize=False) if bare else tt.load(scene, variant=RGB)


@pytest.mark.parametrize(("key", "description"), [
    ("eumelanin", {"type": "hair"}), ("sigma_a.value", {"type": "hair", "sigma_a": {"type": "rgb", "value": 0.3}}),
])  # fmt: skip
def test_derivatives_of_mitsubas_own_are_refused(key, description):
    scene = scene_with(description, bare=True)
    params = mi.traverse(scene)
    value = type(params[f"wall.bsdf.{key}"])(params[f"wall.bsdf.{key}"])
    dr.enable_grad(value)
    params[f"wall.bsdf.{key}"] = value
    params.update()
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    with pytest.raises(GradientError, match="diff_hair"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=4)


@pytest.mark.parametrize(("settings", "words"), [
    ({"sigma_a": 0.1, "eumelanin": 1.0}, "either 'sigma_a' or pigments"),
    ({"sigma_a": 0.1, "azimuthal_roughness": 1.5}, r"'azimuthal_roughness' must be in \[0, 1\], got 1.5"),
    ({}, "pigments absorb by colour"),
    ({"sigma_a": 0.1, "int_ior": -1.0}, "'int_ior'"),
])  # fmt: skip
def test_what_is_refused(settings, words):
    with pytest.raises(SceneError, match=words), plugins.plugin_errors():
        mi.load_dict({"type": "diff_hair", **settings})
