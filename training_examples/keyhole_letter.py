"""See a letter behind a corner through one point of the wall, from how it moved: a measured Keyhole track.

A laser and a single-photon detector look at one point of a relay wall through a keyhole; a letter of retroreflecting
tape moves behind the corner along a known track (Metzler, Lindell and Wetzstein 2020). As seen from the letter the
point moves: the track is a confocal scan, which `Backprojection` takes as a list of points. Its map, convolved with the
measured response of laser and detector, predicts the counts of a picture in the letter's plane; expectation
maximization (Richardson and Lucy) finds the picture of the highest likelihood through the map and its adjoint.

    python training_examples/keyhole_letter.py FOLDER --output demo_output

`FOLDER` holds one letter's files as published: `scan_*.mat` (`data` (positions, bins) counts, `xpos`, `zpos`),
`LongExpNoObject_after.mat` (counts without the letter) and `direct_after.mat` (the response), HDF5, bins of 16 ps.
The picture is compared with all letters of the alphabet, at the place and size that suit the best of them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from tqdm import tqdm

import torchtransient as tt
from torchtransient.vis.files import figure_type, save_figure

BIN_S = 16e-12
# The record behind the wall's own light, in bins after it; its first part is still the wall's.
BINS, FIRST, SUMMED = 768, 270, 2
# Where the track and the letter's plane are, metres: the letter moves in x and z, y is up.
TRACK_X, TRACK_Z, TRACK_Y, PLANE_Z = 1.0, 0.15, 1.13, 0.79
LOW, HIGH, HALF_WIDTH = 0.40, 1.12, 0.33
# (r_laser r_sensor)^-p. Inverse squares and the wall's cosines are p = 3, those of a diffuse patch too p = 4; tape that
# sends light back lies between them.
FALLOFF = 3.5
# Response before and behind its maximum, in bins.
BEFORE, BEHIND = 8, 40


@dataclass(frozen=True)
class Track:
    """``counts`` and ``background`` (T, N), ``response`` (K,) around its middle, and the ``scan`` of N points."""

    counts: Tensor
    background: Tensor
    response: Tensor
    scan: tt.nlos.Scan
    axis: tt.TimeAxis


def read(folder: Path, pattern: str, start_s: float) -> tt.nlos.Capture:
    """The record of the file that fits a pattern, whose first bin begins at ``start_s``."""
    found = sorted(folder.glob(pattern))
    if not found:
        raise SystemExit(f"keyhole_letter: expected {pattern} in {folder}, got none. Give the folder of one letter.")
    return tt.nlos.Capture.read(found[0], start_s=start_s)


def read_track(folder: Path) -> Track:
    """The measured track of a folder, with time zero when light is back from the wall."""
    direct = read(folder, "direct_after.mat", 0.0).transient[0, :, 0].double()
    zero = int(direct.argmax())
    data = read(folder, "scan_*.mat", -zero * BIN_S)
    dark = read(folder, "LongExpNoObject_after.mat", -zero * BIN_S)
    x, z = (np.array(data.metadata[name]) for name in ("xpos", "zpos"))
    counts, background = (summed(record) for record in (data, dark))
    response = torch.zeros(2 * (BEHIND // SUMMED) + 3, dtype=torch.float64)
    lags = torch.round(torch.arange(-BEFORE, BEHIND) / SUMMED).long() + len(response) // 2
    response.index_add_(0, lags, direct[zero - BEFORE : zero + BEHIND])
    # The letter moves to the right: as seen from it, the point moves to the left.
    points = np.stack([TRACK_X * (0.5 - share(x)), np.full_like(x, TRACK_Y), TRACK_Z * share(z)], -1)
    scan = tt.nlos.Scan.points(points, kind="confocal", sensor_origin=(0, 0, 2), laser_origin=(0, 0, 2))
    axis = tt.TimeAxis.from_seconds(0.0, BIN_S * SUMMED, BINS // SUMMED)
    return Track(counts, background.expand_as(counts), response / response.sum(), scan, axis)


def share(values: np.ndarray) -> np.ndarray:
    """From 0 to 1 along the track."""
    return (values - values.min()) / max(float(np.ptp(values)), 1e-9)


def summed(record: tt.nlos.Capture) -> Tensor:
    """(T, N): the bins that are used, some of them added up."""
    used = record.crop(0.0, tt.units.seconds_to_opl(BINS * BIN_S))
    return tt.nlos.sum_bins(used, SUMMED).transient[0].double().contiguous()


def plane(resolution: int) -> Tensor:
    """Points (Y, X, 3) of the letter's plane, the highest row first."""
    x = torch.linspace(-HALF_WIDTH, HALF_WIDTH, resolution, dtype=torch.float64)
    y = torch.linspace(HIGH, LOW, resolution, dtype=torch.float64)
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([columns, rows, torch.full_like(rows, PLANE_Z)], -1)


