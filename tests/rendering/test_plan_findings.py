"""What a plan makes of a pilot run: depth, window and filter, and the sentences that give their numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

import torchtransient as tt
from support.pilot_arrivals import arrivals
from torchtransient.errors import ArgumentError, GradientError, SceneError
from torchtransient.rendering.films import Gates, Histogram, Phasors
from torchtransient.rendering.inventory import SceneInventory
from torchtransient.rendering.parameters import ParameterInfo
from torchtransient.rendering.plan_choices import depth_by_albedo, some
from torchtransient.rendering.plan_finder import Draft, Finder
from torchtransient.rendering.plan_pilot import PilotReport
from torchtransient.rendering.planned_film import PlannedFilm

VARIANT = "llvm_ad_mono"
RECTANGULAR, SMOOTH = tt.Gate.rectangular(1.0, 2.0), tt.Gate.gaussian(5.0, 0.5)
# What can change a path length, and what cannot.
TABLE = {
    key: ParameterInfo(key, "number", (), 1.0, True, moves, "correct")
    for key, moves in (("wall.to_world", True), ("colour", False))
}


def finder(found=None, film=None, tail=0.25, missed=0.25, inventory=None, **draft):
    """As after a pilot run that found ``found``, or without one."""
    settings = {"integrator": "transient_path", "film_choice": None, "pulse": None, "irf": None, "parameters": ()}
    scene = SimpleNamespace(parameters=lambda: TABLE)
    film = film or PlannedFilm(Histogram, "transient", "")
    result = Finder(
        Draft(scene=scene, variant="llvm_ad_rgb_polarized", film=film, sensor=0, **settings | draft),
        ("first",),
        SceneInventory(**inventory or {}),
        tail,
        missed,
        seed=0,
    )
    result.arrivals = found
    if found is not None:
        result.report = PilotReport("llvm_ad_rgb", found.paths, len(found.opl), 1.0, 0.125, 0.0, 0.0, 1.0, 2.0)
    return result


def by_depth():
    """A thousand paths, each with 5 of depth 1, and 2, 1 and 0.5 in ten of them of depth 3, 7 and 9."""
    depth = np.repeat([1, 3, 7, 9], [1000, 10, 10, 10])
    energy = np.repeat([5.0, 2.0, 1.0, 0.5], [1000, 10, 10, 10])
    path = np.concatenate([np.arange(1000), *[np.arange(10)] * 3])
    return arrivals(opl=1.5 * depth, energy=energy, depth=depth, path=path)


def dark():
    return arrivals([1.0, 2.0], [0.0, 0.0])


def shown(found, chosen):
    part, error = found.share(chosen)
    return f"{part:.2g} +- {error:.1g} of the light"


# ------------------------------------------------------------------------------------------------------------- depth


def test_depth_that_suffices():
    """The smallest one with what is left: 15 of 5035 beyond depth 3, of which the plan says the error, too."""
    found = by_depth()
    plan = finder(found, tail=0.006)
    assert plan._depth(None) == 3
    left = shown(found, found.depth > 3)
    assert left == "0.003 +- 0.0009 of the light"
    assert plan.reasons == ["first", f"max_depth: 3; {left} in deeper paths, asked for was 0.006"]
    assert (plan.report.tail, plan.report.tail_error) == found.share(found.depth > 3)


@pytest.mark.parametrize(("own", "said"), [(1, "; at the scene's own 1 it would be 0.007"), (3, ""), (-1, ""), (4, "")])
def test_depth_that_the_scene_has(own, said):
    plan = finder(by_depth(), tail=0.006, inventory={"max_depth": own})
    plan._depth(None)
    assert plan.reasons[-1].endswith(f"asked for was 0.006{said}")


@pytest.mark.parametrize(("deepest", "bounded"), [(511, True), (512, False)])
def test_depth_that_the_pilot_run_does_not_go_beyond(deepest, bounded):
    plan = finder(arrivals([1.0, 2.0], [1.0, 1.0], depth=[1, deepest]), tail=0.0)
    assert plan._depth(None) == deepest
    assert ("went no deeper than 512, so light beyond it is not bounded" in plan.reasons[-1]) != bounded


@pytest.mark.parametrize(("own", "known"), [(11, "11"), (-1, "no limit")])
def test_depth_that_is_kept(own, known):
    """As the scene has it."""
    plan = finder(dark(), inventory={"max_depth": own})
    assert plan._depth(None) is None
    assert plan.reasons[-1] == f"max_depth: {known}, kept, since the pilot run saw no light"
    around = {"integrator": "transient_nlos_path", "max_depth": own}
    plan = finder(None, inventory=around, integrator="transient_nlos_path")
    assert plan._depth(None) is None
    assert plan.reasons[-1].startswith(f"max_depth: {known}, kept; what albedos leave")
    # A pilot run knows more; and of other integrators albedos say enough.
    plan = finder(by_depth(), tail=0.006, inventory=around, integrator="transient_nlos_path")
    assert plan._depth(None) == 3
    assert finder(None, inventory={"integrator": "transient_path", "albedo": 0.0})._depth(None) == 2
    # An integrator for corners that the plan has put in the place of another one knows no corner.
    plan = finder(None, inventory=around | {"integrator": "path", "albedo": 0.0}, integrator="transient_nlos_path")
    assert plan._depth(None) == 2


def test_depth_that_is_asked_for():
    found = by_depth()
    for asked, own, beyond in ((7, 3, 7), ("scene", 3, 3), (0, -1, 0)):
        plan = finder(found, inventory={"max_depth": own})
        assert plan._depth(asked) == beyond
        left = shown(found, found.depth > beyond)
        assert plan.reasons[-1] == f"max_depth: {beyond}, as asked for; {left} in deeper paths"
        assert plan.report.tail == found.share(found.depth > beyond)[0]
    plan = finder(found)
    assert plan._depth(9) == 9
    assert plan.reasons[-1] == "max_depth: 9, as asked for; no light of the pilot run in deeper paths"
    assert plan._depth(-1) == -1
    assert plan.reasons[-1] == "max_depth: no limit, as asked for"
    for without in (finder(None), finder(dark())):
        without._depth(4)
        assert without.reasons[-1] == "max_depth: 4, as asked for"
    with pytest.raises(ArgumentError, match="expected a number, 'scene' or None, got 'deep'"):
        plan._depth("deep")


def test_depth_by_albedo():
    """A third is left three times: 1/27 is at most 0.05, 1/9 is not. What is black needs one bounce."""
    assert depth_by_albedo(SceneInventory(albedo=1 / 3, brightest="wall"), 0.05) == (
        4,
        "max_depth: 4; no albedo exceeds 0.3333 (wall), so that after 3 bounces at most 0.037 of the emitted power is "
        "left",
    )
    assert depth_by_albedo(SceneInventory(albedo=0.0), 0.05)[0] == 2
    assert depth_by_albedo(SceneInventory(albedo=0.01), 0.05)[0] == 2
    assert depth_by_albedo(SceneInventory(albedo=0.5), 0.125)[0] == 4
    for own, kept in ((-1, "no limit"), (3, "3")):
        depth, reason = depth_by_albedo(SceneInventory(albedo=1.0, brightest="lamp", max_depth=own), 0.05)
        assert depth is None and reason.startswith(f"max_depth: {kept}, kept; not bounded, since lamp may reflect")
    assert finder(None, tail=0.05, inventory={"albedo": 1 / 3})._depth(None) == 4


def test_a_few_of_many_findings():
    assert some(["a", "b", "c"]) == "a; b; c"
    assert some(["a", "b", "c", "d", "e"]) == "a; b; c; and 2 more"
    assert some(["a", "b"], most=1) == "a; and 1 more"


# ------------------------------------------------------------------------------------------------------------ window


def by_time():
    """A hundred paths whose light comes at 2 m and 3 m, and one that meets 1 of 101 at 8 m; a deep one at 20 m."""
    opl = [*[2.0] * 100, *[3.0] * 100, 8.0, 20.0]
    return arrivals(opl, [0.25] * 100 + [0.75] * 100 + [1.0, 2.0], [1] * 200 + [2, 5], [*range(100)] * 2 + [7, 8])


def test_window_of_what_was_found():
    """Bins of the scene's film, and what arrives beyond them as it is said."""
    found = by_time()
    plan = finder(found, missed=0.1, inventory={"film_axis": tt.TimeAxis(0.0, 0.5, 7)})
    assert plan._axis(None, (None, None), 2) == tt.TimeAxis(2.0, 0.5, 3)
    part, error = found.share(found.opl == 8.0)
    assert part == pytest.approx(1 / 103)
    assert plan.reasons[-1] == (
        f"time axis: {tt.TimeAxis(2.0, 0.5, 3)}, bin width of the scene's film; {part:.2g} +- {error:.1g} of the light "
        "outside, asked for was 0.1; the pilot run's last arrival came at 20 m"
    )
    assert (plan.report.missed, plan.report.missed_error) == (part, error)
    # Without a bound of the depth, the deep light is missed, too.
    for depth in (None, -1, 0):
        plan._axis(None, (None, None), depth)
        assert plan.report.missed == pytest.approx(3 / 103)


