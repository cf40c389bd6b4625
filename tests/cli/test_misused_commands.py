"""Whatever somebody gets wrong on a command line is one line and status 2; what the library gets wrong, one and 70."""

from __future__ import annotations

import click
from click.testing import CliRunner

from support.sweeps import together
from torchtransient.cli import main as cli
from torchtransient.errors import SceneError


@together("error, status, words", [
    (PermissionError(13, "Permission denied", "a.h5"), 2, "Permission denied"), (TypeError("a\nb"), 70, "a b"),
    (KeyError("a"), 70, "KeyError"), (RuntimeError("x" * 9000), 70, "a fault of torchtransient"),
    (SceneError("no scene"), 2, "no scene"),
])  # fmt: skip
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
