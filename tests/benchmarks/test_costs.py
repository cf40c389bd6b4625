"""Benchmarks of recorded calls, at toy size: they run, and their reports hold what they are for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.sweeps import together

ROOT = Path(__file__).parents[2]


def run(script, tmp_path, *arguments):
    report = tmp_path / "report.json"
    command = [sys.executable, str(ROOT / "benchmarks" / script), "--quick", "--json", str(report), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(report.read_text(encoding="utf-8")), done.stdout


@pytest.mark.soak
def test_steps_and_their_parts(tmp_path):
    report, printed = run("step_cost.py", tmp_path, "--threads", "1")
    rows = {row["kind"]: row for row in report["rows"]}
    assert list(rows) == ["render", "colour", "pose", "phasor film", "medium"]
    assert set(rows["colour"]["seconds"]) == {"launched", "traced", "mi.render"}
    for row in rows.values():
        assert row["parts"]["kernels"] > 0 and row["launches"] > 0
        assert row["compiled_when_launched"] == 0
    assert set(rows["pose"]["recorded"]) == {"launched"} and len(rows["pose"]["recorded"]) == 2
    assert "within" not in json.dumps(report["ratios"]) and "phasor film" in printed


@pytest.mark.soak
def test_batches_and_cameras(tmp_path):
    report, _ = run("batch_cost.py", tmp_path, "--only", "cameras, render and", "--threads", "1")
    assert list(report["peak_bytes"]) == ["cameras, render and sum", "cameras, render and squares"]
    assert all(peak["loop"] > 1e8 and peak["batch"] > 1e8 for peak in report["peak_bytes"].values())
    assert [ratio["to"] for ratio in report["ratios"]] == [f"{name}: loop" for name in report["peak_bytes"]]


@pytest.mark.soak
def test_recordings_stay_what_they_are(tmp_path):
    report, printed = run("frozen_memory.py", tmp_path)
    assert report["recordings_added"] == report["calls_traced_when_settled"] == 0
    assert report["kernels_compiled_when_settled"] == 0
    assert report["every"][-1]["step"] == 60 and "60 steps, 3 parameters" in printed


@pytest.mark.parametrize(
    ("script", "cases", "ratios"),
    [
        pytest.param("thread_cost.py", 6, 4, marks=pytest.mark.soak),
        pytest.param("wrap_cost.py", 20, 12, marks=pytest.mark.slow),
    ],
)
def test_threads_and_functions_across(tmp_path, script, cases, ratios):
    report, _ = run(script, tmp_path)
    assert len(report["cases"]) == cases and len(report["ratios"]) == ratios
    assert all(case["min"] > 0 for case in report["cases"].values())


@pytest.mark.slow
def test_ways_to_store(tmp_path):
    report, printed = run("dataset_storage.py", tmp_path)
    assert list(report["data"]) == ["16 spp", "1024 spp"] and "| exact, gzip |" in printed
    for data in report["data"].values():
        rows = {row["way"]: row for row in data["rows"]}
        assert {"exact", "rounded", "counts", "WebDataset"} < set(rows) and 0 < data["not_zero"] < 1
        assert rows["counts"]["smaller"] > rows["rounded"]["smaller"] > rows["exact"]["smaller"] > 1


@pytest.mark.soak
def test_data_sets(tmp_path):
    report, printed = run("dataset.py", tmp_path, "--only", "samples", "views", "captures", "reading", "loader", "new")
    rows = {row["name"]: row for row in report["rows"]}
    # Of what takes time at any size, so that a part that measured nothing would be seen.
    own = ["4^2 x 8, 1 spp: a sample", "4^2 x 8, 1 spp: its bare kernels", "4^2 x 8, 1 spp, 2 cameras: a view"]
    own += ["confocal, 2^2 points x 64 bins, 16 spp: a capture of 2", "4^2 x 16, 1 spp: reading a MB of whole samples"]
    assert all(rows[name]["min"] > 0 for name in own)
    assert rows["4^2 x 8, 1 spp, 2 cameras: a view"]["calls"] == ["launched"]
    assert rows["4^2 x 8, 1 spp: over one of a kept scene"]["min"] > 0
    assert 0 < rows["4^2 x 16, 1 spp: waits of a training loop"]["median"] < 1
    assert "within" not in json.dumps(report["rows"]) and "bar:" not in printed


@pytest.mark.soak
def test_data_sets_by_two_workers(tmp_path):
    report, _ = run("dataset.py", tmp_path, "--only", "workers")
    assert [row["unit"] for row in report["rows"]] == ["x", "x"] and report["rows"][0]["load"] >= 0


@pytest.mark.soak
def test_bias_of_noisy_renders(tmp_path):
    """At toy size already the likelihood is farther off than squares, whose bias is none."""
    report, printed = run("noisy_renders.py", tmp_path)
    squares, likelihood = (
        report["least"][name]["exact"]["64"] for name in ("`squared_loss`, weighted", "`poisson_loss`, `poisson_nll`")
    )
    assert likelihood["rms"] > 1 > squares["rms"] + 2 * squares["error"]
    assert set(report) >= {"least", "fits", "priors"} and report["settings"]["quick"]
    assert len(report["fits"]) == 16 and all(found["CPU s"] > 0 for found in report["fits"].values())
    assert "the start" in report["priors"] and "`expected_root_loss`" in printed


@pytest.mark.parametrize(
    "script",
    [
        pytest.param("nlos_accuracy.py", marks=pytest.mark.slow),
        pytest.param("accuracy_curve.py", marks=pytest.mark.soak),
    ],
)
def test_quick_runs_leave_the_kept_numbers(script, tmp_path):
    """Their kept files have paths below the folder that they are started in: none of these comes into being."""
    (tmp_path / "temporary").mkdir()
    command = [sys.executable, str(ROOT / "benchmarks" / script), "--quick", "--repeats", "2"]
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    assert [path.name for path in tmp_path.iterdir()] == ["temporary"]
    assert len(list((tmp_path / "temporary" / "torchtransient_quick_runs").iterdir())) == 2


SCENE = """<scene version="3.0.0"><path value="../../common"/>
  <sensor type="perspective">
  <film type="hdrfilm"><integer name="width" value="960"/><integer name="height" value="720"/></film>
  <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  <transform name="to_world"><lookat origin="0, 0, -4" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
  <emitter type="constant"/> {} </scene>"""


@pytest.mark.slow
def test_scenes_of_mitsuba_beside_it(tmp_path):
    contents = {
        "same": '<integrator type="path"/><shape type="sphere"/>',
        "refused": '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="path"/></integrator>',
        "absent": '<shape type="ply"><string name="filename" value="nowhere.ply"/></shape>',
    }
    (tmp_path / "common").mkdir()
    scenes = tmp_path / "docs" / "scenes"
    scenes.mkdir(parents=True)
    for name, content in contents.items():
        (scenes / f"{name}.xml").write_text(SCENE.replace("{}", content))
    report, printed = run("mitsuba_scenes.py", tmp_path, "--data", str(tmp_path))
    assert report["scenes"]["same"]["same"] and report["settings"]["size"] == 24
    assert "labels" in report["scenes"]["refused"]["refused"] and "nowhere.ply" in report["scenes"]["absent"]["absent"]
    assert "same 1, different 0, refused 1, absent 1" in printed


@pytest.mark.soak
@together("command, names", [
    (["cases", "plate"], ["plate"]), (["room", "meter", "--depth", "3"], ["meter, depth 3"]),
    (["spread", "corner"], ["corner, depth 3"]), (["step"], ["wall", "cpu", "memory"]), (["fit"], ["start 0"]),
    (["sweep", "disk"], None),
])  # fmt: skip
def test_moving_edges(tmp_path, command, names):
    """At toy size most differences are noise: none fails to be measured."""
    report, _ = run("boundary_cost.py", tmp_path, *command)
    assert report["results"] and (names is None or list(report["results"]) == names)
    for found in report["results"].values():
        assert "failed" not in found and found.get("verdict") != "failed"


@pytest.mark.slow
def test_variance_beside_another_checkout(tmp_path):
    """The same checkout has the same variance."""
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "problem.py").write_text(
        "import dataclasses, random\n"
        "@dataclasses.dataclass\n"
        "class Case:\n"
        "    name: str = 'one'\n"
        "    support: str = 'correct'\n"
        "    spp: int = 32\n"
        "    fd_spp: int = 32\n"
        "class Problem:\n"
        "    def __init__(self, case): self.case = case\n"
        "    def reverse(self, seed): return random.Random(seed).random() / self.case.spp\n"
    )
    (tmp_path / "toy" / "all_cases.py").write_text("from toy.problem import Case\nALL_CASES = [Case()]\n")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, str(ROOT / "benchmarks" / "boundary_cost.py"), "variance", "toy"]
    for more in (["--json", "before.json"], ["--against", "before.json", "--json", "after.json"]):
        done = subprocess.run([*command, *more], capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads((tmp_path / "after.json").read_text(encoding="utf-8"))["results"]["one"]
    assert found["spp"] == 2 and found["ratio"] == pytest.approx(1) and not found["more"]


@pytest.mark.slow
def test_fits_that_are_watched(tmp_path):
    report, printed = run("fit_monitor.py", tmp_path)
    cases, ratios = report["cases"], report["ratios"]
    assert any(name.endswith("plain") for name in cases) and len(ratios) == 2 * len(cases) - 2
    assert "page" in printed
