"""Runs the peer in a process of its own, in the environment that TORCHTRANSIENT_PEER_PYTHON names."""

import importlib.util
import os
import pickle
import subprocess
import sys
from pathlib import Path

import torchtransient  # noqa: F401  # isort: skip  (finds LLVM before Dr.Jit is imported, for child processes too)

import mitsuba as mi
import numpy as np
import pytest


@pytest.fixture(name="peer_python")
def _peer_python():
    return peer_python()


def peer_python():
    """The interpreter that has mitransient: the one that is named, or this one."""
    named = os.environ.get("TORCHTRANSIENT_PEER_PYTHON")
    if named:
        return named
    if importlib.util.find_spec("mitransient") is None:
        pytest.fail(
            "the tests marked 'peer' need mitransient 1.3.1: install the extra 'peer' here, or set "
            "TORCHTRANSIENT_PEER_PYTHON to the python of an environment that has it",
            pytrace=False,
        )
    return sys.executable


@pytest.fixture
def peer(tmp_path):
    """`peer(scene, seeds, spp)` -> the peer's steady (K, H, W, C) and transient (K, H, W, T, C), float64.

    `peer.frequencies` are those of the last render's phasor film, as the peer stores them.
    """

    def render(scene, seeds, spp, variant="llvm_ad_rgb"):
        request, result = tmp_path / "request.pickle", tmp_path / "result.npz"
        request.write_bytes(pickle.dumps({"variant": variant, "scene": scene, "seeds": list(seeds), "spp": spp}))
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        script = Path(__file__).with_name("peer_render.py")
        done = subprocess.run(
            [peer_python(), script, request, result], env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        with np.load(result) as data:
            assert str(data["version"]).startswith("1.3"), f"compared with 1.3.1, found {data['version']}"
            render.frequencies = data["frequencies"]
            return data["steady"].astype(np.float64), data["transient"].astype(np.float64)

    return render


def build(node):
    """Arrays become Mitsuba transforms."""
    if isinstance(node, np.ndarray):
        return mi.ScalarTransform4f(node)
    return {key: build(value) for key, value in node.items()} if isinstance(node, dict) else node


@pytest.fixture
def ours():
    """`ours(scene, seeds, spp)` -> steady (K, H, W, C), transient (K, H, W, T, C), float64; `ours.film` is the last."""

    def render(description, seeds, spp):
        scene = mi.load_dict(build(description))
        images = [scene.integrator().render(scene, seed=seed, spp=spp) for seed in seeds]
        render.film = scene.sensors()[0].film()
        return tuple(np.stack([np.array(pair[i], dtype=np.float64) for pair in images]) for i in range(2))

    return render
