"""The layer: shapes, batches, sensors, seeds, statistics, and errors that say what to do."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

import torchtransient as tt
from tools.small_room import CAMERA, COLOUR, GREY, VARIANT, WALL_POSE, make_room, pose
from torchtransient.errors import TorchTransientWarning

START = torch.tensor([0.8, 0.5, 0.2])


def test_output(room_scene):
    out = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=16)(seed=0)
    assert out.transient.shape == (3, 24, 3, 4) and out.transient.dtype == torch.float32
    assert out.steady.shape == (3, 3, 4) and out.phasor is None
    assert out.axis == tt.TimeAxis(start_opl=6.0, bin_width_opl=0.25, num_bins=24)
    torch.testing.assert_close(out.transient.sum(1), out.steady)
    assert out.steady.min() > 0


def test_channels_and_pixels_are_where_they_belong(room_scene):
    colour = torch.tensor([0.9, 0.0, 0.0])
    steady = tt.render(room_scene, {COLOUR: colour}, spp=64, seed=0).steady
    full = tt.render(room_scene, {COLOUR: torch.ones(3)}, spp=64, seed=0).steady
    # The camera looks along -z with x to its right: the cube at x = 0.4 is in the right half of the picture.
    blue_lost = (full - steady)[2]
    assert blue_lost[:, 2:].sum() > 20 * blue_lost[:, :2].sum()
    assert (full - steady)[0].sum() < 0.2 * blue_lost.sum()


def test_statistics(room_scene):
    out = tt.TransientRenderer(room_scene, spp=16, time_axis=tt.TimeAxis(8.0, 0.25, 2))(seed=5)
    stats = out.stats
    assert (stats.spp, stats.variant, stats.integrator, stats.seeds) == (16, VARIANT, "transient_path", (5,))
    assert stats.temporal_filter == "box" and stats.seconds > 0
    assert stats.samples_per_second == pytest.approx(16 * 12 / stats.seconds)
    batch = tt.render(room_scene, {GREY: torch.rand(3)}, spp=4, seed=0).stats  # all pixels of all films
    assert batch.samples_per_second == pytest.approx(3 * 4 * 12 / batch.seconds)
    outside = stats.energy_before[0] + stats.energy_after[0]
    inside = float(out.transient.mean(0).sum())
    assert outside > 0
    total = float(out.steady.mean(0).sum())
    assert inside + outside == pytest.approx(total, rel=1e-4)
    # Of all that was rendered, whatever is kept of it.
    assert sum(out.outside) == pytest.approx(outside / total, rel=1e-6)
    assert out.map(lambda tensor: tensor[:1]).outside == out.outside


def test_a_number_of_samples_that_a_sampler_rounds_is_said_once(room_scene, capfd):
    """By Python's warnings: Mitsuba's words of its samplers go past them, several times in a call."""
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], sampler="multijitter")
    capfd.readouterr()
    with pytest.warns(TorchTransientWarning, match="spp=7 is rounded to 8") as said:
        renderer(seed=0, spp=7).steady.sum().backward()
    assert len(said) == 1 and said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert renderer(seed=1, spp=7).stats.spp == 8
        # Samples of a derivative count where there is one.
        renderer.spp_grad = 11
        with torch.no_grad():
            renderer(seed=1, spp=7)
    with pytest.warns(TorchTransientWarning, match="spp=11 is rounded to 12"):
        renderer(seed=1, spp=7)
    assert "ounded" not in "".join(capfd.readouterr())


def test_function_and_module_agree(room_scene):
    x = torch.tensor([0.3, 0.6, 0.9])
    module = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=16)
    assert not tt.render(make_room(), spp=4, seed=0).steady.requires_grad
    assert torch.equal(
        module({COLOUR: x}, seed=4).transient, tt.render(room_scene, {COLOUR: x}, spp=16, seed=4).transient
    )
    y = x.clone().requires_grad_()
    tt.render(room_scene, {COLOUR: y}, spp=16, seed=4).transient.sum().backward()
    assert y.grad.abs().min() > 0


# ------------------------------------------------------------------------------------------------- seeds, batches


def test_same_seed_same_tensor(room_scene):
    renderer = tt.TransientRenderer(room_scene, spp=4)
    assert torch.equal(renderer(seed=3).transient, renderer(seed=3).transient)
    assert not torch.equal(renderer(seed=3).transient, renderer(seed=4).transient)


@pytest.mark.parametrize(("key", "shape"), [(GREY, ()), (WALL_POSE, (4, 4)), ("light.position", (3,))])
def test_batches_of_every_shape(room_scene, key, shape):
    renderer = tt.TransientRenderer(room_scene, parameters=[key], spp=4)
    x = renderer.values[key].detach()
    assert x.shape == shape
    out = renderer({key: torch.stack([x, x])}, seed=6)
    assert out.transient.shape == (2, 3, 24, 3, 4)
    assert out.stats.seeds[0] == 6 and not torch.equal(out.transient[0], out.transient[1])
    for seed, entry in zip(out.stats.seeds, out.transient, strict=True):
        assert torch.equal(entry, renderer({key: x}, seed=seed).transient)


# ------------------------------------------------------------------------------------------------------- sensors


def two_sensor_room(second_width=4):
    room = make_room()
    second = {**room["sensor"], "to_world": CAMERA @ pose(0.3, 0.1, 0.5)}
    second["film"] = {**room["sensor"]["film"], "width": second_width}
    room["second"] = second
    return room


def test_several_sensors():
    scene = tt.load(two_sensor_room(), variant=VARIANT)
    both = tt.TransientRenderer(scene, parameters=[COLOUR], spp=16, sensors="all")
    out = both(seed=2)
    assert out.transient.shape == (2, 3, 24, 3, 4) and out.steady.shape == (2, 3, 3, 4)
    for n, seed in enumerate(out.stats.seeds):
        single = tt.TransientRenderer(scene, parameters=[COLOUR], spp=16, sensors=n)(seed=seed)
        assert torch.equal(single.transient, out.transient[n])
    batch = both({COLOUR: torch.rand(5, 3)}, seed=0)
    assert batch.transient.shape == (5, 2, 3, 24, 3, 4)
    assert tt.TransientRenderer(scene, sensors=[1], spp=4)(seed=0).transient.shape == (1, 3, 24, 3, 4)


def test_gradients_of_several_sensors_add_up():
    scene = tt.load(two_sensor_room(), variant=VARIANT)

    def gradient(sensors, seed, weight):
        renderer = tt.TransientRenderer(scene, parameters=[COLOUR], spp=16, sensors=sensors)
        out = renderer(seed=seed)
        (out.transient * weight).sum().backward()
        return renderer.values[COLOUR].grad, out.stats.seeds

    found, (first, second) = gradient("all", 2, torch.tensor([1.0, 3.0]).view(2, 1, 1, 1, 1))
    assert first != second
    torch.testing.assert_close(found, gradient(0, first, 1.0)[0] + gradient(1, second, 3.0)[0])


# ------------------------------------------------------------------------------------------------ temporal filter


def test_automatic_filter(room_scene):
    def chosen(keys, **settings):
        return tt.TransientRenderer(room_scene, parameters=keys, **settings).effective_filter

    assert chosen([]) == "box" and chosen([COLOUR]) == "box"
    for key in (WALL_POSE, "light.position", "box.vertex_positions", "box.to_world", "sensor.to_world"):
        assert chosen([COLOUR, key]) == "tent"
    assert chosen([WALL_POSE], temporal_filter="gaussian") == "gaussian"


def test_filter_of_one_renderer_does_not_reach_another(room_scene):
    box = tt.TransientRenderer(room_scene, parameters=[WALL_POSE], spp=16, temporal_filter="box")
    tent = tt.TransientRenderer(room_scene, parameters=[WALL_POSE], spp=16)
    with torch.no_grad():
        first, other, again = box(seed=0), tent(seed=0), box(seed=0)
    assert torch.equal(first.transient, again.transient)
    assert not torch.equal(first.transient, other.transient)
    assert other.stats.temporal_filter == "tent"


def test_gradient_of_a_length_through_a_box_is_refused(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[WALL_POSE, COLOUR], spp=4, temporal_filter="box")
    with pytest.raises(tt.errors.GradientError, match=r"wall\.to_world.*'box' has no slope.*'tent'"):
        renderer(seed=0)
    with torch.no_grad():
        renderer(seed=0)
    renderer.values[WALL_POSE].requires_grad_(False)
    renderer(seed=0).transient.sum().backward()
    assert renderer.values[COLOUR].grad.abs().min() > 0


# -------------------------------------------------------------------------------------------------------- errors


def test_wrong_shapes(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR, WALL_POSE, GREY], spp=4)
    cases = {
        COLOUR: (torch.zeros(4), r"box\.bsdf\.reflectance\.value.*expected shape \(3,\), or \(B, 3\).*got \(4,\)"),
        WALL_POSE: (torch.eye(3), r"expected shape \(4, 4\), or \(B, 4, 4\).*got \(3, 3\)"),
        GREY: (torch.zeros(2, 2), r"expected shape \(\), or \(B,\).*got \(2, 2\)"),
    }
    for key, (value, message) in cases.items():
        with pytest.raises(tt.errors.ShapeError, match=message):
            renderer({key: value}, seed=0)
    with pytest.raises(tt.errors.ShapeError, match="batch of 3, but another value has a batch of 2"):
        renderer({COLOUR: torch.rand(2, 3), GREY: torch.rand(3)}, seed=0)
    with pytest.raises(tt.errors.ShapeError, match="at least one entry"):
        renderer({COLOUR: torch.rand(0, 3)}, seed=0)
    with pytest.raises(tt.errors.ShapeError, match="one for each of 2 batch entries, got 3"):
        renderer({COLOUR: torch.rand(2, 3)}, seed=[1, 2, 3])
    with pytest.raises(tt.errors.UnitError, match="1 and 4294967297 are one seed"):
        renderer({COLOUR: torch.rand(2, 3)}, seed=(1, 1 + 2**32))
    with pytest.raises(tt.errors.ShapeError, match="start value"):
        tt.TransientRenderer(room_scene, parameters={COLOUR: torch.rand(2, 3)})


def test_parameters_are_set_by_their_keys(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4)
    before = renderer.values[COLOUR]
    renderer.values[COLOUR] = [0.25, 0.5, 0.75]
    assert renderer.values[COLOUR] is before and before.tolist() == [0.25, 0.5, 0.75] and before.requires_grad
    with pytest.raises(tt.errors.ShapeError, match="has no batch"):
        renderer.values[COLOUR] = torch.rand(2, 3)
    with pytest.raises(tt.errors.SceneError, match=r"no parameter 'box\.colour'; it was made with"):
        renderer.values["box.colour"] = 0.5
    assert "box.colour" not in renderer.values and renderer.values.get("box.colour") is None


def test_values_that_are_not_finite_or_not_declared(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=4)
    with pytest.raises(tt.errors.UnitError, match="1 of 3 that are NaN or infinite"):
        renderer({COLOUR: torch.tensor([0.1, math.nan, 0.2])}, seed=0)
    with pytest.raises(tt.errors.SceneError, match=r"no parameter 'wall\.bsdf\.reflectance\.value'.*parameters=\["):
        renderer({GREY: torch.tensor(0.1)}, seed=0)


def test_cube_that_does_not_fit_is_refused_before_it_is_allocated(room):
    room["sensor"]["film"].update(width=4096, height=4096, temporal_bins=60000)
    renderer = tt.TransientRenderer(tt.load(room, variant=VARIANT), spp=1)
    with pytest.raises(tt.errors.StorageError, match=r"10\.99 TiB \(H x W x T x C = 4096 x 4096 x 60000 x 3"):
        renderer(seed=0)


@pytest.mark.slow
def test_a_film_in_two_bands(room_scene, monkeypatch):
    """As if arrays were limited to two rows of pixels. Each pass has its own samples: amounts can be compared."""
    placed, along = "box.to_world", torch.tensor([0.5, 0.3, 0.4, 0.0])[:, None] * torch.tensor([0.0, 0.0, 0.0, 1.0])
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR, placed], spp=512, grad_seed="same")
    x, at, found, tangents = renderer.values[COLOUR], renderer.values[placed].detach(), [], []

    def moved(value):
        return renderer({placed: value}, seed=0, spp=1 << 15).transient.sum((0, 1))

    for most in (None, 2 * 4 * 24 * 3):
        if most is not None:  # holds while the scene's variant stays active
            monkeypatch.setattr("torchtransient.plugins.films.base.MAX_ARRAY_ENTRIES", most)
        out = renderer(seed=0).transient
        found.append((out.detach(), torch.autograd.grad(out.sum(), x)[0]))
        tangents.append(torch.func.jvp(moved, (at,), (along,))[1].detach())
    (whole, whole_slope), (banded, slope) = found
    pushed = torch.func.jvp(lambda y: renderer({COLOUR: y}, seed=0).transient.sum(), (START,), (torch.ones(3),))[1]
    assert banded.shape == whole.shape and not torch.equal(banded, whole)
    torch.testing.assert_close(banded.sum((0, 1, 3)), whole.sum((0, 1, 3)), rtol=0.05, atol=0)
    torch.testing.assert_close(slope, whole_slope, rtol=0.05, atol=0)
    torch.testing.assert_close(pushed, slope.sum(), rtol=1e-4, atol=0)
    # The outline crosses pixels of all rows. Without their share of the whole film, tangents are off by 0.065 and more.
    assert bool((tangents[0].abs().amax(1) > 0.1).all())
    torch.testing.assert_close(tangents[1], tangents[0], rtol=0, atol=0.04)