@pytest.mark.parametrize(
    ("bins", "axis", "how"),
    [
        ((5, None), (2.0, 0.25, 5), ";"),
        ((None, 0.4), (2.0, 0.4, 3), ";"),
        ((4, 0.4), (2.0, 0.4, 4), ";"),
        ((1, 1.0), (2.0, 1.0, 1), ";"),
        ((None, None), (2.0, 1.0, 2), ", bin width of the scene's film;"),
    ],
)
def test_bins_that_are_asked_for(bins, axis, how):
    plan = finder(by_time(), missed=0.04, inventory={"film_axis": tt.TimeAxis(0.0, 1.0, 7)})
    found = plan._axis(None, bins, 2)
    assert (found.start_opl, found.bin_width_opl, found.num_bins) == pytest.approx(axis)
    assert f"{found}{how}" in plan.reasons[-1]
    # What comes at the end of the only bin is behind it.
    assert plan.report.missed == pytest.approx((76 if bins[0] == 1 else 1) / 103)


def test_light_before_the_window_is_missed_too():
    plan = finder(by_time(), missed=0.0)
    plan.spread = (0.5, 0.0)
    assert plan._axis(None, (1, 0.8), 2) == tt.TimeAxis(2.4, 0.8, 1)
    assert plan.report.missed == pytest.approx(26 / 103)


