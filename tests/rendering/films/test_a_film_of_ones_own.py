"""A new film is one plugin (`moments_film.py`) and one layout (`Moments`), which is listed: renderer, gradients, plan
and result files follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from tools.small_room import WALL_POSE, make_room
from torchtransient import plugins
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.files import read_result, write_result
from torchtransient.plugins import _registry
from torchtransient.rendering.films import FILMS, FilmLayout

VARIANT = "llvm_ad_rgb"


@dataclass(frozen=True)
class Moments(FilmLayout):
    measures: ClassVar[str] = "moments"
    plugin: ClassVar[str] = "moments_hdr_film"
    letter: ClassVar[str] = "K"
    argument: ClassVar[str] = "moments"
    example: ClassVar[str] = "film=Moments(3)"
    plural: ClassVar[str] = "moments"
    output: ClassVar[str] = "moments"

    number_of_moments: int

    @property
    def count(self):
        return self.number_of_moments

    @classmethod
    def from_film(cls, film):
        return cls(film.moments)

    def write(self, props):
        props["moments"] = self.number_of_moments

    def entries(self):
        return self.attributes()

    @classmethod
    def from_entries(cls, values):
        return cls(int(values["number_of_moments"])) if "number_of_moments" in values else None


@pytest.fixture(autouse=True)
def _listed(monkeypatch):
    """List the plugin in `PLUGIN_MODULES` and the class in `FILMS`."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    FILMS.append(Moments)
    mi.set_variant(VARIANT)
    plugins.register_module("moments_film", (("film", "moments_hdr_film"),))
    yield
    FILMS.remove(Moments)
    _registry._state.third_party = []
    _registry._state.variant = None
    plugins.sync()


def test_moments_are_those_of_a_fine_histogram():
    scene, axis = tt.load(make_room(), variant=VARIANT), tt.TimeAxis(6.0, 0.005, 1600)
    out = tt.render(scene, film=Moments(3), spp=64, seed=2)
    assert out.transient is None and out.axis is None and out.others["number_of_moments"] == 3
    found = out.others["moments"]
    assert found.shape == (3, 3, 3, 4)
    fine = tt.render(scene, time_axis=axis, spp=64, seed=2)
    powers = torch.stack([axis.centers_opl**k for k in range(3)]).float()
    torch.testing.assert_close(found, torch.einsum("cthw,kt->ckhw", fine.transient, powers), rtol=2e-3, atol=1e-5)
    torch.testing.assert_close(found[:, 0], out.steady, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_derivatives_in_both_modes():
    key = WALL_POSE
    room = make_room()
    del room["box"]  # whose outline on the wall makes difference quotients noisy
    renderer = tt.TransientRenderer(room, parameters=[key], film=Moments(3), spp=64, grad_seed="same")
    assert renderer.effective_filter == "" and "moments=3" in repr(renderer)
    weights = torch.tensor([0.5, -1.0, 0.1])[:, None, None]

    def loss(x):
        return (renderer({key: x}, seed=1).others["moments"] * weights).sum().double()

    x = renderer.values[key].detach()
    tangent = torch.zeros_like(x)
    tangent.view(-1)[11] = 1.0
    gradient = torch.autograd.functional.jacobian(loss, x)
    forward = torch.func.jvp(loss, (x,), (tangent,))[1]
    torch.testing.assert_close((gradient * tangent).sum().double(), forward, rtol=1e-3, atol=0)
    h = 1e-2
    difference = (loss(x + h * tangent) - loss(x - h * tangent)) / (2 * h)
    assert float(forward) == pytest.approx(float(difference), rel=2e-3)


def test_plan():
    plan = tt.plan(make_room(), ("steady", "moments"), film=Moments(2))
    assert plan.film == "moments" and plan.temporal_filter == "" and plan.time_axis is None
    assert plan.to_dict()["moments"] == 2 and plan.to_dict()["time_axis"] is None
    with pytest.raises(SceneError, match=r"Give film=Moments\(3\)"):
        tt.plan(make_room(), "moments")
    with pytest.raises(ArgumentError, match="on which moments have no effect; ask for outputs"):
        tt.plan(make_room(), "transient", film=Moments(2))


def test_result_files(tmp_path):
    out = tt.render(make_room(), film=Moments(2), spp=2, seed=0)
    back = read_result(write_result(tmp_path / "a.h5", out))
    assert torch.equal(back.others["moments"], out.others["moments"]) and back.others["number_of_moments"] == 2
    assert back.transient is None and back.channels == out.channels
