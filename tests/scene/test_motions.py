"""Velocities of bodies in scenes: by `scene.moving`, in dictionaries and in XML, copied, pickled, saved and reloaded.

The mean rate of a pixel tells which bodies move, and how.
"""

import pickle
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.moving_scenes import LAMP, moving_scene, wall
from torchtransient.errors import GradientWarning, SceneError, TorchTransientWarning

VARIANT = "llvm_ad_mono"
SPEED = 1.5
COMES = tt.Motion(linear=(0.0, 0.0, -SPEED))
RATES, AXIS = tt.RateAxis(-8.0, 0.25, 64), tt.TimeAxis(0.0, 0.2, 60)


def motion(linear=(0, 0, 0), **more):
    return {"type": "rigid_motion", "linear": list(linear), **more}


def two_walls(**nodes):
    """A wall 2 m before camera and lamp; what lies behind it is not seen."""
    return moving_scene(wall=wall((0, 0, 2), (0, 0, 0)), other=wall((0, 0, 5), (0, 0, 0)), **nodes)


def mean_rate(scene, variant=VARIANT, values=None, **settings):
    """Mean rate of the light of a scene, m/s."""
    renderer = tt.TransientRenderer(
        tt.load(scene, variant=variant), rates=RATES, time_axis=AXIS, temporal_filter="tent", spp=16, **settings
    )
    light = renderer(values, seed=0).rates.detach().double()
    over = light.sum(tuple(k for k in range(light.ndim) if k != light.ndim - 4))
    assert float(over.sum()) > 0
    return float((over * RATES.centers).sum() / over.sum())


def close(rate):
    # Rates are spread by a tent over bins of 0.25 m/s, whose first moment is exact; float32 sums are not.
    return pytest.approx(rate, abs=1e-3)


# --------------------------------------------------------------------------------------------------- what can move


def test_bodies_by_name():
    still = tt.load(two_walls(), variant=VARIANT)
    assert mean_rate(still.moving({"wall": COMES})) == close(-2 * SPEED)
    assert mean_rate(still.moving({"lamp": tt.Motion(linear=(0.0, 0.0, 1.0))})) == close(-1.0)
    assert mean_rate(still.moving({"sensor": tt.Motion(linear=(0.0, 0.0, -1.0))})) == close(1.0)
    assert mean_rate(still.moving({"other": COMES})) == close(0.0)
    # Later motions take the place of earlier ones of the same body, and leave the others.
    both = still.moving({"wall": COMES, "lamp": COMES}).moving({"wall": tt.Motion()})
    assert mean_rate(both) == close(SPEED)


BODIES = {
    "wall": (lambda s, m: s["wall"].update(velocity=m), -2 * SPEED),
    "lamp": (lambda s, m: s["lamp"].update(velocity=m), SPEED),
    "sensor": (lambda s, m: s["sensor"].update(velocity=m), SPEED),
    "top": (lambda s, m: s.update(any_name=m | {"of": "wall"}), -2 * SPEED),
}


@pytest.mark.parametrize("place", BODIES)
def test_dictionaries(place):
    scene = two_walls(lamp=dict(LAMP))
    put, rate = BODIES[place]
    put(scene, motion((0, 0, -SPEED)))
    loaded = tt.load(scene, variant=VARIANT)
    assert mean_rate(loaded) == close(rate)
    name = "wall" if place == "top" else place
    keys = [key for key in loaded.parameters() if key.endswith(".linear")]
    assert len(keys) == 1 and (place == "top" or keys == [f"{name}.velocity.linear"])
    # What is described gives way to what is asked for.
    assert mean_rate(loaded.moving({name: tt.Motion()})) == close(0.0)


XML = """<scene version="3.0.0">
  <integrator type="{integrator}"> <integer name="max_depth" value="2"/> <integer name="rr_depth" value="99"/>
  </integrator>
  <sensor type="perspective" id="sensor">
    <float name="fov" value="0.05"/> <float name="near_clip" value="0.001"/>
    <transform name="to_world"> <lookat origin="0, 0, 0" target="0, 0, 1" up="0, 1, 0"/> </transform>
    <sampler type="independent"/>
    <film type="transient_hdr_film"> <integer name="width" value="1"/> <integer name="height" value="1"/> </film>
    {sensor}
  </sensor>
  <emitter type="point" id="lamp"> <point name="position" x="0" y="0" z="0"/> {lamp} </emitter>
  <shape type="rectangle" id="wall">
    <transform name="to_world"> <lookat origin="0, 0, 2" target="0, 0, 0" up="0, 1, 0"/> </transform>
    {wall}
  </shape>
  {fog}
  {top}
</scene>"""
CHILD = f'<texture type="rigid_motion" name="velocity"> <vector name="linear" x="0" y="0" z="{-SPEED}"/> </texture>'
TOP = CHILD.replace(' name="velocity">', '> <string name="of" value="wall"/>')
FOG = """<shape type="cube" id="box">
    <transform name="to_world"> <scale value="0.5"/> <translate z="1.2"/> </transform> <bsdf type="null"/>
    <medium type="homogeneous" name="interior" id="fog"> <float name="sigma_t" value="0.5"/> {} </medium>
  </shape>"""


