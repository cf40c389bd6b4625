"""Paths per second of NLOS captures beside mitransient's: general paths, and shared samples, of three bounces.

Letter Z, a plane and a body of 3 072 triangles before a wall of one metre, confocal and single scans, 512 bins, the
laser as a projector, which the peer has. A path is a sample of a scan point in all of them. Bars: general paths twice
as fast as the peer, shared samples 10 times. Exhaustive captures of the letter: a path is a sample of a pair of
positions; 8 times, and 12 times where a beam falls on the scanned points themselves, so that pairs are worth two.
mitransient 1.3.1 runs in the environment of `--peer-python`, or of the
variable TORCHTRANSIENT_PEER_PYTHON; without it our own rows are timed alone.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from _comparison import OURS, PEER, Comparison, Row, comparison_arguments
from nlos_rates import ALBEDO, BIN_WIDTH, BINS, START, WALL_ALBEDO, body, letter, plate

from torchtransient.scenes import look_at, scale

KINDS = ("confocal", "single")
ORIGIN, SPOT = [-0.5, 0.0, 0.25], [-0.3, 0.1, 0.0]


def write_ply(path: Path, arrays: tuple[np.ndarray, np.ndarray]) -> str:
    """The mesh as a text file."""
    v, f = arrays
    head = [
        "ply", "format ascii 1.0", f"element vertex {len(v)}", "property float x", "property float y",
        "property float z", f"element face {len(f)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    rows = [" ".join(f"{c:.9g}" for c in p) for p in v] + [f"3 {a} {b} {c}" for a, b, c in f]
    path.write_text("\n".join(head + rows) + "\n", encoding="ascii")
    return str(path)


def scene(mesh_file: str, scan: int, kind: str, **integrator: object) -> dict:
    """A scene that both libraries read."""
    film = {
        "type": "transient_hdr_film", "width": scan, "height": scan, "temporal_bins": BINS, "start_opl": START,
        "bin_width_opl": BIN_WIDTH, "rfilter": {"type": "box"},
    }  # fmt: skip
    sensor = {
        "type": "nlos_capture_meter", "sensor_origin": ORIGIN, "film": film, "sampler": {"type": "independent"},
    }  # fmt: skip
    return {
        "type": "scene",
        "integrator": {
            "type": "transient_nlos_path", "capture_type": kind, "nlos_laser_sampling": True, "max_depth": 3,
            "nlos_hidden_geometry_sampling": True, "account_first_and_last_bounces": False, "temporal_filter": "box",
            **integrator,
        },
        "laser": {"type": "projector", "irradiance": 1.0, "fov": 0.2, "to_world": look_at(ORIGIN, SPOT, [0, 1, 0])},
        "wall": {
            "type": "rectangle", "to_world": scale([0.5, 0.5, 1]),
            "bsdf": {"type": "diffuse", "reflectance": WALL_ALBEDO}, "sensor": sensor,
        },
        "hidden": {
            "type": "ply", "filename": mesh_file, "face_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": ALBEDO},
        },
    }  # fmt: skip


def exhaustive(mesh_file: str, scan: int, **integrator: object) -> dict:
    """The same for every pair of positions."""
    description = scene(mesh_file, scan, "exhaustive", **integrator)
    film = description["wall"]["sensor"]["film"]
    film |= {"exhaustive_scan": True, "laser_scan_width": scan, "laser_scan_height": scan}
    return description


def main() -> None:
    parser = comparison_arguments(__doc__)
    parser.set_defaults(variant="llvm_ad_mono", peer_python=os.environ.get("TORCHTRANSIENT_PEER_PYTHON"))
    options = parser.parse_args()
    scan, pairs, spp = (4, 2, 16) if options.quick else (32, 10, 4096)
    hidden = {"Z": letter(), "plane": plate(1, 1, (0, 0, 1)), "body": body(1 if options.quick else 3)}
    comparison = Comparison(options, spp)
    with tempfile.TemporaryDirectory() as folder:
        files = {name: write_ply(Path(folder) / f"{name}.ply", arrays) for name, arrays in hidden.items()}
        cases = [(f"{name}, {kind}", file, kind) for name, file in files.items() for kind in KINDS]
        ways = {"paths": "paths", "shared": "auto"}
        of_pairs = exhaustive(files["Z"], pairs)
        beam = {**of_pairs, "laser": {"type": "laser_beam", "to_world": of_pairs["laser"]["to_world"]}}
        ours = [
            Row(f"{name}, {way}", scene(file, scan, kind, third_bounce=choice))
            for name, file, kind in cases
            for way, choice in ways.items()
        ]
        comparison.add(OURS, [*ours, Row("Z, exhaustive", of_pairs), Row("Z, exhaustive, reciprocal", beam)])
        peers = [Row(name, scene(file, scan, kind)) for name, file, kind in cases]
        comparison.add(PEER, [*peers, Row("Z, exhaustive", of_pairs)])
        for name, _, _ in cases:
            comparison.add_ratio(f"{OURS}: {name}, paths", f"{PEER}: {name}", 0.5)
            comparison.add_ratio(f"{OURS}: {name}, shared", f"{PEER}: {name}", 0.1)
        for row, bar in {"Z, exhaustive": 1 / 8, "Z, exhaustive, reciprocal": 1 / 12}.items():
            comparison.add_ratio(f"{OURS}: {row}", f"{PEER}: Z, exhaustive", bar)
        settings = {"scan": scan, "pairs": pairs**4, "spp": spp, "bins": BINS}
        comparison.run("nlos_rates_over_peer", settings, options.json)


if __name__ == "__main__":
    main()
