"""The table of parameters: which row counts, what is attached, and that every plugin's keys are in it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tools.every_plugin import every_plugin
from torchtransient import plugins
from torchtransient.plugins import parameter_effect
from torchtransient.plugins.parameter_effect import declare_effects, lineage
from torchtransient.plugins.parameters import (
    ParameterEffect,
    ParameterTracker,
    attached_effects,
    can_carry_gradients,
)


@pytest.fixture(autouse=True)
def rgb():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def normals(height=0.5):
    pixels = np.full((2, 2, 3), (0.5, height, 0.9), dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def attach(scene, *keys):
    params = mi.traverse(scene)
    for key in keys:
        value = type(params[key])(params[key])
        dr.enable_grad(value)
        params[key] = value
    params.update()
    return params


def letters(effect):
    flags = (effect.moves_length, effect.moves_silhouette, effect.moves_medium)
    return "".join(letter for letter, flag in zip("LSM", flags, strict=True) if flag)


# plugins, keys, what they move (length, silhouette, medium) and their role; all other keys move nothing
MOVES = [
    ("rectangle sphere disk cylinder sdfgrid instance irradiancemeter nlos_capture_meter",
     "to_world", "LS", "shape"),
    ("area directionalarea diff_directionalarea angulararea", "to_world", "LS", "shape"),
    ("cube obj ply mesh_arrays instance", "vertex_positions vertex_normals", "LS", "shape"),
    ("cube obj ply mesh_arrays instance", "vertex_texcoords", "S", "value"),
    ("bsplinecurve linearcurve", "control_points", "LS", "shape"),
    ("sdfgrid", "grid", "LS", "shape"),
    ("ellipsoids ellipsoidsmesh", "data", "LS", "shape"),
    ("perspective batch transient_hdr_film phasor_hdr_film gated_hdr_film rate_hdr_film beat_hdr_film "
     "slow_phasor_hdr_film",
     "to_world x_fov principal_point_offset_x principal_point_offset_y", "LS", "sensor"),
    ("orthographic", "to_world", "LS", "sensor"),
    ("thinlens", "to_world x_fov aperture_radius focus_distance", "LS", "sensor"),
    ("nlos_capture_meter", "sensor_origin points", "LS", "sensor"),
    ("nlos_capture_meter", "laser_points laser_origin", "LS", "emitter"),
    ("laser_beam", "to_world", "LS", "emitter"),
    ("point", "position", "LS", "emitter"),
    ("spot projector directional envmap sunsky sunsky_at_a_time timed_sunsky", "to_world", "LS", "emitter"),
    ("sunsky sunsky_at_a_time", "sun_direction", "LS", "sun"),
    ("dielectric diff_dielectric", "eta", "LS", "index"),
    ("principled", "specular", "L", "index"),
    ("diff_principled", "specular", "L", "index"),
    ("roughdielectric diff_rough_dielectric", "eta", "L", "index"),
    ("delayed", "lifetime", "L", "delay"),
    ("normalmap", "normalmap.data", "S", "value"),
    ("rigid_motion", "linear angular center", "L", "velocity"),
    ("heterogeneous", "data", "M", "medium"),
    ("homogeneous", "sigma_t.value.value", "M", "medium"),
]  # fmt: skip
EXPECTED = {
    (plugin, key): (moves, role)
    for names, keys, moves, role in MOVES
    for plugin in names.split()
    for key in keys.split()
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("plugins")


def test_what_every_plugin_moves(folder):
    met = set()
    for name, description in every_plugin(folder).items():
        plugin = mi.load_dict(description)
        tracker = ParameterTracker(plugin)
        for key, (handle, cpptype, node, flags) in mi.traverse(plugin).properties.items():
            value = handle if cpptype is None else mi.get_property(handle, cpptype, node)
            effect = tracker.effect_of(node, key, flags)
            if can_carry_gradients(value) or effect.stand_in:
                expected = EXPECTED.get((name, key)) or EXPECTED.get((name, key.rsplit(".", 1)[-1]), ("", "value"))
                met.add((name, key))
                assert (letters(effect), effect.role) == expected, f"{name}: {key}"
    assert {name for name, _ in EXPECTED} <= {name for name, _ in met}


# --------------------------------------------------------------------------------------------------- where a plugin is


def effects_in(scene):
    """Effects by full key, asked in both ways."""
    found = {}
    for key in differentiable_keys(scene):
        params = attach(scene, key)
        by_params, by_tracker = attached_effects(params), ParameterTracker(scene).attached()
        assert sorted((k, str(e)) for _, k, e in by_params) == sorted((k, str(e)) for _, k, e in by_tracker)
        last = key.rsplit(".", 1)[-1]
        (found[key],) = (effect for _, name, effect in by_tracker if name == last)
        params[key] = dr.detach(params[key])
        params.update()
    return found


def differentiable_keys(scene):
    params = mi.traverse(scene)
    return [key for key in params.properties if can_carry_gradients(params[key])]


@pytest.mark.parametrize("plugin", ["normalmap", "bumpmap"])
@pytest.mark.parametrize(("nested", "bends"), [("conductor", True), ("dielectric", True), ("diffuse", False)])
def test_normals_move_lengths_where_a_delta_lobe_follows_them(plugin, nested, bends):
    bsdf = {"type": plugin, "normalmap": normals(), "nested": {"type": nested}}
    scene = mi.load_dict({"type": "scene", "mirror": {"type": "cube", "bsdf": bsdf}})
    effects = effects_in(scene)
    texture = next(effect for key, effect in effects.items() if key.endswith("map.data") or "texture.data" in key)
    assert texture.moves_length == bends and texture.role == ("normal" if bends else "value")
    assert effects["mirror.vertex_texcoords"].moves_length == bends
    assert effects["mirror.vertex_texcoords"].supported
    # The slope of a bump map is the same all over a texel.
    assert effects["mirror.vertex_texcoords"].biased == (plugin == "bumpmap")
    colours = [effect for key, effect in effects.items() if "reflectance" in key or ".k." in key]
    assert not any(effect.moves for effect in colours)


# ------------------------------------------------------------------------------------------------- plugins of one's own


@pytest.fixture
def own_rows():
    before = {name: dict(rows) for name, rows in parameter_effect._rows.items()}
    yield
    parameter_effect._rows.clear()
    parameter_effect._rows.update(before)


def test_a_plugin_enters_by_its_own_file(own_rows):
    class Curtain(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.lag = mi.Float(1)

        def traverse(self, cb):
            cb.put("lag", self.lag, mi.ParamFlags.Differentiable)

    class Veil(Curtain):
        pass

    mi.register_bsdf("curtain", Curtain)
    mi.register_bsdf("veil", Veil)
    declare_effects(Curtain, {"lag": ParameterEffect(moves_length=True, role="delay")})
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "bsdf": {"type": "veil"}}})
    tracker = ParameterTracker(scene)
    assert tracker.attached() == []
    params = attach(scene, "wall.bsdf.lag")
    for found in (attached_effects(params), attached_effects(tracker)):
        ((node, key, effect),) = found
        assert (key, effect.role, effect.moves_length) == ("lag", "delay", True)
        assert lineage(node)[:2] == ("Veil", "Curtain")
