"""A real scene: light crossing The Wooden Staircase, and what its arrival says about the floor.

Three things, with a picture each: the light on its way (steady picture, time of the peak, moments), the derivative of
the light in a window of time with respect to every texel of the floor's texture, and the texture recovered from a
transient with Adam, starting from a dark even brown.

The scene is "The Wooden Staircase" by Wig42, CC-BY 3.0 (https://benedikt-bitterli.me/resources/), as the archive
`staircase_ccby.tar.gz` with a scene.xml for `transient_path`.

    python training_examples/staircase.py staircase_ccby.tar.gz --output demo_output
"""

from __future__ import annotations

import argparse
import tarfile
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import avg_pool2d, interpolate, smooth_l1_loss
from tqdm import tqdm

import torchtransient as tt

# The scene's camera_unwarp leaves out the way from the camera to what it sees: lengths count from the lamp to there.
AXIS = tt.TimeAxis(start_opl=2.0, bin_width_opl=0.1, num_bins=120)
# The gate of the recovery: the light that comes from the lamp by way of the floor alone.
FLOOR_AXIS = tt.TimeAxis(start_opl=7.0, bin_width_opl=0.1, num_bins=16)
WINDOWS = ((7.0, 7.3), (7.3, 7.6), (7.6, 8.0), (8.0, 10.0))
# Bins of the film, until the light has crossed the floor, and bins of a frame.
FILM_BINS, FRAME_BINS = 75, 3
MOMENTS = (3.0, 4.0, 5.0, 6.0, 7.3, 8.0)
TARGET_SEED = 1_000_003
TEXEL_BLOCK = 15


@dataclass(frozen=True)
class Sizes:
    """Pixels, samples per pixel of the light, of gradients and target, of a step, bounces, steps of the recovery,
    windows of time.
    """

    width: int
    height: int
    spp_light: int
    spp: int
    spp_step: int
    max_depth: int
    steps: int
    windows: int


@dataclass
class Recovery:
    """The floor's texture in blocks: (3, h, w) each, the texels that are seen (h, w), and the error of every step."""

    truth: torch.Tensor
    start: torch.Tensor
    found: torch.Tensor
    seen: torch.Tensor
    errors: list[float]


def unpack(archive: Path, folder: Path) -> Path:
    """Unpack the archive and return the path of its scene file."""
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    found = sorted(folder.rglob("scene.xml"))
    if not found:
        raise FileNotFoundError(
            f"{archive}: expected a scene.xml inside, found none; give the archive of the staircase"
        )
    return found[0]


def floor_key(scene: tt.Scene) -> str:
    """The parameter that holds the pixels of the floor's texture, found by the name of its material."""
    table = scene.parameters()
    keys = [key for key in table.differentiable() if key.startswith("WoodFloor") and key.endswith(".data")]
    if len(keys) != 1:
        raise KeyError(
            f"expected one texture of a material called WoodFloor..., found {keys}; print(scene.parameters())"
        )
    return keys[0]


def window_slice(window: tuple[float, float]) -> slice:
    """The bins between two path lengths in metres."""
    first, last = (round((opl - AXIS.start_opl) / AXIS.bin_width_opl) for opl in window)
    return slice(first, last)


def light_on_its_way(scene: tt.Scene, sizes: Sizes) -> tt.RenderOutput:
    """Light over time, from paths that neighbouring pixels share: the noise of late bins is that of many more paths."""
    plan = tt.plan(
        scene, integrator="transient_path_reuse", time_axis=AXIS, max_depth=sizes.max_depth, temporal_filter="box",
        pilot=False,
    )  # fmt: skip
    with torch.no_grad():
        return plan.renderer(spp=sizes.spp_light)(seed=0, progress=True)


def window_gradients(renderer: tt.TransientRenderer, key: str, sizes: Sizes) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """The texture (H, W, 3), and d(light of the whole picture in a window)/d(texel), summed over channels: (H, W) each.

    The loss is linear in the light, so its derivative does not depend on the render: one sample per pixel is enough
    there, and the samples go into the adjoint pass.
    """
    gradients = []
    for number, window in enumerate(tqdm(WINDOWS[: sizes.windows], desc="staircase: gradients", unit="window")):
        renderer.zero_grad()
        renderer(seed=number).transient[:, window_slice(window)].sum().backward()
        gradients.append(renderer.values[key].grad.sum(dim=-1))
    return renderer.values[key].detach(), gradients