def test_300_bins_where_nobody_has_said_a_width():
    found = finder(by_time(), missed=0.04)._axis(None, (None, None), 2)
    assert (found.bin_width_opl, found.start_opl, found.num_bins) == pytest.approx((0.00335, 1.99995, 299))


@pytest.mark.parametrize(("width", "bins"), [(1 / 4096, 4097), (1 / 8192, 4096)])
def test_at_most_4096_bins_without_being_asked(width, bins):
    """From 2 m to 3 m: as many widths, or one more than that to have the end inside."""
    plan = finder(by_time(), missed=0.04, inventory={"film_axis": tt.TimeAxis(0.0, width, 7)})
    assert plan._axis(None, (None, None), 2).num_bins == bins
    assert (", 4096 bins since the film's width would take more;" in plan.reasons[-1]) == (bins == 4096)


def test_pulses_widen_the_window_at_both_ends():
    plan = finder(by_time(), missed=0.04)
    plan.spread = (-0.75, 1.25)
    assert plan._axis(None, (None, 0.5), 2) == tt.TimeAxis(1.0, 0.5, 7)
    assert ", widened by pulse and response from -0.75 to +1.25 m;" in plan.reasons[-1]
    for one in ((-0.75, 0.0), (0.0, 1.25)):
        plan.spread = one
        plan._axis(None, (None, 0.5), 2)
        assert "widened by pulse" in plan.reasons[-1]


