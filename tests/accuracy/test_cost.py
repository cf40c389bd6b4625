"""`tt.cost_of_accuracy` on the real renderer, with tiny scenes."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.accuracy.cost import cosine_over_the_window
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.scenes import transforms

VARIANT = "llvm_ad_mono"
ALBEDO, WALL, LIGHT = "wall.bsdf.reflectance.value", "wall.to_world", "light.position"


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_mono")


def wall_renderer(**settings):
    scene = tt.load(tt.scenes.moving_wall(resolution=2, num_bins=64, bin_width_opl=0.05), variant=VARIANT)
    return tt.TransientRenderer(scene, parameters=[ALBEDO, WALL], **settings)


def cost(**settings):
    return tt.cost_of_accuracy(
        wall_renderer(),
        spp=(16, 64, 256, 1024),
        repeats=8,
        samplers=("independent", "multijitter"),
        temporal_filters=("box", "tent"),
        progress=False,
        **settings,
    )


@pytest.fixture(scope="module")
def report():
    return cost()


@pytest.mark.slow
def test_every_curve_is_there():
    report = tt.cost_of_accuracy(
        wall_renderer(),
        spp=(16, 64),
        gradients=[ALBEDO, WALL],
        repeats=2,
        samplers=("independent", "multijitter"),
        temporal_filters=("box", "tent"),
        progress=False,
    )
    curves = {(quantity, str(choice)) for quantity, choice, _ in report.curves()}
    names = [f"{sampler}, {name}" for sampler in ("independent", "multijitter") for name in ("box", "tent")]
    assert {name for quantity, name in curves if quantity == "transient"} == set(names)
    for key in (ALBEDO, WALL):
        assert {name for quantity, name in curves if quantity == f"d loss / d {key}"} == {names[1], names[3]}
    assert report.settings["without_gradients"] == [names[0], names[2]]
    assert all([p.spp for p in curve] == [16, 64] for _, _, curve in report.curves())
    assert all(p.seconds > 0 for p in report.points)


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
    for call, error in (
        (lambda: report.spp_for(0), UnitError), (lambda: report.spp_for(0.1, quantity="phasor"), ArgumentError),
        (lambda: report.spp_for(0.1, choice=Choice("owen", "box")), ArgumentError),
        (lambda: few.spp_for(0.1), ArgumentError), (lambda: flat.spp_for(0.1), ArgumentError),
    ):  # fmt: skip
        with pytest.raises(error, match="spp_for"):
            call()


@pytest.mark.slow
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


def test_stratified_samples_do_better(report):
    independent, stratified = (
        next(
            curve
            for quantity, choice, curve in report.curves()
            if quantity == "transient" and choice == Choice(s, "tent")
        )
        for s in ("independent", "multijitter")
    )
    assert stratified[-1].squared_error < 0.5 * independent[-1].squared_error


@pytest.mark.slow
def test_the_error_is_the_variance_of_the_renderer():
    renderer = wall_renderer(temporal_filter="tent").variation(sampler="independent")
    runs = (
        torch.stack([renderer(seed=1000 + k, spp=16).transient.detach() for k in range(80)]).numpy().astype(np.float64)
    )
    expected = runs.var(axis=0, ddof=1).mean()
    report = tt.cost_of_accuracy(renderer, spp=(16,), repeats=80, samplers=("independent",), progress=False)
    (point,) = report.points
    assert (
        abs(point.squared_error / expected - 1)
        < 5 * np.sqrt(2) * point.squared_error_standard_error / point.squared_error
    )


def test_gradients_against_a_reference():
    report = tt.cost_of_accuracy(
        wall_renderer(),
        spp=(16, 64),
        gradients=[ALBEDO],
        reference_spp=4096,
        repeats=12,
        samplers=("independent",),
        progress=False,
    )
    coarse, fine = (p for p in report.points if p.quantity == f"d loss / d {ALBEDO}")
    error = np.hypot(
        coarse.squared_error_standard_error / coarse.squared_error,
        fine.squared_error_standard_error / fine.squared_error,
    )
    assert abs(coarse.squared_error / fine.squared_error / 4 - 1) < 4 * error
    assert "reference of 4096" in report.method


def test_gradients_of_a_heavy_tailed_loss_have_no_error():
    def loss(out):
        return cosine_over_the_window(out) * float(np.random.default_rng(out.stats.seeds[0]).standard_cauchy())

    report = tt.cost_of_accuracy(
        wall_renderer(), spp=(4,), gradients=[ALBEDO], samplers=("independent",), loss=loss, progress=False
    )
    transient, gradient = report.points
    assert transient.relative_error > 0 and transient.tail is None
    assert np.isnan(gradient.relative_error) and gradient.tail.heavy
    assert f"d loss / d {ALBEDO} [independent, tent]  heavy tailed: no error" in report.table()


@pytest.mark.slow
def test_gradients_of_a_body_with_hollows_have_an_error():
    """A bumpy sphere before a wall, whose parts hide and light each other: the root of the mean square of its pose's
    gradient is at most twice the median of 200 runs (1.6 of 300).
    """
    n, m = 24, 16
    turns = np.linspace(0, 2 * np.pi, n, endpoint=False)
    places = [(t, p) for t in np.linspace(0, np.pi, m + 1)[1:-1] for p in turns]
    radii = [0.5 * (1 + 0.25 * np.sin(3 * p) * np.sin(t) ** 2) for t, p in places]
    vertices = [
        [r * np.sin(t) * np.cos(p), r * np.cos(t), r * np.sin(t) * np.sin(p)]
        for r, (t, p) in zip(radii, places, strict=True)
    ]
    at, top, bottom = (lambda i, j: i * n + j % n), (m - 1) * n, (m - 1) * n + 1
    faces = [[top, at(0, j + 1), at(0, j)] for j in range(n)]
    faces += [[bottom, at(m - 2, j), at(m - 2, j + 1)] for j in range(n)]
    for i in range(m - 2):
        for j in range(n):
            faces += [[at(i, j), at(i, j + 1), at(i + 1, j)], [at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]]
    film = {"type": "transient_hdr_film", "width": 8, "height": 8, "rfilter": {"type": "box"},
            "temporal_bins": 128, "start_opl": 5.0, "bin_width_opl": 0.06}  # fmt: skip
    far = transforms.translate([0, 0, -0.8]) @ transforms.scale([5, 5, 1])
    scene = {
        "type": "scene", "integrator": {"type": "transient_path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 40, "near_clip": 1e-3, "film": film,
                   "to_world": transforms.look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])},
        "light": {"type": "point", "position": [0.7, 0.4, 3.8], "intensity": 10.0},
        "wall": {"type": "rectangle", "to_world": far, "bsdf": {"type": "diffuse", "reflectance": 0.7}},
        "body": {"type": "mesh_arrays", "vertices": np.array([*vertices, [0, 0.5, 0], [0, -0.5, 0]], np.float32),
                 "faces": np.array(faces), "face_normals": True,
                 "bsdf": {"type": "twosided", "b": {"type": "diffuse", "reflectance": 0.6}}},
    }  # fmt: skip
    pose, albedo = "body.to_world", "wall.bsdf.reflectance.value"
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), [pose, albedo])
    report = tt.cost_of_accuracy(renderer, spp=(16, 64), gradients=[albedo], samplers=("independent",), progress=False)
    assert not any(point.tail.heavy for point in report.points if point.tail is not None)
    gradients = []
    for seed in range(200):
        value = renderer.values[pose].detach().requires_grad_()
        loss = cosine_over_the_window(renderer({pose: value}, seed=seed, spp=16))
        gradients.append(torch.autograd.grad(loss, value)[0])
    found = torch.stack(gradients).flatten(1)
    off = (found - found.median(0).values).norm(dim=1)
    assert off.square().mean().sqrt() < 2 * off.median()


def test_sample_counts_are_those_that_were_drawn():
    renderer = wall_renderer()
    assert renderer.variation(sampler="independent").samples_drawn(10) == 10
    assert renderer.variation(sampler="multijitter").samples_drawn(10) >= 10
    drawn = renderer.variation(sampler="stratified").samples_drawn(10)
    assert drawn == 16  # the next square
    report = tt.cost_of_accuracy(renderer, spp=(10,), repeats=2, samplers=("stratified",), progress=False)
    assert report.points[0].spp == 16


@pytest.mark.slow
def test_the_renderer_is_left_as_it_was():
    renderer = wall_renderer(spp=4)
    before = renderer(seed=3).transient.clone()
    tt.cost_of_accuracy(renderer, spp=(4,), gradients=[ALBEDO], repeats=2, samplers=("multijitter",), progress=False)
    assert torch.allclose(renderer(seed=3).transient, before, rtol=1e-5, atol=1e-7)
    assert all(parameter.grad is None for parameter in renderer.parameters())


def test_the_users_variant_stays_active():
    renderer = wall_renderer()
    mi.set_variant("llvm_ad_rgb")
    tt.cost_of_accuracy(renderer, spp=(4,), repeats=2, samplers=("independent",), progress=False)
    assert mi.variant() == "llvm_ad_rgb"
    mi.set_variant("llvm_ad_mono")


def test_errors():
    renderer = wall_renderer()
    with pytest.raises(SceneError, match=r"light\.position"):
        tt.cost_of_accuracy(renderer, gradients=[LIGHT], progress=False)
    with pytest.raises(ArgumentError, match="at least one"):
        tt.cost_of_accuracy(renderer, samplers=(), progress=False)
    with pytest.raises(SceneError):
        tt.cost_of_accuracy(renderer, spp=(4,), repeats=2, samplers=("no_such_sampler",), progress=False)
    with pytest.raises(ArgumentError, match="temporal_filter"):
        tt.cost_of_accuracy(renderer, spp=(4,), repeats=2, temporal_filters=("round",), progress=False)


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
    assert "phasor [independent]" in report.table() and report.settings["time_axis"] is None
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


@pytest.mark.slow
def test_fresh_renders_have_the_recommended_error():
    """Of six recommendations with intervals of 95 %, one fails in a quarter of all cases, two in 3 %."""
    scene = tt.scenes.cornell_box(16, num_bins=60, bin_width_opl=0.1, max_depth=8)
    scene["integrator"]["hide_emitters"] = True
    renderer = tt.TransientRenderer(tt.load(scene, variant=VARIANT), physics="ignore")
    functions = {"transient": lambda out: out.transient, "late": lambda out: out.transient[:, 35:].sum(1)}
    report = tt.cost_of_accuracy(
        renderer, spp=(16, 64, 256), quantities={"late": functions["late"]}, max_depths=(3, 8), repeats=8,
        reference_spp=4096, progress=False,
    )  # fmt: skip
    long = renderer.variation(sampler="owen", temporal_filter="box")(seed=0, spp=16384)
    held = []
    for quantity, share in [(name, share) for name in functions for share in (1.05, 1.5, 2.5)]:
        least = min(p.error for p in report.points if p.quantity == quantity)
        found = report.recommend(share * least, quantity=quantity)
        choice, truth = found.choice, functions[quantity](long).double()
        twin = renderer.variation(
            sampler=choice.sampler, temporal_filter=choice.temporal_filter, max_depth=choice.max_depth
        )
        runs = [functions[quantity](twin(seed=9000 + k, spp=found.spp)).double() for k in range(16)]
        error = float(torch.stack([(run - truth).square().mean() for run in runs]).mean().sqrt())
        held.append(found.low < error / float(truth.square().mean().sqrt()) < found.high)
        assert found.error <= share * least
    assert sum(held) >= 5


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
    alone = tt.cost_of_accuracy(renderer, spp=(4,), repeats=2, progress=False)
    assert all(np.isnan(p.total_error) for p in alone.points) and alone.settings["finest"] == {}


@pytest.mark.slow
def test_polarization_and_phasors():
    """The degree of polarization of polished walls, and a phasor's phase, are known the better the more samples."""
    scene = tt.scenes.cornell_box(4, num_bins=20, bin_width_opl=0.3)
    scene["white"] = {"type": "pplastic", "diffuse_reflectance": 0.5, "alpha": 0.3}
    scene["integrator"]["hide_emitters"] = True
    polarized = tt.TransientRenderer(tt.load(scene, "llvm_ad_mono_polarized"), physics="ignore")
    phasors = tt.TransientRenderer(tt.load(scene, VARIANT), frequencies=[0.0, 0.3], physics="ignore")
    for renderer, measures, function in (
        (polarized, "transient", lambda out: tt.stokes.degree_of_polarization(out.steady, dim=0)),
        (phasors, "phasor", lambda out: out.phasor / out.phasor.abs().clamp(min=1e-20)),
    ):
        report = tt.cost_of_accuracy(
            renderer, spp=(64, 4096), quantities={"made": function}, samplers=("independent",), max_depths=(3, 6),
            progress=False,
        )  # fmt: skip
        assert report.quantities() == [measures, "made"]
        deep = [p for p in report.points if p.quantity == "made" and p.choice.max_depth == 6]
        assert 0 < deep[1].total_error < 0.5 * deep[0].total_error


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


@pytest.mark.parametrize(
    "given, error, message",
    [
        ({"transient": lambda out: out.steady}, ArgumentError, "'transient' is measured in any case"),
        ([("energy", energy)], ArgumentError, "expected a dictionary {name: function of a RenderOutput}"),
        ({"empty": lambda out: out.transient[:, :0]}, ShapeError, "'empty': expected one number at least"),
        (
            {"bins": lambda out: out.transient.sum((0, -2, -1))},
            ShapeError,
            r"'bins': .* got \(64,\) with \d+ spp \[owen, tent, bins of 0.05 m\] and \(32,\) .*bins of 0.1 m",
        ),
    ],
)
def test_quantities_that_cannot_be_compared(given, error, message):
    settings = {"gradients": [ALBEDO], "bin_widths": (0.05, 0.1), "samplers": ("owen",), "repeats": 2}
    with pytest.raises(error, match=f"^quantities.*{message}"):
        tt.cost_of_accuracy(wall_renderer(), spp=(4,), quantities=given, progress=False, **settings)