def in_blocks(texture: torch.Tensor) -> torch.Tensor:
    """Means over blocks of TEXEL_BLOCK texels: (H, W, 3) -> (3, h, w)."""
    return avg_pool2d(texture.permute(2, 0, 1)[None], TEXEL_BLOCK, ceil_mode=True)[0]


def recover(scene: tt.Scene, key: str, sizes: Sizes) -> Recovery:
    """Fit the texture to a transient of the true one. Its unknowns are blocks of texels: a small picture shows no more.

    The loss is quadratic for small differences and linear for large ones, so that the few samples that find the lamp
    by way of a glossy surface do not outweigh the rest.
    """
    renderer = tt.TransientRenderer(scene, [key], time_axis=FLOOR_AXIS, spp=sizes.spp_step)
    texture = renderer.values[key].detach().clone()
    with torch.no_grad():
        target = renderer(seed=TARGET_SEED, spp=sizes.spp).transient
    truth = in_blocks(texture)
    start = 0.4 * truth.mean(dim=(1, 2), keepdim=True).expand_as(truth)
    blocks = torch.nn.Parameter(start.clone())
    scale = float(target.mean())

    optimizer = torch.optim.Adam([blocks], lr=0.03, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=max(sizes.steps, 1))
    seen = torch.zeros(truth.shape[1:])
    history = [start]
    for step in tqdm(range(sizes.steps), desc="staircase: recovery", unit="step"):
        optimizer.zero_grad()
        size = texture.shape[:2]
        floor = interpolate(blocks[None], size=size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
        loss = smooth_l1_loss(renderer({key: floor}, seed=step).transient, target, beta=scale)
        loss.backward()
        seen += blocks.grad.abs().sum(dim=0)
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            blocks.clamp_(0.0, 1.0)
        history.append(blocks.detach().clone())
    # Texels that the picture hardly shows have next to no gradient and stay where they started.
    visible = seen > 0.05 * seen.median()
    errors = [float((state - truth).abs()[:, visible].mean()) for state in history]
    return Recovery(truth, start, history[-1], visible, errors)


# ------------------------------------------------------------------------------------------------------- pictures


def tone(light: torch.Tensor, quantile: float = 0.98) -> Any:
    """Light (3, H, W) as a picture (H, W, 3): the given quantile is white, gamma 2.2."""
    white = torch.quantile(light.amax(dim=0).flatten(), quantile).clamp_min(1e-12)
    return ((light / white).clamp(0, 1) ** (1 / 2.2)).permute(1, 2, 0).numpy()


def colours(texture: torch.Tensor) -> Any:
    """A linear texture (3, h, w) as a picture (h, w, 3)."""
    return (texture.clamp(0, 1) ** (1 / 2.2)).permute(1, 2, 0).numpy()


def save(figure: Any, path: Path) -> None:
    """Write a figure with a palette of 256 colours: noise packs badly, and a third of the file is enough."""
    from PIL import Image

    for axes in figure.axes:
        if axes.images:
            axes.set(xticks=[], yticks=[])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    with Image.open(path) as picture:
        packed = picture.convert("RGB").quantize(256)
    packed.save(path, optimize=True)


def draw_light(out: tt.RenderOutput, path: Path) -> None:
    """Steady picture, path length of each pixel's brightest bin, and moments of the light."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 9.4), layout="constrained")
    grid = figure.subplots(2, 4).ravel()
    grid[0].imshow(tone(out.steady))
    grid[0].set_title("steady", fontsize=10)
    brightness = out.transient.sum(dim=0)
    peak = AXIS.start_opl + (brightness.argmax(dim=0) + 0.5) * AXIS.bin_width_opl
    drawn = grid[1].imshow(peak, cmap="turbo", vmin=2.5, vmax=12.0)
    grid[1].set_title("path length of the peak [m]", fontsize=10)
    figure.colorbar(drawn, ax=grid[1], location="bottom", shrink=0.9)
    for axes, opl in zip(grid[2:], MOMENTS, strict=True):
        axes.imshow(tone(out.transient[:, window_slice((opl, opl + 0.2))].sum(dim=1), 0.99), interpolation="nearest")
        axes.set_title(f"{opl:.1f} to {opl + 0.2:.1f} m", fontsize=10)
    save(figure, path)


def film_light(out: tt.RenderOutput, path: Path) -> None:
    """The front of light on its way down the stairs, as a GIF."""
    axis = tt.TimeAxis(AXIS.start_opl, AXIS.bin_width_opl, FILM_BINS)
    tt.vis.video(out.transient[:, :FILM_BINS], path, axis=axis, every=FRAME_BINS, fps=8, scale=2)


def draw_gradients(texture: torch.Tensor, gradients: list[torch.Tensor], path: Path) -> None:
    """The floor's texture and, for every window of time, how much each texel adds to the light in it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.7 * (1 + len(gradients)), 3.3), layout="constrained")
    grid = figure.subplots(1, 1 + len(gradients))
    grid[0].imshow(colours(texture.permute(2, 0, 1)[:, ::3, ::3]))
    grid[0].set_title("texture of the floor", fontsize=10)
    for axes, gradient, window in zip(grid[1:], gradients, WINDOWS[: len(gradients)], strict=True):
        smooth = avg_pool2d(gradient[None, None], 6)[0, 0]
        axes.imshow(smooth, cmap="magma", vmin=0, vmax=float(torch.quantile(smooth, 0.99).clamp_min(1e-12)))
        axes.set_title(f"d light({window[0]:.1f} to {window[1]:.1f} m) / d texel", fontsize=10)
    save(figure, path)


def draw_recovery(result: Recovery, path: Path) -> None:
    """The start, what was found, the truth, and the error over the steps. Texels that are not seen are dimmed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 3.3), layout="constrained")
    grid = figure.subplots(1, 4)
    shade = torch.where(result.seen, 1.0, 0.25)
    for axes, (title, blocks) in zip(
        grid[:3], (("start", result.start), ("recovered", result.found), ("truth", result.truth)), strict=True
    ):
        axes.imshow(colours(blocks * shade), interpolation="nearest")
        axes.set_title(f"{title} (dim: not seen)", fontsize=10)
    grid[3].semilogy(result.errors, color="0.3")
    grid[3].set(xlabel="step", ylabel="mean albedo error")
    save(figure, path)


def main(argv: Sequence[str] | None = None) -> Recovery:
    """Command line. Prints one line with the error of the recovered texture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path, help="staircase_ccby.tar.gz")
    parser.add_argument(
        "--resolution", type=int, default=90, help="width in pixels; the height is 16/9 of it (%(default)s)"
    )
    parser.add_argument(
        "--spp-light", type=int, default=256, help="samples per pixel of the light on its way (%(default)s)"
    )
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel of gradients and target (%(default)s)")
    parser.add_argument("--spp-step", type=int, default=16, help="samples per pixel and step (%(default)s)")
    parser.add_argument(
        "--max-depth", type=int, default=12, help="segments of a path; the scene's own is 65 (%(default)s)"
    )
    parser.add_argument("--steps", type=int, default=40, help="steps of Adam for the texture (%(default)s)")
    parser.add_argument("--windows", type=int, default=len(WINDOWS), help="of time, for gradients (%(default)s)")
    parser.add_argument(
        "--output", type=Path, default=Path("demo_output"), help="folder for the pictures (%(default)s)"
    )
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        # Most of a small run is compiled code: a window more is a kernel more.
        parser.set_defaults(resolution=18, spp_light=8, spp=8, spp_step=4, max_depth=4, steps=1, windows=1)
    options = parser.parse_args(argv)
    height = options.resolution * 16 // 9
    steps = (options.spp_step, options.max_depth, options.steps, options.windows)
    sizes = Sizes(options.resolution, height, options.spp_light, options.spp, *steps)
    with tempfile.TemporaryDirectory() as folder:
        path = unpack(options.archive, Path(folder))
        scene = tt.load(path, "llvm_ad_rgb", resx=sizes.width, resy=sizes.height, max_depth=sizes.max_depth)
        key = floor_key(scene)
        light = light_on_its_way(scene, sizes)
        draw_light(light, options.output / "staircase_light.png")
        film_light(light, options.output / "staircase_light.gif")
        renderer = tt.TransientRenderer(scene, [key], time_axis=AXIS, spp=1, spp_grad=sizes.spp)
        texture, gradients = window_gradients(renderer, key, sizes)
        draw_gradients(texture, gradients, options.output / "staircase_gradient.png")
        result = recover(scene, key, sizes)
    draw_recovery(result, options.output / "staircase_recovery.png")
    print(
        f"staircase: mean albedo error of the visible floor {result.errors[-1]:.4f} after {sizes.steps} steps "
        f"(start {result.errors[0]:.4f}); {options.output / 'staircase_recovery.png'}"
    )
    return result


if __name__ == "__main__":
    main()
