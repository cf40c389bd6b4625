"""Scenes for steady pictures through time: what nodes state and leave out means what it means to Mitsuba, unlimited
depth is unlimited, and derivatives name the bound that they use.
"""

from __future__ import annotations

import copy
import warnings

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import GradientError, PhysicsError, PhysicsWarning, SceneError
from torchtransient.rendering.films import Gates, Histogram, Phasors
from torchtransient.scene.edits import BuildOptions, printed_properties
from torchtransient.scene.values import may_have_derivative

VARIANT = "llvm_ad_rgb"
AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=1.0, num_bins=2)
HISTOGRAM = Histogram(AXIS)
PATH, FILM = {"type": "path"}, {"type": "hdrfilm"}


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


def room(integrator=PATH, film=FILM, **sensor):
    return {
        "type": "scene",
        "ball": {"type": "sphere", "emitter": {"type": "area"}},
        "sensor": {"type": "perspective", "film": copy.deepcopy(film), **sensor},
        **({} if integrator is None else {"integrator": integrator}),
    }


def as_xml(path, scene):
    """The scene as a file, without being built."""
    state = mi.parser.parse_dict(mi.parser.ParserConfig(VARIANT), scene)
    for node in state.nodes:  # plugins written in Python, whose kind is not known before they are built
        if node.type == mi.ObjectType.Unknown:
            is_film = "film" in node.props.plugin_name()
            node.type = mi.ObjectType.Film if is_film else mi.ObjectType.Integrator
    mi.parser.write_file(state, str(path))
    return path


def translated(scene, **options):
    return tt.load(scene, variant=mi.variant()).built(
        BuildOptions(**{"transient": True, "film": HISTOGRAM} | options)
    ).scene  # fmt: skip


# ------------------------------------------------------------------------------------------------------ what is stated


def of_paths(integrator):
    """max_depth (-1: no limit), rr_depth, hide_emitters"""
    shown = {**printed_properties(integrator), **getattr(integrator, "__dict__", {})}
    depth, first = int(shown["max_depth"]), int(shown["rr_depth"])
    return -1 if depth == 2**32 - 1 else depth, first, bool(integrator.hide_emitters)


STATED = ({}, {"max_depth": -1}, {"max_depth": 9, "rr_depth": 3, "hide_emitters": True})


@pytest.mark.parametrize(
    "plugin", ["path", "volpath", "volpathmis", "prb", "prb_basic", "prb_projective", "prbvolpath"]
)
def test_integrators_mean_what_they_mean_to_mitsuba(plugin, tmp_path):
    """Described as dictionary or file, or ready, alone or in place of another one."""
    for stated in STATED:
        node = {"type": plugin, **stated}
        own = of_paths(mi.load_dict(node))
        scene = room(node)
        described = [scene, as_xml(tmp_path / "scene.xml", scene)]
        if "prb" not in plugin:  # written in Python, and taken as they are
            described.append(mi.load_dict(scene))
        assert [of_paths(translated(given).integrator()) for given in described] == [own] * len(described)
        assert of_paths(translated(scene, integrator="transient_prbvolpath").integrator()) == own
        around = room({"type": "moment", "nested": node}, FILM)
        assert of_paths(translated(around, integrator="transient_path").integrator()) == own
    assert of_paths(translated(scene, max_depth=4).integrator())[0] == 4


def test_scenes_without_an_integrator_are_those_of_path():
    for scene in (room(None), mi.load_dict(room(None))):
        assert of_paths(translated(scene).integrator()) == of_paths(mi.load_dict(PATH))
    assert of_paths(translated(room({"type": "direct"}), integrator="transient_path").integrator())[0] == 2


