"""The doctor: fine here; with a bad LLVM or a process that dies, it says so and its status is not 0."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from support.sweeps import together
from torchtransient import _llvm
from torchtransient.__main__ import main
from torchtransient.cli import doctor


def test_everything_is_fine(monkeypatch, capsys):
    """The real probe in this process; processes of their own are the slow test's."""
    monkeypatch.setattr(sys, "argv", ["-c", "llvm_ad_rgb"])
    exec(doctor._RENDER, {})
    monkeypatch.setattr(doctor, "_run", lambda command, environment: (0, "17.0.6" if len(command) == 3 else "", ""))
    result = CliRunner().invoke(main, ["doctor"])
    assert result.exit_code == 0, result.output
    assert "renders and differentiates" in result.stdout and "problem" not in result.stdout


@pytest.mark.slow
def test_a_users_bad_choice_of_llvm(tmp_path):
    environment = {**os.environ, _llvm.VARIABLE: str(tmp_path / "libLLVM.so")}
    code = "from torchtransient.__main__ import main; main(['doctor'])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment)
    assert result.returncode == 1
    assert f"'{tmp_path / 'libLLVM.so'}', which does not exist" in result.stdout
    assert "pip install" in result.stdout
    assert "not tried" in result.stdout
    assert "1 problem found" in result.stderr


@together("code, seconds, message", [
    ("import os; os.abort()", 60, "the process was ended by SIGABRT"),
    ("raise SystemExit('the image sums to nan')", 60, "failed: the image sums to nan"),
    ("import time; time.sleep(60)", 0.5, "no answer"),
])  # fmt: skip
def test_a_probe_that_fails(monkeypatch, code, seconds, message):
    monkeypatch.setattr(doctor, "_RENDER", code)
    monkeypatch.setattr(doctor, "_TIMEOUT_S", seconds)
    finding = doctor.probe("llvm_ad_rgb")
    assert finding.state == "problem" and message in finding.text


def test_what_programs_get_that_import_mitsuba_alone(monkeypatch):
    monkeypatch.setattr(doctor, "_PLAIN", "print('15.0.6')")
    found, note = doctor.llvm()
    assert (found.state, note.state) == ("ok", "note") and "gets LLVM 15.0.6" in note.text


def test_a_missing_package(monkeypatch):
    monkeypatch.setattr(doctor, "_version", lambda name: None if name in ("kornia", "h5py") else "1.0")
    found = {f.subject: f for f in doctor.versions()}
    assert (found["kornia"].state, found["h5py"].state, found["torch"].state) == ("problem", "note", "ok")
    assert "torchtransient[data]" in found["h5py"].text


@together("driver, torch_sees, findings", [
    (False, False, [("note", "cuda_ad_rgb", "no NVIDIA driver")]),
    (True, False, [("note", "cuda_ad_rgb", "Dr.Jit sees a GPU and torch")]),
    (True, True, [("ok", "CUDA", "a card, torch built for CUDA"), ("ok", "cuda_ad_rgb", "as expected")]),
])  # fmt: skip
def test_what_is_said_of_a_gpu(monkeypatch, driver, torch_sees, findings):
    import drjit as dr
    import torch

    monkeypatch.setattr(dr, "has_backend", lambda backend: driver)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: torch_sees)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda number: "a card")
    monkeypatch.setattr(doctor, "probe", lambda variant: doctor.Finding("ok", variant, "as expected"))
    found = doctor.cuda()
    assert [(one.state, one.subject) for one in found] == [one[:2] for one in findings]
    assert all(one.text.startswith(start) for one, (_, _, start) in zip(found, findings, strict=True))


def test_problems_of_all_parts_are_counted(monkeypatch):
    bad, fine = doctor.Finding("problem", "a", "b"), doctor.Finding("ok", "c", "d")
    for number, words in ((0, ""), (1, "1 problem found."), (3, "3 problems found.")):
        for n, part in enumerate(("versions", "llvm", "variants")):
            found = [bad, fine] if n < number else [fine]
            monkeypatch.setattr(doctor, part, lambda *_, found=found: found)
        result = CliRunner().invoke(main, ["doctor"])
        assert result.exit_code == (number > 0) and words in result.stderr
