"""`torchtransient view result.h5`"""

from __future__ import annotations

import time
from pathlib import Path

import click

# Light beyond it is read bin by bin by a server.
_PAGE_BYTES = 600_000_000


@click.command()
@click.argument("results", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="The page.  [default: RESULT.html, A-B.html of two]"
)
@click.option("--megabytes", type=click.FloatRange(min=2), default=20.0, show_default=True, help="Size of the page.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of the server for large files.  [default: any]")
@click.option("--server", "served", is_flag=True, help="Read an HDF5 result as it is looked at, whatever its size.")
@click.option("--open", "opens", is_flag=True, help="Show it in the browser.")
def command(
    results: tuple[Path, ...], output: Path | None, megabytes: float, port: int, served: bool, opens: bool
) -> None:
    """Show RESULTS, one file of a render, a capture or a volume, or two of a kind beside each other, in a browser.

    Writes one HTML page that needs no server and no network. Light of more than 600 MB in an HDF5 file is shown by a
    server on this machine until Ctrl-C, unless -o names a page, which is then binned.
    """
    import webbrowser

    from torchtransient.vis.pages.server import cube_bytes, serving

    if len(results) > 2:
        raise click.UsageError(f"expected one file or two, got {len(results)}.")
    if served and (output is not None or len(results) == 2):
        raise click.UsageError("--server shows one file, and writes no page.")
    if served or (output is None and len(results) == 1 and cube_bytes(results[0]) > _PAGE_BYTES):
        with serving(results[0], results[0].name, port) as (server, address):
            click.echo(f"{address}\n{results[0]} is read as it is looked at. Ctrl-C ends this.")
            if opens:
                webbrowser.open(address)
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                click.echo("ended.")
        return
    from torchtransient.vis.pages.page import view  # which takes longer to import than a server to start

    started = time.monotonic()
    named = results[0].with_name("-".join(result.stem for result in results) + ".html")
    target = named if output is None else output
    title = " | ".join(result.name for result in results)
    page = view(results[0] if len(results) == 1 else results, target, title=title, max_megabytes=megabytes)
    click.echo(f"{target}: {len(page.html) / 1e6:.1f} MB in {time.monotonic() - started:.1f} s")
    for note in page.notes:
        click.echo(f"  {note}")
    click.echo(f"Open it in a browser: {target.resolve().as_uri()}")
    if opens:
        webbrowser.open(target.resolve().as_uri())