@pytest.mark.parametrize(
    "stated",
    [
        {},
        {"width": 7, "height": 5},
        {"width": 7, "height": 5, "crop_width": 3, "crop_height": 2, "crop_offset_x": 2, "crop_offset_y": 1},
        {"sample_border": True, "rfilter": {"type": "tent", "radius": 1.5}},
        {"file_format": "pfm", "component_format": "float32", "pixel_format": "rgb", "banner": False},
        {"file_format": "rgbe", "pixel_format": "luminance"},  # Mitsuba makes it RGB
    ],
    ids=lambda stated: " ".join(stated) or "nothing",
)
def test_films_mean_what_they_mean_to_mitsuba(stated, tmp_path):
    def of(film):
        return [*film.size(), *film.crop_size(), *film.crop_offset(), film.sample_border(), str(film.rfilter())]

    scene = room(film={**FILM, **stated})
    own = of(mi.load_dict({**FILM, **stated}))
    for given in (scene, as_xml(tmp_path / "scene.xml", scene), mi.load_dict(scene)):
        (sensor,) = translated(given).sensors()
        assert of(sensor.film()) == own and sensor.film().base_channels_count() == 3


def test_pixels_that_a_film_does_not_have_are_refused():
    with_pixels = {name: room(film={**FILM, "pixel_format": name}) for name in ("luminance", "rgba", "xyz", "xyza")}
    for name, scene in with_pixels.items():
        for given in (scene, mi.load_dict(scene)):
            with pytest.raises(SceneError, match=f"pixel_format: expected 'rgb', got '{name}'.*leave it out"):
                translated(given)
    mi.set_variant("llvm_ad_mono")
    for scene in with_pixels.values():  # Mitsuba has one channel of them there
        assert translated(scene).sensors()[0].film().base_channels_count() == 1
    with pytest.raises(SceneError, match="expected 'luminance', got 'luminance_alpha'"):
        translated(room(film={**FILM, "pixel_format": "luminance_alpha"}))


def test_files_of_older_versions_spell_properties_in_another_way(tmp_path):
    path = tmp_path / "old.xml"
    path.write_text(
        '<scene version="0.6.0"><integrator type="path"><integer name="maxDepth" value="3"/></integrator>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="cropWidth" value="5"/></film></sensor></scene>',
        encoding="utf-8",
    )
    found = translated(path)
    assert of_paths(found.integrator())[0] == 3 and found.sensors()[0].film().crop_size()[0] == 5


# ---------------------------------------------------------------------------------------------------- what is misspelt

MISSPELT = {
    "integrator": (room({**PATH, "max_dpeth": 3}), {}, "'path' does not read 'max_dpeth' = 3"),
    "volumes": (room({"type": "volpathmis", "rr_dpeth": 3}), {}, "'volpathmis' does not read 'rr_dpeth'"),
    "of another": (room({**PATH, "use_spectral_mis": True}), {}, "'path' does not read 'use_spectral_mis'"),
    "nested": (
        room({"type": "aov", "aovs": "d:depth", "nested": {**PATH, "max_dpeth": 3}}),
        {"integrator": "transient_path"},
        "'path' does not read 'max_dpeth'",
    ),
    "around": (
        room({"type": "stokes", "max_depth": 3, "nested": PATH}),
        {"integrator": "transient_path"},
        "'stokes' does not read 'max_depth'",
    ),
    "transient": (
        room({"type": "transient_path", "max_dpeth": 3}),
        {"integrator": "transient_prbvolpath"},
        "'transient_path' does not read 'max_dpeth'",
    ),
    "film": (room(film={**FILM, "crop_witdh": 3}), {}, "'hdrfilm' does not read 'crop_witdh'"),
    "film of gates": (
        room(film={**FILM, "exhaustive_scan": True}),
        {"film": Gates((tt.Gate.rectangular(1.0, 2.0),))},
        "'hdrfilm' does not read 'exhaustive_scan'",
    ),
    "histogram": (
        room(film={"type": "transient_hdr_film", "temporal_binz": 3}),
        {"film": Phasors(tt.FrequencyAxis((0.5,)))},
        "'transient_hdr_film' does not read 'temporal_binz'",
    ),
    "filter": (
        room(film={**FILM, "rfilter": {"type": "gaussian", "stdev": 0.3}}), {}, "'gaussian' does not read 'stdev'",
    ),
    "sampler": (
        room(sampler={"type": "independent", "sample_cuont": 9}),
        {},
        "'independent' does not read 'sample_cuont'",
    ),
    "sensor": (room(fovv=3.0), {}, "'perspective' does not read 'fovv'"),
    "value": (room(film={**FILM, "file_format": "bmp"}), {}, 'The "file_format" parameter must .* found bmp'),
    "depth": (room({**PATH, "max_depth": -7}), {}, '"max_depth" must be set to -1'),
    "number": (room({**PATH, "rr_depth": 1.5}), {}, "expected integer, got float"),
    "silhouettes": (room({"type": "prb_projective", "sppi": 4}), {}, "'sppi': expected no samples of silhouettes"),
}  # fmt: skip


