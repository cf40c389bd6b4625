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
from torchtransient.errors import PhysicsError, PhysicsWarning
from torchtransient.rendering import films
from torchtransient.scene.edits import BuildOptions, printed_properties

VARIANT = "llvm_ad_rgb"
AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=1.0, num_bins=2)
HISTOGRAM = films.Histogram(AXIS)
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


@pytest.mark.parametrize("plugin", ["path", "volpathmis", "prb_projective", "prbvolpath"])
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
        {"width": 7, "height": 5, "crop_width": 3, "crop_height": 2, "crop_offset_x": 2, "crop_offset_y": 1},
        {"sample_border": True, "rfilter": {"type": "tent", "radius": 1.5}},
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


def test_files_of_older_versions_spell_properties_in_another_way(tmp_path):
    path = tmp_path / "old.xml"
    path.write_text(
        '<scene version="0.6.0"><integrator type="path"><integer name="maxDepth" value="3"/></integrator>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="cropWidth" value="5"/></film></sensor></scene>',
        encoding="utf-8",
    )
    found = translated(path)
    assert of_paths(found.integrator())[0] == 3 and found.sensors()[0].film().crop_size()[0] == 5


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


@pytest.mark.parametrize("plugin", ["path", "volpathmis"])
def test_depth_that_is_not_stated_has_no_limit(plugin):
    out = tt.render(tt.load(oven({"type": plugin}), variant="llvm_ad_mono"), time_axis=WINDOW, seed=0)
    mean, error = mean_and_error(out.steady)
    assert error < 0.05 and abs(mean - 1 / (1 - ALBEDO)) < 4 * error
    assert out.stats.max_depth == -1 and out.stats.light_beyond is None
    assert float(out.transient.sum(1).mean()) == pytest.approx(mean, rel=1e-4)


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


@pytest.mark.slow
def test_a_bound_that_leaves_too_much_is_an_error_where_asked():
    """More than half of the light is deeper than 512 at an albedo of 0.999."""
    mi.set_variant("llvm_ad_mono")
    scene = oven()
    scene["ball"]["bsdf"]["reflectance"]["value"] = 0.999
    strict = tt.TransientRenderer(scene, parameters=[KEY], time_axis=WINDOW, spp=1, physics="error")
    with pytest.raises(PhysicsError, match="give max_depth= for these"):
        strict(seed=0)
