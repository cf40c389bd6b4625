"""Transients and files whose pictures are known, and what reads pictures back."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image

from torchtransient.axes import TimeAxis

AXIS = TimeAxis(2.0, 0.5, 10)


def sweep(channels=3, height=6, width=10):
    """Column x is lit in bin x alone, with radiance 1 in every channel; row 5 is dark."""
    cube = torch.zeros(channels, 10, height, width)
    for x in range(width):
        cube[:, x, : height - 1, x] = 1.0
    return cube


def read_png(path):
    return np.asarray(Image.open(path).convert("RGB"))


def read_gif(path):
    image = Image.open(path)
    frames = []
    for index in range(image.n_frames):
        image.seek(index)
        frames.append(np.asarray(image.convert("RGB")))
    return frames, image.info


def read_mp4(path):
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader], meta