def xml(tmp_path, **parts):
    empty = dict.fromkeys(("sensor", "lamp", "wall", "fog", "top"), "") | {"integrator": "transient_path"}
    path = tmp_path / "scene.xml"
    path.write_text(XML.format(**{**empty, **parts}))
    return path


@pytest.mark.parametrize("place, rate", [("lamp", SPEED), ("top", -2 * SPEED)])
def test_files(tmp_path, place, rate):
    scene = tt.load(xml(tmp_path, **{place: TOP if place == "top" else CHILD}), variant=VARIANT)
    assert mean_rate(scene) == close(rate)
    again = tt.load(scene.save(tmp_path / "again.xml"), variant=VARIANT)
    assert mean_rate(again) == close(rate)
    assert mean_rate(tt.load(xml(tmp_path), variant=VARIANT).moving({"wall": COMES})) == close(-2 * SPEED)


def test_media_in_files(tmp_path):
    """Light that the fog scatters has its velocity, twice; that of the wall behind it has none."""
    path = xml(tmp_path, fog=FOG.format(CHILD), integrator="transient_prbvolpath")
    scene = tt.load(path, variant=VARIANT)
    out = tt.TransientRenderer(scene, rates=RATES, time_axis=AXIS, temporal_filter="tent", spp=256)(seed=0)
    over = out.rates.detach().sum((0, 2, 3, 4)).double()
    at = {rate: int((rate - RATES.start) / RATES.bin_width) for rate in (-2 * SPEED, 0.0)}
    lit = {rate: float(over[k - 1 : k + 1].sum()) for rate, k in at.items()}
    assert min(lit.values()) > 0.01 * float(over.sum())
    assert sum(lit.values()) == pytest.approx(float(over.sum()), rel=1e-4)
    assert mean_rate(tt.load(scene.save(tmp_path / "again.xml"))) == pytest.approx(mean_rate(scene), abs=1e-4)


def test_mitsuba_reads_what_was_saved(tmp_path):
    scene = two_walls()
    scene["sensor"]["film"] |= {"type": "rate_hdr_film", "rate_start": -8.0, "rate_width": 0.25, "rate_bins": 64}
    path = tt.load(scene, variant=VARIANT).moving({"wall": COMES}).save(tmp_path / "moved.xml")
    mi.set_variant(VARIANT)
    params = mi.traverse(mi.load_file(str(path)))
    found = next(params[key] for key in params.keys() if key.endswith("linear"))  # noqa: SIM118
    np.testing.assert_allclose(np.ravel(found), [0, 0, -SPEED])
    # Mitsuba merges both walls, unless it is asked not to.
    merged = mi.load_file(str(path))
    with pytest.raises(SceneError, match=r"optimize=False"):
        merged.integrator().render(merged, spp=1)
    whole = mi.load_file(str(path), optimize=False)
    assert float(dr.sum(whole.integrator().render(whole, spp=1)[0].array)[0]) > 0


# ----------------------------------------------------------------------------------------------- scenes as values


def test_pickled_and_saved_with_values(tmp_path):
    spins = tt.Motion(linear=(0.1, 0.0, -SPEED), angular=(0.0, 2.0, 0.0), center=(0.0, 0.5, 2.0))
    scene = tt.load(two_walls(), variant=VARIANT).moving({"wall": spins, "other": COMES})
    expected = mean_rate(scene)
    assert mean_rate(pickle.loads(pickle.dumps(scene))) == expected
    back = tt.load(scene.save(tmp_path / "scene.xml"), variant=VARIANT)
    for name, part in (("linear", spins.linear), ("angular", spins.angular), ("center", spins.center)):
        np.testing.assert_allclose(back.parameters()[f"wall.velocity.{name}"].value, part, rtol=1e-6)
    assert mean_rate(back) == close(expected)
    learnt = {"wall.velocity.linear": torch.tensor([0.0, 0.0, 1.0]), "wall.velocity.angular": torch.zeros(3)}
    saved = tt.load(scene.save(tmp_path / "learnt.xml", values=learnt), variant=VARIANT)
    assert mean_rate(saved) == close(2.0)


