"""One parameter of a scene traced and recorded, value by value: renders and derivatives in both modes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from tools.gradient_sweep.measure import Subject
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.rendering.engine import run
from torchtransient.rendering.job import Item, RenderJob, Seeding
from torchtransient.rendering.recording import LAUNCHED
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.load import Scene
from torchtransient.scene.physics import PhysicsWatch

SPP = 2
# Calls of a kind: traced, recorded, launched with other values and seeds. What is found to change may be recorded once
# more; the last one has to be launched.
STEPS = (0.0, 0.5, 1.0, -0.5, 0.25)


@dataclass(frozen=True)
class Outcome:
    """What a parameter's runs came to: the largest difference of each kind of run by its scale, and what was said."""

    differences: dict[str, float]
    said: dict[str, list[str]]

    @property
    def launched(self) -> bool:
        """Whether the last call of each kind was launched without tracing."""
        return all(words[-1] == LAUNCHED for words in self.said.values())

    @property
    def refused(self) -> bool:
        """Whether some kind is never recorded."""
        return any(words[-1].startswith("traced") for words in self.said.values())


class Runs:
    """Renders and derivatives of one parameter."""

    def __init__(self, scene: Scene, key: str) -> None:
        self.scene, self.key, self.subject = scene, key, Subject(scene, key)
        tangent = self.subject.tangents()[0]
        self.direction, self.step = tangent.direction, tangent.step
        self.one_sided = tangent.one_sided

    def values(self) -> Iterator[tuple[int, torch.Tensor]]:
        """(seed, value)"""
        for seed, share in enumerate(STEPS):
            share = abs(share) if self.one_sided else share
            yield seed, self.subject.value + share * self.step * self.direction

    def job(self, seed: int, freeze: bool, needs: tuple[bool, ...] = ()) -> RenderJob:
        item = Item(0, 0, seed, seed)
        options = self.scene.options_for([self.key], BuildOptions(transient=True))
        watch = PhysicsWatch("ignore", set())
        return RenderJob(
            self.scene, options, (self.key,), (item,), Seeding((0,), 1, "same"), (False,), SPP, SPP, None, watch, needs,
            freeze=freeze,
        )  # fmt: skip

    def outcome(self) -> Outcome:
        """Recorded runs against traced ones."""
        differences: dict[str, float] = {}
        said: dict[str, list[str]] = {"render": [], "reverse": [], "forward": []}
        for seed, value in self.values():
            for kind, call in (("render", self.render), ("reverse", self.reverse), ("forward", self.forward)):
                expected, _ = call(seed, value, False)
                got, words = call(seed, value, True)
                said[kind].append(words)
                scale = max(float(np.abs(expected).max()), 1e-12)
                worst = float(np.abs(got - expected).max()) / scale if expected.size else 0.0
                differences[kind] = max(differences.get(kind, 0.0), worst if np.isfinite(worst) else np.inf)
        return Outcome(differences, said)

    def render(self, seed: int, value: torch.Tensor, freeze: bool) -> tuple[np.ndarray, str]:
        job = self.job(seed, freeze)
        steady, response = run(job, RENDER, [value])
        return np.concatenate([steady.numpy().ravel(), response.numpy().ravel()]), job.log[0].recorded[0]

    def reverse(self, seed: int, value: torch.Tensor, freeze: bool) -> tuple[np.ndarray, str]:
        job = self.job(seed, freeze, (True,))
        shape = self.subject._cube_shape()
        weights = torch.cos(torch.arange(float(np.prod(shape)))).reshape(shape)
        (gradient,) = run(job, BACKWARD, [value], [torch.ones(*shape[:2], shape[-1]), weights])
        return gradient.numpy().ravel(), job.derivative_log[0]

    def forward(self, seed: int, value: torch.Tensor, freeze: bool) -> tuple[np.ndarray, str]:
        job = self.job(seed, freeze, (True,))
        steady, response = run(job, FORWARD, [value], [self.direction])
        return np.concatenate([steady.numpy().ravel(), response.numpy().ravel()]), job.derivative_log[0]
