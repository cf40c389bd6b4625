"""Migrates with y-tal on demand, in an environment of its own; driven by one JSON object per line.

  {"do": "capture", "file"}   .npz with H (T, X, Y), sensors (X, Y, 3), bin_width
  {"do": "fk", "out"}         -> {"seconds"}, CPU seconds; the volume (Z, X, Y) as .npy
"""

import json
import os
import sys
import time

ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

import numpy as np  # noqa: E402
import tal  # noqa: E402
from tal.enums import GridFormat, HFormat  # noqa: E402
from tal.io.capture_data import NLOSCaptureData  # noqa: E402
from tal.log import LogLevel, set_log_level  # noqa: E402


def load(path):
    """A confocal capture without first and last legs, t = 0 at the start of the first bin."""
    with np.load(path) as arrays:
        capture = NLOSCaptureData()
        capture.H, capture.H_format = arrays["H"], HFormat.T_Sx_Sy
        capture.sensor_grid_xyz = capture.laser_grid_xyz = arrays["sensors"]
        capture.sensor_grid_format = capture.laser_grid_format = GridFormat.X_Y_3
        normals = np.zeros_like(arrays["sensors"])
        normals[..., 2] = 1
        capture.sensor_grid_normals = capture.laser_grid_normals = normals
        capture.sensor_xyz = capture.laser_xyz = np.array([0, 0, 1], np.float32)
        capture.delta_t, capture.t_start = float(arrays["bin_width"]), 0.0
        capture.t_accounts_first_and_last_bounces = False
    return capture


def main():
    set_log_level(LogLevel.ERROR)
    tal.set_resources(cpu_processes=1)
    print(json.dumps({"version": tal.__version__, "numpy": np.__version__}), file=ANSWERS)
    capture = None
    for line in sys.stdin:
        request = json.loads(line)
        if request["do"] == "capture":
            capture, answer = load(request["file"]), {"ok": True}
        else:
            start = time.process_time()
            volume = tal.reconstruct.fk.solve(capture)
            answer = {"seconds": time.process_time() - start}
            np.save(request["out"], np.asarray(volume))
        print(json.dumps(answer), file=ANSWERS)


if __name__ == "__main__":
    main()
