"""`torchtransient demo`: from a rendered transient back to the colour of a wall."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import torch

KEY = "red.reflectance.value"
CHANNELS = ("red", "green", "blue")
_TITLE = (
    "Light in flight: a lamp at the ceiling flashes once, and the slider follows its light through the box in steps of "
    "0.2 ns. Press play, click the walls, and see at their histograms when light reaches them directly and by bounces."
)


def fit_colour(
    renderer: Any, target: torch.Tensor, steps: int, look: Callable[[torch.Tensor, Any], None]
) -> list[float]:
    """Fit the colour of the wall with Adam, from the transient alone.

    Few samples per pixel make single bins noisy, so averages over 8 x 8 pixels and 2 bins are compared, each relative
    to its own size (the pixels that see the lamp would outweigh all others).

    Args:
        renderer: a TransientRenderer whose only parameter is KEY, at its start value.
        target: transient (C, T, H, W) that is aimed at.
        steps: number of steps of Adam.
        look: function that is called with loss and output of every step.

    Returns:
        The colour that was found.
    """
    import torch
    from tqdm import tqdm

    # Little momentum: with the usual 0.9, thirty steps are spent on overshooting.
    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.06, betas=(0.5, 0.9))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    colour = renderer.values[KEY]
    wanted = _averages(target)
    weight = 1 / (wanted + wanted.mean()).square()
    with tqdm(range(steps), desc="fit", unit="step") as bar:
        for step in bar:
            optimizer.zero_grad()
            out = renderer(seed=step)
            loss = (weight * (_averages(out.transient) - wanted).square()).mean()
            loss.backward()  # type: ignore[no-untyped-call]
            look(loss, out)
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                colour.clamp_(0.0, 1.0)
            bar.set_postfix(loss=f"{loss.item():.2e}")
    found: list[float] = colour.tolist()
    return found


def _averages(transient: torch.Tensor) -> torch.Tensor:
    import torch

    return torch.nn.functional.avg_pool3d(transient, (2, 8, 8))


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("demo_output"), show_default=True)
@click.option("--resolution", type=click.IntRange(8, 1024), default=64, show_default=True, help="Pixels a side.")
@click.option("--spp", type=click.IntRange(1), default=32, show_default=True, help="Samples per pixel of a step.")
@click.option("--steps", type=click.IntRange(1), default=30, show_default=True, help="Steps of Adam.")
def command(output: Path, resolution: int, spp: int, steps: int) -> None:
    """Render light in flight as a page for the browser, then find the colour of a wall from it, from grey."""
    import torch

    import torchtransient as tt
    from torchtransient.errors import StorageError
    from torchtransient.files.result_file import write_result
    from torchtransient.scene.variant import DEFAULT_VARIANT
    from torchtransient.vis.fit_monitor import FitMonitor
    from torchtransient.vis.pages.layout import import_bokeh
    from torchtransient.vis.pages.page import view
    from torchtransient.vis.pictures import plot_overview

    import_bokeh()  # missing packages before the work
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"demo: the folder '{output}' cannot be made: {error}. Choose another with -o.") from error
    bins = 100
    box = tt.scenes.cornell_box(resolution=resolution, max_depth=6, num_bins=bins, start_opl=3.5, bin_width_opl=0.06)
    scene = tt.load(box, variant=DEFAULT_VARIANT)  # it is about colours
    click.echo(f"Rendering the Cornell box: {resolution} x {resolution} pixels, {bins} bins.")
    with torch.no_grad():
        truth = tt.render(scene, spp=16 * spp, seed=10_000, progress=True, errors=True)
    assert truth.transient is not None and truth.axis is not None  # the film of the box is a histogram
    truth_colour = scene.parameters()[KEY].value
    write_result(output / "cornell_box.npz", truth, {"scene": "cornell_box"})
    plot_overview(truth.transient, truth.steady, truth.axis, path=output / "cornell_box.png", title="Cornell box")

    page = output / "light_in_flight.html"
    view(truth, page, title=_TITLE)
    click.echo(f"Light in flight, open it in a browser: {page.resolve().as_uri()}")

    click.echo("Fitting the colour of the red wall to this transient, from grey.")
    grey = [0.4, 0.4, 0.4]
    renderer = tt.TransientRenderer(scene, parameters={KEY: grey}, spp=spp)
    place = resolution // 2
    monitor = FitMonitor(
        renderer, target=truth, pixels=[(place, place // 4), (place, place)], truth={KEY: truth_colour}, every=1
    )
    found = fit_colour(renderer, truth.transient, steps, monitor.step)
    for name in ("fit.png", "fit.html"):
        monitor.save(output / name)
    click.echo(f"{'':>8}  {'start':>7} {'found':>7} {'truth':>7}")
    for n, name in enumerate(CHANNELS):
        click.echo(f"{name:>8}  {grey[n]:7.4f} {found[n]:7.4f} {float(truth_colour[n]):7.4f}")
    click.echo(f"\nWritten to {output.resolve()}:")
    for name, meaning in (
        ("light_in_flight.html", "light in flight, for the browser"),
        ("cornell_box.png", "overview of the transient"),
        ("fit.png", "the fit"),
        ("fit.html", "the fit step by step, for a browser"),
        ("cornell_box.npz", "the transient itself"),
    ):
        click.echo(f"  {name:<20} {meaning}")
