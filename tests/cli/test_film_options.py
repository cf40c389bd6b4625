"""Films that the options of a command line ask for."""

from __future__ import annotations

import pytest

import torchtransient as tt
from support.sweeps import together
from torchtransient.cli.options import film_of_options
from torchtransient.errors import TorchTransientError
from torchtransient.rendering.films import Beats, Gates, Histogram, Phasors, Rates

AXIS = {"start_opl": 3.5, "bin_width_opl": 0.25, "num_bins": 5}
RATES, CHIRPS = tt.RateAxis(-10.0, 0.5, 40), tt.Chirps(1e9, 1e-5, 1550e-9)
GATES = (tt.Gate.rectangular(3, 4), tt.Gate.gaussian(7.0, 0.5), tt.Gate.tabulated([1, 2, 4], [0, 1, 0]))


@together("options, expected", [
    (AXIS, Histogram(tt.TimeAxis(3.5, 0.25, 5))),
    ({"frequencies": "0, 0.5,-2", "gates": None}, Phasors(tt.FrequencyAxis((0.0, 0.5, -2.0)))),
    ({"gates": "rectangular 3 4; gaussian 7.0 0.5; tabulated 1:0 2:1 4:0"}, Gates(GATES)),
    ({"rates": "-10:0.5:40"}, Rates(RATES)), ({"chirps": "1e9:1e-5:1550e-9"}, Beats(CHIRPS)),
    ({"rates": "-10:0.5:40", **AXIS}, Rates(RATES, tt.TimeAxis(3.5, 0.25, 5))),
    ({"chirps": "1e9:1e-5:1550e-9:nuttall"}, Beats(tt.Chirps(1e9, 1e-5, 1550e-9, window="nuttall"))),
    ({"start_opl": None, "frequencies": None}, None),
])  # fmt: skip
def test_command_line(options, expected):
    assert film_of_options(options) == expected


@together("options", [
    {"num_bins": 5}, {"start_opl": 0.0, "bin_width_opl": 1.0}, {"frequencies": "1, two"},
    {"frequencies": "1", "gates": "rectangular 1 2"}, {"gates": "round 1 2"}, {"rates": "-10:0.5"},
    {"rates": "-10:0.5:many"}, {"rates": "-10:0:4"}, {"chirps": "1e9:1e-5"}, {"chirps": "1e9:1e-5:1550e-9:round"},
    {"rates": "-10:0.5:40", "chirps": "1e9:1e-5:1550e-9"}, {"rates": "-10:0.5:40", "frequencies": "1", **AXIS},
    {**AXIS, "gates": "rectangular 1 2"},
])  # fmt: skip
def test_command_lines_that_ask_for_nothing(options):
    with pytest.raises(TorchTransientError):
        film_of_options(options)
