"""The cases of `recompilation.py`, in a process of their own: `python _recompilation_cases.py all|first|again VARIANT`.

Prints one JSON object a line. A case is a function of the settled base that returns the step to look at.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torchtransient as tt  # finds LLVM before Dr.Jit is imported

import drjit as dr  # isort: skip
import torch

ALBEDO, PANEL = "wall.bsdf.reflectance.value", "side.bsdf.reflectance.value"
AXIS = tt.TimeAxis(7.0, 0.1, 32)
SETTLED, MOST_STEPS = 4, 6
Step = Callable[[int], Any]


def described(**options: Any) -> dict[str, Any]:
    settings = {"side_panel": True, "resolution": 8, "num_bins": 32, "start_opl": 7.0, "bin_width_opl": 0.1}
    return tt.scenes.moving_wall(**{**settings, "max_depth": 4, **options})


def textured(resolution: int) -> dict[str, Any]:
    scene = described()
    image = torch.full((resolution, resolution, 1), 0.5).numpy()
    scene["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "data": image, "raw": True}
    return scene


class Base:
    """One scene and renderer, whose steps are launched; no kernels of others are known to the process."""

    def __init__(self, variant: str, steps: int = SETTLED) -> None:
        self.variant = variant
        self.kept: list[Any] = []
        self.scene: Any = tt.load(described(), variant=variant)
        self.renderer: Any = self.another()
        for seed in range(steps):
            self.step(seed)

    def another(self, scene: tt.Scene | None = None, axis: Any = None, **options: Any) -> tt.TransientRenderer:
        settings = {"parameters": [ALBEDO, PANEL], "spp": 4, "physics": "ignore", **options}
        return tt.TransientRenderer(scene or self.scene, time_axis=axis, **settings)

    def instead(self, scene: dict[str, Any], **options: Any) -> tt.TransientRenderer:
        """A renderer of another scene; this one's is gone."""
        self.drop()
        return self.beside(scene, **options)

    def beside(self, scene: dict[str, Any], **options: Any) -> tt.TransientRenderer:
        """A renderer of another scene."""
        return self.another(tt.load(scene, variant=options.pop("variant", self.variant)), **options)

    def step(self, seed: int) -> Any:
        return trained(self.renderer)(seed)

    def drop(self) -> None:
        """Scene, recordings and what they hold."""
        self.scene = self.renderer = None
        self.kept.clear()
        gc.collect()


def trained(renderer: tt.TransientRenderer, values: Any = None, loss: str = "squares", **options: Any) -> Step:
    """Steps of a renderer: (what was said of render and derivative)."""

    def step(seed: int) -> Any:
        renderer.zero_grad()
        out = renderer(values, seed=seed, **options)
        measured = out.transient if out.phasor is None else torch.view_as_real(out.phasor)
        (measured.sum() if loss == "sum" else measured.square().sum()).backward()
        return out.stats

    return step


def rendered(renderer: tt.TransientRenderer) -> Step:
    def step(seed: int) -> Any:
        with torch.no_grad():
            return renderer(seed=seed).stats

    return step


# --------------------------------------------------------------------------------------------------------------- cases


def value(base: Base) -> Step:
    with torch.no_grad():
        base.renderer.values[ALBEDO].mul_(0.9)
    return base.step


def batch(size: int) -> Callable[[Base], Step]:
    return lambda base: trained(base.renderer, {ALBEDO: torch.linspace(0.2, 0.8, size, requires_grad=True)})


def fewer_gradients(base: Base) -> Step:
    renderer = base.another()
    renderer.values[PANEL].requires_grad_(False)
    return trained(renderer)


def settled(renderer: tt.TransientRenderer) -> None:
    for seed in range(SETTLED):
        trained(renderer)(seed)


def texels(base: Base) -> Step:
    """The scene of a texture is launched and dropped, then the same with more texels."""
    key = "wall.bsdf.reflectance.data"
    settled(base.instead(textured(4), parameters=[key]))
    return trained(base.instead(textured(6), parameters=[key]))


def beside(base: Base) -> Step:
    base.kept.append(base.beside(described(side_panel=False), parameters=[ALBEDO]))
    settled(base.kept[-1])
    return base.step


def threads(base: Base) -> Step:
    tt.threads(2)
    return base.step


