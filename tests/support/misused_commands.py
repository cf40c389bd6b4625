"""The commands with what people get wrong: files that are none, options that do not go together, places that cannot be
written to. Run as a script in a folder of its own, it prints what does not end as it should.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import traceback
from pathlib import Path

MOST_LETTERS = 500


def files(folder: Path) -> dict[str, Path]:
    """What commands read, whole and not, by name."""
    from support.capture_files import grids, made
    from support.killed_writers import output
    from support.text_files import RECIPES, SCENE, SETUPS
    from torchtransient.files import write_result

    folder.joinpath("empty").write_bytes(b"")
    folder.joinpath("folder").mkdir()
    found = {
        "result": write_result(folder / "result.h5", output(0)), "archive": write_result(folder / "r.npz", output(0)),
        "capture": made(grids()["confocal"]).write(folder / "capture.h5"),
    }  # fmt: skip
    texts = {"scene.xml": SCENE, "recipe.yaml": RECIPES["scene"], "setup.yaml": SETUPS["own"], "words.yaml": "a: [1\n"}
    texts |= {"list.yaml": "- 1\n", "broken.xml": SCENE[:400], "unknown.xml": SCENE.replace("perspective", "fisheye9")}
    for name, text in texts.items():
        found[name] = folder / name
        found[name].write_text(text)
    for name in ("result", "archive", "capture"):
        data = found[name].read_bytes()
        found[f"cut {name}"] = folder / f"cut{found[name].suffix}"
        found[f"cut {name}"].write_bytes(data[: len(data) // 2])
        found[f"changed {name}"] = folder / f"changed_{name}{found[name].suffix}"
        found[f"changed {name}"].write_bytes(data[:2000] + bytes(b ^ 255 for b in data[2000:2300]) + data[2300:])
    for name in ("scene.xml", "recipe.yaml"):
        found[f"latin {name}"] = folder / f"latin_{name}"
        found[f"latin {name}"].write_bytes(found[name].read_bytes() + b"\xff\xfe")
    for ending in ("h5", "npz", "npy", "xml", "yaml", "json"):
        found[f"empty .{ending}"] = folder / f"empty.{ending}"
        found[f"empty .{ending}"].write_bytes(b"")
        found[f"noise .{ending}"] = folder / f"noise.{ending}"
        found[f"noise .{ending}"].write_bytes(bytes(range(256)) * 20)
    return found | {
        "none": folder / "none.h5", "none.xml": folder / "none.xml", "folder": folder / "folder",
        "null": Path("/dev/null"),
    }  # fmt: skip


def calls(found: dict[str, Path], folder: Path) -> list[list[str]]:
    """Command lines none of which can be done."""
    out = str(folder / "out")
    sound = ("result", "archive", "capture", "setup.yaml", "recipe.yaml")
    bad = [str(path) for name, path in found.items() if name not in sound]
    scene, result, capture = (str(found[name]) for name in ("scene.xml", "result", "capture"))
    many: list[list[str]] = []
    for path in bad:
        if path != scene:
            many += [["plan", path], ["render", path, "-o", f"{out}.h5"], ["cost", path, "--spp", "1"]]
            many += [["nlos", path, "-o", f"{out}.h5", "--describe"]]
        many += [["video", path, f"{out}.gif"], ["picture", path, f"{out}.png"], ["reconstruct", path]]
        many += [["dataset", "make", path, "-o", f"{out}_set"], ["dataset", "verify", path], ["dataset", "info", path]]
        many += [["dataset", "show", path], ["dataset", "export", path, "-o", out], ["dataset", "cost", path]]
        many += [["dataset", "preview", path, "-o", f"{out}.png"]]
    nowhere, taken = str(folder / "nowhere" / "a"), str(found["folder"])
    render = ["render", scene, "--quiet"]
    many += [
        [*render, "-o", f"{nowhere}.h5"], [*render, "-o", taken], [*render, "-o", f"{out}.exr"],
        [*render, "-o", f"{out}.h5", "--set", "wall"], [*render, "-o", f"{out}.h5", "--set", "none.value=3"],
        [*render, "-o", f"{out}.h5", "--set", "grey.reflectance.value=x"], [*render, "--sensor", "7"],
        [*render, "--spp", "0"], [*render, "--spp", "x"], [*render, "--spp", "9" * 30], [*render, "--variant", "none"],
        [*render, "--param", "depth"], [*render, "--param", "depth=x"], [*render, "--param", "nobody=1"],
        [*render, "-o", f"{out}.h5", "--start-opl", "nan", "--bin-width-opl", "1", "--num-bins", "5"],
        [*render, "-o", f"{out}.h5", "--num-bins", "5"], [*render, "-o", f"{out}.h5", "--frequencies", "a,b"],
        [*render, "-o", f"{out}.h5", "--gates", "x"],
        [*render, "-o", f"{out}.h5", "--frequencies", "1", "--num-bins", "5"], [*render, "--nonsense"],
        ["plan", scene, "--gradient", "none"], ["plan", scene, "--tail", "nan"], ["plan", scene, "--missed", "7"],
        ["plan", scene, "--outputs", "none"], ["plan", scene, "--sensor", "5"],
        ["video", result, f"{nowhere}.gif"], ["video", result, f"{out}.xyz"], ["video", result, taken],
        ["video", result, f"{out}.gif", "--scale", "0"],
        ["picture", result, f"{nowhere}.png"], ["picture", result, f"{out}.xyz"], ["picture", result, taken],
        ["picture", result, f"{out}.png", "--kind", "none"], ["picture", result, f"{out}.png", "--kind", "streak",
         "--row", "900"], ["picture", result, f"{out}.png", "--kind", "histogram", "--pixel", "-900", "3"],
        ["picture", result, f"{out}.png", "--kind", "polarization"], ["picture", capture, f"{out}.png"],
        ["reconstruct", capture, "-o", f"{nowhere}.h5"], ["reconstruct", capture, "--format", "none"],
        ["reconstruct", capture, "--method", "none"], ["reconstruct", capture, "--depths", "3", "1"],
        ["reconstruct", capture, "--wall-size", "x"], ["reconstruct", capture, "--bin-width-s", "-1"],
        ["reconstruct", capture, "--record", "5", "1"], ["reconstruct", capture, "--sum-bins", "900"],
        ["reconstruct", capture, "--device", "none"], ["reconstruct", capture, "--method", "fk", "--taps", "3"],
        ["reconstruct", capture, "--method", "lct", "--snr", "nan"], ["reconstruct", capture, "--slab", "-3"],
        ["reconstruct", result], ["reconstruct", capture, "--method", "bp", "--bounds", *"123456"],
        ["cost", scene, "--spp", "x"], ["cost", scene, "--gradient", "none"], ["cost", scene, "--sampler", "none"],
        ["cost", scene, "--spp", "1", "--plot", f"{nowhere}.png"], ["cost", scene, "--spp", "1", "--json",
         f"{nowhere}.json"],
        ["dataset", "make", str(found["recipe.yaml"]), "-o", f"{nowhere}/b"], ["dataset", "none"], ["none"],
        ["dataset", "make", str(found["recipe.yaml"]), "-o", f"{out}_set", "--shard", "9/3"],
        ["nlos", scene, "-o", f"{out}.h5"], ["nlos", str(found["setup.yaml"]), "-o", f"{nowhere}.h5"],
        ["nlos", str(found["setup.yaml"]), "-o", f"{out}.h5", "--variant", "none"], ["render"], ["picture", result],
        ["nlos", str(found["setup.yaml"]), "-o", f"{out}.h5", "--part", taken],
        ["demo", "-o", result, "--steps", "1"], ["doctor", "--none"],
    ]  # fmt: skip
    return many


def faults(arguments: list[str]) -> list[str]:
    """What is wrong with the end of one command: a traceback, another status, a message of several lines."""
    from torchtransient.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    status: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main.main(arguments, prog_name="torchtransient")
        except SystemExit as end:
            status = end.code
        except BaseException as error:  # noqa: BLE001  # that is what is looked for
            where = " < ".join(f"{f.name}:{f.lineno}" for f in reversed(traceback.extract_tb(error.__traceback__)[-4:]))
            return [f"{type(error).__name__}: {str(error)[:200]} in {where}"]
    said = err.getvalue()
    found = [] if status == 2 else [f"status {status}: {said[-200:]!r} {out.getvalue()[-100:]!r}"]
    errors = [line for line in said.split("\n") if line.lower().startswith("error: ")]
    if status == 2 and (len(errors) != 1 or len(errors[0]) > MOST_LETTERS or not said.endswith(errors[0] + "\n")):
        found.append(f"said {said!r}")
    if "Traceback" in said:
        found.append(f"a traceback: {said[-300:]!r}")
    return found


def _main(folder: Path, part: tuple[int, int]) -> None:
    import torchtransient.nlos  # noqa: F401  # before Mitsuba, and with the layouts of captures

    every = calls(files(folder), folder)[part[0] :: part[1]]
    told = {" ".join(arguments).replace(str(folder), "."): faults(arguments) for arguments in every}
    print(json.dumps({"count": len(every), "faults": {name: found for name, found in told.items() if found}}))


if __name__ == "__main__":
    _main(Path(sys.argv[1]), (int(sys.argv[2]), int(sys.argv[3])))
