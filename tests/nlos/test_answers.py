"""What is known of a capture and said of it: its scan as it was in the call, its seed and light, sensors that do not
fit, and captures without light.
"""

from __future__ import annotations

import copy
import json
import warnings

import pytest
import torch

import torchtransient as tt
from support.marks import long, long_rows
from torchtransient import sensing
from torchtransient.errors import PhysicsError, PhysicsWarning, SceneError, UnitError

VARIANT = "llvm_ad_mono"
AXIS = tt.TimeAxis(1.5, 0.05, 40)
WALL = tt.nlos.Wall.plane(2.0, 2.0, albedo=0.7)
HIDDEN = tt.scenes.nlos_z()
VERTICES = "letter.vertex_positions"
# Keys of the points of a scan in its scene.
POINTS, SPOTS = "wall.sensor.points", "wall.sensor.laser_points"
ORIGIN, LASER_ORIGIN = "wall.sensor.sensor_origin", "wall.sensor.laser_origin"
POINT_TENSORS = {POINTS: "sensor_points", SPOTS: "laser_points", ORIGIN: "sensor_origin", LASER_ORIGIN: "laser_origin"}
# A square whose normals point away from the wall.
SQUARE = [[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.0], [-0.5, 0.5, 1.0]]
AWAY, TOWARDS = (SQUARE, [[0, 1, 2], [0, 2, 3]]), (SQUARE, [[0, 2, 1], [0, 3, 2]])


def scan(kind="confocal"):
    return tt.nlos.Scan.grid(WALL, 4, kind=kind, laser_grid=2 if kind == "exhaustive" else None)


def renderer(parameters=(), hidden=HIDDEN, of=None, **settings):
    return tt.nlos.CaptureRenderer(hidden, of or scan(), parameters, **{"time_axis": AXIS, "spp": 16} | settings)


def simulated(hidden=HIDDEN, of=None, **settings):
    return tt.nlos.simulate(hidden, of or scan(), **{"time_axis": AXIS, "spp": 16, "progress": False} | settings)


def physics_of(act):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        act()
    return [str(warning.message) for warning in caught if issubclass(warning.category, PhysicsWarning)]


# ------------------------------------------------------------------------------------------------------------ settings


@pytest.mark.slow
def test_bins_that_nobody_gave():
    """Those of `simulate`: they hold all light of three bounces, but what a wider filter spreads over their rim."""
    made = renderer([VERTICES], time_axis=None)(seed=0)
    assert made.axis == scan().default_axis(tt.scenes.bounds(HIDDEN), tt.units.seconds_to_opl(16e-12))
    assert made.axis == simulated(time_axis=None).axis
    torch.testing.assert_close(made.total().detach(), made.steady.detach(), rtol=1e-2, atol=0)
    plain = renderer(time_axis=None)(seed=0)
    torch.testing.assert_close(plain.total(), plain.steady, rtol=1e-5, atol=0)
    phasors = renderer(frequencies=[1.0], time_axis=None)(seed=0)
    assert phasors.axis is None and phasors.phasor.shape == (1, 1, 4, 4)


@pytest.mark.slow
def test_what_metadata_say():
    """The names of a simulation's, as far as a layer knows them; the seed of a call is the one that draws it again."""
    layer, made = renderer([VERTICES]), simulated(seed=3).metadata
    told = layer(seed=3).metadata
    assert set(told) == {"spp", "seed", "seconds", "variant", "light"} < set(made)
    assert all(told[name] == made[name] for name in ("spp", "seed", "light"))
    drawn = layer()
    again = layer(seed=drawn.metadata["seed"])
    torch.testing.assert_close(again.transient, drawn.transient, rtol=1e-5, atol=1e-9)
    values = layer.values[VERTICES].detach().expand(2, -1, -1)
    batch = layer({VERTICES: values}, seed=[4, 5]).metadata
    assert batch["seed"] == [4, 5] and json.loads(json.dumps(dict(batch))) == batch
    assert "from paths" in renderer(bounces="all")(seed=0).metadata["light"]


# --------------------------------------------------------------------------------------------------- points of a call


@pytest.mark.parametrize("key", long([POINTS, LASER_ORIGIN], [POINTS]))
def test_captures_know_the_points_of_their_call(key):
    of = scan("single")
    layer, old = renderer([key], of=of), getattr(of, POINT_TENSORS[key])
    same = layer(seed=0).scan
    torch.testing.assert_close(getattr(same, POINT_TENSORS[key]).detach(), old, rtol=0, atol=1e-6)
    moved = (old + torch.tensor([0.125, 0.0, 0.0])).float().reshape(layer.values[key].shape).requires_grad_()
    made = layer({key: moved}, seed=0).scan
    for name in POINT_TENSORS.values():
        expected = moved.double().reshape(old.shape) if name == POINT_TENSORS[key] else getattr(of, name)
        assert torch.equal(getattr(made, name), expected)
    getattr(made, POINT_TENSORS[key]).sum().backward()
    assert bool((moved.grad == 1).all())
    assert made.wall is of.wall and made != of and layer.scan is of


