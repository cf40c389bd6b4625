"""Render and draw the figures of docs/pictures.md: `python docs/make_pictures.py [PART ...]`, 20 minutes on two cores.

Everything is a render, of a Cornell box or of two balls; nothing is drawn by hand.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

import torchtransient as tt
from torchtransient.scenes import look_at, scale, translate
from torchtransient.vis.files import enlarge, save_image, to_palette

OUT = Path(__file__).parent / "images" / "pictures"
AXIS = {"num_bins": 200, "start_opl": 3.6, "bin_width_opl": 0.03}


def surfaces() -> None:
    """Pictures of intensity over time."""
    description = tt.scenes.cornell_box(resolution=128, mirror=True, **AXIS)
    # Neighbouring pixels share late light, of which independent paths see a few bright samples.
    description["integrator"]["type"] = "transient_path_reuse"
    with torch.no_grad():
        out = tt.render(tt.load(description, "llvm_ad_rgb"), spp=16384, seed=0, progress=True)
    tt.vis.peak_time_picture(out, OUT / "peak_time.png")
    styles = [
        tt.vis.rainbow(out),
        tt.vis.rainbow(out, style="fusion"),
        tt.vis.rainbow(out, period_opl=0.5),
    ]
    gap = np.full((128, 3, 3), 255, np.uint8)
    row = np.concatenate([styles[0], gap, styles[1], gap, styles[2]], axis=1)
    save_image(enlarge(row, 2), OUT / "rainbow.png", "make_pictures")
    tt.vis.streak(out, OUT / "streak.png", row=84)
    figure = tt.vis.frame_grid(out, count=8)
    figure.savefig(OUT / "frames.png", dpi=90)
    to_palette(OUT / "frames.png")
    tt.vis.histogram(out, OUT / "histogram.png", pixels=[(52, 84), (110, 40)], log=True)
    small = torch.nn.functional.avg_pool2d(out.transient.transpose(0, 1), 2).transpose(0, 1)
    tt.vis.video(small, OUT / "light.gif", axis=out.axis, scale=4, every=5, fps=10)


def polarization() -> None:
    """A ball of plastic and one of metal on a plastic floor, under a uniform sky that is not polarized."""
    camera = look_at([0.0, -4.0, 1.6], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0])
    film = {"type": "transient_hdr_film", "width": 128, "height": 96, "rfilter": {"type": "box"}, "temporal_bins": 64}
    plastic = {"type": "pplastic", "diffuse_reflectance": 0.05, "alpha": 0.05}
    description = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 36.0, "to_world": camera, "film": {**film, "bin_width_opl": 1.0}},
        "sky": {"type": "constant"},
        "floor": {"type": "rectangle", "to_world": scale(4.0), "bsdf": plastic},
        "plastic": {"type": "sphere", "center": [-0.6, 0.0, 0.5], "radius": 0.5, "bsdf": plastic},
        "metal": {
            "type": "sphere",
            "center": [0.6, 0.0, 0.5],
            "radius": 0.5,
            "bsdf": {"type": "roughconductor", "material": "Cr", "alpha": 0.05},
        },
    }
    with torch.no_grad():
        out = tt.render(tt.load(description, "llvm_ad_mono_polarized"), spp=512, seed=0)
    tt.vis.polarization_picture(out, OUT / "polarization.png")


def phasors() -> None:
    """Waves of modulated light."""
    scene = tt.load(tt.scenes.cornell_box(resolution=96, **AXIS), "llvm_ad_mono")
    axis = tt.FrequencyAxis((0.5, 2.0))
    with torch.no_grad():
        out = tt.render(scene, spp=4096, seed=0, frequencies=axis)
    tt.vis.phasor_picture(out, OUT / "phasors.png", which=(0, 1), show=("real", "phase", "domain"))
    to_palette(OUT / "phasors.png")


def gradients() -> None:
    """What the picture of all times, and that of one moment, does when the back wall moves away."""
    key = "back.to_world"
    scene = tt.load(tt.scenes.cornell_box(resolution=96, max_depth=4, **AXIS), "llvm_ad_mono")
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=4096)
    start = renderer.values[key].detach()
    away = torch.as_tensor(translate([0.0, 0.0, -1.0]), dtype=torch.float32)
    direction = (away - torch.eye(4)) @ start

    def render(to_world: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = renderer({key: to_world}, seed=0)
        return out.steady, out.transient

    _, (steady, transient) = torch.func.jvp(render, (start,), (direction,))
    moment = renderer.axis.bin_index(6.3).item()
    name = f"between {renderer.axis.edges_opl[moment]:.2f} m and {renderer.axis.edges_opl[moment + 4]:.2f} m"
    pictures = {"gradient_steady.png": ("of all times", steady)}
    pictures["gradient_moment.png"] = (name, transient[:, moment : moment + 4].sum(1))
    for file, (title, values) in pictures.items():
        figure = tt.vis.gradient_picture(values, title=title, label="radiance per metre")
        figure.savefig(OUT / file, dpi=80)


def page() -> None:
    """A page with the light of a box, as Chromium shows it."""
    from playwright.sync_api import sync_playwright

    box = tt.scenes.cornell_box(resolution=128, mirror=True, sampler="multijitter", **AXIS)
    with torch.no_grad():
        out = tt.render(tt.load(box, "llvm_ad_rgb"), spp=512, seed=0, errors=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        file = Path(folder) / "page.html"
        tt.vis.view(out, file, title="Cornell box with a mirror")
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        shown = browser.new_page(viewport={"width": 1280, "height": 640})
        shown.goto(file.as_uri())
        shown.wait_for_function("window.torchtransient && window.torchtransient.ready")
        shown.evaluate("torchtransient.state.pixels = []")
        shown.evaluate("torchtransient.tap(84.5, 52.5), torchtransient.tap(40.5, 110.5)")
        shown.evaluate("torchtransient.go(92)")
        shown.wait_for_timeout(1000)
        shown.screenshot(path=OUT / "page.png")
        browser.close()
    to_palette(OUT / "page.png")


def fit() -> None:
    """The figure of a fit: nine albedos of the Cornell box."""
    keys = [f"{paint}.reflectance.value" for paint in ("white", "red", "green")]
    box = tt.scenes.cornell_box(64, start_opl=4.2, bin_width_opl=0.04, num_bins=150, max_depth=8)
    scene = tt.load(box, "llvm_ad_rgb")
    with torch.no_grad():
        truth = tt.TransientRenderer(scene, keys)
        target = truth(seed=1_000_003, spp=1024)
    renderer = tt.TransientRenderer(scene, {key: torch.full((3,), 0.5) for key in keys}, spp=32)
    values = {key: value.detach() for key, value in truth.values.items()}
    monitor = tt.vis.FitMonitor(renderer, target=target, pixels=[(24, 8), (24, 32)], truth=values, every=2)
    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.05, betas=(0.8, 0.95))
    weight = 1 / (target.steady + target.steady.mean()).square()[:, None]
    for step in range(41):
        optimizer.zero_grad()
        out = renderer(seed=step)
        loss = (weight * (out.transient - target.transient).square()).mean()
        loss.backward()
        monitor.step(loss, out)
        optimizer.step()
        with torch.no_grad():
            for value in renderer.parameters():
                value.clamp_(0.001, 0.999)
    monitor.figure().savefig(OUT / "fit.png", dpi=85)
    to_palette(OUT / "fit.png")


PARTS = {part.__name__: part for part in (surfaces, polarization, phasors, gradients, fit, page)}

if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or PARTS:
        part = PARTS[name]
        print(part.__name__, flush=True)
        part()
    sizes = {path.name: path.stat().st_size for path in sorted(OUT.iterdir())}
    print(*(f"{name}: {size / 1e3:.0f} kB" for name, size in sizes.items()), sep="\n")
    print(f"together {sum(sizes.values()) / 1e6:.2f} MB")
