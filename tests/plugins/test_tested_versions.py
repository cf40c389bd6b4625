"""Mitsuba and Dr.Jit of a version that nobody tested: said once, and nothing is refused."""

from __future__ import annotations

import warnings

import pytest

import torchtransient as tt
from torchtransient.errors import VersionWarning
from torchtransient.plugins import _registry as tested_versions


@pytest.fixture
def other_mitsuba(monkeypatch):
    """As if the tests had run with an earlier Mitsuba than the one that is here."""
    monkeypatch.setitem(tested_versions.TESTED, "mitsuba", ("3.9.0",))
    monkeypatch.setattr(tested_versions, "_warned", set())


def render():
    return tt.render(tt.load(tt.scenes.cornell_box(resolution=4, num_bins=300), "llvm_ad_rgb"), {}, spp=1)


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


