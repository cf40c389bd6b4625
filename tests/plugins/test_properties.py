"""Numbers of plugins: what is none is refused by name."""

from __future__ import annotations

import math
import re
from pathlib import Path

import mitsuba as mi
import pytest

import torchtransient
from support.sweeps import together
from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.plugins.properties import number, truth, whole_number

TEXTURE = {"type": "uniform", "value": 0.5}
NUMBERS = [
    ("retroreflector", "alpha", {}),
    ("retroreflector", "share", {}),
    ("diff_rough_plastic", "alpha", {}),
    ("diff_hair", "scale_tilt", {}),
    ("diff_hair", "longitudinal_roughness", {}),
    ("diff_principled", "eta", {}),
    ("angulararea", "cutoff_angle", {}),
    ("transient_path", "gaussian_stddev", {"temporal_filter": "gaussian"}),
    ("transient_nlos_path", "illumination_scan_fov", {}),
    ("transient_hdr_film", "start_opl", {}),
    ("transient_hdr_film", "bin_width_opl", {}),
    ("transient_hdr_film", "pulse_fwhm_opl", {"pulse": "gaussian"}),
    ("phasor_hdr_film", "wl_mean", {"wl_sigma": 1.0}),
    ("phasor_hdr_film", "frequency_step", {"frequency_first": 0.0, "frequency_count": 3}),
]


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


@together("plugin, name, more", NUMBERS)
@together("wrong", [TEXTURE, "wide", True, float("nan"), float("inf"), [0.1, 0.2, 0.3]], repr)
def test_what_is_no_number_is_refused(plugin, name, more, wrong):
    words = rf"{name}: expected a (finite )?number, got"
    if wrong is TEXTURE and "film" in plugin:
        words = name  # of a film it would be a response curve
    with pytest.raises(SceneError, match=words), plugins.plugin_errors():
        mi.load_dict({"type": plugin, name: wrong, **more})


def test_every_number_is_read_with_a_check():
    room = Path(torchtransient.__file__).parent / "plugins"
    bare = {path.name for path in room.rglob("*.py") if re.search(r"(float|int)\(props(\.get\(|\[)", path.read_text())}
    assert not bare


class Given:
    """Properties of a plugin as Python sees them."""

    def __init__(self, **given):
        self.given = given

    def __getitem__(self, name):
        return self.given[name]

    def get(self, name, default):
        return self.given.get(name, default)

    def plugin_name(self):
        return "thing"


def test_whole_numbers():
    """Up to what kernels count, their bounds included; -1 unless something else is said."""
    assert [whole_number(Given(n=n), "n", 7) for n in (-1, 0, 3.0, 2**32 - 2)] == [-1, 0, 3, 2**32 - 2]
    assert whole_number(Given(), "n", 7) == 7 and whole_number(Given(n=5), "n", 7, least=5) == 5
    assert isinstance(whole_number(Given(n=3.0), "n", 7), int)
    for wrong in (True, False, 2.5, -0.5, "3", None, math.nan, math.inf):
        with pytest.raises(SceneError, match=f"^thing: n: expected a whole number, got .*{wrong}.*\\.$"):
            whole_number(Given(n=wrong), "n", 7)
    for wrong, least in ((-2, -1), (2**32 - 1, -1), (4, 5), (4.0, 5)):
        with pytest.raises(SceneError, match=rf"^thing: n: .* number from {least} to 2\^32 - 2, got {wrong}"):
            whole_number(Given(n=wrong), "n", 7, least)


def test_real_numbers():
    assert number(Given(x=-2), "x") == -2.0 and number(Given(), "x", 0.5) == 0.5 and number(Given(x=3), "x", 0.5) == 3
    with pytest.raises(KeyError):
        number(Given(), "x")
    for wrong in (True, "3", None, [1.0]):
        with pytest.raises(SceneError, match=r"^thing: x: expected a number, got"):
            number(Given(x=wrong), "x")
    for wrong in (math.nan, -math.inf):
        with pytest.raises(SceneError, match=r"^thing: x: expected a finite number, got"):
            number(Given(x=wrong), "x")


def test_truth():
    assert [truth(Given(t=t), "t", default=False) for t in (True, 1, 1.0, False, 0)] == [True, True, True, False, False]
    assert truth(Given(), "t", default=True) is True
    for wrong in (2, -1, 0.5, "yes", None, math.nan):
        with pytest.raises(SceneError, match=r"^thing: t: expected true or false, got"):
            truth(Given(t=wrong), "t", default=True)