class Prediction(torch.nn.Module):
    """Counts (T, N) of a picture (Y, X), without background, where they are used."""

    def __init__(self, track: Track, resolution: int) -> None:
        super().__init__()
        self.geometry = tt.nlos.Backprojection(
            track.scan, plane(resolution), time_axis=track.axis, falloff=FALLOFF, dtype=torch.float64
        )
        self.register_buffer("kernel", track.response.flip(0)[None, None])
        used = torch.zeros(track.axis.num_bins, 1, dtype=torch.float64)
        used[FIRST // SUMMED :] = 1
        self.register_buffer("used", used)

    def forward(self, picture: Tensor) -> Tensor:
        light = self.geometry(picture).T[:, None]
        return functional.conv1d(light, self.kernel, padding=self.kernel.shape[-1] // 2)[:, 0].T * self.used


def most_likely(model: Prediction, track: Track, steps: int, progress: bool = True) -> Tensor:
    """The picture (Y, X) after `steps` of expectation maximization, which begins with a grey one.

    Each step multiplies with the adjoint of counts over prediction, so that the likelihood of the counts rises and no
    value falls below zero.
    """
    counts = track.counts * model.used
    # A count for each bin where none was measured: nothing is impossible.
    background = (track.background + 1) * model.used
    picture = torch.ones(model.geometry.volume_shape, dtype=torch.float64)
    predicted, adjoint = torch.func.vjp(model, picture)
    (sensitivity,) = adjoint(model.used.expand_as(counts).contiguous())
    picture = picture * (counts - background).clamp_min(0).sum() / predicted.sum()
    for _ in tqdm(range(steps), disable=not progress, desc="picture"):
        predicted, adjoint = torch.func.vjp(model, picture)
        excess = torch.where(model.used > 0, counts / (predicted + background).clamp_min(1e-9), 0.0)
        picture = picture * adjoint(excess)[0] / sensitivity.clamp_min(1e-12 * float(sensitivity.max()))
    return picture.detach()


# ------------------------------------------------------------------------------------------------------------ letters


def alphabet() -> dict[str, Tensor]:
    """The letters (H, W) of one font from 0 to 1: of one height, on one line, each in the middle of its picture."""
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf"), 96)
    pictures = {}
    for letter in ascii_uppercase:
        image = Image.new("L", (160, 160))
        draw = ImageDraw.Draw(image)
        left, _, right, _ = draw.textbbox((0, 120), letter, font=font, anchor="ls")
        draw.text((80 - (left + right) / 2, 120), letter, fill=255, font=font, anchor="ls")
        pictures[letter] = torch.from_numpy(np.asarray(image, dtype=np.float64) / 255)
    used = torch.stack(list(pictures.values())).amax(0) > 0
    rows, columns = (used.any(dim).nonzero() for dim in (1, 0))
    reach = int((columns - 80).abs().max())
    box = (slice(int(rows.min()), int(rows.max()) + 1), slice(80 - reach, 80 + reach))
    return {letter: picture[box] for letter, picture in pictures.items()}


def blurred(pictures: Tensor, sigma: float, reach: int = 3) -> Tensor:
    """(N, H, W) with a Gaussian of `sigma` pixels, `reach` pixels larger to every side."""
    t = torch.arange(-reach, reach + 1, dtype=torch.float64)
    kernel = torch.exp(-(t**2) / (2 * sigma**2))
    kernel = kernel / kernel.sum()
    wide = functional.pad(pictures, (2 * reach,) * 4)[:, None]
    return functional.conv2d(functional.conv2d(wide, kernel[None, None, :, None]), kernel[None, None, None])[:, 0]


def letter_scores(picture: Tensor) -> dict[str, float]:
    """Correlation coefficients of a square picture with every letter of the alphabet, the highest first.

    Place and size are one for the whole alphabet: those at which the highest coefficient of all is found. Compared is
    the amplitude, the root of the picture: squares hide what is dim.
    """
    amplitude, size = picture.sqrt(), picture.shape[0]
    letters = alphabet()
    shapes = torch.stack(list(letters.values()))[:, None]
    margin = size // 2
    wide = functional.pad(amplitude, (margin,) * 4)[None, None]
    deviation = (amplitude - amplitude.mean()).norm()
    best, scores = -1.0, torch.zeros(len(letters))
    for height in range(round(0.35 * size), size):
        width = round(height * shapes.shape[-1] / shapes.shape[-2])
        templates = blurred(functional.interpolate(shapes, (height, width), mode="area")[:, 0], 0.7)
        mean = templates.sum((1, 2)) / size**2
        spread = (templates.square().sum((1, 2)) - size**2 * mean**2).sqrt()
        products = functional.conv2d(wide, templates[:, None])[0].flatten(1) - (mean * amplitude.sum())[:, None]
        found = products / (spread[:, None] * deviation)
        if float(found.max()) > best:
            best = float(found.max())
            scores = found[:, int(found.amax(0).argmax())]
    pairs = zip(letters, scores.tolist(), strict=True)
    return dict(sorted(pairs, key=lambda pair: -pair[1]))


def draw(path: Path, picture: Tensor, plain: Tensor, scores: dict[str, float]) -> None:
    """The picture, backprojection of the same counts, and the letters that are most alike."""
    figure = figure_type()(figsize=(10, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    extent = (-HALF_WIDTH, HALF_WIDTH, LOW, HIGH)
    for panel, (title, values) in zip(
        panels, {"backprojection": plain, "most likely": picture.sqrt()}.items(), strict=False
    ):
        panel.imshow(values.clamp_min(0).numpy(), cmap="gray", extent=extent)
        panel.set_title(title, fontsize=9)
        panel.set_xlabel("x (m)")
        panel.set_ylabel("y (m)")
    best = list(scores.items())[:8]
    panels[2].bar([letter for letter, _ in best], [value for _, value in best], color="0.4")
    panels[2].set_title("correlation with letters", fontsize=9)
    save_figure(figure, path, "keyhole_letter")


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folder", type=Path, help="files of one letter")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--resolution", type=int, default=48, help="pixels of a side of the picture")
    parser.add_argument("--output", type=Path, default=Path("demo_output"))
    parser.add_argument("--smoke", action="store_true", help="small enough for seconds: coarse, shows that it runs")
    if parser.parse_known_args(argv)[0].smoke:
        parser.set_defaults(steps=60, resolution=24)
    options = parser.parse_args(argv)
    track = read_track(options.folder)
    model = Prediction(track, options.resolution)
    picture = most_likely(model, track, options.steps)
    plain = model.geometry.adjoint((track.counts - track.background) * model.used)
    scores = letter_scores(picture)
    options.output.mkdir(parents=True, exist_ok=True)
    draw(options.output / "keyhole_letter.png", picture, plain, scores)
    (first, value), (second, other) = list(scores.items())[:2]
    print(f"keyhole_letter: {first} {value:.3f}, then {second} {other:.3f}; {options.output / 'keyhole_letter.png'}")
    result = {"scores": scores, "positions": track.counts.shape[1]}
    (options.output / "keyhole_letter.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return {**result, "picture": picture}


if __name__ == "__main__":
    main()
