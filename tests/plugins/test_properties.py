"""Numbers of plugins: what is none is refused by name."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import pytest

import torchtransient
from torchtransient import plugins
from torchtransient.errors import SceneError

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


@pytest.mark.parametrize(("plugin", "name", "more"), NUMBERS)
@pytest.mark.parametrize("wrong", [TEXTURE, "wide", True, float("nan"), float("inf"), [0.1, 0.2, 0.3]], ids=repr)
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
