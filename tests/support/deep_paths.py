"""A furnace whose paths have 20 000 bounces: its gradient needs a record that is larger than the stack of a thread."""

from __future__ import annotations

import sys

import torchtransient as tt


def furnace(variant):
    """Radiance and its derivative by the reflectance 0.999 of a closed sphere that emits 1."""
    light = {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}
    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.999}}
    film = {"type": "transient_hdr_film", "width": 1, "height": 1, "temporal_bins": 1, "bin_width_opl": 1e6}
    scene = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 20_000, "rr_depth": 10**6},
        "sensor": {"type": "perspective", "film": film},
        "ball": {"type": "sphere", "flip_normals": True, "emitter": light, "bsdf": grey},
    }
    key = "ball.bsdf.reflectance.value"
    renderer = tt.TransientRenderer(tt.load(scene, variant=variant), [key], spp=64)
    out = renderer(seed=0)
    out.steady.mean().backward()
    return out.steady.mean().item(), renderer.values[key].grad.sum().item()


if __name__ == "__main__":
    print(*furnace(sys.argv[1]))