def test_the_table_of_parameters():
    table = tt.load(two_walls(), variant=VARIANT).moving({"wall": COMES}).parameters()
    info = table["wall.velocity.linear"]
    assert info.differentiable and info.is_velocity and info.shape == (3,) and not info.moves_silhouette
    np.testing.assert_allclose(np.ravel(info.value), [0, 0, -SPEED])
    assert {key for key in table.differentiable() if ".velocity." in key} == {
        f"wall.velocity.{part}" for part in ("linear", "angular", "center")
    }
    assert not table["wall.to_world"].is_velocity and "wall.velocity.linear" in str(table)


# ------------------------------------------------------------------------------------------------------- warnings


def caught(call):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return [one for one in found if issubclass(one.category, TorchTransientWarning)]


def test_a_film_without_rates_says_that_velocities_have_no_derivative():
    scene = tt.load(two_walls(), variant=VARIANT).moving({"wall": COMES})
    key = "wall.velocity.linear"
    renderer = tt.TransientRenderer(scene, parameters=[key], time_axis=AXIS, spp=4)
    assert renderer.effective_filter == "box"
    [warning] = caught(lambda: renderer(seed=0).transient.square().sum().backward())
    assert warning.category is GradientWarning and key in str(warning.message)
    assert "rates=" in str(warning.message) and "chirps=" in str(warning.message)
    assert warning.filename == __file__
    assert torch.equal(renderer.values[key].grad, torch.zeros(3))
    assert not caught(lambda: renderer(seed=1).transient.sum().backward())
    with torch.no_grad():
        assert not caught(lambda: tt.TransientRenderer(scene, parameters=[key], time_axis=AXIS, spp=4)(seed=0))
    rates = tt.TransientRenderer(scene, parameters=[key], rates=RATES, time_axis=AXIS, spp=4)
    assert not caught(lambda: rates(seed=0).rates.square().sum().backward())
    assert float(rates.values[key].grad[2].abs()) > 0


# ------------------------------------------------------------------------------------- calls with other velocities

KEY = "wall.velocity.linear"
LINEAR = torch.tensor([[0.0, 0.0, -1.5], [0.0, 0.0, 2.0], [1.0, 0.0, 0.25]])
SETTINGS = {"rates": RATES, "time_axis": AXIS, "spp": 16, "temporal_filter": "tent"}
BEATS = {"rates": None, "chirps": tt.Chirps(1e9, 5e-6, 1550e-9), "time_axis": tt.TimeAxis(-8, 0.2, 90)}


def a_moving_wall(variant=VARIANT, **nodes):
    return tt.load(two_walls(**nodes), variant=variant).moving({"wall": COMES})


def test_recorded_calls_follow_velocities_and_their_derivatives():
    found = {}
    for freeze in (True, False):
        renderer = tt.TransientRenderer(a_moving_wall(), parameters=[KEY], freeze=freeze, **SETTINGS | BEATS)
        weights = torch.linspace(-1, 1, 90)[:, None, None]
        rows = []
        for linear in (*LINEAR, *LINEAR):
            given = linear.clone().requires_grad_()
            out = renderer({KEY: given}, seed=1)
            light = out.beats
            by_row = torch.arange(1.0, 1 + light.shape[1])[:, None, None, None]
            (light * weights * by_row).sum().backward()
            rows.append((light.detach(), given.grad))
        found[freeze] = rows
    for (light, gradient), (plain, plain_gradient) in zip(found[True], found[False], strict=True):
        torch.testing.assert_close(light, plain)
        torch.testing.assert_close(gradient, plain_gradient, rtol=1e-4, atol=1e-6)
    assert not torch.allclose(found[True][0][0], found[True][1][0])
    assert float(found[True][0][1].abs().max()) > 0


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono_polarized"])
def test_variants(variant):
    """Rates know no wavelength: each channel has the light of the steady image at the rate of the wall."""
    out = tt.TransientRenderer(a_moving_wall(variant), **SETTINGS)(seed=0)
    light = out.rates.detach().double()
    total = light.sum((-4, -3))
    rate = (light.sum(-3) * RATES.centers[:, None, None]).sum(-3)
    torch.testing.assert_close(total, out.steady.detach().double(), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(rate, -2 * SPEED * total, rtol=1e-3, atol=1e-5)
    assert float(out.steady.abs().max()) > 0
