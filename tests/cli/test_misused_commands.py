"""Whatever somebody gets wrong on a command line is one line and status 2; what the library gets wrong, one and 70."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from torchtransient.cli import main as cli


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (PermissionError(13, "Permission denied", "a.h5"), 2, "Permission denied"), (TypeError("a\nb"), 70, "a b"),
        (KeyError("a"), 70, "KeyError"), (RecursionError("deep"), 70, "a fault of torchtransient"),
        (RuntimeError("x" * 9000), 70, "--debug shows where"),
    ],
)  # fmt: skip
def test_errors_of_others(monkeypatch, error, status, words):
    @click.command()
    def broken():
        raise error

    monkeypatch.setattr(cli.Commands, "get_command", lambda self, ctx, name: broken)
    found = CliRunner().invoke(cli.main, ["plan"])
    assert found.exit_code == status and words in found.stderr
    assert found.stderr.startswith("error: ") and found.stderr.count("\n") == 1 and len(found.stderr) < 500
    assert type(CliRunner().invoke(cli.main, ["--debug", "plan"]).exception) is type(error)


def test_a_reader_that_has_left_is_no_error_of_ours(monkeypatch):
    @click.command()
    def broken():
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(cli.Commands, "get_command", lambda self, ctx, name: broken)
    found = CliRunner().invoke(cli.main, ["plan"])
    assert found.exit_code == 1 and not found.stderr


def test_a_folder_that_is_no_data_set(tmp_path):
    found = CliRunner().invoke(cli.main, ["dataset", "verify", str(tmp_path)])
    assert found.exit_code == 2 and "holds no shard" in found.stderr
