"""Light from and to infinity is timed by the sphere around the scene as described: whatever was rendered before, and
through whichever integrator, sensor, copy or call values came in.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.lights_and_sensors import film, looking_down
from torchtransient import plugins

VARIANT = "llvm_ad_rgb"
LIGHTS = {
    "constant": {"type": "constant"},
    "envmap": {"type": "envmap", "bitmap": np.ones((4, 8, 3), dtype=np.float32)},
    "directional": {"type": "directional", "direction": [0.3, 0.0, -1.0]},
}
AXIS = {"bins": 400, "width": 0.1, "start": -5.0}


def square(x, z, size=1.0):
    matrix = np.diag([size, size, 1.0, 1.0])
    matrix[:3, 3] = [x, 0, z]
    return {"type": "rectangle", "to_world": matrix}


def description(light="constant", sensor=None, integrator=True):
    """A plane, and a small square far from it, whose place decides how large the scene is."""
    sensor = sensor or {"type": "perspective", "fov": 1.0, **looking_down(4.0), "film": film(**AXIS)}
    kept = {"integrator": {"type": "transient_path", "max_depth": 2}} if integrator else {}
    return {
        "type": "scene", **kept, "sensor": sensor, "plane": square(0, 0), "far": square(0, -3, 0.1),
        "sky": LIGHTS[light] if isinstance(light, str) else light,
    }  # fmt: skip


def load(*args, **kwargs):
    mi.set_variant(VARIANT)
    plugins.sync()
    scene = description(*args, **kwargs)
    if "bitmap" in scene["sky"]:
        scene["sky"] = scene["sky"] | {"bitmap": mi.Bitmap(scene["sky"]["bitmap"])}
    for node in scene.values():
        if isinstance(node, dict) and isinstance(node.get("to_world"), np.ndarray):
            node["to_world"] = mi.ScalarTransform4f(node["to_world"])
    return mi.load_dict(scene, optimize=False)


def move(scene, distance):
    params = mi.traverse(scene)
    matrix = square(0, -distance, 0.1)["to_world"]
    params["far.to_world"] = mi.Transform4f(mi.Matrix4f(matrix))
    params.update()


def arrival(scene, integrator=None, sensor=0):
    """Mean arrival of the light in metres."""
    integrator = integrator or scene.integrator()
    bins = np.array(integrator.render(scene, sensor=sensor, seed=0, spp=256)[1], dtype=float)[0, 0].sum(-1)
    centers = AXIS["start"] + (np.arange(AXIS["bins"]) + 0.5) * AXIS["width"]
    assert bins.sum() > 0
    return float(bins @ centers / bins.sum())


def other_values_first(scene):
    move(scene, 50.0)
    arrival(scene)


def other_integrator_first(scene):
    move(scene, 20.0)
    arrival(scene, mi.load_dict({"type": "transient_path", "max_depth": 2}))


def another_scene_first(scene):
    move(scene, 20.0)
    other = load()
    arrival(other, scene.integrator())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "light"),
    [
        (other_values_first, "constant"), (other_integrator_first, "envmap"), (another_scene_first, "directional"),
        (lambda scene: None, "constant"),
    ],
)  # fmt: skip
def test_order_of_calls(order, light):
    scene = load(light)
    order(scene)
    move(scene, 10.0)
    got = arrival(scene)
    sphere = scene.integrator().reference(scene)
    assert sphere.radius == pytest.approx(np.sqrt(2 + 1.5**2), rel=1e-6) and sphere.center[2] == pytest.approx(-1.5)
    expected = load(light)
    arrival(expected)
    move(expected, 10.0)
    assert got == pytest.approx(arrival(expected), abs=1e-4)


def layer_arrival(renderer, distance, **call):
    value = torch.tensor(square(0, -distance, 0.1)["to_world"], dtype=torch.float32)
    out = renderer({"far.to_world": value}, seed=0, spp=256, **call)
    bins = out.transient.detach().double().sum((0, 2, 3))
    centers = AXIS["start"] + (torch.arange(AXIS["bins"]) + 0.5) * AXIS["width"]
    return float(bins @ centers.double() / bins.sum())


def layer(light="directional"):
    scene = tt.load(description(light), variant=VARIANT)
    return tt.TransientRenderer(scene, parameters=["far.to_world"], temporal_filter="box")


def test_layer_does_not_depend_on_what_it_rendered_first():
    first, second = layer("envmap"), layer("envmap")
    expected = layer_arrival(first, 3.0)  # the values described
    assert layer_arrival(second, 40.0) == pytest.approx(expected, abs=0.02)
    assert layer_arrival(second, 3.0) == pytest.approx(expected, abs=1e-4)


def test_batch_starts_with_the_description():
    renderer, alone = layer(), layer()
    expected = layer_arrival(alone, 3.0)
    values = torch.tensor(np.stack([square(0, -d, 0.1)["to_world"] for d in (40.0, 3.0)]), dtype=torch.float32)
    out = renderer({"far.to_world": values}, seed=0, spp=256)
    bins = out.transient.double().sum((1, 3, 4))
    centers = (AXIS["start"] + (torch.arange(AXIS["bins"]) + 0.5) * AXIS["width"]).double()
    np.testing.assert_allclose((bins @ centers / bins.sum(-1)).detach(), expected, atol=0.02)
