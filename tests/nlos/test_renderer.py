"""Captures as a layer: which tensors are rendered and get gradients, which seeds count, and what is said of values that
take the scan's points out of sight.
"""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import ArgumentError, PhysicsError, PhysicsWarning, SceneError

VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.5, 0.05, 40)
WALL = tt.nlos.Wall.plane(2.0, 1.6, albedo=0.7)
VERTICES = "letter.vertex_positions"
# Keys of the points of a scan in its scene.
POINTS, SPOTS = "wall.sensor.points", "wall.sensor.laser_points"
ORIGIN, LASER_ORIGIN = "wall.sensor.sensor_origin", "wall.sensor.laser_origin"
ASIDE = torch.tensor([-0.5, 0.0, 0.25], dtype=torch.float64)
GRID = torch.tensor(WALL.grid((3, 2))[0])


def scan(points=GRID, kind="confocal", origin=ASIDE, **settings):
    return tt.nlos.Scan.points(points, kind=kind, sensor_origin=origin, laser_origin=ASIDE, wall=WALL, **settings)


def renderer(of=None, parameters=(), **settings):
    return tt.nlos.CaptureRenderer(tt.scenes.nlos_z(), of or scan(), parameters, time_axis=AXIS, spp=16, **settings)


# --------------------------------------------------------------------------------------------------- points of a scan


@pytest.mark.parametrize("key", [POINTS, LASER_ORIGIN])
def test_a_key_that_the_scan_brings_too(key):
    leaf = torch.nn.Parameter(GRID.clone())
    origin, spot = torch.nn.Parameter(ASIDE.clone()), torch.nn.Parameter(GRID[0, 1].clone())
    of = tt.nlos.Scan.points(
        leaf, kind="single", laser_points=spot, sensor_origin=origin, laser_origin=origin, wall=WALL
    )
    with pytest.raises(SceneError, match=rf"{key}: expected one tensor, got one of the scan.*scan\.detach\(\)"):
        renderer(of, [VERTICES, key])
    layer = renderer(of.detach(), [VERTICES, key])
    assert set(layer.values) == {VERTICES, key}


@pytest.mark.slow
@pytest.mark.parametrize("as_leaf", ["as it is", "transposed", "of a larger one"])
def test_points_that_an_optimizer_changes(as_leaf):
    """However their numbers lie in memory, a call renders those of now and gives their gradient to the leaf."""
    made = {"transposed": GRID.transpose(0, 1).contiguous().transpose(0, 1), "of a larger one": torch.cat([GRID, GRID])}
    leaf = torch.nn.Parameter(made.get(as_leaf, GRID).clone(memory_format=torch.preserve_format))
    assert leaf.is_contiguous() == (as_leaf != "transposed")
    layer = renderer(scan(leaf[:2] if as_leaf == "of a larger one" else leaf))
    before = layer(seed=0).transient
    before.sum().backward()
    before = before.detach()
    assert leaf.grad is not None and float(leaf.grad.abs().sum()) > 0
    with torch.no_grad():
        leaf[:2, :, 0] += 0.2
    after = layer(seed=0).transient.detach()
    expected = renderer(scan((GRID + torch.tensor([0.2, 0.0, 0.0])).requires_grad_()))(seed=0).transient.detach()
    torch.testing.assert_close(after, expected, rtol=0, atol=1e-5 * float(expected.max()))
    assert float((after - before).abs().max()) > 1e-3 * float(before.max())


@pytest.mark.slow
def test_points_that_were_computed_do_not_follow():
    """Of an offset, and in single precision."""
    for leaf, points in ((torch.zeros(3).double(), lambda leaf: GRID + leaf), (GRID.float(), lambda leaf: leaf)):
        leaf = torch.nn.Parameter(leaf)
        layer = renderer(scan(points(leaf)))
        layer(seed=0).transient.sum().backward()
        assert float(leaf.grad.abs().sum()) > 0
        with torch.no_grad():
            leaf += 0.0
        with pytest.raises(SceneError, match=r"computed of have changed.*make scan and renderer anew"):
            layer(seed=0)


def test_copies_follow_their_own_points():
    leaf = torch.nn.Parameter(GRID.clone())
    layer = renderer(scan(leaf), [VERTICES])
    for twin in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        torch.testing.assert_close(twin(seed=0).transient, layer(seed=0).transient, rtol=1e-5, atol=1e-9)
        assert set(twin.values) == {VERTICES}


# -------------------------------------------------------------------------------------------------------------- seeds


def test_seeds_of_any_library():
    layer = renderer()
    expected = layer(seed=5).transient.squeeze(0)
    for seed in (np.uint32(5), torch.tensor(5), [5]):
        torch.testing.assert_close(layer(seed=seed).transient.squeeze(0), expected)
    capture = tt.nlos.simulate(tt.scenes.nlos_z(), scan(), time_axis=AXIS, spp=4, seed=np.int64(3), progress=False)
    assert capture.metadata["seed"] == 3 and type(capture.metadata["seed"]) is int


