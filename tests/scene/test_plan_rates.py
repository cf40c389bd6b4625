"""Plans of films of rates: the bins hold the rates and beats of a moving scene, and a scene at rest says that it is."""

import pytest

import torchtransient as tt
from torchtransient.rendering import films

VARIANT = "llvm_ad_mono"
SPEED = 3.0
CHIRPS = tt.Chirps(1e9, 1e-5, 1550e-9)


def wall(**settings):
    return tt.load(tt.scenes.moving_wall(resolution=4, max_depth=2, **settings), variant=VARIANT)


def coming(speed=SPEED):
    """The wall comes nearer to camera and light, 4 m above it, which lengthens paths by two cosines less per second."""
    return wall().moving({"wall": tt.Motion(linear=(0.0, 0.0, speed))})


def share_inside(film, out):
    return float(film.tensor(out).sum()) / float(out.steady.sum())


def test_rates_are_found():
    plan = tt.plan(coming(), outputs="rates")
    assert isinstance(plan.film_choice, films.Rates) and plan.film == "rates"
    # 0.5 m from the camera the light sees the wall at an angle: cos from 0.98 to 1 on both legs.
    assert plan.rates.start < -2 * SPEED < plan.rates.end and plan.rates.bin_width < 0.05 * SPEED
    assert any(line.startswith("rates: -5.9") for line in plan.reasons)
    out = plan.renderer(spp=64)(seed=0)
    assert out.rate_axis == plan.rates and out.axis == plan.time_axis
    assert share_inside(plan.film_choice, out) == pytest.approx(1, abs=2e-3)
    mean = float((out.rates.sum((0, 2, 3, 4)) * plan.rates.centers).sum() / out.rates.sum())
    assert mean == pytest.approx(-2 * SPEED, rel=0.02)
    assert "nothing moves" not in str(plan)


def test_beats_are_found_where_they_stand():
    """The up chirp sees the wall behind the camera, at a negative length."""
    plan = tt.plan(coming(), outputs=("beats", "steady"), chirps=CHIRPS)
    shift = 2 * SPEED * CHIRPS.rate_scale_s
    assert isinstance(plan.film_choice, films.Beats) and plan.chirps == CHIRPS
    axis = plan.time_axis
    assert axis.start_opl < 8 - shift < 0 and axis.end_opl > 8 + shift and axis.end_opl < 8 + shift + 5
    assert axis.bin_width_opl == CHIRPS.resolution_opl
    out = plan.renderer(spp=64)(seed=0)
    # Each spectrum has all of the light, but for lines of which a thousandth lies outside.
    for spectrum, place in zip(out.beats[0], (8 - shift, 8 + shift), strict=True):
        found = spectrum.sum((1, 2))
        assert float(found.sum()) == pytest.approx(float(out.steady.sum()), rel=5e-3)
        assert float((found * axis.centers_opl).sum() / found.sum()) == pytest.approx(place, abs=0.3)
    wider = tt.plan(coming(), outputs="beats", chirps=CHIRPS, bin_width_opl=1.0)
    assert wider.time_axis.bin_width_opl == 1.0


def test_a_scene_at_rest_says_so():
    for settings in ({"outputs": "rates"}, {"outputs": "beats", "chirps": CHIRPS}):
        plan = tt.plan(wall(), **settings)
        assert any(line.startswith("nothing moves") for line in plan.reasons)
    assert "nothing moves" not in str(tt.plan(wall()))
    plan = tt.plan(wall(), outputs="rates")
    assert plan.rates.num_bins == 1 and plan.rates.start < 0 < plan.rates.end
    # Unlike one whose velocities are zero, which are parameters.
    assert "nothing moves" not in str(tt.plan(coming(0.0), outputs="rates"))


def test_settings_that_are_given_or_described():
    rates, axis = tt.RateAxis(-8.0, 0.5, 24), tt.TimeAxis(6.0, 0.1, 40)
    plan = tt.plan(coming(), outputs="rates", rates=rates, time_axis=axis)
    assert (plan.rates, plan.time_axis) == (rates, axis)
    assert plan.film_choice == films.Rates(rates, axis)
    assert plan.film_choice == tt.plan(coming(), "rates", film=films.Rates(rates, axis)).film_choice
    assert plan.renderer(spp=1).film == films.Rates(rates, axis)
    description = tt.scenes.moving_wall(resolution=4, max_depth=2)
    own = {"rate_start": -8.0, "rate_width": 0.5, "rate_bins": 24, "start_opl": 6.0, "bin_width_opl": 0.1}
    description["sensor"]["film"] |= own | {"type": "rate_hdr_film", "temporal_bins": 40}
    kept = tt.plan(tt.load(description, variant=VARIANT), outputs="rates", time_axis="scene", pilot=False)
    assert kept.film_choice == films.Rates(rates, axis) and "the scene's own" in str(kept)
    film = description["sensor"]["film"]
    for name in own:
        if name.startswith("rate"):
            del film[name]
    chirp = {"chirp_bandwidth": 1e9, "chirp_duration": 1e-5, "chirp_wavelength": 1550e-9}
    film |= chirp | {"type": "beat_hdr_film"}
    kept = tt.plan(tt.load(description, variant=VARIANT), outputs="beats")
    assert kept.chirps == CHIRPS and kept.time_axis.bin_width_opl == CHIRPS.resolution_opl
