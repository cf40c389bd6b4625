"""`torchtransient dataset`: a recipe in a file, a data set in a folder, rendered for real."""

from __future__ import annotations

import json
import os
import signal

import pytest
from click.testing import CliRunner

from support.generation_runs import data_files, finish, start_command, wait_until, workers_of
from torchtransient.__main__ import main
from torchtransient.data import read_web_dataset

VARIANT = "llvm_ad_rgb"
RECIPE = """
scene: {builtin: cornell_box, resolution: 8, num_bins: 150, bin_width_opl: 0.08}
vary:
  red.reflectance.value: {uniform: [0.1, 0.9]}
labels: [depth]
spp: 16
variant: llvm_ad_rgb
n: 6
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a recipe, and its data set as the command makes it."""
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "box.yaml").write_text(RECIPE)
    result = run(folder, "box.yaml", "--out", "set", "--workers", 1, "--per-shard", 2, "--quiet")
    assert result.exit_code == 0, result.output
    assert "6 samples in 3 shards" in result.stdout
    return folder


def run(folder, *arguments):
    before = os.getcwd()
    os.chdir(folder)
    try:
        return CliRunner().invoke(main, ["dataset", *map(str, arguments)])
    finally:
        os.chdir(before)


@pytest.mark.slow
def test_verify(made, tmp_path):
    result = run(made, "verify", "set", "--quiet")
    assert result.exit_code == 0 and "6 samples in 3 shards, 0 failed" in result.stdout and "complete" in result.stdout
    for name in data_files(made / "set"):
        (tmp_path / name).write_bytes((made / "set" / name).read_bytes())
    (tmp_path / "shard-000001.h5").unlink()
    result = run(tmp_path, "verify", ".", "--quiet")
    assert result.exit_code == 1 and "missing: 2 samples, 2 to 3" in result.stdout
    raw = bytearray((tmp_path / "shard-000000.h5").read_bytes())
    raw[len(raw) // 2] ^= 1
    (tmp_path / "shard-000000.h5").write_bytes(raw)
    result = run(tmp_path, "verify", ".", "--quiet")
    assert result.exit_code == 1 and "shard-000000.h5: " in result.stdout
    result = run(made, "verify", "nowhere", "--quiet")
    assert result.exit_code == 2 and result.stderr.startswith("error: ")


@pytest.mark.slow
def test_info_and_cost(made):
    result = run(made, "cost", "box.yaml", "--samples", 2, "--quiet")
    assert result.exit_code == 0 and "seconds" in result.stdout and "bytes a sample" in result.stdout
    result = run(made, "info", "set")
    assert result.exit_code == 0, result.output
    for words in ("6 of 6 samples in 3 shards", "transient: 3 x 150 x 8 x 8 float32", "depth: 8 x 8 float32",
                  "red.reflectance.value", "150 bins of 0.08 m", "16 samples per pixel", "mitsuba 3."):  # fmt: skip
        assert words in result.stdout


@pytest.mark.slow
def test_show_and_preview(made):
    result = run(made, "show", "set", "-o", "drawn.png", "--count", 3, "--seed", 1)
    assert result.exit_code == 0 and result.stdout.startswith("drawn.png: samples "), result.output
    assert len(result.stdout.split("samples ")[1].split(", ")) == 3
    result = run(made, "preview", "box.yaml", "--count", 2, "--quiet")
    assert result.exit_code == 0 and "box.png: samples 0 to 1" in result.stdout, result.output
    for name in ("drawn.png", "box.png"):
        assert (made / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_export(made):
    result = run(made, "export", "set", "--out", "tars/of_mine", "--quiet")
    assert result.exit_code == 0 and "1 files" in result.stdout, result.output
    (tar,) = (made / "tars" / "of_mine").glob("*.tar")
    assert [sample["index"] for sample in read_web_dataset(tar)] == list(range(6))
    result = run(made, "export", "set", "--out", "captures", "--format", "tal", "--quiet")
    assert result.exit_code == 2 and "scan" in result.stderr
    result = run(made, "export", "set", "--out", "box.yaml", "--quiet")
    assert result.exit_code == 2 and "cannot be made" in result.stderr


@pytest.mark.slow
def test_shares_of_machines(made, tmp_path):
    """The same bytes, from two commands that take every other file."""
    for part in ("0/2", "1/2"):
        more = ("--shard", part, "--workers", 2, "--per-shard", 2, "--quiet")
        result = run(made, "box.yaml", "--out", tmp_path / "set", *more)
        assert result.exit_code == 0, result.output
    assert data_files(tmp_path / "set") == data_files(made / "set")


@pytest.mark.slow
def test_what_is_wrong_is_one_line(made):
    for arguments, words in (
        (("box.yaml", "--out", "set", "--n", 7, "--quiet"), "n is 6 there and 7 here"),
        (("box.yaml", "--out", "set", "--no-resume", "--quiet"), "has a data set"),
        (("nothing.yaml", "--out", "other"), "nothing.yaml"),
    ):
        result = run(made, *arguments)
        assert result.exit_code == 2 and result.stderr.startswith("error: ") and words in result.stderr, result.stderr
        assert len(result.stderr.splitlines()) == 1
    for arguments in (("box.yaml",), ("box.yaml", "--out", "set", "--shard", "2/2"), ()):
        assert run(made, *arguments).exit_code == 2
    assert not (made / "other").exists()


@pytest.mark.slow
def test_ctrl_c_and_on_again(made, tmp_path):
    command = ("dataset", str(made / "box.yaml"), "--out", "set", "--n", "4000", "--per-shard", "20", "--quiet")
    child = start_command(tmp_path, *command)
    wait_until(lambda: list((tmp_path / "set").glob("shard-*.h5")))
    workers = workers_of(child.pid)
    os.killpg(child.pid, signal.SIGINT)
    status, _, err = finish(child, 30)
    assert status == 130 and "stopped; what is finished is kept in set: the same command goes on" in err
    assert "Traceback" not in err and workers
    events = [json.loads(line)["event"] for line in (tmp_path / "set" / "log.jsonl").read_text().splitlines()]
    assert events[0] == "begin" and events[-1] == "stopped"
    result = run(tmp_path, "verify", "set", "--quiet")
    assert result.exit_code == 1 and "missing" in result.stdout and "\nshard" not in result.stdout


def test_a_misspelt_command(tmp_path):
    assert "'inf' cannot be read" in run(tmp_path, "inf", "--out", "set").output
    (tmp_path / "inf").write_text("scene: {}")  # a recipe by that name is a recipe
    assert "Missing option" in run(tmp_path, "inf").output
    assert "holds no shard" in run(tmp_path, "verify", str(tmp_path)).output
