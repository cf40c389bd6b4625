"""Training steps on demand in a process of its own; driven by `step_cost.py` through one JSON object per line.

Run as `python _step_worker.py SIDE VARIANT` with SIDE `torchtransient` (the package on PYTHONPATH) or `mitsuba` (its
own integrators, without torch). Requests:
  {"do": "load", "name", "scene", "keys", "frequencies", "tent", "freeze", "gradient"} -> {"ok": true}
  {"do": "step", "name", "seed", "count"}      `count` steps               -> {"seconds" of one, "recorded"}
  {"do": "kernels", "name", "seed", "count"}   the same with their kernels -> {"steps": [...]}
  {"do": "torch", "name", "seed", "count"}     losses without renders      -> {"seconds" of one}
  {"do": "threads", "count"}                   torch's and Dr.Jit's        -> {"ok": true}
A step is a render, and with "gradient" the sum of squares of what it measured and its derivative. Scenes: as in
`_worker.py`. "freeze": null for a package that does not know it.
"""

import json
import os
import sys
import time

# Answers go to the original stdout; whatever a library prints goes to stderr.
ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

import torchtransient as tt  # noqa: E402  (finds LLVM before Dr.Jit is imported)

import drjit as dr  # noqa: E402  isort: skip
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402


def decoded(node, matrix):
    """A scene with `matrix` of its matrices."""
    if isinstance(node, dict):
        if set(node) == {"matrix"}:
            return matrix(np.array(node["matrix"]))
        return {key: decoded(value, matrix) for key, value in node.items()}
    return node


class Layer:
    """Steps of the torch layer."""

    def __init__(self, request, variant, scenes):
        # Renderers of one scene share it: kernels are compiled for all scenes that are alive.
        name = json.dumps(request["scene"], sort_keys=True)
        if name not in scenes:
            scenes[name] = tt.load(decoded(request["scene"], lambda matrix: matrix), variant=variant)
        options = {} if request["freeze"] is None else {"freeze": request["freeze"]}
        if request["frequencies"]:
            options["frequencies"] = request["frequencies"]
        if request["tent"]:
            options["temporal_filter"] = "tent"
        self.gradient = request["gradient"]
        self.renderer = tt.TransientRenderer(
            scenes[name], parameters=request["keys"], spp=1, physics="ignore", **options
        )
        self.measured = None

    def loss(self, measured):
        return torch.view_as_real(measured).square().sum() if measured.is_complex() else measured.square().sum()

    def step(self, seed):
        self.renderer.zero_grad()
        with torch.set_grad_enabled(self.gradient):
            out = self.renderer(seed=seed)
        measured = out.transient if out.phasor is None else out.phasor
        if self.gradient:
            self.loss(measured).backward()
        self.measured = measured.detach()
        stats = out.stats
        return [*getattr(stats, "recorded", ()), *getattr(stats, "derivatives_recorded", ())]

    def torch_alone(self, seed):
        """Loss and adjoint of a result of the same layout."""
        if self.gradient:
            leaf = self.measured.detach().requires_grad_()
            self.loss(leaf).backward()


class Plain:
    """The same of Mitsuba's own integrator, steady."""

    def __init__(self, request, variant, scenes):
        self.scene = mi.load_dict(decoded(request["scene"], mi.ScalarTransform4f))
        self.parameters = mi.traverse(self.scene)
        (self.key,) = request["keys"]
        self.start = type(self.parameters[self.key])(self.parameters[self.key])
        dr.eval(self.start)
        self.gradient = request["gradient"]

    def step(self, seed):
        leaf = type(self.start)(self.start)
        if self.gradient:
            dr.enable_grad(leaf)
        self.parameters[self.key] = leaf
        self.parameters.update()
        image = mi.render(self.scene, self.parameters, spp=1, seed=seed, seed_grad=seed + 2**20)
        if self.gradient:
            dr.backward(dr.sum(dr.square(image), axis=None))
            dr.eval(image, dr.grad(leaf))
        else:
            dr.eval(image)
        dr.sync_thread()
        return []

    def torch_alone(self, seed):
        raise NotImplementedError("no torch here")


def timed(run, seed, count):
    """Mean seconds of one of `count` runs, and what the last one returned."""
    begin = time.perf_counter()
    for i in range(count):
        said = run(seed * count + i)
    return (time.perf_counter() - begin) / count, said


def with_kernels(job, seed, count):
    """Of each of `count` steps: seconds, launches, kernels compiled, seconds of compiling, seconds of running."""
    steps = []
    for i in range(count):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            seconds, said = timed(job.step, seed + i, 1)
            history = dr.kernel_history()
        made = [entry for entry in history if "cache_hit" in entry and not entry["cache_hit"]]
        steps.append({
            "seconds": seconds,
            "launches": len(history),
            "compiled": len(made),
            "compile_seconds": 1e-3 * sum(entry["codegen_time"] + entry["backend_time"] for entry in made),
            "kernel_seconds": 1e-3 * sum(entry.get("execution_time", 0.0) for entry in history),
            "recorded": said,
        })  # fmt: skip
    return steps


def answer_to(request, jobs, kind, variant, scenes):
    match request["do"]:
        case "load":
            jobs[request["name"]] = kind(request, variant, scenes)
            return {"ok": True}
        case "threads":
            # As `tt.threads` does, which older commits lack.
            dr.set_thread_count(request["count"])
            torch.set_num_threads(request["count"])
            return {"ok": True}
        case "step":
            seconds, said = timed(jobs[request["name"]].step, request["seed"], request["count"])
            return {"seconds": seconds, "recorded": said}
        case "kernels":
            return {"steps": with_kernels(jobs[request["name"]], request["seed"], request["count"])}
        case "torch":
            return {"seconds": timed(jobs[request["name"]].torch_alone, request["seed"], request["count"])[0]}
    raise ValueError(f"unknown request {request['do']!r}")


def main():
    side, variant = sys.argv[1:3]
    kind, jobs, scenes = {"torchtransient": Layer, "mitsuba": Plain}[side], {}, {}
    if side == "mitsuba":
        mi.set_variant(variant)
    package = os.path.dirname(tt.__file__)
    print(json.dumps({"mitsuba": mi.__version__, "drjit": dr.__version__, "package": package}), file=ANSWERS)
    for line in sys.stdin:
        # An error ends the process: its trace is on stderr, and the driver stops at the missing answer.
        print(json.dumps(answer_to(json.loads(line), jobs, kind, variant, scenes)), file=ANSWERS)


if __name__ == "__main__":
    main()
