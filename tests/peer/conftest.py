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


def python_of(variable, module, version):
    """The interpreter that has a peer: the one that is named, or this one."""
    named = os.environ.get(variable)
    if not named and importlib.util.find_spec(module) is None:
        pytest.fail(
            f"these tests need {version}: install the extra 'peer' here, or set {variable} to the python of an "
            "environment that has it", pytrace=False,
        )  # fmt: skip
    return named or sys.executable


@pytest.fixture
def peer_python():
    return python_of("TORCHTRANSIENT_PEER_PYTHON", "mitransient", "mitransient 1.3.1")


@pytest.fixture(scope="session")
def tal_python():
    return python_of("TORCHTRANSIENT_TAL_PYTHON", "tal", "y-tal 0.20")


@pytest.fixture
def peer(peer_python, tmp_path):
    """`peer(scene, seeds, spp)` -> the peer's steady (K, H, W, C) and transient (K, H, W, T, C), float64.

    `peer.frequencies` are those of the last render's phasor film, as the peer stores them.
    """

    def render(scene, seeds, spp, variant="llvm_ad_rgb"):
        request, result = tmp_path / "request.pickle", tmp_path / "result.npz"
        request.write_bytes(pickle.dumps({"variant": variant, "scene": scene, "seeds": list(seeds), "spp": spp}))
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        script = Path(__file__).with_name("peer_render.py")
        done = subprocess.run(
            [peer_python, script, request, result], env=environment, capture_output=True, text=True, check=False
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
