"""Renders with mitransient in its own environment: `python peer_render.py REQUEST.pickle RESULT.npz`.

The request holds `variant`, `scene` (a dictionary with (4, 4) arrays as transforms), `seeds` and `spp`. The result
holds `steady` (K, H, W, C) and `transient` (K, H, W, T, C) for the K seeds, of a phasor film (K, H, W, F, 2) and its
`frequencies` (F,), and the peer's `version`.
"""

import pickle
import sys

import mitsuba as mi
import numpy as np


def decoded(node):
    """Arrays become Mitsuba transforms."""
    if isinstance(node, np.ndarray):
        return mi.ScalarTransform4f(node)
    return {key: decoded(value) for key, value in node.items()} if isinstance(node, dict) else node


def main():
    with open(sys.argv[1], "rb") as file:
        request = pickle.load(file)
    mi.set_variant(request["variant"])
    import mitransient

    scene = mi.load_dict(decoded(request["scene"]))
    images = [scene.integrator().render(scene, seed=seed, spp=request["spp"]) for seed in request["seeds"]]
    steady, transient = (np.stack([np.array(pair[i]) for pair in images]) for i in range(2))
    frequencies = np.ravel(np.array(getattr(scene.sensors()[0].film(), "frequencies", [])))
    np.savez(
        sys.argv[2], steady=steady, transient=transient, frequencies=frequencies, version=mitransient.__version__
    )


if __name__ == "__main__":
    main()
