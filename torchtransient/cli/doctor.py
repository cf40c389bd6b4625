"""`torchtransient doctor`: is everything there that a render needs?"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import signal
import subprocess
import sys
from dataclasses import dataclass

import click

# A process of its own: a bad LLVM or driver may end it, and that is what has to be found out.
_RENDER = """
import sys
import torch
import torchtransient as tt
scene = tt.load(tt.scenes.cornell_box(resolution=8, num_bins=16, bin_width_opl=0.4), variant=sys.argv[1])
renderer = tt.TransientRenderer(scene, parameters=["red.reflectance.value"], spp=4)
output = renderer(seed=0)
output.transient.sum().backward()
energy, slope = float(output.transient.sum()), float(renderer.values["red.reflectance.value"].grad.sum())
if not (energy > 0 and slope > 0):
    raise SystemExit(f"the image sums to {energy}, its derivative to {slope}")
"""
_PLAIN = "import drjit; print('.'.join(str(n) for n in drjit.detail.llvm_version()))"
_TIMEOUT_S = 300


@dataclass(frozen=True)
class Finding:
    """One line of the report: `state` is "ok", "problem" or "note"."""

    state: str
    subject: str
    text: str


def versions() -> list[Finding]:
    """Return findings about Python and the packages; a missing or mismatched one is a problem, an optional one a
    note.
    """
    python = platform.python_version()
    good = sys.version_info >= (3, 11)
    found = [Finding("ok" if good else "problem", "python", python if good else f"{python}; 3.11 or newer is needed")]
    for name in ("torchtransient", "torch", "mitsuba", "drjit", "numpy", "kornia", "click", "tqdm"):
        version = _version(name)
        found.append(_judged(name, version) if version else Finding("problem", name, f"missing: pip install {name}"))
    optional = (("matplotlib", "vis", "pictures"), ("bokeh", "view", "pages"), ("h5py", "data", "HDF5 files"))
    for name, extra, purpose in optional:
        version = _version(name)
        missing = f"not installed; {purpose} need it: pip install 'torchtransient[{extra}]'"
        found.append(Finding("ok", name, version) if version else Finding("note", name, missing))
    return found


def _judged(name: str, version: str) -> Finding:
    """Return a finding about a package that is there, by the versions that were tested."""
    try:
        from torchtransient.plugins._registry import untested
    except ImportError as error:  # what the package needs is missing, and stands in a line of its own
        return Finding("ok", name, f"{version} (not compared with the tested versions: {error})")
    message = untested(name, version)
    return Finding("ok", name, version) if message is None else Finding("note", name, message)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        if name == "torchtransient":  # run from a checkout that is not installed
            from torchtransient import __version__

            return __version__
        return None


def llvm() -> list[Finding]:
    """Return findings about the LLVM of this process, and of programs that import Mitsuba without this library."""
    from torchtransient import _llvm
    from torchtransient.errors import VariantError

    try:
        library = _llvm.ensure_llvm()
    except VariantError as error:
        return [Finding("problem", "LLVM", str(error))]
    found = [Finding("ok", "LLVM", str(library))]
    environment = {k: v for k, v in os.environ.items() if k != _llvm.VARIABLE}
    if _llvm.users_choice():
        environment[_llvm.VARIABLE] = str(_llvm.users_choice())
    code, out, _ = _run([sys.executable, "-c", _PLAIN], environment)
    major = int(out.split(".")[0]) if code == 0 and out.split(".")[0].lstrip("-").isdigit() else -1
    if major < _llvm.MIN_MAJOR:
        gets = f"LLVM {out}" if major > 0 else "no LLVM"
        said = (
            f"a program that imports drjit or mitsuba before torchtransient gets {gets}. Import torchtransient first, "
            f"or set {_llvm.VARIABLE}={library.path}"
        )
        found.append(Finding("note", "LLVM", said))
    return found


def variants(llvm_is_good: bool) -> list[Finding]:
    """Return findings about the variants of Mitsuba, one of each kind rendered and differentiated.

    Args:
        llvm_is_good: try an LLVM variant.
    """
    import mitsuba as mi

    found = [Finding("ok", "variants", " ".join(mi.variants()))]
    if llvm_is_good:
        found.append(probe("llvm_ad_rgb"))
    else:
        found.append(Finding("note", "llvm_ad_rgb", "not tried, since no usable LLVM was found"))
    return found + cuda()


def cuda() -> list[Finding]:
    """Return findings about the GPU, as Dr.Jit and torch see it. A missing one is a note: the llvm variants do
    without.
    """
    import drjit as dr
    import torch

    if not dr.has_backend(dr.JitBackend.CUDA):
        return [
            Finding("note", "cuda_ad_rgb", "no NVIDIA driver that Dr.Jit can use: only the llvm variants work here")
        ]
    if not torch.cuda.is_available():
        text = f"Dr.Jit sees a GPU and torch {torch.__version__} does not: cuda variants need a torch built for CUDA"
        return [Finding("note", "cuda_ad_rgb", text)]
    device = f"{torch.cuda.get_device_name(0)}, torch built for CUDA {torch.version.cuda}"
    return [Finding("ok", "CUDA", device), probe("cuda_ad_rgb")]


def probe(variant: str) -> Finding:
    """Return the finding of a small scene that is rendered and differentiated in a process of its own.

    Args:
        variant: variant of Mitsuba.
    """
    code, _, errors = _run([sys.executable, "-c", _RENDER, variant], dict(os.environ))
    if code == 0:
        return Finding("ok", variant, "renders and differentiates")
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        reason = f"the process was ended by {name}"
    else:
        reason = "failed"
    last = errors.strip().splitlines()[-1] if errors.strip() else "no message"
    return Finding("problem", variant, f"{reason}: {last}")


def _run(command: list[str], environment: dict[str, str]) -> tuple[int, str, str]:
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIMEOUT_S, env=environment, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, "", f"no answer within {_TIMEOUT_S} s"
    return result.returncode, result.stdout.strip(), result.stderr


@click.command()
def command() -> None:
    """Check that this machine can render, and say what to install. Exit status 1 when something is missing."""
    found = versions()
    _show(found)
    libraries = llvm()
    _show(libraries)
    rest = variants(all(f.state != "problem" for f in libraries))
    _show(rest)
    problems = sum(f.state == "problem" for f in found + libraries + rest)
    if problems:
        click.echo(f"\n{problems} problem{'s' if problems > 1 else ''} found.", err=True)
        raise SystemExit(1)
    click.echo("\nEverything that rendering needs is there.")


def _show(findings: list[Finding]) -> None:
    colours = {"ok": "green", "note": "yellow", "problem": "red"}
    for finding in findings:
        mark = click.style(f"{finding.state:<8}", colours[finding.state])
        click.echo(f"{mark} {finding.subject:<15} {finding.text}")
