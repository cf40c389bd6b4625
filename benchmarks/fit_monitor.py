"""What `tt.vis.FitMonitor` adds to a training step, in CPU seconds of one thread, loops with and without it in turns.

`page`: losses, parameters, light and noise of gradients, for a page at the end. `log`: a TensorBoard log too, where the
package is installed. Looks and figures take no more than 1 % of the time each, by their schedule. `without`: the step
over itself without the time inside of `FitMonitor.step`, which steps of some milliseconds need to tell costs from
noise. Fits of the Cornell box, from small to large films, nine albedos.
"""

from __future__ import annotations

import importlib.util
import tempfile
import time
from collections.abc import Callable
from typing import Any

import torch
from _runner import arguments, environment, interleave, ratio, report, summary

import torchtransient as tt

KEYS = [f"{paint}.reflectance.value" for paint in ("white", "red", "green")]


def loop(
    resolution: int, spp: int, steps: int, variant: str, settings: dict[str, Any] | None, inside: list[float]
) -> Callable[[int], float]:
    """CPU seconds of one step, in a loop that goes on from call to call; `inside` gets those of the monitor."""
    bins = {"start_opl": 3.6, "bin_width_opl": 0.08, "num_bins": 80, "max_depth": 6}
    box = tt.scenes.cornell_box(resolution, **bins)
    renderer = tt.TransientRenderer(tt.load(box, variant=variant), KEYS, spp=spp, physics="ignore")
    with torch.no_grad():
        target = renderer(seed=1_000_003, spp=4 * spp)
    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-3)
    monitor, number = None, 0
    if settings is not None:
        pixels = [(resolution // 2, resolution // 3), (resolution // 4, resolution // 2)]
        monitor = tt.vis.FitMonitor(renderer, target=target, pixels=pixels, **settings)

    def run(_: int) -> float:
        nonlocal number
        begin, spent = time.process_time(), 0.0
        for _ in range(steps):
            optimizer.zero_grad()
            out = renderer(seed=number)
            loss = (out.transient - target.transient).square().mean()
            loss.backward()
            optimizer.step()
            if monitor is not None:
                entered = time.process_time()
                monitor.step(loss=loss, output=out)
                spent += time.process_time() - entered
            number += 1
        inside.append(spent / steps)
        return (time.process_time() - begin) / steps

    return run


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    repeats = options.repeats or (2 if options.quick else 15)
    tt.threads(1)
    torch.set_num_threads(1)
    cases, ratios = {}, []
    with tempfile.TemporaryDirectory() as folder:
        sides: dict[str, dict[str, Any] | None] = {"plain": None, "page": {}}
        if importlib.util.find_spec("tensorboard"):
            sides["log"] = {"log_dir": folder}
        for resolution, spp in ((8, 4),) if options.quick else ((8, 4), (32, 16), (96, 16)):
            steps = 10 if options.quick else {8: 100, 32: 20, 96: 10}[resolution]
            name = f"{resolution} x {resolution} x 80, {spp} samples"
            inside: dict[str, list[float]] = {f"{name}: {side}": [] for side in sides}
            runs = {
                key: loop(resolution, spp, steps, options.variant, given, inside[key])
                for key, given in zip(inside, sides.values(), strict=True)
            }
            seconds = interleave(runs, repeats)
            cases.update({key: summary(values) for key, values in seconds.items()})
            anchor, *others = list(seconds)
            for key in others:
                ratios.append(ratio(seconds, key, anchor))
                pairs = zip(seconds[key], inside[key][-repeats:], strict=True)  # the first are those of the warm-up
                seconds[f"{key}, without"] = [whole - part for whole, part in pairs]
                ratios.append(ratio(seconds, key, f"{key}, without", 1.02))
    results = {"cases": cases, "ratios": ratios, "environment": environment(options.variant)}
    report("fit_monitor", {"repeats": repeats, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
