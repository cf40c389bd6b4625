"""Light through measured foam slabs: path tracing and diffusion theory against the counts of a SPAD.

The published coefficients (not fitted) go into a slab with a smooth boundary of index 1.12. A pencil of light enters
at right angles and all light that leaves the other face is collected; by reciprocity the pencil is a camera pixel and
the face an area light. The measurement collected a spot opposite to the laser: lateral spreading is a Gaussian whose
variance grows with the path length, so the spot's curve is the collected one over the path length. Both are convolved
with the measured response of the laser and aligned in time and height, the only two things fitted.

Reported: root mean square of the difference over the peak, for the whole record of 76 ns, and for the part of it where
the curve is above 1 % of its peak, which is stricter. Beside it the tracer's own noise in the same measure: the
standard error of the traced curve, from batches of paths with seeds of their own.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

import torchtransient as tt
from tools.diffusion import slab_transmittance
from torchtransient.scenes import look_at, rotate, scale, translate
from torchtransient.units import SPEED_OF_LIGHT

HERE = Path(__file__).resolve().parent
SCATTERING, ABSORPTION, INDEX = 262.0, 0.53, 1.12
INCH = 0.0254
RESPONSE_BIN_S, BIN_S = 8e-12, 32e-12
BRIGHT = 0.01  # of the peak
BATCHES = 8
# Little of the light comes through thick slabs.
PATHS = {2: 4_000_000, 4: 4_000_000, 8: 16_000_000}
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Comparison:
    """A measured curve, a model's curve on the same bins, and their difference relative to the peak."""

    seconds: Array
    measured: Array
    model: Array
    rms: float
    rms_bright: float
    shift_s: float


@dataclass(frozen=True)
class Noise:
    """Standard error of a traced curve over its peak: root mean square over the record, and where it is bright."""

    rms: float
    rms_bright: float


