"""One variant's part of `gpu_check.py`: renders, gradients, where the tensors live, and times."""

import json
import sys
import time

import torchtransient as tt  # first: it finds LLVM before Dr.Jit is imported

import drjit as dr  # isort: skip
import torch  # isort: skip

ALBEDO, WALL = "red.reflectance.value", "red-wall.to_world"
VARIANT = sys.argv[1]
DEVICE = "cuda" if VARIANT.startswith("cuda") else "cpu"


def synchronise():
    """Wait for both libraries."""
    dr.sync_thread()
    if DEVICE == "cuda":
        torch.cuda.synchronize()


def box(resolution, bins, spp):
    """A renderer of the Cornell box with two parameters on the variant's device."""
    scene = tt.load(tt.scenes.cornell_box(resolution, num_bins=bins, bin_width_opl=6.0 / bins), variant=VARIANT)
    return tt.TransientRenderer(scene, parameters=[ALBEDO, WALL], spp=spp, temporal_filter="tent").to(DEVICE)


def gradients(renderer, seed):
    """Gradients of a time-resolved loss with both signs."""
    renderer.zero_grad()
    out = renderer(seed=seed)
    weight = torch.sin(3.0 * torch.arange(out.transient.shape[1], device=DEVICE) * out.axis.bin_width_opl)
    (out.transient * weight[:, None, None]).sum().backward()
    return out, {key: parameter.grad.detach().clone() for key, parameter in renderer.values.items()}


def main():
    small = box(16, 60, 256)
    steady, transient, albedo, wall = [], [], [], []
    for seed in range(8):
        out, found = gradients(small, seed)
        steady.append(out.steady.mean(dim=(1, 2)).tolist())
        transient.append(out.transient.sum(dim=(0, 2, 3)).tolist())
        albedo.append(found[ALBEDO].flatten().tolist())
        wall.append(found[WALL].flatten().tolist())
    result = {
        "steady": steady,
        "transient": transient,
        "gradient albedo": albedo,
        "gradient wall": wall,
        "tensor on the GPU": out.transient.device.type == DEVICE,
        # a view of (H, W, T, C) memory: channels lie side by side
        "tensor is the film's memory": out.transient.stride()[0] == 1,
        "parameter on the GPU": all(p.device.type == DEVICE for p in small.parameters()),
        "gradient on the GPU": all(p.grad.device.type == DEVICE for p in small.parameters()),
        "gpu": torch.cuda.get_device_name() if DEVICE == "cuda" else None,
        "forward": [],
        "backward": [],
    }
    large = box(16, 30, 4) if "--quick" in sys.argv else box(256, 300, 64)
    for seed in range(7):
        for what, job in (("forward", lambda s: large(seed=s)), ("backward", lambda s: gradients(large, s))):
            synchronise()
            begin = time.perf_counter()
            with torch.set_grad_enabled(what == "backward"):
                kept = job(seed)
            synchronise()
            if seed >= 2:
                result[what].append(time.perf_counter() - begin)
            del kept
    print("RESULT " + json.dumps(result))


if __name__ == "__main__":
    main()
