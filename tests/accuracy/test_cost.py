"""`tt.cost_of_accuracy` on the real renderer, with tiny scenes."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.errors import ArgumentError, SceneError, ShapeError

VARIANT = "llvm_ad_mono"
ALBEDO, WALL, LIGHT = "wall.bsdf.reflectance.value", "wall.to_world", "light.position"


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_mono")


def wall_renderer(**settings):
    scene = tt.load(tt.scenes.moving_wall(resolution=2, num_bins=64, bin_width_opl=0.05), variant=VARIANT)
    return tt.TransientRenderer(scene, parameters=[ALBEDO, WALL], **settings)


@pytest.fixture(scope="module")
def report():
    return tt.cost_of_accuracy(
        wall_renderer(), spp=(16, 64, 256, 1024), repeats=8, samplers=("independent",),
        temporal_filters=("box", "tent"), progress=False,
    )  # fmt: skip


def test_independent_samples_converge_as_one_over_spp(report):
    for name in ("box", "tent"):
        slope = report.slope("transient", Choice("independent", name))
        assert abs(slope.slope + 1) < max(4 * slope.standard_error, 0.1)


def test_samples_for_an_error(report):
    """Independent samples: a quarter of the error takes sixteen times the samples, and a render has that error then."""
    choice = Choice("independent", "box")
    curve = next(points for _, found, points in report.curves() if found == choice)
    inside = report.spp_for(curve[1].relative_error, choice=choice)
    assert inside.low < curve[1].spp < inside.high and not inside.extrapolated
    coarse, fine = (report.spp_for(curve[-1].relative_error / k, quantity="transient", choice=choice) for k in (1, 4))
    assert 10 < fine.spp / coarse.spp < 26 and fine.extrapolated
    assert fine.high / fine.low > coarse.high / coarse.low > 1
    assert fine.seconds > coarse.seconds and f"{fine.spp:.3g} spp" in str(fine)
    first = report.spp_for(0.01)
    assert first == report.spp_for(0.01, quantity="transient", choice=choice)


def test_samples_of_curves_that_are_not_there(report):
    few = replace(report, points=[p for p in report.points if p.spp < 100])
    flat = replace(report, points=[replace(p, relative_error=0.1 + p.spp / 1e4) for p in report.points])
    for call in (
        lambda: report.spp_for(0.1, quantity="phasor"), lambda: report.spp_for(0.1, choice=Choice("owen", "box")),
        lambda: few.spp_for(0.1), lambda: flat.spp_for(0.1),
    ):  # fmt: skip
        with pytest.raises(ArgumentError, match="spp_for"):
            call()


def test_the_interval_holds_the_samples():
    """Of artificial curves with the scatter that they say, 95 of 100."""
    generator, held = np.random.default_rng(0), 0
    for _ in range(400):
        noise = generator.normal(0, 0.1, 4)
        points = [
            CostPoint(Choice("independent", "box"), "transient", n, 0.1, np.exp(e) / n, 0.1 * np.exp(e) / n,
                      np.sqrt(np.exp(e) / n), 0.1, 4)
            for n, e in zip((16, 64, 256, 1024), noise, strict=True)
        ]  # fmt: skip
        needed = AccuracyReport(points, "").spp_for(0.005)
        held += needed.low < 1 / 0.005**2 < needed.high
    assert held / 400 > 0.92


def test_gradients_against_a_reference():
    report = tt.cost_of_accuracy(
        wall_renderer(), spp=(16, 64), gradients=[ALBEDO], reference_spp=4096, repeats=12, samplers=("independent",),
        progress=False,
    )  # fmt: skip
    coarse, fine = (p for p in report.points if p.quantity == f"d loss / d {ALBEDO}")
    error = np.hypot(
        coarse.squared_error_standard_error / coarse.squared_error,
        fine.squared_error_standard_error / fine.squared_error,
    )
    assert abs(coarse.squared_error / fine.squared_error / 4 - 1) < 4 * error
    assert "reference of 4096" in report.method


def test_the_renderer_and_the_variant_are_left_as_they_were():
    renderer = wall_renderer(spp=4)
    before = renderer(seed=3).transient.clone()
    mi.set_variant("llvm_ad_rgb")
    tt.cost_of_accuracy(renderer, spp=(4,), repeats=2, samplers=("independent",), progress=False)
    assert mi.variant() == "llvm_ad_rgb"
    mi.set_variant("llvm_ad_mono")
    assert torch.allclose(renderer(seed=3).transient, before, rtol=1e-5, atol=1e-7)
    assert all(parameter.grad is None for parameter in renderer.parameters())
    with pytest.raises(SceneError, match=r"light\.position"):
        tt.cost_of_accuracy(renderer, gradients=[LIGHT], progress=False)
    with pytest.raises(ArgumentError, match="at least one"):
        tt.cost_of_accuracy(renderer, samplers=(), progress=False)


@pytest.mark.slow
def test_phasors_have_a_cost_too():
    scene = tt.load(tt.scenes.moving_wall(resolution=2, num_bins=64, bin_width_opl=0.05), variant=VARIANT)
    renderer = tt.TransientRenderer(scene, parameters=[WALL], frequencies=[0.0, 0.4])
    report = tt.cost_of_accuracy(
        renderer, spp=(16, 64, 256), gradients=[WALL], repeats=8, samplers=("independent",), progress=False
    )
    assert report.quantities() == ["phasor", f"d loss / d {WALL}"]
    slope = report.slope("phasor", Choice("independent", ""))
    assert abs(slope.slope + 1) < max(4 * slope.standard_error, 0.1)
    assert report.settings["time_axis"] is None
    with pytest.raises(ArgumentError, match="the film has none"):
        tt.cost_of_accuracy(renderer, temporal_filters=("tent",), progress=False)


def energy(out):
    return out.transient.sum()


@pytest.fixture(scope="module")
def settings_report():
    """Depths and bin widths of a Cornell box, with the light of all pixels as a quantity. The lamp, which a single
    pixel sees, would have most of the noise."""
    scene = tt.scenes.cornell_box(4, num_bins=20, bin_width_opl=0.3, max_depth=8)
    scene["integrator"]["hide_emitters"] = True
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), physics="ignore")
    report = tt.cost_of_accuracy(
        renderer, spp=(64, 256), quantities={"energy": energy}, samplers=("owen",), temporal_filters=("box", "tent"),
        max_depths=(2, 8), bin_widths=(0.3, 0.6), repeats=8, progress=False,
    )  # fmt: skip
    return renderer, report


def point_of(report, quantity, spp=256, **choice):
    wanted = Choice("owen", **({"temporal_filter": "box", "max_depth": 8, "bin_width_opl": 0.3} | choice))
    return next(p for p in report.points if (p.quantity, p.choice, p.spp) == (quantity, wanted, spp))


def is_the_bias(point, expected, error):
    """The total error is the root of noise and bias, whose squares are known up to the standard errors."""
    found = point.total_error**2
    spread = point.total_squared_error_standard_error / point.total_squared_error * found
    return abs(found - point.relative_error**2 - expected**2) < 4 * (spread + 2 * expected * error)


def test_bias_of_a_depth_is_the_light_it_leaves_out(settings_report):
    renderer, report = settings_report
    deep, shallow = (
        torch.stack([energy(renderer.variation(max_depth=depth)(seed=k, spp=1024)) for k in range(4)])
        for depth in (8, 2)
    )
    missing = 1 - shallow / deep
    expected, error = float(missing.mean()), float(missing.std()) / 2
    assert expected > 0.05 > 10 * error
    assert is_the_bias(point_of(report, "energy", max_depth=2), expected, error)
    assert is_the_bias(point_of(report, "energy", max_depth=2, bin_width_opl=0.6), expected, error)
    deepest = point_of(report, "energy")
    assert deepest.bias == 0 and is_the_bias(deepest, 0.0, error)


def test_bias_of_wide_bins_and_filters_is_what_they_blur(settings_report):
    """Wide bins by sums over pairs of narrow ones, which are spread over both; a tent by its own long render."""
    renderer, report = settings_report
    long = [renderer.variation(temporal_filter=name)(seed=0, spp=16384).transient for name in ("box", "tent")]
    narrow, tent = (x.double() for x in long)
    wide = narrow.unflatten(1, (10, 2)).mean(2).repeat_interleave(2, 1)
    for blurred, choice in ((wide, {"bin_width_opl": 0.6}), (tent, {"temporal_filter": "tent"})):
        expected = float((blurred - narrow).norm() / narrow.norm())
        found = point_of(report, "transient", **choice)
        assert expected > 0.05 and is_the_bias(found, expected, 0.0)
        assert found.bias == pytest.approx(expected, rel=0.1)
    assert report.settings["finest"] == {"values": "owen, box, depth 8, bins of 0.3 m"}
    assert report.settings["time_axis"][1:] == pytest.approx([0.3, 20])


def test_a_setting_is_recommended_for_a_depth_that_suffices(settings_report):
    _, report = settings_report
    found = report.recommend(0.02, quantity="energy")
    assert found.choice.max_depth == 8 and found.low < found.error <= 0.02 < 0.2
    with pytest.raises(ArgumentError, match="recommend"):
        report.recommend(1e-9, quantity="energy")


def test_quantities_that_cannot_be_compared():
    given, settings = {"bins": lambda out: out.transient.sum((0, -2, -1))}, {"bin_widths": (0.05, 0.1), "repeats": 2}
    with pytest.raises(ShapeError, match=r"'bins': .* got \(64,\) .* and \(32,\)"):
        tt.cost_of_accuracy(
            wall_renderer(), spp=(4,), samplers=("independent",), quantities=given, progress=False, **settings
        )
    with pytest.raises(ArgumentError, match="'transient' is measured in any case"):
        tt.cost_of_accuracy(wall_renderer(), quantities={"transient": lambda out: out.steady}, progress=False)


def test_complex_quantities_and_samplers_alone():
    """A unit phasor: its relative error is that of the phase in radians."""

    def phase(out):
        wave = torch.exp(-2j * torch.pi * 0.3 * out.axis.centers_opl.float())[:, None, None]
        found = (out.transient * wave).sum(-3)
        return found / found.abs()

    renderer = wall_renderer().variation(sampler="independent")
    report = tt.cost_of_accuracy(
        renderer, spp=(64,), quantities={"phase": phase}, samplers=("independent",), repeats=40, progress=False
    )
    runs = torch.stack([phase(renderer(seed=5000 + k, spp=64).detach()).angle() for k in range(80)])
    expected = float(runs.var(0).mean().sqrt())
    (found,) = (p for p in report.points if p.quantity == "phase")
    assert found.relative_error == pytest.approx(expected, rel=0.25)
    assert found.total_error == pytest.approx(expected, rel=0.25)
    assert str(report) == report.table()
    alone = tt.cost_of_accuracy(
        renderer.variation(sampler="stratified"), spp=(10,), repeats=2, samplers=("stratified",), progress=False
    )
    assert alone.points[0].spp == 16  # the next square
    assert all(np.isnan(p.total_error) for p in alone.points) and alone.settings["finest"] == {}


@pytest.mark.slow
def test_gradients_are_compared_with_the_finest_that_has_some():
    report = tt.cost_of_accuracy(
        wall_renderer(), spp=(16,), gradients=[WALL], samplers=("independent",), temporal_filters=("box", "tent"),
        progress=False,
    )  # fmt: skip
    assert report.settings["finest"] == {"values": "independent, box", "gradients": "independent, tent"}
    values = tt.TransientRenderer(wall_renderer().scene)
    report = tt.cost_of_accuracy(
        values, spp=(4,), repeats=2, samplers=("independent", "owen"), max_depths=(1, 2, -1), progress=False
    )
    assert report.settings["finest"] == {"values": "owen, box, any depth"}