def slab_scene(thickness: float, axis: tt.TimeAxis, max_depth: int, anisotropy: float = 0.0) -> dict[str, Any]:
    """The slab between z = 0 and z = thickness, seen at right angles from below, with a light on its upper face."""
    medium = {
        "type": "homogeneous",
        "sigma_t": SCATTERING / (1 - anisotropy) + ABSORPTION,
        "albedo": SCATTERING / (1 - anisotropy) / (SCATTERING / (1 - anisotropy) + ABSORPTION),
        "phase": {"type": "hg", "g": anisotropy} if anisotropy else {"type": "isotropic"},
    }
    boundary = {"type": "dielectric", "int_ior": INDEX, "ext_ior": 1.0}

    def face(height: float, up: bool) -> dict[str, Any]:
        turn = rotate([1, 0, 0], 0 if up else 180)
        return {"type": "rectangle", "to_world": translate([0, 0, height]) @ turn @ scale(4.0),
                "bsdf": boundary, "interior": medium}  # fmt: skip

    return {
        "type": "scene",
        "integrator": {"type": "transient_prbvolpath", "max_depth": max_depth, "rr_depth": 10**6},
        "sensor": {
            "type": "perspective",
            "fov": 0.01,
            "near_clip": 1e-4,
            "to_world": look_at([0, 0, -0.01], [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"},
                "start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "temporal_bins": axis.num_bins,
            },
        },
        "below": face(0.0, False),
        "above": face(thickness, True),
        "light": {
            "type": "rectangle",
            "to_world": translate([0, 0, thickness + 1e-3]) @ rotate([1, 0, 0], 180) @ scale(4.0),
            "emitter": {"type": "area", "radiance": 1.0},
        },
    }  # fmt: skip


def traced(thickness: float, axis: tt.TimeAxis, paths: int, max_depth: int, seed: int) -> Array:
    """Transmitted light per bin (T,), collected over the whole face, for one pencil of light."""
    scene = tt.load(slab_scene(thickness, axis, max_depth), variant="llvm_ad_mono")
    result = tt.render(scene, spp=paths, seed=seed, progress=True)
    return result.transient[0, :, 0, 0].double().numpy()


def convolved(curve: Array, response: Array) -> Array:
    """Curve on bins of RESPONSE_BIN_S through the response, then on bins of BIN_S."""
    step = round(BIN_S / RESPONSE_BIN_S)
    whole = np.convolve(curve, response / response.sum())[: len(curve)]
    return whole.reshape(-1, step).sum(axis=1)


def moved(curve: Array, shift: float, bins: int) -> Array:
    """Curve that arrives `shift` bins later, on the first `bins` bins."""
    return np.interp(np.arange(bins) - shift, np.arange(len(curve)), curve, left=0.0, right=0.0)


def compare(measured: Array, curve: Array) -> Comparison:
    """Align a curve with a measurement on bins of the same width, by a shift in time and a factor."""
    background = float(np.median(measured[:60]))
    counts = measured - background

    def model(shift: float) -> Array:
        late = moved(curve, shift, len(counts))
        return late * (counts @ late) / (late @ late)

    def error(shift: float) -> float:
        return float(np.square(model(shift) - counts).sum())

    first = float(np.argmax(counts) - np.argmax(curve))
    coarse = min((first + 0.5 * k for k in range(-60, 61)), key=error)
    best = minimize_scalar(error, bounds=(coarse - 1, coarse + 1), method="bounded", options={"xatol": 1e-4}).x
    fitted = model(best)
    squares = np.square((fitted - counts) / fitted.max())
    bright = fitted > BRIGHT * fitted.max()
    rms, rms_bright = float(np.sqrt(squares.mean())), float(np.sqrt(squares[bright].mean()))
    return Comparison(np.arange(len(counts)) * BIN_S, counts, fitted, rms, rms_bright, best * BIN_S)


def noise_of(batches: list[Array], shift: float, bins: int) -> Noise:
    """Noise of the mean of several curves, where they lie in a record of `bins` bins once they come `shift` later."""
    late = np.stack([moved(curve, shift, bins) for curve in batches])
    mean = late.mean(axis=0)
    variance = late.var(axis=0, ddof=1) / len(batches) / mean.max() ** 2
    bright = mean > BRIGHT * mean.max()
    return Noise(float(np.sqrt(variance.mean())), float(np.sqrt(variance[bright].mean())))


def spot(collected: Array, axis: tt.TimeAxis) -> Array:
    """The curve of a spot opposite to the laser, from that of the whole face."""
    return collected / axis.centers_opl.numpy()


def run(inches: int, paths: int, max_depth: int, seed: int = 0) -> dict[str, Any]:
    """Both models against one slab."""
    data = np.load(HERE / "data" / "foam_slabs.npz")
    response = data["direct"].astype(np.float64)
    response = np.maximum(response - np.median(response[-256:]), 0.0)
    thickness = inches * INCH
    bins = len(data[f"slab_{inches}_inch"]) * round(BIN_S / RESPONSE_BIN_S)
    axis = tt.TimeAxis(0.0, RESPONSE_BIN_S * SPEED_OF_LIGHT, bins)
    measured = data[f"slab_{inches}_inch"].astype(np.float64)
    theory = slab_transmittance(axis.centers_opl.numpy(), thickness, SCATTERING, ABSORPTION, INDEX)
    # Seeds of neighbouring numbers are streams of their own.
    lights = [traced(thickness, axis, paths // BATCHES, max_depth, seed * BATCHES + k) for k in range(BATCHES)]
    curves = [convolved(spot(light, axis), response) for light in lights]
    fit = compare(measured, np.mean(curves, axis=0))
    result = {
        "traced": fit,
        "noise": noise_of(curves, fit.shift_s / BIN_S, len(measured)),
        "diffusion": compare(measured, convolved(spot(theory, axis), response)),
    }
    return {"inches": inches, "paths": paths, "transmitted": float(np.mean([x.sum() for x in lights])), **result}


def draw(results: list[dict[str, Any]], path: Path) -> None:
    """Measured counts and both models, linear and logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.4 * len(results)), layout="constrained")
    grid = figure.subplots(len(results), 2, squeeze=False)
    for row, result in zip(grid, results, strict=True):
        traced_, theory = result["traced"], result["diffusion"]
        for axes, logarithmic in zip(row, (False, True), strict=True):
            end = 1.15 * traced_.seconds[traced_.model > 0.003 * traced_.model.max()][-1]
            axes.plot(traced_.seconds * 1e9, traced_.measured, color="0.6", lw=2.5, label="measured")
            axes.plot(traced_.seconds * 1e9, traced_.model, color="C3", lw=1, label=f"traced, rms {traced_.rms:.2%}")
            axes.plot(theory.seconds * 1e9, theory.model, "k:", lw=1, label=f"diffusion, rms {theory.rms:.2%}")
            axes.set(xlim=(traced_.shift_s * 1e9 - 0.5, end * 1e9), xlabel="time [ns]")
            if logarithmic:
                axes.set(yscale="log", ylim=(1e-3 * traced_.model.max(), 1.5 * traced_.model.max()))
        row[0].set(ylabel="counts", title=f"foam of {result['inches']} inches")
        row[0].legend(frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inches", type=int, nargs="+", default=[2, 4, 8], choices=[2, 4, 8])
    parser.add_argument("--paths", type=int, help="for every slab; 4 million, 16 million for 8 inches, if not given")
    parser.add_argument("--max-depth", type=int, default=30_000)
    parser.add_argument("--json", type=Path, default=HERE / "results" / "foam_slabs.json")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/foam_slabs.png"))
    options = parser.parse_args()
    results = [run(inches, options.paths or PATHS[inches], options.max_depth) for inches in options.inches]
    for result in results:
        print(
            f"{result['inches']} inches, rms over the peak, whole record (above 1 %): traced "
            f"{result['traced'].rms:.2%} ({result['traced'].rms_bright:.2%}), of it noise of the tracer "
            f"{result['noise'].rms:.2%} ({result['noise'].rms_bright:.2%}), diffusion theory "
            f"{result['diffusion'].rms:.2%} ({result['diffusion'].rms_bright:.2%}); "
            f"{result['transmitted']:.4f} of the light is transmitted"
        )
    options.json.parent.mkdir(parents=True, exist_ok=True)
    numbers = [
        {**{k: result[k] for k in ("inches", "paths", "transmitted")},
         **{f"{name}_{model}": getattr(result[model], name)
            for model in ("traced", "noise", "diffusion") for name in ("rms", "rms_bright")}}
        for result in results
    ]  # fmt: skip
    options.json.write_text(json.dumps(numbers, indent=1) + "\n")
    draw(results, options.picture)
    print(f"{options.picture}, {options.json}")


if __name__ == "__main__":
    main()
