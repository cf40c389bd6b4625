"""The shortest path of light over a moved shape, between boxes, and whether the time axis holds it."""

from __future__ import annotations

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.scenes import look_at, translate

D = tt.data
# A ball of radius one that moves to (0, 0, 11), seen from (0, 0, -4): its box spans (-1, -1, 10) to (1, 1, 12).
LAMP = {"type": "point", "position": [0.0, 3.0, 1.0], "intensity": 1.0}
TO_BALL, TO_EYE = np.hypot(2.0, 9.0), 14.0


def recipe(end, lamp=LAMP, vary=None, integrator=None, **settings):
    scene = {
        "type": "scene",
        "integrator": integrator or {"type": "transient_path", "max_depth": 2},
        "sensor": {
            "type": "perspective", "fov": 40.0, "to_world": look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "transient_hdr_film", "width": 2, "height": 2},
        },
        "ball": {"type": "sphere", "to_world": translate([0.0, 0.0, 1.0]), "bsdf": {"type": "diffuse"}},
        "lamp": lamp,
    }  # fmt: skip
    away = {"ball.to_world": D.Offset([0, 0, 10], [0, 0, 10])}
    axis = tt.TimeAxis(0.0, end / 4, 4)
    return D.Recipe(scene, away | (vary or {}), variant="llvm_ad_mono", spp=1, time_axis=axis, **settings)


@pytest.fixture
def nothing_is_rendered(monkeypatch):
    """The check passes; its renders, which follow, fail at once."""

    def render(*arguments, **keywords):
        raise SceneError("not rendered")

    monkeypatch.setattr(tt.TransientRenderer, "forward", render)
    with pytest.warns(TorchTransientWarning, match="not rendered"):
        yield


def leaves(made):
    """The shortest path, where the window is too short for it."""
    with pytest.raises(SceneError, match=r"'ball\.to_world' .* leaves the window") as caught:
        made.check()
    return float(str(caught.value).split(" is ")[1].split(" m,")[0])


@pytest.mark.usefixtures("nothing_is_rendered")
def test_the_shortest_path_from_a_light_to_an_eye():
    assert leaves(recipe((TO_BALL + TO_EYE) * (1 - 1e-3))) == pytest.approx(TO_BALL + TO_EYE, rel=1e-3)
    recipe((TO_BALL + TO_EYE) * (1 + 1e-3)).check()


def test_lights_and_eyes_that_move():
    vary = {"lamp.position": D.Choice([[0.0, 1.0, 6.0]])}
    assert leaves(recipe(5.0, vary=vary)) == pytest.approx(4 + TO_EYE)
    vary = {"sensor.to_world": D.Offset([0, 0, 12], [0, 0, 12])}
    assert leaves(recipe(5.0, vary=vary)) == pytest.approx(TO_BALL + 2, rel=1e-3)


def test_lights_with_a_shape():
    panel = {"type": "rectangle", "to_world": translate([0, 0, 15.0]), "emitter": {"type": "area", "radiance": 1.0}}
    assert leaves(recipe(5.0, panel)) == pytest.approx(3 + TO_EYE)


def test_lengths_that_are_counted_from_the_first_thing_seen():
    unwarped = {"type": "transient_path", "max_depth": 2, "camera_unwarp": True}
    assert leaves(recipe(5.0, integrator=unwarped)) == pytest.approx(TO_BALL, rel=1e-3)


@pytest.mark.usefixtures("nothing_is_rendered")
def test_lights_without_a_place_and_pulses_are_not_checked():
    recipe(1.0, {"type": "constant", "radiance": 1.0}).check()
    recipe(1.0, pulse=tt.Pulse.gaussian(0.5)).check()
