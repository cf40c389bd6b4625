"""What a call of `tt.wrap` and its derivative cost beside `dr.wrap` on the same function, in CPU seconds of one thread.

`numbers`: squares of 3, 1000 and a million numbers, which is what either way of crossing costs. `render`: `mi.render`
of a transient film of 4 x 3 pixels and 24 bins, 16 samples, with a colour that the function writes into the scene; `by
key`: the same with `parameters`. `layer`: the same step of `tt.TransientRenderer`, which launches recorded calls.
`render, 64^2`: with 64 x 64 pixels, where kernels take longer than crossings. A step is a call, a sum and its backward.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from _runner import arguments, environment, interleave, ratio, report, summary

import torchtransient as tt  # isort: skip

import drjit as dr
import mitsuba as mi
import torch

from tools.small_room import COLOUR, make_room

START = [0.8, 0.5, 0.2]


def room(resolution: int | None) -> dict[str, Any]:
    description = make_room()
    if resolution:
        description["sensor"]["film"] |= {"width": resolution, "height": resolution}
    return description


def for_mitsuba(description: dict[str, Any]) -> dict[str, Any]:
    """With Mitsuba's transforms for arrays."""
    taken = {key: for_mitsuba(value) if isinstance(value, dict) else value for key, value in description.items()}
    return taken | {key: mi.ScalarTransform4f(taken[key]) for key in taken if key == "to_world"}


def squares(x: Any) -> Any:
    return x * x


def writing(resolution: int | None) -> Callable[..., Any]:
    """A function that writes the colour into a scene of its own."""
    scene = mi.load_dict(for_mitsuba(room(resolution)))
    params = mi.traverse(scene)

    def render(x: Any, seed: int) -> Any:
        params[COLOUR] = dr.unravel(mi.Color3f, x.array)
        params.update()
        return mi.render(scene, params, spp=16, seed=seed)[1]

    return render


def by_key(resolution: int | None) -> Callable[..., Any]:
    scene = mi.load_dict(for_mitsuba(room(resolution)))
    wrapped = tt.wrap(lambda params, seed: mi.render(scene, params, spp=16, seed=seed)[1], mi.traverse(scene))
    return lambda x, seed: wrapped({COLOUR: x}, seed)


def layer(resolution: int | None) -> Callable[..., Any]:
    renderer = tt.TransientRenderer(room(resolution), parameters=[COLOUR], spp=16)
    return lambda x, seed: renderer({COLOUR: x}, seed=seed).transient


def timed(function: Callable[..., Any], x: torch.Tensor, count: int, *, step: bool) -> Callable[[int], float]:
    """CPU seconds of one call, or of one step."""

    def run(seed: int) -> float:
        begin = time.process_time()
        for n in range(count):
            out = function(x, seed * count + n)
            if step:
                out.sum().backward()
                x.grad = None
        return (time.process_time() - begin) / count

    return run


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    repeats = options.repeats or (2 if options.quick else 11)
    tt.threads(1)
    mi.set_variant(options.variant)
    count = 2 if options.quick else 20
    drjit, ours = dr.wrap(source="torch", target="drjit"), tt.wrap
    cases, ratios = {}, []

    def compare(name: str, sides: dict[str, Callable[..., Any]], x: torch.Tensor, count: int) -> None:
        for what, step in (("call", False), ("step", True)):
            runs = {f"{name}, {what}: {side}": timed(f, x, count, step=step) for side, f in sides.items()}
            seconds = interleave(runs, repeats)
            cases.update({key: summary(values) for key, values in seconds.items()})
            anchor, *others = seconds
            ratios.extend(ratio(seconds, other, anchor) for other in others)

    for size in (3, 1000, 1_000_000):
        x = torch.rand(size, requires_grad=True)
        sides = {"dr.wrap": drjit(squares), "tt.wrap": ours(squares)}
        compare(f"{size} numbers", {k: lambda x, _, f=f: f(x) for k, f in sides.items()}, x, count)
    for resolution in (None,) if options.quick else (None, 64):
        x = torch.tensor(START, requires_grad=True)
        sides = {"dr.wrap": drjit(writing(resolution)), "tt.wrap": ours(writing(resolution))}
        sides |= {"tt.wrap by key": by_key(resolution), "layer": layer(resolution)}
        compare(f"render {resolution or '4 x 3'}", sides, x, max(1, count // 4))
    results = {"cases": cases, "ratios": ratios, "environment": environment(options.variant)}
    report("wrap_cost", {"repeats": repeats, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
