"""What generating and reading data sets costs beside the kernels: samples, workers, views, captures, training.

The recipe is a Cornell box with two solids that move and turn and three colours that change. CPU milliseconds of
processes with one thread, unless it is said; sizes in MB are those of float32 before compression.

- samples: what a worker of `tt.data.generate` spends on a sample over its bare kernels (the integrator's, recorded,
  with values that stay): drawing, installing, launching, copying, checks, compression, checksum, file. Bars: 2.5 ms and
  4 ms a MB; where kernels take 50 ms and more, 5 % of them.
- workers: samples a second by the clock, two processes over one, without what comes before the first sample. Bar 1.7,
  on cores that are free: the load is printed. The same by CPU seconds is what cores that are free would bring.
- views: a film of 8^2 from 8 cameras in one call; 1 ms a view.
- captures: confocal captures of a letter that is elsewhere in each, beside `tal render` of y-tal 0.20 (with mitransient
  1.3.1) for the same scene file: wall, scan, bins, samples, bounces. y-tal starts a process for every point, whose CPU
  seconds count, and so it renders but some of them. The pictures agree but for one factor. Bar: 3 times as fast.
- reading: whole samples, 2 ms a MB; a window of 64 of 1024 bins, 1/5 of a sample; waits of a training loop for a
  `DataLoader` with one worker, 5 % of its time by the clock.
- new scenes: a renderer of a new scene for each sample, with what it drew written into the description, over samples of
  a scene that is kept. Shown.

`dataset_storage.py` measures files: sizes, writing, reading. y-tal runs in the environment of `--peer-python`, or of
the variable TORCHTRANSIENT_TAL_PYTHON; without it captures are timed alone.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _dataset_cases import tal_scene, write_letter
from _runner import HERE, ROOT, ChildProcess, arguments, commit_of, environment, summary

PARTS = ("samples", "workers", "views", "captures", "reading", "loader", "new")
# Of a sample: milliseconds, milliseconds a MB; and of kernels as long as that, this share.
FIXED, A_MEGABYTE, LONG, SHARE = 2.5, 4.0, 50.0, 0.05
PLACE = [0.0, 0.0, 1.0]


class Table:
    """Lines with a median, quartiles and a bar."""

    def __init__(self, judges: bool) -> None:
        self.rows: list[dict[str, Any]] = []
        self._judges = judges

    def add(
        self, name: str, values: list[float], unit: str, most: float | None = None, least: float | None = None,
        **facts: Any,
    ) -> None:  # fmt: skip
        """``most``, ``least``: what the median should not exceed, or reach."""
        row: dict[str, Any] = {"name": name, "unit": unit, **summary(values), **facts}
        bar, said = (most, "at most") if most is not None else (least, "at least")
        text = ""
        if bar is not None and self._judges:
            row |= {"bar": bar, "within": bool(row["median"] <= bar if most is not None else row["median"] >= bar)}
            text = f"   bar: {said} {bar:.4g}: {'reached' if row['within'] else 'MISSED'}"
        self.rows.append(row)
        middle = f"{row['median']:9.3f} {unit:<8} [{row['q25']:.3f}, {row['q75']:.3f}]"
        told = "".join(f"   {key} {value}" for key, value in facts.items())
        print(f"  {name:<58}{middle}{text}{told}", flush=True)


def start() -> ChildProcess:
    """A process with the package of this checkout."""
    search = os.pathsep.join((str(ROOT), os.environ["PYTHONPATH"]))
    alone = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, str(HERE / "_dataset_worker.py")]
    worker = ChildProcess(command, env={**os.environ, "PYTHONPATH": search, **alone}, cwd=ROOT)
    if Path(worker.greeting["package"]).resolve() != (ROOT / "torchtransient").resolve():
        raise RuntimeError(f"expected the package of {ROOT}, the worker imported {worker.greeting['package']}")
    return worker


def ask(**request: Any) -> dict[str, Any]:
    """One request to a process of its own."""
    worker = start()
    answer = worker.ask(**request)
    worker.close()
    return answer


def named(film: tuple[int, int, int]) -> str:
    resolution, bins, spp = film
    return f"{resolution}^2 x {bins}, {spp} spp"


# ---------------------------------------------------------------------------------------------------------- generation


def samples(table: Table, quick: bool, repeats: int) -> None:
    films = {"small": (8, 16, 1), "middle": (32, 1024, 16), "long kernels": (32, 64, 256)}
    if quick:
        films = {"small": (4, 8, 1)}
    for kind, film in films.items():
        count = 3 if quick else 200 if kind == "small" else 24
        found = ask(do="samples", film=film, count=count, repeats=repeats)
        megabytes = round(found["megabytes"], 4)
        over = [a - b for a, b in zip(found["generated"], found["bare"], strict=True)]
        table.add(f"{named(film)}: a sample", found["generated"], "ms", MB=megabytes)
        clock = round(found["kernels_by_the_clock"], 3)
        table.add(f"{named(film)}: its bare kernels", found["bare"], "ms", least_by_the_clock=clock)
        table.add(f"{named(film)}: without storage", found["maker"], "ms")
        long = kind == "long kernels"
        bar = None if long else FIXED + A_MEGABYTE * megabytes
        table.add(f"{named(film)}: over its bare kernels", over, "ms", most=bar)
        if long:
            shares = [a / b for a, b in zip(over, found["bare"], strict=True)]
            judged = SHARE if float(np.median(found["bare"])) >= LONG else None
            table.add(f"{named(film)}: over its bare kernels, as a share", shares, "", most=judged)


def workers(table: Table, quick: bool, repeats: int) -> None:
    film = (4, 8, 1) if quick else (32, 1024, 16)
    sizes = (2, 2) if quick else (24, 8)
    found = ask(do="workers", film=film, per_shard=sizes[0], shards=sizes[1], repeats=1 if quick else min(repeats, 5))
    load = round(found["load"], 1)
    clock = [a / b for a, b in zip(found["wall, 1"], found["wall, 2"], strict=True)]
    cpu = [2 * a / b for a, b in zip(found["cpu, 1"], found["cpu, 2"], strict=True)]
    table.add(f"{named(film)}: two workers over one, by the clock", clock, "x", least=1.7, load=load)
    table.add(f"{named(film)}: the same by CPU seconds of a sample", cpu, "x")


def views(table: Table, quick: bool, repeats: int) -> None:
    film, number = ((4, 8, 1), 2) if quick else ((8, 16, 1), 8)
    found = ask(do="views", views=number, film=film, count=3 if quick else 100, repeats=repeats)
    table.add(f"{named(film)}, {number} cameras: a view", found["view"], "ms", most=1.0, calls=found["recorded"])


def new(table: Table, quick: bool, repeats: int) -> None:
    film = (4, 8, 1) if quick else (32, 1024, 16)
    found = ask(do="new", film=film, count=1 if quick else 4, repeats=repeats)
    table.add(f"{named(film)}: a sample of a new scene", found["new"], "ms")
    ratios = [a / b for a, b in zip(found["new"], found["kept"], strict=True)]
    table.add(f"{named(film)}: over one of a kept scene", ratios, "x")


# ------------------------------------------------------------------------------------------------------------ captures


def captured(table: Table, quick: bool, python: str | None, peers: int) -> None:
    scan, bins, spp, count = (2, 64, 16, 2) if quick else (8, 512, 16384, 32)
    width = 0.08 if quick else 0.01
    case = f"confocal, {scan}^2 points x {bins} bins, {spp} spp"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh, file = folder / "letter.obj", folder / "capture.yaml"
        write_letter(mesh)
        file.write_text(tal_scene(mesh, PLACE, scan, bins, spp, width), encoding="utf-8")
        ours = start()
        found = ours.ask(do="captures", file=str(file), count=count)
        table.add(f"{case}: a capture of {count}", found["generated"], "ms")
        if python is not None:
            home = folder / "home"
            home.mkdir()
            place = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
            theirs = ChildProcess([python, str(HERE / "_tal_render_worker.py"), str(home)], env=place)
            print(f"  {theirs.greeting}", file=sys.stderr)
            seconds, likeness, factors = [], [], []
            for index in range(peers + 1):
                out = [str(folder / f"{side}.npy") for side in ("ours", "theirs")]
                # Where sample `index` has the letter; the first one compiles y-tal's kernels.
                answer = ours.ask(do="capture", index=index, out=out[0])
                text = tal_scene(mesh, answer["place"], scan, bins, spp, width)
                file.write_text(text, encoding="utf-8")
                taken = theirs.ask(do="render", file=str(file), seed=index, out=out[1])["seconds"]
                if index > 0:
                    mine, other = np.load(out[0]), np.load(out[1]).swapaxes(1, 2)
                    seconds.append(1e3 * taken)
                    likeness.append(float(np.corrcoef(mine.ravel(), other.ravel())[0, 1]))
                    factors.append(float(other.sum(dtype=np.float64) / mine.sum(dtype=np.float64)))
            theirs.close()
            table.add(f"{case}: one of y-tal", seconds, "ms")
            own = float(np.median(found["generated"]))
            table.add(f"{case}: y-tal over ours", [taken / own for taken in seconds], "x", least=3.0)
            table.add(f"{case}: correlation of the cubes", likeness, "", least=0.99)
            table.add(f"{case}: sums, over their mean factor", [f / np.mean(factors) for f in factors], "")
        ours.close()


# ------------------------------------------------------------------------------------------------------------- reading


def reading(table: Table, quick: bool, repeats: int) -> None:
    film = (4, 16, 1) if quick else (32, 1024, 16)
    # Shards have slabs of 32 bins.
    windows = {"of two slabs": [4, 8] if quick else [448, 512], "of three slabs": [6, 10] if quick else [496, 560]}
    found = ask(do="reading", film=film, count=3 if quick else 24, repeats=repeats, windows=windows)
    per_mb = [value / found["megabytes"] for value in found["whole"]]
    table.add(f"{named(film)}: reading a MB of whole samples", per_mb, "ms", most=2.0)
    for name, (first, last) in windows.items():
        part = [a / b for a, b in zip(found[name], found["whole"], strict=True)]
        table.add(f"{named(film)}: {last - first} bins {name} over all", part, "x", most=0.2)


def training(table: Table, quick: bool) -> None:
    film = (4, 16, 1) if quick else (32, 1024, 16)
    steps, batch, width = (2, 2, 4) if quick else (40, 8, 32)
    found = ask(do="loader", film=film, count=4 if quick else 24, batch=batch, steps=steps, width=width)
    step = f"step_ms {1e3 * float(np.median(found['step_seconds'])):.0f}"
    facts = {"load": round(found["load"], 1), "of": step}
    table.add(f"{named(film)}: waits of a training loop", [found["share"]], "", most=0.05, **facts)


def main() -> None:
    parser = arguments(__doc__)
    parser.set_defaults(peer_python=os.environ.get("TORCHTRANSIENT_TAL_PYTHON"))
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="these parts alone")
    parser.add_argument("--peer-captures", type=int, default=2, help="captures that y-tal renders, after a first one")
    options = parser.parse_args()
    repeats = options.repeats or (2 if options.quick else 7)
    table = Table(judges=not options.quick)
    print(f"dataset: {repeats} rounds; medians and quartiles; load {os.getloadavg()[0]:.1f}")
    quick = options.quick
    parts = {
        "samples": lambda: samples(table, quick, repeats),
        "workers": lambda: workers(table, quick, repeats),
        "views": lambda: views(table, quick, repeats),
        "captures": lambda: captured(table, quick, options.peer_python, options.peer_captures),
        "reading": lambda: reading(table, quick, repeats),
        "loader": lambda: training(table, quick),
        "new": lambda: new(table, quick, repeats),
    }
    for name in options.only:
        parts[name]()
    if options.json is not None:
        settings = {"repeats": repeats, "quick": quick, "only": list(options.only), "load": os.getloadavg()[0]}
        facts = {"environment": environment(), "commit": commit_of(ROOT)}
        data = {"benchmark": "dataset", "settings": settings, "rows": table.rows, **facts}
        options.json.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
        print(f"  written to {options.json}")


if __name__ == "__main__":
    main()
