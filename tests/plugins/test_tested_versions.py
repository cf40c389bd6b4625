"""Mitsuba and Dr.Jit of a version that nobody tested: said once, and nothing is refused."""

from __future__ import annotations

import warnings

import mitsuba as mi
import pytest

import torchtransient as tt
from torchtransient.cli import doctor
from torchtransient.errors import VersionWarning
from torchtransient.plugins import _registry as tested_versions


@pytest.fixture
def other_mitsuba(monkeypatch):
    """As if the tests had run with an earlier Mitsuba than the one that is here."""
    monkeypatch.setitem(tested_versions.TESTED, "mitsuba", ("3.9.0",))
    monkeypatch.setattr(tested_versions, "_warned", set())


def render():
    return tt.render(tt.load(tt.scenes.cornell_box(resolution=4, num_bins=300), "llvm_ad_rgb"), {}, spp=1)


@pytest.mark.slow
def test_it_is_said_once_and_the_scene_is_rendered(other_mitsuba):
    with pytest.warns(VersionWarning, match=rf"mitsuba {mi.__version__} was never tested .* mitsuba==3\.9\.0"):
        assert float(render().transient.sum()) > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", VersionWarning)
        render()


def test_as_an_error_it_is_raised_once(other_mitsuba):
    with warnings.catch_warnings():
        warnings.simplefilter("error", VersionWarning)
        with pytest.raises(VersionWarning, match="never tested"):
            render()
        assert float(render().transient.sum()) > 0


def test_tested_versions_and_builds_of_them_are_silent():
    assert tested_versions.untested("mitsuba", "3.9.1") is None
    assert tested_versions.untested("mitsuba", "3.9.1+cuda12") is None
    assert tested_versions.untested("drjit", "1.5.0") is None
    assert "drjit 1.5.1" in tested_versions.untested("drjit", "1.5.1")
    assert tested_versions.untested("numpy", "9.9") is None


def test_the_doctor_says_it(monkeypatch):
    found = {"mitsuba": "3.9.7", "drjit": "1.5.0"}
    real = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: found.get(name) or real(name))
    states = {f.subject: (f.state, f.text) for f in doctor.versions()}
    assert states["mitsuba"][0] == "note" and "3.9.7 was never tested" in states["mitsuba"][1]
    assert states["drjit"] == ("ok", "1.5.0")