@pytest.mark.slow
def test_scans_stay_what_they_were():
    """A step of an optimizer changes its leaves, not the captures before it."""
    leaf = torch.nn.Parameter(scan().sensor_points.clone())
    origin = scan().sensor_origin
    of = tt.nlos.Scan.points(leaf, kind="confocal", sensor_origin=origin, laser_origin=origin, wall=WALL)
    layer, optimizer = renderer(of=of), torch.optim.SGD([leaf], lr=1e-3)
    first = layer(seed=0)
    before = first.scan.sensor_points.detach().clone()
    first.transient.sum().backward()
    optimizer.step()
    second = layer(seed=0)
    assert torch.equal(first.scan.sensor_points, before) and not torch.equal(leaf, before)
    assert torch.equal(second.scan.sensor_points, leaf) and second.scan.sensor_points.requires_grad
    assert second.scan != first.scan


def test_points_of_a_batch_are_the_constructors():
    of = scan()
    layer = renderer([POINTS], of=of)
    moved = torch.stack([of.sensor_points.reshape(-1, 3) + torch.tensor([x, 0.0, 0.0]) for x in (0.0, 0.1)])
    assert layer({POINTS: moved}, seed=0).scan is of

    def total(points):
        made = layer({POINTS: points}, seed=0)
        assert made.scan is of
        return made.transient.sum()

    found = torch.func.vmap(total)(moved)
    torch.testing.assert_close(found, torch.stack([layer({POINTS: p}, seed=0).transient.sum() for p in moved]).detach())


def test_points_that_are_no_scan():
    of = scan()
    behind = torch.tensor([-0.5, 0.0, -0.25])
    layer = renderer([ORIGIN], of=of)
    found = physics_of(lambda: [layer({ORIGIN: behind}, seed=0) for _ in range(2)])
    told = [message for message in found if "are no scan, capture.scan is the constructor's" in message]
    assert len(told) == 1 and "sensor_origin in front of the wall" in told[0]
    assert layer({ORIGIN: behind}, seed=0).scan is of
    assert physics_of(lambda: renderer([ORIGIN], physics="ignore")({ORIGIN: behind}, seed=0)) == []


# ------------------------------------------------------------------------------------------------------------- sensors


def response(axis):
    return sensing.ImpulseResponse(sensing.GaussianResponse(200e-12), axis)


def correlation(axis):
    return sensing.ItofCorrelation(sensing.sine_code(4), (80e6, 60e6), axis)


@pytest.mark.parametrize(
    ("sensor", "error", "message"),
    [
        (sensing.Compose([response(tt.TimeAxis(1.5, 0.06, 40))]), UnitError, r"the axis of stage 'stages\.0'"),
        (correlation(tt.TimeAxis(1.5, 0.05, 41)), UnitError, r"the axis of stage '0' \(ItofCorrelation"),
        (sensing.Compose([correlation(AXIS)]), SceneError, "expected an answer with the transient's 40 bins, got 8"),
    ],
)  # fmt: skip
def test_sensors_that_do_not_fit_are_said_before_the_render(monkeypatch, sensor, error, message):
    monkeypatch.setattr(tt.TransientRenderer, "forward", None)
    with pytest.raises(error, match=message):
        simulated(sensor=sensor)
    with pytest.raises(error, match=message):
        renderer(sensor=sensor)


def test_checks_of_sensors_draw_nothing():
    """Torch's own generator is where it was."""
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    simulated(sensor=response(AXIS))
    renderer(sensor=response(AXIS))
    assert torch.equal(torch.rand(3), expected)


# ------------------------------------------------------------------------------------------------------- without light


@pytest.mark.parametrize(
    ("kind", "settings", "tiles"),
    long_rows(
        [("confocal", {}, 3), ("exhaustive", {}, 1), ("exhaustive", {"frequencies": [1.0], "time_axis": None}, 3)],
        [("confocal", {}, 3)],
    ),
)
def test_captures_without_light_are_said_once(kind, settings, tiles):
    found = physics_of(lambda: simulated(AWAY, of=scan(kind), tiles=tiles, **settings))
    assert len(found) == 1 and found[0].startswith("simulate: no light comes back from the hidden things")
    assert ("within the bins" in found[0]) == (kind == "exhaustive" and not settings)
    assert physics_of(lambda: simulated(TOWARDS, of=scan(kind), tiles=tiles, **settings)) == []


@pytest.mark.slow
def test_layers_without_light_say_it_once():
    layer = renderer(hidden=AWAY)
    found = physics_of(lambda: [layer(seed=seed) for seed in range(3)])
    assert len(found) == 1 and found[0].startswith("CaptureRenderer: no light comes back from the hidden things.")
    assert physics_of(lambda: renderer(hidden=TOWARDS)(seed=0)) == []
    assert physics_of(lambda: renderer(hidden=AWAY, physics="ignore")(seed=0)) == []
    strict = renderer(hidden=AWAY, physics="error")
    for _ in range(2):
        with pytest.raises(PhysicsError, match="no light comes back"):
            strict(seed=0)
    assert len(physics_of(lambda: simulated(TOWARDS, energy=0.0))) == 1


def test_a_detached_capture_has_points_without_gradients():
    capture = renderer([POINTS])(seed=0)
    assert capture.scan.sensor_points.requires_grad
    assert not capture.detach().scan.sensor_points.requires_grad
    assert copy.deepcopy(capture.detach()) == capture.detach()
