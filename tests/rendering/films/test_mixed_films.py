"""Scenes whose sensors have different films: each renders as if alone, and a call leaves every film as it was."""

from __future__ import annotations

import copy

import pytest
import torch

import torchtransient as tt
from tools.small_room import WALL_POSE, make_room
from torchtransient.errors import GradientError, SceneError

VARIANT = "llvm_ad_rgb"
SIZE = {"width": 4, "height": 3, "rfilter": {"type": "box"}}
HISTOGRAM = {"type": "transient_hdr_film", **SIZE, "temporal_bins": 24, "start_opl": 6.0, "bin_width_opl": 0.25}
FILMS = {
    "histogram": HISTOGRAM,
    "smooth histogram": {**HISTOGRAM, "temporal_filter": "gaussian", "gaussian_stddev": 0.8},
    "gated": {"type": "gated_hdr_film", **SIZE, "gates": "gaussian 8 0.5; gaussian 9 0.5"},
    "phasor": {"type": "phasor_hdr_film", **SIZE, "frequencies": "0.0, 0.5"},
}


def room_of(*films, **integrator):
    """The small room seen through several films from one place."""
    room = make_room()
    room["integrator"] |= integrator
    sensor = room.pop("sensor")
    for number, film in enumerate(films):
        room[f"sensor_{number}"] = {**copy.deepcopy(sensor), "film": film}
    return room


def measured(out):
    return next(tensor for tensor in (out.transient, out.phasor, out.gated) if tensor is not None)


def grad_and_values(renderer):
    out = renderer(seed=3)
    tensor = measured(out)
    loss = (tensor.abs().square().sum() if tensor.is_complex() else tensor[..., 0, :].square().sum()) + out.steady.sum()
    loss.backward()
    return tensor.detach(), renderer.values[WALL_POSE].grad, out.stats.temporal_filter


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "of_integrator"), [(("gated", "histogram"), ""), (("smooth histogram", "phasor"), "gaussian")]
)
def test_each_sensor_renders_as_if_it_were_alone(pair, of_integrator):
    settings = {"temporal_filter": of_integrator, "gaussian_stddev": 0.8} if of_integrator else {}
    scene = tt.load(room_of(*(FILMS[name] for name in pair), **settings), variant=VARIANT)
    for sensor, name in enumerate(pair):
        alone = tt.load(room_of(FILMS[name], **settings), variant=VARIANT)
        for wanted in ("tent",) if "histogram" in name else ("auto",):
            arguments = {"parameters": [WALL_POSE], "temporal_filter": wanted, "spp": 4, "grad_seed": "same"}
            renderer = tt.TransientRenderer(scene, sensors=sensor, **arguments)
            found = grad_and_values(renderer)
            expected = grad_and_values(tt.TransientRenderer(alone, **arguments))
            torch.testing.assert_close(found[0], expected[0])
            torch.testing.assert_close(found[1], expected[1], rtol=1e-4, atol=1e-5)
            assert found[2] == expected[2] and bool(found[2]) == ("histogram" in name)


def test_a_filter_that_one_film_refuses_changes_no_other():
    # A pulse and a filter that together cover more bins than are spread while rendering.
    late = {**HISTOGRAM, "gaussian_stddev": 1e4, "pulse": "gaussian", "pulse_fwhm_opl": 0.5}
    scene = tt.load(room_of(HISTOGRAM, late), variant=VARIANT)
    first, second = (tt.TransientRenderer(scene, sensors=n, spp=2) for n in range(2))
    expected = [renderer(seed=0).transient for renderer in (first, second)]
    with pytest.raises(SceneError, match="4096"):
        tt.TransientRenderer(scene, sensors=1, temporal_filter="gaussian", spp=2)(seed=0)
    for renderer, before in zip((first, second), expected, strict=True):
        assert torch.equal(renderer(seed=0).transient, before)


# -------------------------------------------------------------------------------------- several films in one call


@pytest.mark.parametrize(
    "first, second, message",
    [
        ({**HISTOGRAM, "temporal_bins": 2}, FILMS["gated"], "Histogram.*Gates"),
        (HISTOGRAM, {**HISTOGRAM, "start_opl": 5.0}, "start_opl=5.0"),
        (FILMS["gated"], {**FILMS["gated"], "gates": "gaussian 8 0.5; gaussian 9 0.6"}, "Gates"),
        (FILMS["phasor"], {**FILMS["phasor"], "start_opl": 1.0}, "start_opl=1"),
        (HISTOGRAM, {**HISTOGRAM, "width": 3}, r"\(3, 3, 24, 3\)"),
    ],
)
def test_films_of_one_call_measure_the_same(first, second, message):
    """Equal shapes are not enough: one tensor would hold bins of different times, or gates beside bins."""
    scene = tt.load(room_of(first, second), variant=VARIANT)
    with pytest.raises(SceneError, match=f"measure the same.*{message}.*per sensor"):
        tt.TransientRenderer(scene, sensors="all")
    tt.TransientRenderer(scene, sensors=1)


def test_every_film_of_a_call_needs_a_slope():
    """A pulse in one film does not speak for the other."""
    pulsed = {**HISTOGRAM, "pulse": "gaussian", "pulse_fwhm_opl": 0.5}
    scene = tt.load(room_of(pulsed, HISTOGRAM), variant=VARIANT)
    arguments = {"parameters": [WALL_POSE], "sensors": "all", "spp": 2}
    assert tt.TransientRenderer(scene, **arguments).effective_filter == "tent"
    with pytest.raises(GradientError, match="no slope"):
        tt.TransientRenderer(scene, temporal_filter="box", **arguments)(seed=0).transient.sum().backward()