def test_no_values_are_those_of_the_layer():
    assert renderer(parameters=["letter.bsdf.reflectance.value"])(None, seed=0).transient.shape == (1, 40, 2, 3)


def test_a_vmap_of_seeds():
    layer = renderer(parameters=[VERTICES])
    values = layer.values[VERTICES].detach().expand(2, -1, -1)

    def total(value, seed):
        return layer({VERTICES: value}, seed=seed).transient.sum()

    found = torch.func.vmap(total)(values, torch.tensor([3, 4]))
    torch.testing.assert_close(found, torch.stack([total(values[0], s) for s in (3, 4)]), rtol=1e-5, atol=0)


def test_which_draws_are_those_of_simulate():
    """A layer's in the same variant are those of a simulation in one part; parts are other draws."""
    settings = {"time_axis": AXIS, "spp": 16, "seed": 3, "progress": False}
    whole = tt.nlos.simulate(tt.scenes.nlos_z(), scan(), **settings).transient
    parts = tt.nlos.simulate(tt.scenes.nlos_z(), scan(), tiles=2, **settings).transient
    layer = renderer(parameters=["letter.bsdf.reflectance.value"])(seed=3).transient.detach()
    torch.testing.assert_close(layer, whole, rtol=0, atol=1e-6 * float(whole.max()))
    assert float((parts - whole).abs().max()) > 0.01 * float(whole.max())


# ------------------------------------------------------------------------------------------------ values out of sight

BEHIND, BETWEEN = -2.0, -0.9
SAID = {BEHIND: "nothing hidden is before the wall", BETWEEN: r"2 of 6 rays of the sensor do not end at their points"}


def moved(layer, z):
    return layer.values[VERTICES].detach() + torch.tensor([0.0, 0.0, z])


@pytest.mark.slow
@pytest.mark.parametrize(("z", "batch"), [(BEHIND, True), (BETWEEN, False)])
def test_values_that_hide_the_scan_are_said_once(z, batch):
    layer = renderer(parameters=[VERTICES])
    value = moved(layer, z)
    with warnings.catch_warnings():
        warnings.simplefilter("error", PhysicsWarning)
        layer(seed=0)
        layer({VERTICES: moved(layer, 0.1)}, seed=0)
    given = torch.stack([moved(layer, 0.0), value]) if batch else value
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            layer({VERTICES: given}, seed=0)
    found = [warning for warning in caught if "window" not in str(warning.message)]
    assert len(found) == 1 and issubclass(found[0].category, PhysicsWarning)
    assert re.search(SAID[z], str(found[0].message))


def test_values_that_hide_the_scan_as_errors():
    z, layer = BEHIND, renderer(parameters=[VERTICES], physics="error")
    with pytest.raises(PhysicsError, match=SAID[z]):
        layer({VERTICES: moved(layer, z)}, seed=0)
    quiet = renderer(parameters=[VERTICES], physics="ignore")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet({VERTICES: moved(quiet, z)}, seed=0)


@pytest.mark.parametrize(
    ("key", "who"),
    [(SPOTS, "laser"), (ORIGIN, "sensor"), ("wall.to_world", "sensor")],
)
def test_points_and_wall_that_part(key, who):
    layer = renderer(scan(kind="single", laser_points=GRID[0, 1]), [key], physics="error")
    layer(seed=0)
    value = layer.values[key].detach().clone()
    if key == "wall.to_world":
        value[2, 3] -= 0.1
    elif key in (ORIGIN, LASER_ORIGIN):
        value[:] = torch.tensor([0.0, -0.4, 4.0])  # beyond the foot of the letter
    else:
        value.reshape(-1, 3)[0, 2] += 0.1
    with pytest.raises(PhysicsError, match=f"rays of the {who} do not end at their points"):
        layer({key: value}, seed=0)


def test_lasers_of_confocal_scans_stand_elsewhere():
    layer = renderer(scan(), [LASER_ORIGIN])
    beyond = torch.tensor([0.0, -0.4, 4.0])
    with pytest.warns(PhysicsWarning, match="rays of the laser do not end at their points") as found:
        layer({LASER_ORIGIN: beyond}, seed=0)
    assert not any("rays of the sensor" in str(warning.message) for warning in found)


def test_captures_have_no_gates():
    layer = tt.nlos.CaptureRenderer(tt.scenes.nlos_z(), scan(), gates=[tt.Gate.gaussian(2.0, 0.5)], spp=4)
    with pytest.raises(ArgumentError, match="capture: expected a time axis or frequencies; a capture has no place for"):
        layer(seed=0)


@pytest.mark.parametrize("moved", ["sensor_points", "laser_points"])
def test_points_that_carry_gradients_are_looked_at(moved):
    of = tt.nlos.Scan.grid(WALL, (3, 2), kind="single")
    of = replace(of, **{moved: getattr(of, moved).clone().requires_grad_()})
    with no_gradient_is_lost():
        renderer(of)
