"""Films that the options of a command line ask for."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

import torchtransient as tt
from torchtransient.cli.options import film_of_options, write_film_video
from torchtransient.errors import ArgumentError, TorchTransientError
from torchtransient.rendering.films import Beats, Gates, Histogram, Phasors, Rates

AXIS = {"start_opl": 3.5, "bin_width_opl": 0.25, "num_bins": 5}
RATES, CHIRPS = tt.RateAxis(-10.0, 0.5, 40), tt.Chirps(1e9, 1e-5, 1550e-9)
GATES = (tt.Gate.rectangular(3, 4), tt.Gate.gaussian(7.0, 0.5), tt.Gate.tabulated([1, 2, 4], [0, 1, 0]))


@pytest.mark.parametrize(
    "options, expected",
    [
        ({"start_opl": 3.5, "bin_width_opl": 0.25, "num_bins": 5}, Histogram(tt.TimeAxis(3.5, 0.25, 5))),
        ({"frequencies": "0, 0.5,-2", "gates": None}, Phasors(tt.FrequencyAxis((0.0, 0.5, -2.0)))),
        ({"gates": "rectangular 3 4; gaussian 7.0 0.5; tabulated 1:0 2:1 4:0"}, Gates(GATES)),
        ({"rates": "-10:0.5:40"}, Rates(RATES)),
        ({"rates": "-10:0.5:40", **AXIS}, Rates(RATES, tt.TimeAxis(3.5, 0.25, 5))),
        ({"chirps": "1e9:1e-5:1550e-9"}, Beats(CHIRPS)),
        ({"chirps": "1e9:1e-5:1550e-9:hann", **AXIS}, Beats(CHIRPS, tt.TimeAxis(3.5, 0.25, 5))),
        ({"chirps": "1e9:1e-5:1550e-9:nuttall"}, Beats(tt.Chirps(1e9, 1e-5, 1550e-9, window="nuttall"))),
        ({"start_opl": None, "frequencies": None}, None),
    ],
)
def test_command_line(options, expected):
    assert film_of_options(options) == expected


@pytest.mark.parametrize(
    "options, message",
    [
        ({"num_bins": 5}, "give all"),
        ({"start_opl": 0.0, "bin_width_opl": 1.0}, "give all"),
        ({"start_opl": 0.0, "num_bins": 5}, "give all"),
        ({"bin_width_opl": 1.0, "num_bins": 5}, "give all"),
        ({"frequencies": "1, two"}, r"--frequencies: expected numbers with commas, got '1, two'"),
        ({"frequencies": "1", "gates": "rectangular 1 2"}, "--frequencies and --gates ask for different films"),
        ({"gates": "round 1 2"}, "kind out of"),
        ({"rates": "-10:0.5"}, r"--rates: expected START:WIDTH:BINS in m/s, such as -10\.25:0\.5:41, got '-10:0\.5'"),
        ({"rates": "-10:0.5:many"}, "--rates: expected START:WIDTH:BINS"),
        ({"rates": "-10:0:4"}, "bin_width"),
        ({"chirps": "1e9:1e-5"}, "--chirps: expected BANDWIDTH:DURATION:WAVELENGTH"),
        ({"chirps": "1e9:1e-5:1550e-9:round"}, "expected window to be one of"),
        ({"rates": "-10:0.5:40", "chirps": "1e9:1e-5:1550e-9"}, "--rates and --chirps ask for different films"),
        ({"rates": "-10:0.5:40", "frequencies": "1", **AXIS}, "--frequencies and --rates ask for different films"),
    ],
)
def test_command_lines_that_ask_for_nothing(options, message):
    with pytest.raises(TorchTransientError, match=message):
        film_of_options(options)


def test_films_without_a_video():
    with pytest.raises(ArgumentError, match="--video shows nothing of moments"):
        write_film_video(SimpleNamespace(plural="moments"), None, "a.mp4", False)


@pytest.mark.parametrize("given", [{"start_opl": 0.0}, {"bin_width_opl": 1.0}, {"num_bins": 5}])
def test_no_part_of_an_axis_is_given_alone(given):
    with pytest.raises(ArgumentError, match="replace the scene's axis together: give all"):
        film_of_options(given)


def test_options_of_two_films_are_named_by_their_first():
    axis = {"start_opl": 3.5, "bin_width_opl": 0.25, "num_bins": 5}
    with pytest.raises(ArgumentError, match=r"^--start-opl and --gates ask for different films"):
        film_of_options({**axis, "gates": "rectangular 1 2"})
