"""The scenes of Mitsuba's documentation, by Mitsuba's own integrators and through time: do they show the same light?

Needs a checkout of Mitsuba's data (https://github.com/mitsuba-renderer/mitsuba-data): `--data FOLDER`, in which
`docs/scenes` and `common` are. Names of scenes after the options choose some. Every scene is rendered as it is loaded,
in a variant like that of its documentation, but for small films and a bound on unlimited depths. Shown are the ratio of
the energies with its standard error, and the worst deviate of blocks of 4 x 4 pixels (without the rim of the film,
where Mitsuba's filters see one side alone); or the line that refuses a scene; or why Mitsuba does not load it.
Mitsuba samples a `blendbsdf` wrongly of which a part is smooth: `bsdf_blendbsdf` is not the same.
"""

from __future__ import annotations

import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from _runner import arguments, environment, report

import torchtransient as tt
from torchtransient.accuracy import two_sample_z_test

# Beside those that say so in their name; all others are shown in colour.
POLARIZED = ("bsdf_polarizer", "bsdf_pplastic", "bsdf_measured_polarized")
VARIANTS = {"integrator_stokes_cbox": "llvm_ad_mono_polarized", "variants_cbox_spectral": "llvm_ad_spectral"}
RIM, BLOCK = 2, 4


def variant_of(name: str) -> str:
    """The variant that a scene is about, without scalar modes."""
    return VARIANTS.get(name, "llvm_ad_spectral_polarized" if name.startswith(POLARIZED) else "llvm_ad_rgb")


