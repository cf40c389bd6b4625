"""The command `torchtransient`: its subcommands, and how errors leave it.

An error that the library raises on purpose, or that the system does, is one line on stderr and exit status 2; any
other is a fault of the library, one line and status 70. With `--debug` both are tracebacks.
Commands are imported when they are called, so that `torchtransient --help` needs no torch.
"""

from __future__ import annotations

import functools
import importlib
import sys
import warnings
from typing import Any

import click

from torchtransient import __version__
from torchtransient.errors import TorchTransientError, TorchTransientWarning

# In the order of the help text: name of the command (and of its module), what the help says about it.
COMMANDS = {
    "doctor": "Check that this machine can render, and say what to install.",
    "plan": "Say what a render of a scene needs, and why.",
    "render": "Render a scene file to HDF5 or npz, with pictures and video.",
    "view": "Show results, captures and volumes in a browser.",
    "video": "Write the light in flight of a result as .mp4 or .gif.",
    "picture": "Draw a result: peak time, rainbow, streak, frames, polarization, ...",
    "nlos": "Simulate a capture around a corner, going on where it was stopped.",
    "reconstruct": "Find what a capture around a corner has seen, and draw it.",
    "cost": "Measure what accuracy costs in time on a scene.",
    "dataset": "Make a data set of a recipe, going on where it was stopped; check it, show it.",
    "demo": "Render the Cornell box, fit a colour to it, write pictures.",
}

# Letters of a fault that are shown.
_FAULT = 300


class Commands(click.Group):
    """Group that imports a command when it is used, and turns the library's errors into messages."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return names in the order of COMMANDS."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a name, from the module of that name."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"torchtransient.cli.{cmd_name}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands, without importing any."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an error of the library ends the process with status 2, a warning is a line on stderr."""
        try:
            with warnings.catch_warnings():
                show = warnings.showwarning
                warnings.showwarning = functools.partial(_show_warning, show)
                return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise  # which click handles
        except Exception as error:
            if ctx.params.get("debug"):
                raise
            match error:
                case TorchTransientError():
                    said, status = _in_options(error), 2
                case OSError():
                    said, status = f"{error}.", 2
                case _:
                    fault = " ".join(f"{type(error).__name__}: {error}".split())[:_FAULT]
                    said, status = f"a fault of torchtransient, not of yours: {fault} (--debug shows where).", 70
            click.echo(f"error: {' '.join(said.split())}", err=True)
            sys.exit(status)


def _in_options(message: Any) -> str:
    # Where the library could not be imported, its films are not known, and its message is as it is.
    from torchtransient.cli.options import in_options

    return in_options(str(message))


def _show_warning(otherwise: Any, message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
    if issubclass(category, TorchTransientWarning):
        click.echo(f"warning: {_in_options(message)}", err=True)
    else:
        otherwise(message, category, *where, **more)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
@click.version_option(__version__, prog_name="torchtransient")
def main(debug: bool) -> None:
    """Time-resolved light transport as differentiable PyTorch tensors."""


if __name__ == "__main__":
    main()
