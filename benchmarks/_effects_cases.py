"""The cases of `effects.py`: one entry per effect, and the process that runs one of them.

To add an effect, add a line to `CASES`. A case that this installation cannot run (a plugin that is not registered, an
argument that the renderer does not take) is reported as such; any other error ends the benchmark.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

SceneDict = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One way to render the Cornell box.

    `change`: makes the scene from the plain one. `settings`: makes the arguments of the renderer. `gradients`:
    parameters of a backward pass, none for a render alone. `plugins`: what has to be registered, as (kind, name).
    `group`: heading in the table.
    """

    name: str
    group: str
    what: str
    change: Callable[[SceneDict], SceneDict] = lambda scene: scene
    settings: Callable[[], dict[str, Any]] = dict
    variant: str = "llvm_ad_rgb"
    gradients: tuple[str, ...] = ()
    plugins: tuple[tuple[str, str], ...] = ()


# ------------------------------------------------------------------------------------------------- changes of the scene


def integrator(name: str) -> Callable[[SceneDict], SceneDict]:
    """Another integrator with the same parameters."""
    return lambda scene: {**scene, "integrator": {**scene["integrator"], "type": name}}


def with_fog(scene: SceneDict) -> SceneDict:
    """A thin homogeneous medium in a box that fills the room."""
    from torchtransient.scenes import scale

    fog = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    box = {"type": "cube", "to_world": scale(0.999), "bsdf": {"type": "null"}, "interior": fog}
    return {**integrator("transient_prbvolpath")(scene), "fog": box}


def with_glass_and_metal(scene: SceneDict) -> SceneDict:
    """Something to polarize light: the boxes become glass and metal."""
    glass, metal = {"type": "dielectric"}, {"type": "roughconductor", "alpha": 0.2}
    return {
        **scene,
        "small-box": {**scene["small-box"], "bsdf": glass},
        "large-box": {**scene["large-box"], "bsdf": metal},
    }


def with_filter(name: str) -> Callable[[SceneDict], SceneDict]:
    """Another temporal filter of the film."""

    def change(scene: SceneDict) -> SceneDict:
        film = {**scene["sensor"]["film"], "temporal_filter": name}
        return {**scene, "sensor": {**scene["sensor"], "film": film}}

    return change


def with_delays(scene: SceneDict) -> SceneDict:
    """The white walls answer with a lifetime of 0.3 m."""
    return {**scene, "white": {"type": "delayed", "lifetime": 0.3, "bsdf": scene["white"]}}


# ------------------------------------------------------------------------------------------------------------ settings


def frequencies(count: int) -> Callable[[], dict[str, Any]]:
    """A uniform grid of frequencies up to 5 per metre."""

    def make() -> dict[str, Any]:
        import torchtransient as tt

        return {"frequencies": tt.FrequencyAxis.uniform(0.1, 4.9 / max(count - 1, 1), count)}

    return make


def pulse() -> dict[str, Any]:
    """A Gaussian pulse of five bins."""
    import torchtransient as tt

    return {"pulse": tt.Pulse.gaussian(fwhm_opl=0.1)}


def gate() -> dict[str, Any]:
    """One gate of 20 cm in the middle of the light."""
    import torchtransient as tt

    return {"gates": [tt.Gate.rectangular(5.4, 5.6)]}


MEDIA = (("integrator", "transient_prbvolpath"),)
PHASOR = (("film", "phasor_hdr_film"),)
ALBEDO, WHITE, WALL = "red.reflectance.value", "white.reflectance.value", "red-wall.to_world"
SPECTRAL = "llvm_ad_spectral"
POLARIZED_MONO, POLARIZED_SPECTRAL = "llvm_ad_mono_polarized", "llvm_ad_spectral_polarized"
VOLUME, SMOOTH = integrator("transient_prbvolpath"), with_glass_and_metal

