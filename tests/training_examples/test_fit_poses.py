"""Poses from moving edges: an occluder from its shadow alone, a concave body before a wall."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

import torchtransient as tt

FOLDER = Path(__file__).parents[2] / "training_examples"


@pytest.fixture(scope="module")
def shadow():
    return runpy.run_path(str(FOLDER / "fit_shadow.py"))


@pytest.fixture(scope="module")
def body():
    return runpy.run_path(str(FOLDER / "fit_body.py"))


@pytest.fixture(autouse=True)
def one_thread():
    with tt.threads(1):
        yield


def test_the_block_is_closed_and_seen_from_outside(body):
    """Each edge belongs to two faces, once in either direction, and the volume has its sign and size."""
    vertices, faces = body["block"]()
    edges = [(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    volume = np.linalg.det(vertices[faces]).sum() / 6
    assert volume == pytest.approx(0.3 * (0.6 * 0.25 + 0.55 * 0.25), rel=1e-9)


def test_starts_and_truths_are_as_far_off_as_said(shadow, body):
    assert shadow["errors"](shadow["start_of"](3)) == pytest.approx((200.0, 5.0), rel=1e-4)
    truth = body["POSE"](body["true_numbers"](3))
    assert body["errors"](body["POSE"](torch.zeros(6)), truth) == pytest.approx((100.0, 15.0), rel=1e-4)


@pytest.mark.slow
def test_a_pose_from_its_shadow(shadow, tmp_path, capsys):
    (fit,) = shadow["main"](["--smoke", "--output", str(tmp_path)])
    assert capsys.readouterr().out.startswith("fit_shadow, seed 0: ")
    # From 200 mm and 5 degrees; with half of the steps and a seventh of the samples two seeds end at 17 and 11 mm,
    # 1.2 and 0.8 degrees.
    assert fit.millimetres[-1] < 40
    assert fit.degrees[-1] < 2.5
    assert (tmp_path / "fit_shadow.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchtransient.errors.GradientWarning")
def test_the_interior_derivative_of_a_shadow_moves_nothing(shadow, tmp_path):
    (fit,) = shadow["main"](["--smoke", "--no-boundary", "--steps", "3", "--output", str(tmp_path)])
    assert fit.millimetres[-1] == pytest.approx(fit.millimetres[0], rel=1e-6)
    assert fit.degrees[-1] == pytest.approx(fit.degrees[0], rel=1e-6)


@pytest.mark.slow
def test_a_pose_of_a_concave_body(body, tmp_path, capsys):
    (fit,) = body["main"](["--smoke", "--output", str(tmp_path)])
    assert capsys.readouterr().out.endswith(" of 1 within 2 mm and 0.5 degrees\n")
    # A guess of 11 mm and 8 degrees; with half of the steps and a quarter of the samples, 1.5 mm and 0.2 degrees.
    assert fit.millimetres[-1] < 0.5 * fit.millimetres[0]
    assert fit.degrees[-1] < 0.2 * fit.degrees[0]
    assert (tmp_path / "fit_body.png").read_bytes().startswith(b"\x89PNG")
