"""The sweep of gradients: it misses no plugin, its page is what was measured, and nothing called correct is wrong."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.every_plugin import every_plugin
from tools.gradient_sweep import compare, runner
from tools.gradient_sweep.bsdfs import HOLDERS
from tools.gradient_sweep.compare import QUICK, Runs, judge
from tools.gradient_sweep.measure import Subject, Tangent, tangents_of
from tools.gradient_sweep.page import PAGE, page, read_rows, swept
from tools.gradient_sweep.runner import ResultFile
from tools.gradient_sweep.settings import all_settings
from tools.gradient_sweep.stages import between_lights, matte
from torchtransient.plugins import _registry
from torchtransient.plugins.mitsuba_compat import COMPLETED_PLUGINS
from torchtransient.plugins.parameter_effect import FILE

DOCS = Path(__file__).parents[2] / "docs"
SETTINGS = {setting.name: setting for setting in all_settings()}
# Verdicts that a parameter with a right derivative cannot have.
WRONG = ("contradict", "modes differ", "not finite", "error")
# Integrators, films, samplers and reconstruction filters have no parameters of light transport.
NO_PART_OF_A_SCENE = {
    "aov", "depth", "direct", "moment", "path", "ptracer", "stokes", "volpath", "volpathmis", "hdrfilm", "specfilm",
    "independent", "stratified", "multijitter", "orthogonal", "ldsampler", "box", "tent", "gaussian", "mitchell",
    "catmullrom", "lanczos", "transient_hdr_film", "phasor_hdr_film", "gated_hdr_film", "rate_hdr_film",
    "beat_hdr_film", "slow_phasor_hdr_film",
}  # fmt: skip
# Listed as unchecked: their data come in files of their own, or there is nothing to load.
NOT_SWEPT = {"measured", "measured_polarized", "serialized", "blender"}
# Go by another name in a dictionary (`srgb` is `rgb`), or are built in place of others always.
BY_ANOTHER_NAME = {"srgb", "merge", *COMPLETED_PLUGINS.values()}


def plugins_in(description):
    """The types of a description and of what it holds."""
    if isinstance(description, dict) and "type" in description:
        yield description["type"]
    if isinstance(description, dict | list):
        for value in description.values() if isinstance(description, dict) else description:
            yield from plugins_in(value)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sweep")


@pytest.fixture(scope="module")
def rows():
    return read_rows(DOCS)


# ------------------------------------------------------------------------------------------------- nothing is left out


def test_no_plugin_is_forgotten(folder):
    """Of Mitsuba, a later one that brings more too, and of this library."""
    installed = {path.stem for path in (Path(mi.__file__).parent / "plugins").glob("*.so")}
    mi.set_variant("llvm_ad_rgb")
    kinds = ("bsdf", "emitter", "medium", "phase", "sensor", "shape", "texture")
    ours = {name for module in _registry.PLUGIN_MODULES for kind, name in module.plugins if kind in kinds}
    met = {plugin for setting in SETTINGS.values() for plugin in plugins_in(setting.make(folder))}
    described = set(plugins_in(list(every_plugin(folder).values())))
    assert ours - described == set()
    missing = installed | ours | described
    assert missing - met - NO_PART_OF_A_SCENE - NOT_SWEPT - BY_ANOTHER_NAME == set()


def test_every_surface_is_nested_in_every_holder():
    inside = {}
    for setting in SETTINGS.values():
        if setting.kind == "bsdf":
            inside.setdefault(setting.plugin, set()).add(setting.inside)
    assert inside["diffuse"] == {"", "mask", "blendbsdf", "bumpmap", "normalmap", "twosided", "instance"}
    assert inside["dielectric"] == inside["diffuse"] - {"twosided"}
    assert inside["mask"] == set(HOLDERS) - {"twosided"} and inside["bumpmap"] == set(HOLDERS)


def offered(setting, folder):
    """The keys of a scene that the sweep has to list."""
    mi.set_variant(setting.variant)
    table = tt.load(setting.make(folder), variant=setting.variant).parameters()
    numeric = [key for key, info in table.items() if info.shape is not None and info.kind not in ("plain", "integer")]
    return {key for key in numeric if setting.takes(key)}


def listed(rows):
    keys = {}
    for row in rows:
        keys.setdefault(row["setting"], set()).add(row["key"])
    return keys


@pytest.mark.parametrize("name", random.Random(11).sample(sorted(SETTINGS), 6))
def test_keys_listed_are_keys_offered(rows, folder, name):
    assert listed(rows).get(name, set()) == offered(SETTINGS[name], folder)


@pytest.mark.soak
def test_all_keys_listed_are_keys_offered(rows, folder):
    found = listed(rows)
    for name, setting in SETTINGS.items():
        assert found.get(name, set()) == offered(setting, folder), name
    assert set(found) <= set(SETTINGS)


# ------------------------------------------------------------------------------------------------- what the page says


def test_page_and_table_are_those_of_the_data(rows):
    assert (DOCS / PAGE).read_text(encoding="utf-8") == page(rows)
    assert json.loads(FILE.read_text(encoding="utf-8")) == swept(rows)


def test_nothing_called_correct_contradicts(rows):
    assert [row for row in rows if row["verdict"] in WRONG and not row["biased"]] == []


def test_hardly_anything_is_unresolved(rows):
    """Of the parameters, each of which is decided when it is along one direction."""
    verdicts = {}
    for row in rows:
        if row["verdict"] != "refused":
            verdicts.setdefault((row["setting"], row["key"]), set()).add(row["verdict"])
    undecided = [key for key, found in verdicts.items() if found <= {"unresolved", "no effect"}]
    assert len(undecided) <= 0.05 * len(verdicts), undecided


# ------------------------------------------------------------------------------------------ what is compared, and how


def runs(reverse, differences, noise=0.0, scale=0.1, seeds=8):
    rng = np.random.default_rng(1)
    return Runs(reverse + noise * rng.normal(size=seeds), differences + noise * rng.normal(size=seeds), scale)


@pytest.mark.parametrize(
    ("reverse", "differences", "noise", "expected"),
    [
        (1.0, 1.0, 1e-3, "agree"),
        (0.0, 1.0, 1e-3, "contradict"),
        (1.02, 1.0, 1e-3, "contradict"),
        (1.005, 1.0, 1e-3, "agree"),
        (1.0, 1.0, 0.1, "unresolved"),
        (0.0, 0.0, 0.0, "no effect"),
        (float("nan"), 1.0, 0.0, "not finite"),
    ],
)
def test_verdicts(reverse, differences, noise, expected):
    assert compare.verdict(runs(reverse, differences, noise), reverse, reverse) == expected
    assert compare.verdict(runs(1.0, 1.0, 1e-3), 1.01, 1.0) == "modes differ"
    assert compare.verdict(runs(0.0, 0.0, scale=0.0), 0.0, 0.0) == "no effect", "a black picture proves nothing"


class Doubled(Subject):
    """A subject with twice the right derivative."""

    def reverse(self, seed, spp):
        return 2 * super().reverse(seed, spp)


@pytest.mark.slow
def test_a_wrong_derivative_is_found(no_leftovers):
    scene = tt.load(between_lights(matte(0.3)), variant="llvm_ad_rgb")
    key = "plate.bsdf.reflectance.value"
    (tangent,) = tangents_of(key, "number", torch.tensor(0.3))
    effort = replace(QUICK, paths=2**13)
    assert judge(Subject(scene, key), tangent, effort).verdict in ("agree", "unresolved")
    assert judge(Doubled(scene, key), tangent, effort).verdict == "contradict"


def test_directions():
    """Poses move and turn, colours and grids change in each entry, and the same key has the same directions."""
    names = [t.name for t in tangents_of("a.to_world", "transform", torch.eye(4))]
    assert names == ["translation", "rotation and growth"]
    grid = torch.full((2, 2, 2, 1), 0.5)
    (first,), (again,) = (tangents_of("a.data", "tensor", grid) for _ in range(2))
    assert isinstance(first, Tangent) and torch.equal(first.direction, again.direction)
    assert first.direction.square().mean().sqrt() == pytest.approx(0.5)
    assert len(tangents_of("lamp.position", "vector", torch.zeros(3))) == 2


@pytest.mark.parametrize(("value", "sign"), [(0.0, 1), (1.0, -1)])
def test_directions_lead_inwards(value, sign):
    (tangent,) = tangents_of("plate.bsdf.opacity.value", "number", torch.tensor(value))
    assert tangent.one_sided and float(tangent.direction) == sign


# ----------------------------------------------------------------------------------------------------- the sweep itself


def row(setting, key, verdict, place, **values):
    result = compare.Result(setting, key, "random", verdict, **values)
    return result.as_dict() | {"place": place}


def test_results_are_taken_up_again(tmp_path):
    """Settings that are not finished are done anew, and the later one of two results counts."""
    first, second = list(SETTINGS)[:2]
    file = ResultFile(tmp_path / "results.jsonl")
    file.write(row(second, "x", "agree", [], scale=1.0))
    file.write({"done": second})
    file.write(row(first, "x", "agree", []))
    file.path.write_text(file.path.read_text() + '{"setting": "cut o')
    assert file.done() == {second}
    assert [line["setting"] for line in file.results()] == [second]
    file.path.write_text(file.path.read_text() + "\n")
    file.write(row(first, "x", "contradict", []))
    file.write({"done": first})
    assert [(line["setting"], line["verdict"]) for line in file.results()] == [(first, "contradict"), (second, "agree")]


def test_a_process_that_dies_is_a_result(tmp_path, monkeypatch):
    """What it was at is given up, the rest goes to another process."""
    names, died = list(SETTINGS)[:3], []

    def process(waiting, results, quick, progress):
        if waiting[0] == names[1]:
            died.append(waiting[0])
            return [], "Segmentation fault"
        results.write({"done": waiting[0]})
        return waiting[:1] if names[1] in waiting else waiting, ""

    monkeypatch.setattr(runner, "_run_process", process)
    file = ResultFile(tmp_path / "results.jsonl")
    runner.sweep([SETTINGS[name] for name in names], file, processes=1)
    assert died == [names[1]]
    (lost,) = [line for line in file.lines() if line.get("verdict") == "error"]
    assert lost["setting"] == names[1] and "Segmentation fault" in lost["note"]


@pytest.mark.slow
def test_from_the_command_line(tmp_path):
    """Processes, file and page, for one scene."""
    results, name = tmp_path / "results.jsonl", "sensor orthographic"
    command = [sys.executable, "-m", "tools.gradient_sweep", "--results", str(results)]
    subprocess.run([*command, "--only", f"^{name}$", "--quick"], check=True, cwd=runner.ROOT)
    assert {line["key"] for line in ResultFile(results).results()} == {"sensor.to_world"}


def sample():
    """Every bare plugin, and some of what is inside others."""
    bare = [setting for setting in SETTINGS.values() if setting.is_bare]
    nested = [setting for setting in SETTINGS.values() if not setting.is_bare]
    return [*bare, *random.Random(3).sample(nested, 6)]


PARTS = [pytest.param(part, marks=pytest.mark.soak if part else pytest.mark.slow) for part in range(16)]


@pytest.mark.parametrize("part", PARTS)
def test_against_finite_differences(tmp_path, part):
    """Few samples: what they cannot decide, the whole sweep does."""
    file, settings = ResultFile(tmp_path / "results.jsonl"), sample()[part::16]
    runner.sweep(settings, file, quick=True)
    results = file.results()
    assert {line["setting"] for line in results} >= {setting.name for setting in settings if setting.kind == "bsdf"}
    assert [line for line in results if line["verdict"] in WRONG and not line["biased"]] == []
    compared = [line["verdict"] for line in results if line["verdict"] != "refused"]
    assert compared.count("agree") > 0.8 * len(compared)
