"""Reconstructs with y-tal on demand, in an environment of its own; driven by one JSON object per line.

{"do": "capture", "file"}   .npz with H (T, X, Y) or (T, Lx, Ly, X, Y), sensors (X, Y, 3), lasers (X, Y, 3), bin_width
{"do": "solve", "method", "planes", "out", ...options}   -> {"seconds"}, CPU seconds; the volume (X, Y, Z) as .npy
{"do": "migrate", "out"}   f-k migration -> {"seconds"}; the volume (Z, X, Y) as .npy

The argument is how many pieces along each side y-tal cuts volumes into.
"""

import json
import os
import sys
import time

ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

import numpy as np  # noqa: E402
import tal  # noqa: E402
from tal.enums import CameraSystem, GridFormat, HFormat, VolumeFormat  # noqa: E402
from tal.io.capture_data import NLOSCaptureData  # noqa: E402
from tal.log import LogLevel, set_log_level  # noqa: E402


def load(path):
    """A capture without first and last legs, t = 0 at the start of the first bin."""
    with np.load(path) as arrays:
        capture = NLOSCaptureData()
        capture.H = arrays["H"]
        capture.H_format = HFormat.T_Sx_Sy if capture.H.ndim == 3 else HFormat.T_Lx_Ly_Sx_Sy
        capture.sensor_grid_xyz, capture.laser_grid_xyz = arrays["sensors"], arrays["lasers"]
        capture.sensor_grid_format = capture.laser_grid_format = GridFormat.X_Y_3
        for name in ("sensor", "laser"):
            normals = np.zeros_like(getattr(capture, f"{name}_grid_xyz"))
            normals[..., 2] = 1
            setattr(capture, f"{name}_grid_normals", normals)
        capture.sensor_xyz = capture.laser_xyz = np.array([0, 0, 1], np.float32)
        capture.delta_t, capture.t_start = float(arrays["bin_width"]), 0.0
        capture.t_accounts_first_and_last_bounces = False
    return capture


def solve(capture, method, planes, camera="DIRECT_LIGHT", **options):
    """The volume and the CPU seconds that it took."""
    volume = tal.reconstruct.get_volume_project_rw(capture, planes)
    start = time.process_time()
    found = getattr(tal.reconstruct, method).solve(
        capture, volume_xyz=volume, volume_format=VolumeFormat.X_Y_Z_3, camera_system=CameraSystem[camera],
        progress=False, **options,
    )  # fmt: skip
    return np.asarray(found), time.process_time() - start


def migrate(capture):
    """The volume of f-k migration, whose planes are y-tal's own, and the CPU seconds that it took."""
    start = time.process_time()
    found = tal.reconstruct.fk.solve(capture)
    return np.asarray(found), time.process_time() - start


def main():
    set_log_level(LogLevel.ERROR)
    # Whole volumes at once take y-tal many GB.
    tal.set_resources(cpu_processes=1, downscale=int(sys.argv[1]))
    print(json.dumps({"version": tal.__version__, "numpy": np.__version__}), file=ANSWERS)
    capture = None
    for line in sys.stdin:
        request = json.loads(line)
        if (what := request.pop("do")) == "capture":
            capture, answer = load(request["file"]), {"ok": True}
        else:
            out = request.pop("out")
            volume, seconds = {"solve": solve, "migrate": migrate}[what](capture, **request)
            np.save(out, volume)
            answer = {"seconds": seconds}
        print(json.dumps(answer), file=ANSWERS)


if __name__ == "__main__":
    main()
