"""What of a parsed scene is changed before it is built: films, integrators, samplers and plugins, node by node."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import pytest

import torchtransient as tt
from torchtransient import plugins
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.rendering import build, translation
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.films import Gates, Histogram, Phasors

VARIANT = "llvm_ad_rgb"
AXIS = tt.TimeAxis(1.5, 0.25, 7)
HISTOGRAM, GATES = Histogram(AXIS), Gates((tt.Gate.rectangular(3.0, 4.0),))
PHASORS = Phasors(tt.FrequencyAxis((0.0, 0.5), 1.5))
STEADY = """<film type="hdrfilm" id="f"><integer name="width" value="3"/><integer name="height" value="5"/>
  <integer name="crop_offset_x" value="2"/><string name="file_format" value="openexr"/><rfilter type="tent" id="r"/>
  <boolean name="sample_border" value="true"/></film>"""
PULSED = """<film type="transient_hdr_film" id="f"><integer name="width" value="3"/>
  <integer name="temporal_bins" value="9"/><float name="start_opl" value="4"/>
  <string name="irf" value="gaussian"/><float name="irf_fwhm_opl" value="0.5"/>
  <spectrum name="red" value="500:0.5, 600:1"/></film>"""
FOG = '<medium name="interior" type="homogeneous"/>'


@pytest.fixture(autouse=True, scope="module")
def variant():
    """One whose plugins are known."""
    mi.set_variant(VARIANT)
    plugins.sync()


def parsed(content):
    config = mi.parser.ParserConfig(VARIANT)
    return mi.parser.parse_string(config, f'<scene version="3.0.0">{content}</scene>')


def sensor(inside="", plugin="perspective"):
    return f'<sensor type="{plugin}">{inside}</sensor>'


def shape(inside):
    return f'<shape type="sphere">{inside}</shape>'


def found(state, kind):
    """(plugin, id, numbers and texts by name, plugins inside) of the nodes of a kind."""
    names = {index: node.props.plugin_name() for index, node in enumerate(state.nodes)}
    return [
        (
            node.props.plugin_name(),
            node.props.id(),
            {key: value for key, value in node.props.items() if isinstance(value, (int, float, str))},
            {key: names[index] for key, index in build.children(state, node)},
        )
        for node in state.nodes
        if node.type == kind
    ]


def films(content, **options):
    state = parsed(content)
    build._override_films(state, BuildOptions(**options))
    return found(state, mi.ObjectType.Film)


def integrators(content, **options):
    state = parsed(content)
    build._override_integrator(state, BuildOptions(**options))
    return found(state, mi.ObjectType.Integrator)


# -------------------------------------------------------------------------------------------------------------- films


def test_films_are_left_alone_where_nothing_is_asked():
    state = parsed(sensor() + sensor(STEADY))
    before = len(state.nodes)
    build._override_films(state, BuildOptions(pulse=tt.Pulse.gaussian(0.5)))
    assert len(state.nodes) == before and [film[0] for film in found(state, mi.ObjectType.Film)] == ["hdrfilm"]
    # A film through time stays where the integrator alone is to be one of time; so does a steady one where none is.
    assert films(sensor(PULSED), transient=True)[0][2]["temporal_bins"] == 9
    ((plugin, _, numbers, _),) = films(sensor(STEADY), film=HISTOGRAM)
    assert plugin == "hdrfilm" and numbers["file_format"] == "openexr" and "temporal_bins" not in numbers


def test_steady_films_become_films_through_time():
    """With what both have: size and place, its filter and its name."""
    ((plugin, name, numbers, inside),) = films(sensor(STEADY), film=HISTOGRAM, transient=True)
    assert (plugin, name, list(inside.values())) == ("transient_hdr_film", "f", ["tent"])
    assert numbers == {
        "width": 3, "height": 5, "crop_offset_x": 2, "sample_border": True,
        "start_opl": 1.5, "bin_width_opl": 0.25, "temporal_bins": 7,
    }  # fmt: skip
    with pytest.raises(SceneError, match=r"the film is a steady 'hdrfilm', which has no time axis\. Give one"):
        films(sensor(STEADY), transient=True)


def test_sensors_without_a_film_get_one():
    added = films(sensor() + sensor(), film=HISTOGRAM, transient=True)
    assert [film[0] for film in added] == ["transient_hdr_film"] * 2
    assert [film[0] for film in films(sensor(), film=HISTOGRAM)] == ["hdrfilm"]
    # Whatever is no sensor gets none.
    assert films(shape(""), film=HISTOGRAM, transient=True) == []


def test_films_of_one_kind_keep_what_is_not_asked_for():
    ((plugin, _, numbers, _),) = films(sensor(PULSED), film=HISTOGRAM)
    assert plugin == "transient_hdr_film"
    assert numbers == {
        "width": 3, "temporal_bins": 7, "start_opl": 1.5, "bin_width_opl": 0.25, "irf": "gaussian", "irf_fwhm_opl": 0.5,
    }  # fmt: skip


def test_films_of_another_kind_keep_what_both_have():
    """Pulses and response curves, not the time axis."""
    state = parsed(sensor(PULSED))
    build._override_films(state, BuildOptions(film=GATES))
    ((plugin, name, numbers, _),) = found(state, mi.ObjectType.Film)
    assert (plugin, name) == ("gated_hdr_film", "f")
    assert numbers == {"width": 3, "irf": "gaussian", "irf_fwhm_opl": 0.5, "gates": numbers["gates"]}
    (film,) = (node for node in state.nodes if node.type == mi.ObjectType.Film)
    assert "red" in film.props
    with pytest.raises(SceneError, match="'transient_hdr_film' has a pulse or an irf, which a phasor_hdr_film would"):
        films(sensor(PULSED), film=PHASORS)
    plain = PULSED.replace('name="irf"', 'name="width_of"').replace("irf_fwhm_opl", "height_of")
    assert films(sensor(plain), film=PHASORS)[0][0] == "phasor_hdr_film"


def test_films_of_other_packages_stay_what_they_are():
    """Their histograms are set by the same numbers; other films than histograms they are not."""
    other = '<film type="film_of_others"><integer name="rows" value="4"/></film>'
    ((plugin, _, numbers, _),) = films(sensor(other), film=HISTOGRAM, transient=True)
    assert plugin == "film_of_others" and (numbers["rows"], numbers["temporal_bins"]) == (4, 7)
    for film in (GATES, PHASORS):
        with pytest.raises(SceneError, match=f"'film_of_others' cannot become a {film.plugin}; make it one of"):
            films(sensor(other), film=film, transient=True)


def test_pulses_of_a_call_replace_those_of_the_film():
    ((_, _, numbers, _),) = films(
        sensor(PULSED), film=HISTOGRAM, irf=tt.Pulse.rectangular(0.75, center_opl=0.125), pulse=tt.Pulse.gaussian(2.0)
    )
    said = {key: value for key, value in numbers.items() if key.startswith(("irf", "pulse"))}
    assert said == {
        "irf": "rectangular", "irf_width_opl": 0.75, "irf_center_opl": 0.125,
        "pulse": "gaussian", "pulse_fwhm_opl": 2.0, "pulse_center_opl": 0.0,
    }  # fmt: skip
    ((_, _, numbers, _),) = films(sensor(PULSED), transient=True, irf=tt.Pulse.tabulated([0.5, 1.5, 2.0], [0, 3, 1]))
    said = {key: value for key, value in numbers.items() if key.startswith(("irf", "pulse"))}
    assert set(said) == {"irf", "irf_center_opl", "irf_opl", "irf_values"}
    assert said["irf_opl"] == "0.5, 1.5, 2.0" and len(said["irf_values"].split(", ")) == 3
    with pytest.raises(SceneError, match=r"pulse: the film 'phasor_hdr_film' does not spread arrivals over time"):
        films(sensor(STEADY), film=PHASORS, transient=True, pulse=tt.Pulse.gaussian(2.0))
    with pytest.raises(SceneError, match=r"irf: the film 'hdrfilm' does not spread arrivals over time"):
        films(sensor(STEADY), film=HISTOGRAM, irf=tt.Pulse.gaussian(2.0))


def test_steady_images_are_spared_by_histograms_alone():
    assert films(sensor(PULSED), transient=True, steady=False)[0][2]["steady"] is False
    assert "steady" not in films(sensor(PULSED), transient=True)[0][2]
    for film, plugin in ((PHASORS, "phasor_hdr_film"), (GATES, "gated_hdr_film")):
        with pytest.raises(ArgumentError, match=f"spares a histogram the light .* the film is a '{plugin}'"):
            films(sensor(STEADY), film=film, transient=True, steady=False)
    with pytest.raises(ArgumentError, match="the film is a 'hdrfilm'"):
        films(sensor(STEADY), film=HISTOGRAM, steady=False)


# -------------------------------------------------------------------------------------------------------- integrators

PATH = """<integrator type="{}" id="i"><integer name="max_depth" value="9"/><integer name="rr_depth" value="4"/>
  <boolean name="hide_emitters" value="true"/><boolean name="camera_unwarp" value="true"/>
  <float name="gaussian_stddev" value="0.5"/><integer name="samples_per_pass" value="2"/></integrator>"""
BOTH = {"max_depth": 9, "rr_depth": 4, "hide_emitters": True}


@pytest.mark.parametrize(
    ("given", "surfaces", "volumes"),
    [
        *[(name, "transient_path", "transient_prbvolpath") for name in ("path", "prb", "prb_basic", "prb_projective")],
        *[(name, "transient_prbvolpath", "transient_prbvolpath") for name in ("volpath", "volpathmis", "prbvolpath")],
    ],
)
def test_steady_integrators_become_transient_ones(given, surfaces, volumes):
    """With a medium that is met they follow light in it, and they keep what both have."""
    for more, plugin in (("", surfaces), (shape(FOG), volumes)):
        assert integrators(PATH.format(given) + more, transient=True) == [(plugin, "i", BOTH, {})]
    assert integrators(PATH.format(given))[0][0] == given


def test_integrators_where_there_is_none():
    assert integrators(shape("")) == [] and integrators(shape(""), max_depth=3) == []
    assert integrators(shape(""), transient=True) == [("transient_path", "", {"max_depth": -1}, {})]
    assert integrators(shape(FOG), transient=True, max_depth=3) == [("transient_prbvolpath", "", {"max_depth": 3}, {})]


def test_integrators_that_are_asked_for():
    """They keep what all transient ones read, and an integrator of that kind keeps all."""
    kept = BOTH | {"camera_unwarp": True, "gaussian_stddev": 0.5}
    for given in ("path", "transient_path"):
        assert integrators(PATH.format(given), transient=True, integrator="transient_prbvolpath") == [
            ("transient_prbvolpath", "i", kept, {})
        ]
    for asked in ("transient_path", None):
        ((plugin, _, numbers, _),) = integrators(PATH.format("transient_path"), transient=True, integrator=asked)
        assert plugin == "transient_path" and numbers == kept | {"samples_per_pass": 2}
    # Nested integrators are those of a picture.
    moment = '<integrator type="moment"><integrator type="path"/></integrator>'
    state = parsed(moment)
    build._override_integrator(state, BuildOptions(transient=True, integrator="transient_path"))
    assert build.children(state, state.nodes[build.find_child(state, state.root, build.is_integrator)]) == []


def test_depths_are_written_into_every_integrator():
    for options in ({}, {"transient": True}):
        for depth in (0, 3, -1):
            ((_, _, numbers, _),) = integrators(PATH.format("transient_path"), max_depth=depth, **options)
            assert numbers["max_depth"] == depth
        assert integrators(PATH.format("transient_path"), **options)[0][2]["max_depth"] == 9


def test_integrators_that_are_a_path_tracer_in_another_form():
    """``direct`` is the path of two vertices, and the one inside of ``stokes`` shows Stokes vectors by itself."""
    samples = '<boolean name="hide_emitters" value="true"/><integer name="{}" value="{}"/>'
    direct = f'<integrator type="direct">{samples}</integrator>'
    assert integrators(direct.format("shading_samples", 3), transient=True) == [
        ("transient_path", "", {"max_depth": 2, "hide_emitters": True}, {})
    ]
    for kind in ("bsdf_samples", "emitter_samples"):
        with pytest.raises(SceneError, match="integrator 'direct': expected samples of emitters and of BSDFs"):
            integrators(direct.format(kind, 0), transient=True)
    stokes = f'<integrator type="stokes">{PATH.format("path")}</integrator>'
    with pytest.raises(SceneError, match="integrator 'stokes': expected a polarized variant, got"):
        integrators(stokes, transient=True)
    state = parsed(stokes)
    with mi.variant_context("llvm_ad_mono_polarized"):
        build._override_integrator(state, BuildOptions(transient=True, max_depth=4))
    node = state.nodes[build.find_child(state, state.root, build.is_integrator)]
    assert node.props.plugin_name() == "transient_path" and node.props["max_depth"] == 4 and node.props.id() == "i"


@pytest.mark.parametrize("plugin", ["ptracer", "aov", "moment"])
def test_integrators_without_a_counterpart(plugin):
    with pytest.raises(SceneError, match=f"integrator '{plugin}' has no transient counterpart"):
        integrators(f'<integrator type="{plugin}"/>', transient=True)
    assert integrators(f'<integrator type="{plugin}"/>') == [(plugin, "", {}, {})]


def test_integrators_of_images_are_told_apart_when_they_are_built():
    scene = SimpleNamespace(integrator=lambda: mi.load_dict({"type": "path"}))
    build._check_integrator(scene, BuildOptions())
    with pytest.raises(SceneError, match="the integrator PathIntegrator renders images"):
        build._check_integrator(scene, BuildOptions(transient=True))
    build._check_integrator(
        SimpleNamespace(integrator=lambda: mi.load_dict({"type": "transient_path"})), BuildOptions(transient=True)
    )


# ----------------------------------------------------------------------------------------------------------- samplers


@pytest.mark.parametrize("order", [1, -1])
def test_every_sensor_gets_the_sampler(order):
    content = [sensor(), shape(""), sensor('<film type="hdrfilm"/>')]
    state = parsed("".join(content[::order]))
    build._override_samplers(state, BuildOptions(sampler="multijitter"))
    assert [one[0] for one in found(state, mi.ObjectType.Sampler)] == ["multijitter"] * 2


def test_samplers_keep_their_number_and_seed():
    state = parsed(
        sensor('<sampler type="orthogonal" id="s"><integer name="sample_count" value="9"/>'
               '<integer name="seed" value="5"/><integer name="strength" value="3"/></sampler>')
        + sensor() + shape("")
    )  # fmt: skip
    before = len(state.nodes)
    build._override_samplers(state, BuildOptions())
    assert len(state.nodes) == before and found(state, mi.ObjectType.Sampler)[0][0] == "orthogonal"
    build._override_samplers(state, BuildOptions(sampler="stratified"))
    assert found(state, mi.ObjectType.Sampler) == [
        ("stratified", "s", {"sample_count": 9, "seed": 5}, {}), ("stratified", "", {}, {}),
    ]  # fmt: skip
    assert len(state.nodes) == before + 1


# ------------------------------------------------------------------------------------------------------------ plugins


def substituted(content, substitute=(), **options):
    state = parsed(content)
    build._substitute_plugins(state, BuildOptions(substitute=frozenset(substitute), **options))
    return {node.props.id(): node.props for node in state.nodes if node.props.id()}


def bsdf(plugin, name, inside=""):
    return f'<bsdf type="{plugin}" id="{name}">{inside}</bsdf>'


def test_surfaces_are_built_as_their_twins_where_they_are_asked_for():
    content = bsdf("plastic", "a") + bsdf("plastic", "b") + bsdf("diffuse", "c") + bsdf("principled", "d")
    found = substituted(content, [("a", ""), ("c", ""), ("d", "metallic"), ("d", "clearcoat")])
    assert {name: props.plugin_name() for name, props in found.items()} == {
        "a": "diff_plastic", "b": "plastic", "c": "diffuse", "d": "diff_principled",
    }  # fmt: skip
    assert found["d"]["lobes"] == "clearcoat,metallic" and "lobes" not in found["a"]


def test_surfaces_of_two_sides_let_lobes_be_built():
    """A lobe of transmission whose weight is zero is refused by Mitsuba's own, unless that is allowed."""
    two = bsdf("twosided", "t", bsdf("principled", "p")) + bsdf("twosided", "u", bsdf("principled", "q"))
    found = substituted(two + bsdf("twosided", "v", bsdf("plastic", "r")), [("p", "spec_trans"), ("r", "")])
    assert found["t"]["allow_transmission"] is True
    assert "allow_transmission" not in found["u"] and "allow_transmission" not in found["v"]