CASES = (
    Case("plain", "variants", "surfaces, RGB, 300 bins, box filter"),
    Case("mono", "variants", "one channel", variant="llvm_ad_mono"),
    Case("spectral", "variants", "four wavelengths a path, RGB output", variant=SPECTRAL),
    Case("volume integrator, no medium", "media", "costs nothing when not used", VOLUME, plugins=MEDIA),
    Case("fog", "media", "homogeneous medium in the whole room", with_fog, plugins=MEDIA),
    Case("glass and metal", "polarization", "the boxes, unpolarized", SMOOTH),
    Case("polarized, mono", "polarization", "the same, Stokes vectors, one channel", SMOOTH, variant=POLARIZED_MONO),
    Case("polarized, spectral", "polarization", "the same with wavelengths", SMOOTH, variant=POLARIZED_SPECTRAL),
    Case("16 frequencies", "frequencies", "phasor film", settings=frequencies(16), plugins=PHASOR),
    Case("301 frequencies", "frequencies", "phasor film", settings=frequencies(301), plugins=PHASOR),
    Case("tent filter", "time", "temporal filter of two bins", with_filter("tent")),
    Case("gaussian filter", "time", "temporal filter of several bins", with_filter("gaussian")),
    Case("pulse", "time", "Gaussian laser pulse", settings=pulse),
    Case("gate", "time", "one gate instead of 300 bins", settings=gate, plugins=(("film", "gated_hdr_film"),)),
    Case("delays", "time", "exponential lifetime of the white walls", with_delays, plugins=(("bsdf", "delayed"),)),
    Case("backward, albedo", "gradients", "render and gradient, paths stay", gradients=(ALBEDO,)),
    Case("backward, wall", "gradients", "render and gradient through the time of flight", gradients=(WALL,)),
    Case("fog + 16 frequencies", "pairs", "", with_fog, frequencies(16), plugins=(*MEDIA, *PHASOR)),
    Case("polarized + 16 frequencies", "pairs", "", SMOOTH, frequencies(16), POLARIZED_MONO, plugins=PHASOR),
    Case("spectral + pulse", "pairs", "", settings=pulse, variant=SPECTRAL),
    Case("backward, wall + 16 frequencies", "pairs", "", settings=frequencies(16), gradients=(WALL,), plugins=PHASOR),
    Case("backward, albedo + spectral", "pairs", "", variant=SPECTRAL, gradients=(ALBEDO,)),
    Case("backward, albedo + polarized", "pairs", "", SMOOTH, variant=POLARIZED_MONO, gradients=(WHITE,)),
    Case("backward, albedo + fog", "pairs", "", with_fog, gradients=(ALBEDO,), plugins=MEDIA),
)  # fmt: skip


# --------------------------------------------------------------------------------------------------------- the process


class Runner:
    """A case in use. `run(seed)` gives seconds and the steady image's mean."""

    def __init__(self, case: Case, resolution: int, spp: int) -> None:
        import torchtransient as tt
        from torchtransient.scenes import cornell_box

        scene = case.change(cornell_box(resolution, num_bins=300, bin_width_opl=0.02, spp=spp, max_depth=8))
        self.case, self.spp = case, spp
        loaded = tt.load(scene, variant=case.variant)
        self.renderer = tt.TransientRenderer(loaded, parameters=list(case.gradients), **case.settings())
        self.before = peak_bytes()

    def run(self, seed: int, spp: int | None = None) -> dict[str, Any]:
        """Render, and go backward if the case says so."""
        import torch

        begin = time.perf_counter()
        if self.case.gradients:
            self.renderer.zero_grad()
            out = self.renderer(seed=seed, spp=spp or self.spp)
            measured = next(tensor for tensor in (out.transient, out.phasor, out.gated) if tensor is not None)
            measured = torch.view_as_real(measured) if measured.is_complex() else measured
            (measured * weights(measured)).sum().backward()
        else:
            with torch.no_grad():
                out = self.renderer(seed=seed, spp=spp or self.spp)
        seconds = time.perf_counter() - begin
        return {"seconds": seconds, "mean": float(out.steady.detach().mean())}

    def noise(self, spp: int, runs: int) -> float:
        """Variance of a pixel of the steady image for `spp` samples over the squared mean of the image, from `runs`."""
        import torch

        with torch.no_grad():
            images = [self.renderer(seed=1000 + k, spp=spp).steady.double() for k in range(runs)]
        # Of Stokes vectors the first component is the intensity.
        stack = torch.stack([image[0] if image.ndim == 4 else image for image in images]).mean(1)
        return float(stack.var(0).mean() / stack.mean() ** 2)


def weights(measured: Any) -> Any:
    """A loss that differs from bin to bin."""
    import torch

    return torch.linspace(0.0, 1.0, measured.shape[1])[(None, slice(None)) + (None,) * (measured.ndim - 2)]


def peak_bytes() -> int:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def unavailable(case: Case) -> str | None:
    """What this installation lacks for a case."""
    import mitsuba as mi

    from torchtransient import plugins

    if case.variant not in mi.variants():
        return f"no variant {case.variant}"
    for kind, name in case.plugins:
        if plugins.kind_of(name) != kind:
            return f"no {kind} {name}"
    return None


def main() -> None:
    """Answer requests: one JSON object a line, as `_runner.Worker` sends them."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    name, resolution, spp = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    import torchtransient
    from torchtransient.errors import GradientError

    case = next(case for case in CASES if case.name == name)
    missing = unavailable(case)
    print(json.dumps({"unavailable": missing, "version": torchtransient.__version__}), file=answers)
    if missing:
        return
    runner = Runner(case, resolution, spp)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            if request["do"] == "run":
                answer: dict[str, Any] = runner.run(request["seed"])
            elif request["do"] == "noise":
                answer = {"noise": runner.noise(request["spp"], request["runs"])}
            else:
                answer = {"added_bytes": max(0, peak_bytes() - runner.before)}
        except GradientError as error:
            answer = {"unavailable": str(error)}
        print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main()