def frequencies(*values: float) -> Callable[[Base], Step]:
    def case(base: Base) -> Step:
        settled(base.another(frequencies=[0.5, 1.0]))
        return trained(base.another(frequencies=list(values)))

    return case


CASES: dict[str, Callable[[Base], Step]] = {
    "the seed": lambda base: base.step,
    "the value of a parameter": value,
    "no derivative is asked for": lambda base: rendered(base.renderer),
    "a second renderer of the same `tt.Scene` and keys": lambda base: trained(base.another()),
    "`spp_grad` alone": lambda base: trained(base.another(spp_grad=8)),
    "`spp`": lambda base: trained(base.renderer, spp=8),
    "a batch of 2 values": batch(2),
    "`tt.load` again, the first scene gone": lambda base: trained(base.instead(described())),
    "other numbers in the description, the first scene gone": lambda base: trained(
        base.instead(described(panel_reflectance=0.6, intensity=20.0))
    ),
    "`tt.load` again, the first scene still there": lambda base: trained(base.beside(described())),
    "a scene of another structure is used beside it": beside,
    "a value needs no gradient any more": fewer_gradients,
    "other keys": lambda base: trained(base.another(parameters=[ALBEDO])),
    "layout of the adjoint (`sum()`)": lambda base: trained(base.renderer, loss="sum"),
    "start of the time axis": lambda base: trained(base.another(axis=tt.TimeAxis(7.2, 0.1, 32))),
    "number of bins": lambda base: trained(base.another(axis=tt.TimeAxis(7.0, 0.1, 40))),
    "temporal filter": lambda base: trained(base.another(temporal_filter="tent")),
    "frequencies of a phasor film": frequencies(0.6, 1.1),
    "number of frequencies": frequencies(0.5, 1.0, 1.5),
    "`max_depth`": lambda base: trained(base.another(max_depth=3)),
    "threads": threads,
    "resolution, the first scene gone": lambda base: trained(base.instead(described(resolution=12))),
    "texels of a texture, the first scene gone": texels,
    "a shape less, the first scene gone": lambda base: trained(
        base.instead(described(side_panel=False), parameters=[ALBEDO])
    ),
    "variant (`llvm_ad_rgb`)": lambda base: trained(base.beside(described(), variant="llvm_ad_rgb")),
    "`freeze=False`": lambda base: trained(base.another(freeze=False)),
}
FIRST, AGAIN = "a new process, no kernels on the disk", "a new process, kernels on the disk"


def word(said: Sequence[str]) -> str:
    """Of the first entry of a batch that was not launched."""
    words = [how.split(":")[0] for how in said] or ["not asked for"]
    return next((how for how in words if how != "launched"), words[0])


def looked_at(step: Step, name: str) -> dict[str, Any]:
    """Steps until one is launched: verdicts and CPU time of the first, kernels compiled in all."""
    compiled, first = 0, {}
    for number in range(MOST_STEPS):
        dr.kernel_history_clear()
        begin = time.process_time()
        stats = step(1000 + number)
        ms = 1e3 * (time.process_time() - begin)
        compiled += sum(not entry["cache_hit"] for entry in dr.kernel_history() if "cache_hit" in entry)
        render, derivative = word(stats.recorded), word(stats.derivatives_recorded)
        first = first or {"name": name, "render": render, "derivative": derivative, "ms": ms}
        if {render, derivative} <= {"launched", "not asked for"}:
            return first | {"compiled": compiled, "steps": number}
    return first | {"compiled": compiled, "steps": "never"}


def tell(row: dict[str, Any]) -> None:
    print(json.dumps(row), flush=True)


def forget_kernels() -> None:
    """Of earlier cases: those in memory, and those in the folder that is this process's own."""
    gc.collect()
    dr.flush_kernel_cache()
    for file in Path(os.environ["DRJIT_CACHE_DIR"]).rglob("*.bin"):
        file.unlink()


def main() -> None:
    which, variant = sys.argv[1:]
    tt.threads(1)
    # From the beginning: recordings are kept by flags of Dr.Jit, too.
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    if which in ("first", "again"):
        base = Base(variant, steps=0)
        tell(looked_at(base.step, FIRST if which == "first" else AGAIN))
        return
    for name, case in CASES.items():
        base = Base(variant)
        step = case(base)
        tell(looked_at(step, name))
        tt.threads(1)
        del step
        base.drop()
        forget_kernels()


if __name__ == "__main__":
    main()