def test_pictures_are_stored_as_real_numbers_where_they_have_derivatives():
    picture = '<texture type="bitmap" id="a"/><texture type="checkerboard" id="b"/>'
    assert substituted(picture, real_bitmaps=True)["a"]["format"] == "variant"
    assert "format" not in substituted(picture, real_bitmaps=True)["b"]
    assert "format" not in substituted(picture)["a"]


def test_lights_that_lack_methods_are_completed():
    light = '<shape type="rectangle"><emitter type="directionalarea" id="e"/><emitter type="area" id="a"/></shape>'
    found = substituted(light)
    assert (found["e"].plugin_name(), found["a"].plugin_name()) == ("diff_directionalarea", "area")


def test_polarizing_surfaces_in_polarized_variants(monkeypatch):
    content = bsdf("dielectric", "a") + bsdf("roughdielectric", "b") + bsdf("plastic", "c") + bsdf("polarizer", "d")
    assert substituted(content)["a"].plugin_name() == "dielectric"
    monkeypatch.setattr(mi, "is_polarized", True)
    assert {name: props.plugin_name() for name, props in substituted(content, [("c", "")]).items()} == {
        "a": "diff_dielectric", "b": "diff_rough_dielectric", "c": "diff_plastic", "d": "diff_polarizer",
    }  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- places


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("Error: At room.xml (line 3, col 14): no", "room.xml (line 3, col 14)"),
        ("While loading room.xml (line 12, col 1): no", "room.xml (line 12, col 1)"),
        ('While loading dictionary node "scene.box": no', 'dictionary node "scene.box"'),
        ("no such plugin", None),
        ("", None),
    ],
)
def test_places_that_messages_name(text, place):
    assert build._location(RuntimeError(text)) == place
    assert build._location(None) is None


def test_what_stands_at_the_top():
    with pytest.raises(SceneError, match="expected a <scene> at the top, got <diffuse>"):
        build._check_root(SimpleNamespace(root=SimpleNamespace(props=mi.Properties("diffuse"))))
    build._check_root(parsed(""))


def test_looks_at_properties_leave_no_trace():
    """Mitsuba reports those that nobody has read."""
    state = parsed(shape('<float name="radiuz" value="2"/>'))
    props = next(node.props for node in state.nodes if node.props.plugin_name() == "sphere")
    assert props["radiuz"] == 2 and "radiuz" not in props.unqueried()
    translation.forget_queries(state)
    assert "radiuz" in props.unqueried()