def test_what_asks_for_no_samples_of_silhouettes_passes():
    node = {"type": "prb_projective", "sppp": 0, "sppi": 0, "guiding": "none", "guiding_proj": False, "max_depth": 4}
    assert of_paths(translated(room(node)).integrator())[0] == 4
    for stated in ({"sppc": 0}, {"guiding": "grid"}):
        with pytest.raises(SceneError, match="expected no samples of silhouettes"):
            translated(room({**node, **stated}))


@pytest.mark.parametrize("name", MISSPELT)
def test_what_mitsuba_refuses_is_refused(name, tmp_path):
    scene, options, said = MISSPELT[name]
    for given in (scene, as_xml(tmp_path / "scene.xml", scene)):
        with pytest.raises(SceneError, match=said):
            translated(given, **options)


# ------------------------------------------------------------------------------------------------------------- renders

ALBEDO, KEY = 0.8, "ball.bsdf.reflectance.value"
WINDOW = tt.TimeAxis(start_opl=0.0, bin_width_opl=2.0, num_bins=100)


def oven(integrator=PATH):
    """Inside of a closed sphere that shines itself: 1 + a + a^2 + ... everywhere, by the depth in lengths of two."""
    film = {**FILM, "width": 4, "height": 4, "rfilter": {"type": "box"}}
    scene = room(integrator, film, sampler={"type": "independent", "sample_count": 512})
    paint = {"type": "diffuse", "reflectance": {"type": "uniform", "value": ALBEDO}}
    shine = {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}
    return scene | {"ball": {"type": "sphere", "flip_normals": True, "bsdf": paint, "emitter": shine}}


def mean_and_error(values):
    """Mean and standard error of numbers that are drawn alike."""
    return float(values.mean()), float(values.std() / np.sqrt(values.numel()))


@pytest.mark.parametrize("plugin", ["path", "volpath", "volpathmis"])
def test_depth_that_is_not_stated_has_no_limit(plugin):
    out = tt.render(tt.load(oven({"type": plugin}), variant="llvm_ad_mono"), time_axis=WINDOW, seed=0)
    mean, error = mean_and_error(out.steady)
    assert error < 0.05 and abs(mean - 1 / (1 - ALBEDO)) < 4 * error
    assert out.stats.max_depth == -1 and out.stats.light_beyond is None
    assert float(out.transient.sum(1).mean()) == pytest.approx(mean, rel=1e-4)


@pytest.mark.slow
def test_glass_is_as_bright_as_mitsuba_makes_it():
    """Behind two walls of glass that stand in a room of mirrors: most of the light is deeper than six."""
    scene = oven({"type": "path", "rr_depth": 8}) | {
        "glass": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "dielectric"}},
        "core": {"type": "sphere", "radius": 0.4, "bsdf": {"type": "dielectric"}},
    }
    mi.set_variant("llvm_ad_mono")
    ready, described = mi.load_dict(scene), tt.load(scene, variant="llvm_ad_mono")
    own = torch.tensor([float(np.mean(mi.render(ready, seed=seed, spp=128))) for seed in range(8)])
    ours = torch.tensor([float(tt.render(described, time_axis=WINDOW, seed=s).steady.mean()) for s in range(8, 16)])
    (mean, error), (found, own_error) = mean_and_error(own), mean_and_error(ours)
    assert abs(mean - found) < 4 * np.hypot(error, own_error)
    cut = float(tt.render(described, time_axis=WINDOW, seed=0, max_depth=6).steady.mean())
    assert cut < 0.8 * mean


