"""Light travelling through a bottle: a laser pulse in water with a little milk, frame by frame.

The scene of the first films of light in flight (Velten et al. 2013): a bottle of rough glass filled with diluted milk,
a laser that shines up from its base. Writes a video, eight moments, and the picture of when each pixel is brightest.

    python training_examples/bottle.py --output demo_output
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import torch

import torchtransient as tt

AXIS = tt.TimeAxis(start_opl=0.0, bin_width_opl=0.005, num_bins=100)


def bottle(folder: Path, height: int, spp: int, max_depth: int) -> tt.Scene:
    """The scene, `height` pixels high; its mesh is written to `folder`."""
    size = (height * 5 // 8, height)
    scene = tt.scenes.milk_bottle(folder / "bottle.ply", resolution=size, spp=spp, max_depth=max_depth)
    return tt.load(scene, variant="llvm_ad_rgb")


def film(scene: tt.Scene, spp: int, folder: Path) -> tt.RenderOutput:
    """Render the pulse and write video and pictures."""
    with torch.no_grad():
        out = tt.TransientRenderer(scene, time_axis=AXIS, spp=spp)(seed=0, progress=True)
    tt.vis.video(out, folder / "bottle.mp4", fps=20, progress=True)
    tt.vis.frame_grid(out, folder / "bottle_frames.png", count=8, columns=4, title="a pulse in diluted milk")
    tt.vis.peak_time_picture(out, folder / "bottle_peak.png", title="when each pixel is brightest")
    return out


def speed_of_rise(out: tt.RenderOutput) -> float:
    """Speed of the pulse up the bottle over the speed of light in vacuum: mean height of the light against time.

    A straight line by least squares over the times when the pulse is in the body of the bottle. Water of index 1.33
    slows light to 0.75; the way out of the bottle is the same at every height.
    """
    rows = out.transient.sum(dim=(0, 3)).double()
    pixels = rows.shape[1]
    # The camera sees 20 degrees over the width, which is 5/8 of the height, from 0.626 m.
    row_metres = 2 * 0.626 * math.tan(math.radians(10)) / (pixels * 5 // 8)
    height = -row_metres * (rows * torch.arange(pixels)).sum(1) / rows.sum(1).clamp_min(1e-12)
    inside = (AXIS.centers_opl > 0.1) & (AXIS.centers_opl < 0.2)
    opl, height = AXIS.centers_opl[inside], height[inside]
    opl, height = opl - opl.mean(), height - height.mean()
    return float((opl * height).sum() / opl.square().sum())


def main(argv: Sequence[str] | None = None) -> tt.RenderOutput:
    """Command line. Prints one line with what was written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=int, default=160, help="pixels of the video (%(default)s)")
    parser.add_argument("--spp", type=int, default=8192, help="samples per pixel (%(default)s)")
    parser.add_argument("--max-depth", type=int, default=24, help="vertices of a path (%(default)s)")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder (%(default)s)")
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(height=24, spp=64, max_depth=8)
    options = parser.parse_args(argv)
    options.output.mkdir(parents=True, exist_ok=True)
    out = film(bottle(options.output, options.height, options.spp, options.max_depth), options.spp, options.output)
    print(
        f"bottle: the pulse rises at {speed_of_rise(out):.2f} of the speed of light in vacuum; "
        f"{options.output / 'bottle.mp4'}, {options.output / 'bottle_frames.png'}"
    )
    return out


if __name__ == "__main__":
    main()
