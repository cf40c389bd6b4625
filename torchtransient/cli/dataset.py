"""`torchtransient dataset recipe.yaml --out DIR`"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

INTERRUPTED, FAULTY = 130, 1
PATH = click.Path(path_type=Path)


class GeneratesByDefault(click.Group):
    """Group whose first argument, unless it names a subcommand, is a recipe to generate from."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read `FILE --out DIR` as `generate FILE --out DIR`."""
        if args and args[0] not in {*self.commands, *ctx.help_option_names}:
            args = ["generate", *args]
        return super().parse_args(ctx, args)


@click.group(cls=GeneratesByDefault, invoke_without_command=False)
def command() -> None:
    """Make data sets of recipes, check them, look at them.

    `torchtransient dataset recipe.yaml --out DIR --n 10000` is short for `dataset generate ...`.
    """


def _share(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    part, sign, parts = value.partition("/")
    if not (sign and part.isdigit() and parts.isdigit() and int(part) < int(parts)):
        raise click.BadParameter(f"expected I/K with I from 0 to K - 1, as 0/4, got '{value}'", ctx, param)
    return int(part), int(parts)


@command.command()
@click.argument("recipe", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the data set.")
@click.option("--n", type=click.IntRange(min=1), help="How many samples.  [default: the recipe's]")
@click.option("--workers", type=click.IntRange(min=1), default=2, show_default=True, help="Processes, a thread each.")
@click.option("--store", type=click.Choice(["exact", "rounded", "counts"]), default="exact", show_default=True)
@click.option("--compression", type=click.Choice(["blosc2", "gzip", "none"]), default="blosc2", show_default=True)
@click.option("--shard", metavar="I/K", callback=_share, help="Every K-th file from the I-th on: K machines share.")
@click.option("--per-shard", type=click.IntRange(min=1), help="Samples in a file.  [default: 64 to 256 MB]")
@click.option("--timeout", "timeout_s", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS",
              help="A sample may take.  [default: 30 times the slowest]")  # fmt: skip
@click.option("--retries", type=click.IntRange(min=0), default=2, show_default=True, help="Of a sample that fails.")
@click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True)
@click.option("--address", help="Of a cluster of Ray.")
@click.option("--no-resume", is_flag=True, help="An error where the folder has a data set.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def generate(recipe: Path, out: Path, **options: Any) -> None:
    """Make the data set of RECIPE, a YAML file. After Ctrl-C or a kill the same command goes on.

    The folder holds shard-*.h5, manifest.json, recipe.json, log.jsonl (what happened) and latest.png (the last sample).
    Samples that fail are named in their files with the reason.
    """
    from torchtransient.data import generate as make

    resume, quiet = not options.pop("no_resume"), options.pop("quiet")
    try:
        done = make(read_recipe(recipe), out, resume=resume, progress=not quiet, **options)
    except KeyboardInterrupt:
        click.echo(f"stopped; what is finished is kept in {out}: the same command goes on", err=True)
        sys.exit(INTERRUPTED)
    click.echo(str(done))


@command.command()
@click.argument("folder", type=PATH)
@click.option("--quiet", is_flag=True, help="No progress bar.")
def verify(folder: Path, quiet: bool) -> None:
    """Compare every byte of the data set in FOLDER with its checksums. Status 1 where something is wrong or missing."""
    from torchtransient.data import verify as check
    from torchtransient.data.run_settings import RECIPE_FILE
    from torchtransient.errors import StorageError

    found = check(folder, progress=not quiet)
    if not found.shards and not (folder / RECIPE_FILE).exists():
        raise StorageError(f"data set: '{folder}' holds no shard and no {RECIPE_FILE}: expected the folder of one.")
    click.echo(str(found))
    if not found.complete:
        sys.exit(FAULTY)
    click.echo("complete, every byte as it was written")


@command.command()
@click.argument("folder", type=PATH)
def info(folder: Path) -> None:
    """Say what the data set in FOLDER holds."""
    from torchtransient.data.overview import summary

    click.echo(summary(folder))


@command.command()
@click.argument("folder", type=PATH)
@click.option("-o", "--out", type=PATH, help="Picture, .png or .pdf.  [default: FOLDER/samples.png]")
@click.option("--count", type=click.IntRange(min=1), default=16, show_default=True, help="How many.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Which ones are drawn.")
def show(folder: Path, out: Path | None, count: int, seed: int) -> None:
    """Draw samples of the data set in FOLDER."""
    from torchtransient.data.overview import drawn_sheet

    target = out or folder / "samples.png"
    drawn = drawn_sheet(folder, target, count, seed)
    click.echo(f"{target}: samples {', '.join(map(str, drawn))}")


@command.command()
@click.argument("recipe", type=PATH)
@click.option("-o", "--out", type=PATH, help="Picture, .png or .pdf.  [default: RECIPE.png]")
@click.option("--count", type=click.IntRange(min=1), default=16, show_default=True, help="How many.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def preview(recipe: Path, out: Path | None, count: int, quiet: bool) -> None:
    """Render the first samples of RECIPE and draw them."""
    target = out or recipe.with_suffix(".png")
    read_recipe(recipe).preview(count, target, progress=not quiet)
    click.echo(f"{target}: samples 0 to {count - 1}")


@command.command()
@click.argument("recipe", type=PATH)
@click.option("--samples", type=click.IntRange(min=1), default=5, show_default=True, help="Rendered of each structure.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def cost(recipe: Path, samples: int, quiet: bool) -> None:
    """Say what a sample of RECIPE takes.

    Seconds of one thread, bytes, light outside the window, standard error; measured on some samples.
    """
    click.echo(str(read_recipe(recipe).cost(samples, progress=not quiet)))


@command.command()
@click.argument("folder", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder to write to.")
@click.option("--format", "kind", type=click.Choice(["webdataset", "tal"]), default="webdataset", show_default=True)
@click.option("--quiet", is_flag=True, help="No progress bar.")
def export(folder: Path, out: Path, kind: str, quiet: bool) -> None:
    """Write the data set in FOLDER for other programs: tar files of WebDataset, or, of captures around a corner, a file
    of y-tal for each.
    """
    from torchtransient.data import export_tal, export_web_dataset
    from torchtransient.errors import StorageError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"--out: the folder '{out}' cannot be made: {error}.") from error
    written = (export_tal if kind == "tal" else export_web_dataset)(folder, out, progress=not quiet)
    click.echo(f"{out}: {len(written)} files")


def read_recipe(path: Path) -> Any:
    """Return the recipe of a file.

    Args:
        path: the file.
    """
    from torchtransient.data import Recipe

    return Recipe.read(path)