# -------------------------------------------------------------------------------------------------------- derivatives


def asked(function, *arguments, **options):
    """(result, physics warnings)"""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = function(*arguments, **options)
    return result, [str(one.message) for one in caught if issubclass(one.category, PhysicsWarning)]


def test_derivatives_name_their_bound():
    """Value and derivative are those of a renderer with that depth; what lies beyond is a^depth of the light."""
    mi.set_variant("llvm_ad_mono")
    scene = tt.load(oven())
    renderer = tt.TransientRenderer(scene, parameters=[KEY], time_axis=WINDOW, spp=16)
    out, said = asked(renderer, seed=0)
    depth, beyond = out.stats.max_depth, out.stats.light_beyond
    # The pilot run's 2000 paths a block of the picture and more know a share of a thousandth within a half.
    assert 0.5e-3 * ALBEDO < ALBEDO**depth < 2e-3 and beyond == pytest.approx(ALBEDO**depth, rel=0.6)
    assert len(said) == 1 and f"max_depth {depth}" in said[0] and f"{beyond:.2g} +-" in said[0]
    assert f"max_depth {depth} with {beyond:.2g} of the light beyond" in repr(out)
    stated = tt.TransientRenderer(scene, parameters=[KEY], time_axis=WINDOW, spp=16, max_depth=depth)
    same, said = asked(stated, seed=0)
    assert said == [] and same.stats.light_beyond is None and same.stats.max_depth == depth
    torch.testing.assert_close(out.transient, same.transient)
    for each in (out, same):
        each.steady.mean().backward()
    torch.testing.assert_close(renderer.values[KEY].grad, stated.values[KEY].grad, rtol=1e-4, atol=0.0)
    with torch.no_grad():
        again, said = asked(renderer, seed=0)
    assert said == [] and again.stats.max_depth == depth
    torch.testing.assert_close(again.steady, out.steady.detach())
    # A thousandth of the light beyond is no error, as little as that beyond a window.
    strict = tt.TransientRenderer(tt.load(oven()), parameters=[KEY], time_axis=WINDOW, spp=16, physics="error")
    assert [f"max_depth {depth}" in text for text in asked(strict, seed=0)[1]] == [True]


@pytest.mark.slow
def test_a_bound_keeps_the_light_of_a_late_window():
    """The light of all times has a bound that leaves a third of what comes so late to deeper paths."""
    mi.set_variant("llvm_ad_mono")
    late = tt.TimeAxis(40.0, 1.0, 20)
    common = {"parameters": [KEY], "time_axis": late, "spp": 64, "physics": "ignore"}
    scene = tt.load(oven() | {"integrator": {"type": "path", "rr_depth": 1000}})
    found, deep = (tt.TransientRenderer(scene, max_depth=depth, **common)(seed=0) for depth in (None, 256))
    torch.testing.assert_close(found.transient.sum(), deep.transient.sum(), rtol=2e-2, atol=0.0)


def modes(function, value):
    """Calls of a function of one number, by what torch differentiates them with."""
    batch = value[None]
    return {
        "reverse": lambda: function(value.clone().requires_grad_()).backward(),
        "grad": lambda: torch.func.grad(function)(value),
        "jvp": lambda: torch.func.jvp(function, (value,), (value,)),
        "vmap of grad": lambda: torch.func.vmap(torch.func.grad(function))(batch),
        "grad of vmap": lambda: torch.func.grad(lambda x: torch.func.vmap(function)(x).sum())(batch),
        "jvp of vmap": lambda: torch.func.jvp(torch.func.vmap(function), (batch,), (batch,)),
    }