def test_axes_that_are_given():
    axis = tt.TimeAxis(1.0, 0.25, 9)
    plan = finder(by_time(), inventory={"film_axis": tt.TimeAxis(2.0, 0.5, 3)})
    assert plan._axis(axis, (None, None), 2) == axis
    assert plan.reasons[-1] == f"time axis: {axis}, as asked for"
    with pytest.raises(ArgumentError, match=r"expected a tt\.TimeAxis, 'scene' or None, got 'all'"):
        plan._axis("all", (None, None), 2)


def test_axes_of_the_scene():
    own = tt.TimeAxis(2.0, 0.5, 3)
    for found, given, why in (
        (by_time(), "scene", "as asked for"),
        (dark(), "scene", "as asked for"),
        (None, None, "without a pilot run"),
        (dark(), None, "since the pilot run saw no light"),
    ):
        plan = finder(found, inventory={"film_axis": own})
        assert plan._axis(given, (None, None), 2) == own
        assert plan.reasons[-1] == f"time axis: {own}, the scene's own, {why}"
        for bins in ((7, None), (None, 0.5)):
            with pytest.raises(ArgumentError, match=f"no effect on the scene's own axis, taken {why}"):
                plan._axis(given, bins, 2)
        with pytest.raises(SceneError, match=f"no time axis, which would be taken {why}"):
            finder(found)._axis(given, (None, None), 2)


def test_one_bin_for_all_times():
    """Four times the last arrival, since what comes later still has to be inside."""
    film = PlannedFilm(Histogram, "steady", "", all_times=True)
    assert finder(by_time(), film)._axis(None, (None, None), 2) == tt.TimeAxis(0.0, 80.0, 1)
    for found in (None, dark()):
        assert finder(found, film)._axis(None, (None, None), 2) == tt.TimeAxis(0.0, 1e9, 1)


def test_films_without_a_time_axis():
    plan = finder(by_time(), PlannedFilm(Phasors, "phasor", ""))
    assert plan._axis(None, (None, None), 2) is None
    for given, bins in ((tt.TimeAxis(0, 1, 1), (None, None)), (None, (3, None)), (None, (None, 0.5))):
        with pytest.raises(ArgumentError, match="a phasor film has no time axis; leave time_axis and bins out"):
            plan._axis(given, bins, 2)


# ------------------------------------------------------------------------------------------------------------ filter


@pytest.mark.parametrize(
    ("settings", "own", "chosen", "reason"),
    [
        ({}, None, "box", "box, since no parameter changes a path length"),
        ({"parameters": ("colour",)}, "gaussian", "gaussian", "gaussian, the scene's own"),
        (
            {"parameters": ("colour", "wall.to_world")},
            None,
            "tent",
            "tent, since wall.to_world changes path lengths and",
        ),
        ({"parameters": ("wall.to_world",)}, "gaussian", "gaussian", "gaussian, the scene's own"),
        ({"parameters": ("wall.to_world",), "irf": tt.Pulse.gaussian(0.2)}, "box", "box", "box, the scene's own"),
        ({"parameters": ("wall.to_world",), "pulse": tt.Pulse.gaussian(0.2)}, "box", "box", "box, the scene's own"),
    ],
)
def test_filters(settings, own, chosen, reason):
    plan = finder(inventory={"temporal_filter": own}, **settings)
    assert plan._filter(None) == chosen
    assert plan.reasons[-1].startswith(f"temporal filter: {reason}")


def test_filters_that_are_asked_for():
    plan = finder(parameters=("wall.to_world",))
    assert plan._filter("gaussian") == "gaussian"
    assert plan.reasons[-1] == "temporal filter: gaussian, as asked for"
    with pytest.raises(GradientError, match=r"'wall\.to_world' can change path lengths, and the film's 'box'"):
        plan._filter("box")
    assert finder(parameters=("wall.to_world",), inventory={"pulsed": True})._filter("box") == "box"
    with pytest.raises(SceneError, match=r"wall\.colour"):
        finder(parameters=("wall.colour",))._filter(None)


def test_nothing_is_said_of_the_filter_of_a_steady_picture():
    plan = finder(film=PlannedFilm(Histogram, "steady", "", all_times=True))
    assert (plan._filter(None), plan.reasons) == ("box", ["first"])


