"""Messages of the library in the words of the command line: options instead of arguments and calls."""

from __future__ import annotations

import re
from collections.abc import Sequence

from torchtransient.cli.films import OPTIONS

_WORDS = {
    "print(scene.parameters()) lists all keys": "`torchtransient render SCENE --list-parameters` lists all keys",
    "tt.plan(scene) finds a window": "`torchtransient plan SCENE` finds a window",
    " RenderOutput.stats has the energies.": "",
    ", by a sigmoid or, after each step, by torch.no_grad() and x.clamp_(0, 1)": "",
    "tt.plan: outputs are some of": "--outputs takes some of",
    "error='relative'": "--error relative",
    "tt.plan: ": "",
    "tt.load: ": "",
    "temporal_filter: ": "--temporal-filter: ",
    "sensors: the scene has": "--sensor: the scene has",
    "neither the film nor the call has": "neither the film of the scene nor the command line has",
}


def in_options(message: str) -> str:
    """The message without Python in it."""
    for kind, flags in OPTIONS.items():
        message = message.replace(f"Give {kind.example}", f"Give {', '.join(flags)}")
    for python, option in _WORDS.items():
        message = message.replace(python, option)
    return message


# Calls and classes of reconstruction, after arguments have become options.
_RECONSTRUCTION = {
    " to read_capture": "",
    "reconstruct: ": "",
    "DiffusionDeconvolution: ": "--slab: ",
    "method '": "--method '",
    "VoxelGrid.before: ": "",
    "Give extent=(width, height) in metres": "Give --extent WIDTH,HEIGHT in metres",
    "Use Backprojection, which takes any points.": "Take --method bp or fbp.",
    "expected size= for a list of points": "expected --voxels for a list of points",
    "Crop the capture.": "Give --record.",
}


def arguments_as_options(message: str, names: Sequence[str]) -> str:
    """The message with ``name=`` as ``--name`` for these arguments, and without calls of reconstruction."""
    for name in names:
        option = f"--{name.replace('_', '-')}"
        # With a value behind it, or as a name alone.
        message = re.sub(rf"\b{name}=(?=['\"\w])", f"{option} ", message)
        message = re.sub(rf"\b{name}=", option, message)
    for python, option in _RECONSTRUCTION.items():
        message = message.replace(python, option)
    return message
