"""docs/sensors.md: its examples run, its names exist, its pictures are there."""

from __future__ import annotations

import re
from pathlib import Path

import torch

from torchtransient import sensing

PAGE = Path(__file__).parents[2] / "docs" / "sensors.md"
TEXT = PAGE.read_text(encoding="utf-8")


def run(number):
    code = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)[number]
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    return names


def test_first_example():
    names = run(0)
    assert names["taps"].shape == (1, 8, 16, 16)
    # Bin 133 ends at 13.4 ns; 4000 electrons with a contrast of 0.6 measure to some millimetres.
    wanted = 0.5 * 133.5 * names["axis"].bin_width_opl
    assert float((names["depth_m"] - wanted).abs().max()) < 0.15
    assert abs(float(names["depth_m"].mean()) - wanted) < 0.01
    assert bool(torch.isfinite(names["reading"].depth_std_m).all())


def test_example_of_two_taps():
    names = run(1)
    assert names["frames"].shape == (1, 4, 16, 16)
    error = names["found"].depth_m - 0.5 * 120.5 * names["axis"].bin_width_opl
    # The deviation that the reading says, and what noise leaves of a mean of 256 pixels.
    said = float(names["found"].depth_std_m.mean())
    assert abs(float(error.std()) / said - 1) < 0.2
    assert abs(float(error.mean())) < 4 * said / 16


def test_devices_example():
    assert run(2)["quiet"].sensor().stages[1].read_noise_e == 5.0


def test_names_exist():
    named = set(re.findall(r"`(?:sensing\.)?([A-Za-z]\w+)`", TEXT))
    known = {n for n in named if hasattr(sensing, n)}
    elsewhere = {
        "Compose", "TransientRenderer", "expected", "forward", "gaussian", "straight_through", "score", "transform",
        "polarsens", "LinearPhysics", "Physics", "img_size", *sensing.DEVICES, "depth_std_m", "std_e", "offset_e",
        "electrons_per_unit",
    }  # fmt: skip
    assert named - known - elsewhere == set()
    assert {"read_itof", "StreakCamera", "PolarizationMosaic", "log_matched_filter"} <= known


def test_pictures_are_there_and_drawn_by_the_script():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT)
    assert len(pictures) >= 12
    script = (PAGE.parent / "make_sensor_figures.py").read_text(encoding="utf-8")
    for picture in pictures:
        path = PAGE.parent / picture
        assert path.read_bytes().startswith(b"\x89PNG")
        example = Path(__file__).parents[2] / "training_examples" / f"{path.stem}.py"
        assert f'"{path.name}"' in script or example.exists()


def test_all_devices_are_listed():
    assert all(f"`{name}`" in TEXT for name in sensing.DEVICES)
