"""Pages of `tt.vis.view`: time to write, size, first frame, frames a second; the server with a cube of 4 GB.

    python benchmarks/view_page.py [--pixels 256 --bins 400 --spp 64] [--server-gb 4] [--folder FOLDER]

The render is a Cornell box in colour. Frames are counted in headless Chromium without a GPU, screen 1280 x 800: each
one is drawn before the next is asked for. The cube of the server is written to FOLDER and removed afterwards.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import torch

import torchtransient as tt

SWITCHES = (
    "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip
FRAMES = """async (count) => {
  const page = window.torchtransient, bins = document.getElementById("meta") && JSON.parse(
    document.getElementById("meta").textContent).shape[0], start = performance.now();
  for (let k = 0; k < count; k++) {
    await page.go((page.state.t + 1) % bins);
    await new Promise(requestAnimationFrame);
  }
  return 1000 * count / (performance.now() - start);
}"""


def opened(browser, address, repeats=3):
    """A page that shows its first frame, and the seconds until then, the middle one of some openings."""
    seconds = []
    for _ in range(repeats):
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(address)
        page.wait_for_function("window.torchtransient && window.torchtransient.ready", timeout=60_000)
        seconds.append(page.evaluate("torchtransient.readyAfter") / 1000)
        if len(seconds) < repeats:
            page.close()
    return page, sorted(seconds)[repeats // 2]


def frames(page, repeats=3, count=60):
    """Frames a second, the middle one of some runs."""
    return sorted(page.evaluate(FRAMES, count) for _ in range(repeats))[repeats // 2]


def measure_page(browser, folder, pixels, bins, spp):
    box = tt.scenes.cornell_box(
        resolution=pixels, max_depth=6, num_bins=bins, start_opl=3.5, bin_width_opl=8.0 / bins
    )
    scene = tt.load(box, variant="llvm_ad_rgb")
    with torch.no_grad():
        out = tt.render(scene, spp=spp, seed=1)
    out = out.map(torch.Tensor.contiguous)
    path = folder / "page.html"
    wall, cpu = time.perf_counter(), time.process_time()
    made = tt.vis.view(out, path)
    found = {"write_s": time.perf_counter() - wall, "write_cpu_s": time.process_time() - cpu}
    found |= {"megabytes": path.stat().st_size / 1e6, "notes": made.notes}
    page, found["first_frame_s"] = opened(browser, path.as_uri())
    found["frames_per_s"] = {}
    for mode in ("colour", "light", "rainbow"):
        page.evaluate(f"Bokeh.documents[0].get_model_by_name('mode').value = '{mode}'")
        page.wait_for_timeout(1500)
        found["frames_per_s"][mode] = frames(page)
    page.evaluate("Bokeh.documents[0].get_model_by_name('mode').value = 'light'")
    page.evaluate("Bokeh.documents[0].get_model_by_name('accumulate').active = true")
    page.wait_for_timeout(2500)
    found["frames_per_s"]["accumulated"] = frames(page)
    page.close()
    return found


def measure_server(browser, folder, gigabytes):
    side, bins = 1000, max(1, round(gigabytes * 250))
    path = folder / "large.h5"
    rows, columns = np.mgrid[:side, :side].astype(np.float32)
    away = np.hypot(rows - side / 2, columns - side / 2)
    with h5py.File(path, "w") as file:
        cube = file.create_dataset("transient", (1, bins, side, side), "f4")
        file.attrs.update(start_opl=1.0, bin_width_opl=0.01, num_bins=bins)
        for t in range(bins):
            cube[0, t] = np.exp(-(((away - 0.7 * t) / 20) ** 2)) + 1e-4
    start = time.perf_counter()
    server = subprocess.Popen(
        [sys.executable, "-u", "-m", "torchtransient", "view", str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        address = server.stdout.readline().strip()
        found = {"gigabytes": path.stat().st_size / 1e9, "until_address_s": time.perf_counter() - start}
        page, found["first_frame_s"] = opened(browser, address)
        found["frames_per_s"] = frames(page)
        page.close()
        return found
    finally:
        server.terminate()
        server.wait()
        path.unlink()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=256)
    parser.add_argument("--bins", type=int, default=400)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--server-gb", type=float, default=4.0, help="0 leaves the server out")
    parser.add_argument("--folder", type=Path, default=None)
    arguments = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        sys.exit("Chromium is needed: apt-get install -y chromium")
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory(dir=arguments.folder) as name, sync_playwright() as play:
        folder = Path(name)
        browser = play.chromium.launch(executable_path=chromium, args=list(SWITCHES))
        found = {"page": measure_page(browser, folder, arguments.pixels, arguments.bins, arguments.spp)}
        if arguments.server_gb:
            found["server"] = measure_server(browser, folder, arguments.server_gb)
        browser.close()
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