def make_small(path: Path, size: int, depth: int, common: Path) -> None:
    """Rewrite a scene file: a film of ``size`` x 3/4 ``size`` pixels, a bound on the depth, an absolute path."""
    tree = ET.parse(path)
    for film in tree.iter("film"):
        for node in film.iter("integer"):
            value = {"width": size, "height": size * 3 // 4}.get(node.get("name", ""))
            node.set("value", str(value) if value else node.get("value", ""))
    for node in tree.iter("default"):
        if node.get("name") == "max_depth" and node.get("value") == "-1":
            node.set("value", str(depth))
    for integrator in tree.iter("integrator"):
        bounds = [node for node in integrator.findall("integer") if node.get("name") == "max_depth"]
        if not bounds and integrator.get("type") in ("path", "volpath"):
            bounds = [ET.SubElement(integrator, "integer", name="max_depth", value="-1")]
        for bound in bounds:
            bound.set("value", str(depth) if bound.get("value") == "-1" else bound.get("value", ""))
    root = tree.getroot()
    for old in root.findall("path"):
        root.remove(old)
    root.insert(0, ET.Element("path", value=str(common)))
    if "$spp" in ET.tostring(root, encoding="unicode") and root.find("default[@name='spp']") is None:
        root.insert(0, ET.Element("default", name="spp", value="64"))
    tree.write(path)


def small_copy(data: Path, folder: Path, size: int, depth: int) -> None:
    """Small scenes in ``folder``, which links everything else."""
    scenes = data.resolve() / "docs" / "scenes"
    for source in scenes.rglob("*"):
        target = folder / source.relative_to(scenes)
        if source.is_dir():
            target.mkdir(exist_ok=True)
        elif source.suffix == ".xml":
            target.write_bytes(source.read_bytes())
            make_small(target, size, depth, data.resolve() / "common")
        else:
            target.symlink_to(source)


def of_mitsuba(path: Path, variant: str, spp: int, count: int) -> np.ndarray:
    """Images (count, H, W, channels) of the scene's own integrator."""
    import mitsuba as mi

    mi.set_variant(variant)
    scene = mi.load_file(str(path))
    return np.stack([np.array(mi.render(scene, spp=spp, seed=1000 + seed)) for seed in range(count)])


def through_time(path: Path, variant: str, spp: int, count: int) -> np.ndarray:
    """The same of this library's steady images, Stokes components first."""
    axis = tt.TimeAxis(start_opl=0.0, bin_width_opl=20.0, num_bins=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tt.errors.PhysicsWarning)  # windows
        renderer = tt.TransientRenderer(tt.load(path, variant=variant), time_axis=axis, spp=spp)
        images = np.stack([renderer(seed=seed).steady.numpy() for seed in range(count)])
    return np.moveaxis(images.reshape(count, -1, *images.shape[-2:]), 1, -1)


def same_channels(ours: np.ndarray, theirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images without alpha, Stokes components without the picture in front of them; the intensity where one side has no
    more.
    """
    if theirs.shape[-1] in (4, 16):
        theirs = np.delete(theirs, 3, -1)
    if theirs.shape[-1] > ours.shape[-1]:
        theirs = theirs[..., -12:] if ours.shape[-1] == 12 else theirs[..., -12::3]
    return ours[..., : theirs.shape[-1]], theirs


def blocks(images: np.ndarray) -> np.ndarray:
    """Means over blocks of pixels."""
    images = images[:, RIM:-RIM, RIM:-RIM]
    count, height, width, channels = images.shape
    rows, columns = height // BLOCK, width // BLOCK
    images = images[:, : rows * BLOCK, : columns * BLOCK]
    return images.reshape(count, rows, BLOCK, columns, BLOCK, channels).mean((2, 4))


def compare(path: Path, spp: int, count: int) -> dict[str, Any]:
    """One row of the table."""
    variant, start = variant_of(path.stem), time.perf_counter()
    try:
        theirs = of_mitsuba(path, variant, spp, count)
    except RuntimeError as error:
        return {"absent": " ".join(str(error).split())[-160:]}
    try:
        ours = through_time(path, variant, spp, count)
    except tt.errors.SceneError as error:
        return {"refused": " ".join(str(error).split())}
    a, b = map(blocks, same_channels(ours, theirs))
    energies = [side.mean((1, 2, 3)) for side in (a, b)]
    ratio = energies[0].mean() / energies[1].mean()
    spread = [np.std(side, ddof=1) / abs(side.mean()) / count**0.5 for side in energies]
    # Tails of filters, which no sample of the one side fell into.
    rounding = 1e-3 * float(np.abs(b).mean())
    test, whole = two_sample_z_test(a, b, rounding=rounding), two_sample_z_test(*energies, rounding=rounding)
    return {
        "ratio": float(ratio), "error": float(ratio * np.hypot(*spread)), "worst": float(np.abs(test.z).max()),
        "same": bool(test.passed and whole.passed), "seconds": time.perf_counter() - start,
    }  # fmt: skip


def main() -> None:
    parser = arguments(__doc__, peer=False)
    parser.add_argument("--data", type=Path, required=True, help="a checkout of mitsuba-data")
    parser.add_argument("--depth", type=int, default=8, help="bound of integrators that have none")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel and run")
    parser.add_argument("names", nargs="*", help="names of scenes, all without")
    options = parser.parse_args()
    size, spp, count = (24, 4, 4) if options.quick else (40, options.spp, options.repeats or 12)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        small_copy(options.data, Path(folder), size, options.depth)
        paths = sorted(path for path in Path(folder).glob("*.xml"))
        for path in (one for one in paths if not options.names or one.stem in options.names):
            row = rows[path.stem] = compare(path, spp, count)
            said = row.get("refused") or row.get("absent")
            numbers = said or f"{row['ratio']:.4f} +- {row['error']:.4f}   worst |z| {row['worst']:.1f}"
            word = "refused: " if "refused" in row else "not loaded: " if "absent" in row else ""
            print(f"{path.stem:45s} {word}{numbers}{'' if row.get('same', True) else '   DIFFERS'}", flush=True)
    settings = {"quick": options.quick, "size": size, "spp": spp, "runs": count, **environment()}
    counts = {
        "same": [name for name, row in rows.items() if row.get("same", False)],
        "different": [name for name, row in rows.items() if not row.get("same", True)],
        **{word: [name for name, row in rows.items() if word in row] for word in ("refused", "absent")},
    }  # fmt: skip
    print(", ".join(f"{word} {len(names)}" for word, names in counts.items()))
    if options.json:
        report("mitsuba_scenes", settings, {"scenes": rows}, options.json)


if __name__ == "__main__":
    main()
