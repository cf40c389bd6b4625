"""Renders on demand in a process of its own; driven by `_runner.Worker` through one JSON object per line.

Run as `python _worker.py LIBRARY VARIANT` with LIBRARY `torchtransient`, `mitransient` or `mitsuba`. It imports only
the named library, so that each side of a comparison runs in its own environment. Requests:
  {"do": "load", "name", "scene", "gradients": [keys], "shifts": {key: [x, y, z]}}           -> {"ok": true}
  {"do": "render", "name", "spp", "seed"}                                 -> {"seconds", "cpu_seconds", "mean"}
  {"do": "save", "name", "spp", "seed", "file"}   render, and write the transient as .npy -> the same
  {"do": "backward", "name", "spp", "seed"}   render, then render_backward              -> {"seconds", "gradients"}
  {"do": "first", "what": "render" or "backward", "name", "spp", "seed"}   with its kernels -> {"seconds", "kernels"}
  {"do": "memory"}                                                                     -> {"peak_bytes"}
A scene is a Mitsuba dictionary with {"matrix": 4x4} for transforms, or {"xml": path, "parameters": {...}}.
"""

import json
import os
import resource
import sys
import time

# Answers go to the original stdout; whatever a library prints goes to stderr.
ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

if sys.argv[1] == "torchtransient":
    import torchtransient  # noqa: F401  (finds LLVM before Dr.Jit is imported)

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402


def start(library, variant):
    """Set the variant and register the library's plugins."""
    mi.set_variant(variant)
    if library == "torchtransient":
        from torchtransient import plugins

        plugins.sync()
    elif library == "mitransient":
        import mitransient  # noqa: F401


def decoded(node):
    """Matrices back to Mitsuba transforms."""
    if isinstance(node, dict):
        if set(node) == {"matrix"}:
            return mi.ScalarTransform4f(np.array(node["matrix"]))
        return {key: decoded(value) for key, value in node.items()}
    return node


class Job:
    """A loaded scene and the parameters whose gradients are asked for."""

    def __init__(self, request):
        scene = request["scene"]
        if "xml" in scene:
            parameters = {key: str(value) for key, value in scene.get("parameters", {}).items()}
            self.scene = mi.load_file(scene["xml"], **parameters)
        else:
            self.scene = mi.load_dict(decoded(scene))
        self.integrator = self.scene.integrator()
        self.gradients = request.get("gradients", [])
        self.shifts = request.get("shifts", {})
        self.adjoint = None
        self.parameters = mi.traverse(self.scene) if self.gradients or self.shifts else None
        self.initial = {}
        for key in [*self.gradients, *self.shifts]:
            value = self.parameters[key]
            self.initial[key] = type(value)(value)
        dr.eval(self.initial)

    def render(self, spp, seed, file=None):
        """Seconds of one render, everything evaluated; the mean of the result as a check."""
        begin, cpu = time.perf_counter(), time.process_time()
        images = self.integrator.render(self.scene, sensor=0, seed=seed, spp=spp)
        dr.eval(images)
        dr.sync_thread()
        seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
        image = images[0] if isinstance(images, tuple) else images
        if file is not None:
            np.save(file, np.array(images[1]))
        return {"seconds": seconds, "cpu_seconds": cpu, "mean": float(np.array(image, dtype=np.float64).mean())}

    def backward(self, spp, seed):
        """Seconds of attaching the parameters, rendering, and the backward pass down to the leaves."""
        begin = time.perf_counter()
        leaves = self.attach()
        images = self.integrator.render(self.scene, sensor=0, seed=seed, spp=spp)
        if self.adjoint is None:
            self.adjoint = tuple(pattern(image) for image in images)
        self.integrator.render_backward(self.scene, self.parameters, self.adjoint, sensor=0, seed=seed + 1, spp=spp)
        for key in self.shifts:
            dr.enqueue(dr.ADMode.Backward, self.parameters[key])
        if self.shifts:
            dr.traverse(dr.ADMode.Backward)
        found = {key: dr.grad(leaf) for key, leaf in leaves.items()}
        dr.eval(images, found)
        dr.sync_thread()
        seconds = time.perf_counter() - begin
        gradients = {key: np.array(value, dtype=np.float64).ravel().tolist() for key, value in found.items()}
        return {"seconds": seconds, "gradients": gradients}

    def first(self, what, spp, seed):
        """A render or backward pass with the kernels that it launched, each once."""
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            answer = getattr(self, what)(spp, seed)
            history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
        return {"seconds": answer["seconds"], "kernels": kernels_of(history)}

    def attach(self):
        """Fresh leaves: the value itself, or how far a transform is shifted along its direction."""
        leaves = {}
        for key in self.gradients:
            leaf = type(self.initial[key])(self.initial[key])
            dr.enable_grad(leaf)
            self.parameters[key] = leaf
            leaves[key] = leaf
        for key, direction in self.shifts.items():
            shift = mi.Float(0)
            dr.enable_grad(shift)
            self.parameters[key] = mi.Transform4f().translate(mi.Vector3f(direction) * shift) @ self.initial[key]
            leaves[key] = shift
        self.parameters.update()
        return leaves


def pattern(image):
    """An adjoint with both signs, different from bin to bin."""
    size = int(np.prod(image.shape))
    return mi.TensorXf(dr.sin(dr.arange(mi.Float, size) * 0.01) / size, image.shape)


def kernels_of(history):
    """Hash, sizes, seconds of code generation and compilation, and launches of every kernel, in the order of launch."""
    kernels = {}
    for entry in history:
        ir = entry["ir"] if isinstance(entry["ir"], str) else entry["ir"].getvalue()
        kernel = {
            "hash": str(entry["hash"]),
            "operations": entry["operation_count"],
            "ir_bytes": len(ir),
            "compile_seconds": 1e-3 * (entry["codegen_time"] + entry["backend_time"]),
            "launches": 0,
        }
        kernels.setdefault(kernel["hash"], kernel)["launches"] += 1
    return list(kernels.values())


def answer_to(request, jobs):
    """Carry out one request."""
    match request["do"]:
        case "load":
            jobs[request["name"]] = Job(request)
            return {"ok": True}
        case "render":
            return jobs[request["name"]].render(request["spp"], request["seed"])
        case "save":
            return jobs[request["name"]].render(request["spp"], request["seed"], request["file"])
        case "backward":
            return jobs[request["name"]].backward(request["spp"], request["seed"])
        case "first":
            return jobs[request["name"]].first(request["what"], request["spp"], request["seed"])
        case "memory":
            return {"peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024}
    raise ValueError(f"unknown request {request['do']!r}")


def main():
    library, variant = sys.argv[1:3]
    jobs = {}
    start(library, variant)
    versions = {"python": sys.version.split()[0], "mitsuba": mi.__version__, "drjit": dr.__version__}
    package = os.path.dirname(sys.modules[library].__file__)
    print(json.dumps({**versions, "package": package}), file=ANSWERS)
    for line in sys.stdin:
        # An error ends the process: its trace is on stderr, and the driver stops at the missing answer.
        print(json.dumps(answer_to(json.loads(line), jobs)), file=ANSWERS)


if __name__ == "__main__":
    main()