def test_which_values_can_be_differentiated_by():
    found, value = [], torch.tensor(ALBEDO)

    def square(given):
        found.append(may_have_derivative(given))
        return given * given

    square(value), torch.func.vmap(square)(value[None])
    for run in modes(square, value).values():
        run()
    with torch.no_grad():
        square(value.clone().requires_grad_())
    assert found == [False] * 2 + [True] * 7


@pytest.mark.slow
@pytest.mark.parametrize(("albedo", "share"), [(0.97, 1e-3), (0.99, 0.99**512)])
def test_bounds_of_bright_rooms(albedo, share):
    """No bound is deeper than 512 where Russian roulette ends no path, and a warning gives the rest.

    A pilot run of that depth lacks a^512 of the light that it takes for all, and by the middle, a^256, the light has
    fallen to as much as it falls from there.
    """
    mi.set_variant("llvm_ad_mono")
    scene = oven()
    scene["ball"]["bsdf"]["reflectance"]["value"] = albedo
    renderer = tt.TransientRenderer(scene, parameters=[KEY], time_axis=WINDOW, spp=1, physics="ignore")
    stats = renderer(seed=0).stats
    assert stats.light_beyond == pytest.approx(albedo**stats.max_depth, rel=2 * albedo**256 + 0.02)
    assert share * 0.9 < albedo**stats.max_depth <= share


@pytest.mark.slow
def test_a_bound_that_leaves_too_much_is_an_error_where_asked():
    """More than half of the light is deeper than 512 at an albedo of 0.999."""
    mi.set_variant("llvm_ad_mono")
    scene = oven()
    scene["ball"]["bsdf"]["reflectance"]["value"] = 0.999
    strict = tt.TransientRenderer(scene, parameters=[KEY], time_axis=WINDOW, spp=1, physics="error")
    with pytest.raises(PhysicsError, match="give max_depth= for these"):
        strict(seed=0)


@pytest.mark.slow
def test_which_calls_have_a_bound():
    """Calls that may be differentiated, in either mode, have one."""
    mi.set_variant("llvm_ad_mono")
    renderer = tt.TransientRenderer(oven(), parameters=[KEY], time_axis=WINDOW, spp=16, physics="ignore")
    depths, value = [], torch.tensor(ALBEDO)

    def bright(given):
        out = renderer({KEY: given}, seed=0)
        depths.append(out.stats.max_depth)
        return out.steady.mean()

    bright(value), torch.func.vmap(bright)(value[None])
    assert depths == [-1, -1]
    for name, run in modes(bright, value).items():
        depths.clear()
        run()
        assert depths[0] > 20, name
    # One bound for all samplers, which differ in noise alone.
    assert renderer.variation(sampler="stratified")(seed=1).stats.max_depth == depths[0]
    renderer.requires_grad_(False)
    assert renderer(seed=0).stats.max_depth == -1


def test_bounds_that_are_not_found():
    scene = oven()
    scene["ball"].pop("emitter")
    dark = tt.TransientRenderer(tt.load(scene, variant="llvm_ad_mono"), parameters=[KEY], time_axis=WINDOW, spp=1)
    with pytest.raises(GradientError, match=r"a pilot run saw no light\. Set max_depth"):
        dark(seed=0)


def test_plans_say_what_has_no_limit():
    plan = tt.plan(oven(), parameters=[KEY], time_axis=WINDOW, max_depth="scene", pilot=False)
    assert plan.max_depth == -1 and "max_depth: no limit (derivatives: a bound that renderers find)" in str(plan)
    pictures = oven({"type": "aov", "aovs": "d:depth", "nested": {"type": "path", "max_depth": 4}})
    plan = tt.plan(pictures, time_axis=WINDOW, max_depth="scene", pilot=False)
    assert plan.max_depth == 4 and "not rendered: the pictures that 'aov' adds" in str(plan)