def test_gates_have_a_slope_of_their_own_or_a_pulse():
    film, moving = PlannedFilm(Gates, "gated", ""), ("wall.to_world",)
    sharp, smooth = Gates((SMOOTH, RECTANGULAR)), Gates((SMOOTH,))
    assert finder(film=film, film_choice=smooth, parameters=moving)._filter(None) == ""
    assert finder(film=film, film_choice=sharp, parameters=("colour",))._filter(None) == ""
    assert finder(film=film, parameters=moving)._filter(None) == ""
    assert finder(film=film, film_choice=sharp, pulse=tt.Pulse.gaussian(0.2), parameters=moving)._filter(None) == ""
    for settings in ({"film_choice": sharp}, {"inventory": {"film_settings": sharp}}):
        with pytest.raises(GradientError, match=r"'rectangular gate' has no slope.*Use gates that rise from zero"):
            finder(film=film, parameters=moving, **settings)._filter(None)
    # The gates of the call count, not those of the scene.
    settings = {"film_choice": smooth, "inventory": {"film_settings": sharp}}
    assert finder(film=film, parameters=moving, **settings)._filter(None) == ""
    with pytest.raises(ArgumentError, match="a gated film takes no temporal filter; leave it out"):
        finder(film=film)._filter("box")


# ------------------------------------------------------------------------------------------------------ all together


@pytest.mark.parametrize(("paths", "overlooked"), [(1000, 333), (2, 1), (6, 2)])
def test_what_the_pilot_run_was(paths, overlooked):
    plan = finder(arrivals([1.0, 2.0], [1.0, 1.0], paths=paths))
    assert plan._pilot_line() == (
        f"pilot: {paths} paths in llvm_ad_rgb, 2 arrivals, image mean within 12.5%; light that fewer than one path in "
        f"{overlooked} meets may have been overlooked"
    )
    assert "2 arrivals, no light at all;" in finder(dark())._pilot_line()
    with pytest.raises(SceneError, match="no pilot run was made"):
        finder(None)._pilot_line()


@pytest.mark.parametrize(
    ("film", "arguments", "runs"),
    [
        (PlannedFilm(Histogram, "transient", ""), (None, None), True),
        (PlannedFilm(Histogram, "transient", ""), (5, None), True),
        (PlannedFilm(Histogram, "transient", ""), (None, tt.TimeAxis(0, 1, 3)), True),
        (PlannedFilm(Histogram, "transient", ""), (5, tt.TimeAxis(0, 1, 3)), False),
        (PlannedFilm(Histogram, "steady", "", all_times=True), (5, None), False),
        (PlannedFilm(Phasors, "phasor", ""), (5, None), False),
        (PlannedFilm(Phasors, "phasor", ""), (None, None), True),
    ],
)
def test_a_pilot_run_is_made_where_it_is_asked_something(film, arguments, runs):
    settings = {"film_axis": tt.TimeAxis(2.0, 0.5, 3), "albedo": 0.5}
    for pilot in (True, False):
        plan, made = finder(film=film, inventory=settings), []
        plan._run = lambda made=made: made.append(1)
        found = plan.settle(pilot, *arguments, (None, None), None)
        assert bool(made) == (runs and pilot)
        assert found.max_depth == (arguments[0] or 3)
        assert found.pilot is None and not any(line.startswith("pilot") for line in found.reasons)
        assert (found.film_choice is None) == (film.kind is Phasors)


def test_findings_hold_the_window_and_the_report():
    plan = finder(by_time(), missed=0.04, tail=0.25, inventory={"film_axis": tt.TimeAxis(0.0, 0.5, 7)})
    found = plan.settle(False, None, None, (None, None), None)
    assert found.max_depth == 1 and found.temporal_filter == "box"
    assert found.film_choice == Histogram(tt.TimeAxis(2.0, 0.5, 3))
    assert found.pilot is plan.report and found.reasons == tuple(plan.reasons)
    assert {line.split(":")[0] for line in found.reasons} == {
        "first", "max_depth", "time axis", "temporal filter", "pilot",
    }  # fmt: skip
