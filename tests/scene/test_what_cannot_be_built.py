"""Films and integrators that a render would have to change, and cannot without losing something."""

from __future__ import annotations

import pytest

import torchtransient as tt
from tools.small_room import VARIANT
from torchtransient.errors import SceneError

GATES = [tt.Gate.gaussian(8.0, 0.5)]


def rendered(room, **settings):
    return tt.TransientRenderer(tt.load(room, variant=VARIANT), spp=1, physics="ignore", **settings)


@pytest.mark.parametrize("prefix", ["pulse", "irf"])
def test_a_pulse_that_phasors_would_lose(room, prefix):
    """Films of gates take one, films of frequencies do not."""
    room["sensor"]["film"] |= {prefix: "gaussian", f"{prefix}_fwhm_opl": 0.3}
    rendered(room, gates=GATES)
    with pytest.raises(SceneError, match="has a pulse or an irf, which a phasor_hdr_film would lose; take it out"):
        rendered(room, frequencies=[0.0, 0.5])


def test_films_that_are_steady(room):
    room["sensor"]["film"] = {"type": "hdrfilm", "width": 3, "height": 2}
    with pytest.raises(SceneError, match=r"is a steady 'hdrfilm', which has no time axis\. Give Transient"):
        rendered(room)
    for settings in ({"frequencies": [0.5]}, {"gates": GATES}, {"time_axis": tt.TimeAxis(6.0, 0.5, 8)}):
        rendered(room, **settings)
    with pytest.raises(SceneError, match="'phasor_hdr_film' does not read 'steady'"):
        rendered(room, frequencies=[0.5], steady=False)
    del room["sensor"]["film"]
    with pytest.raises(SceneError, match="has no time axis"):
        rendered(room)
    assert rendered(room, time_axis=tt.TimeAxis(6.0, 0.5, 8)).axis.num_bins == 8


def test_integrators_without_a_transient_counterpart(room):
    room["integrator"] = {"type": "depth"}
    with pytest.raises(SceneError, match=r"integrator 'depth' has no transient counterpart. Expected transient_path"):
        rendered(room)
    room["integrator"] = {"type": "path", "max_depth": 4}
    assert rendered(room)(seed=0).stats.integrator == "transient_path"
    del room["integrator"]
    assert rendered(room)(seed=0).stats.integrator == "transient_path"
