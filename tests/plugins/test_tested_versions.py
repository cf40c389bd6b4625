"""Mitsuba of a version that was never tested: said once, and nothing is refused."""

from __future__ import annotations

import warnings

import mitsuba as mi
import pytest

import torchtransient as tt
from torchtransient.errors import VersionWarning


def render():
    return tt.render(tt.load(tt.scenes.cornell_box(resolution=4, num_bins=300), "llvm_ad_rgb"), {}, spp=1)


def test_as_an_error_it_is_raised_once(monkeypatch):
    monkeypatch.setattr(mi, "__version__", "3.9.77")
    with warnings.catch_warnings():
        warnings.simplefilter("error", VersionWarning)
        with pytest.raises(VersionWarning, match=r"mitsuba 3\.9\.77 was never tested"):
            render()
        assert float(render().transient.sum()) > 0


def test_builds_of_tested_versions_are_silent(monkeypatch):
    monkeypatch.setattr(mi, "__version__", "3.9.1+cuda12")
    with warnings.catch_warnings():
        warnings.simplefilter("error", VersionWarning)
        mi.set_variant("llvm_ad_rgb")
        tt.plugins.sync()
        render()
