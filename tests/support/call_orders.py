"""Calls of the public interface in any order, and what every one of them has to answer: for machines that draw orders.

What a renderer answers depends on its scene, values and seed alone. :class:`Calls` knows the answers of fresh renderers
and compares, whatever was called before: other scenes and variants, copies, mistakes, interrupts, other threads.
"""

from __future__ import annotations

import copy
import faulthandler
import gc
import pickle
import signal
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

import torchtransient as tt
from tools.small_room import COLOUR, GREY, WALL_POSE, make_room
from torchtransient.errors import TorchTransientError
from torchtransient.plugins.guards import interrupts_wait

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_mono_polarized", "scalar_rgb")
# Lanes add up in the order in which threads come; poses and fog amplify what single precision rounds.
ROUNDING = 2e-4
SEEDS = (0, 2**32 - 1)
# Values of parameters are those of the scene times these.
FACTORS = (1.0, 0.5, 1.25)


def _fog() -> dict[str, Any]:
    room = make_room()
    room["integrator"] = {"type": "transient_prbvolpath", "max_depth": 3}
    fog = {"type": "homogeneous", "sigma_t": 1.5, "albedo": 0.75}
    room["box"] = {**room["box"], "bsdf": {"type": "null"}, "interior": fog}
    return room


def _metal() -> dict[str, Any]:
    room = make_room()
    room["box"]["bsdf"] = {"type": "roughconductor", "alpha": 0.25}
    return room


@dataclass(frozen=True)
class Case:
    """A scene, the variant it is made in, parameters and options."""

    scene: Callable[[], dict[str, Any]]
    variant: str
    keys: tuple[str, ...]
    options: tuple[tuple[str, Any], ...] = ()
    ready: bool = False  # given as a loaded `mi.Scene`

    def renderer(self) -> tt.TransientRenderer:
        if self.ready:
            # A user's own change of the variant: Mitsuba reloads modules, and an interrupt where Python's import lets
            # go of its lock keeps it, so that other threads wait for ever.
            with interrupts_wait():
                mi.set_variant(self.variant)
            scene = tt.load(mi.load_dict(self.scene()))
        else:
            scene = tt.load(self.scene(), variant=self.variant)
        return tt.TransientRenderer(scene, list(self.keys), spp=2, **dict(self.options))


CASES = {
    "colours": Case(make_room, "llvm_ad_rgb", (COLOUR,)),
    "poses": Case(make_room, "llvm_ad_mono", (WALL_POSE, GREY), (("temporal_filter", "tent"),)),
    "phasors": Case(make_room, "llvm_ad_rgb", (COLOUR,), (("frequencies", (0.25, 0.5)),)),
    "fog": Case(_fog, "llvm_ad_mono", ("box.interior_medium.sigma_t.value.value",)),
    "polarization": Case(_metal, "llvm_ad_mono_polarized", ("box.bsdf.alpha.value",)),
    "ready": Case(make_room, "llvm_ad_rgb", (COLOUR,), ready=True),
    "traced": Case(make_room, "llvm_ad_rgb", (COLOUR,), (("freeze", False),)),
}


def image_of(out: tt.RenderOutput) -> torch.Tensor:
    """The time-resolved light of a result, histogram or phasors, as one real tensor."""
    if out.transient is not None:
        return out.transient
    return torch.view_as_real(out.phasor)


class Calls:
    """What was made so far, and every call that can follow. Each compares its own answer and raises where it is off."""

    references: dict[tuple[Any, ...], Any] = {}  # noqa: RUF012 - shared: fresh renderers answer the same every time

    def __init__(self) -> None:
        self.renderers: dict[str, tt.TransientRenderer] = {}
        self.pending: list[tuple[str, int, int, torch.Tensor, dict[str, torch.Tensor]]] = []
        self.stopped_at = ""

    # ------------------------------------------------------------------------------------------------- expectations

    @classmethod
    def prepare(cls) -> None:
        """Ask fresh renderers for every answer."""
        if cls.references:
            return
        for name in CASES:
            for k in range(len(FACTORS)):
                for seed in SEEDS:
                    renderer = CASES[name].renderer()
                    values = cls.values(renderer, k)
                    image = image_of(renderer(values, seed=seed))
                    gradients = torch.autograd.grad(cls.loss(image), list(values.values()))
                    cls.references[name, k, seed] = image.detach(), dict(zip(values, gradients, strict=True))
                    del renderer
            gc.collect()

    @staticmethod
    def values(renderer: tt.TransientRenderer, k: int) -> dict[str, torch.Tensor]:
        """The k-th values of a renderer's parameters: poses are moved, all others scaled."""
        found = {}
        for key, value in CaseValues.of(renderer).items():
            new = value.clone()
            if key == WALL_POSE:
                new[2, 3] += 0.25 * (FACTORS[k] - 1)
            else:
                new *= FACTORS[k]
            found[key] = new.requires_grad_()
        return found

    @staticmethod
    def loss(image: torch.Tensor) -> torch.Tensor:
        """Something that weighs the entries apart from each other; linear, so that its slope is that of the light."""
        weights = torch.linspace(0.5, 1.5, image.numel(), dtype=image.dtype).reshape(image.shape)
        return (image * weights).sum()

    def check_image(self, name: str, k: int, seed: int, image: torch.Tensor) -> None:
        expected = self.references[name, k, seed][0]
        torch.testing.assert_close(image.detach(), expected, rtol=ROUNDING, atol=ROUNDING * float(expected.abs().max()))

    def check_gradients(self, name: str, k: int, seed: int, found: dict[str, torch.Tensor]) -> None:
        for key, expected in self.references[name, k, seed][1].items():
            atol = ROUNDING * float(expected.abs().max())
            torch.testing.assert_close(found[key], expected, rtol=ROUNDING, atol=atol)

    # --------------------------------------------------------------------------------------------------------- calls

    def renderer(self, name: str) -> tt.TransientRenderer:
        if name not in self.renderers:
            self.load(name)
        return self.renderers[name]

    def load(self, name: str) -> None:
        self.renderers[name] = CASES[name].renderer()

    def let_go(self, name: str) -> None:
        self.renderers.pop(name, None)
        gc.collect()

    def switch(self, variant: str) -> None:
        mi.set_variant(variant)

    def render(self, name: str, k: int, seed: int) -> None:
        self.check_image(name, k, seed, image_of(self.renderer(name)(self.values(self.renderer(name), k), seed=seed)))

    def render_without_derivatives(self, name: str, k: int, seed: int) -> None:
        renderer = self.renderer(name)
        with torch.inference_mode():
            values = {key: value.detach().clone() for key, value in self.values_outside(renderer, k).items()}
            self.check_image(name, k, seed, image_of(renderer(values, seed=seed)).clone())

    def values_outside(self, renderer: tt.TransientRenderer, k: int) -> dict[str, torch.Tensor]:
        with torch.inference_mode(False):
            return self.values(renderer, k)

    def backward(self, name: str, k: int, seed: int) -> None:
        renderer = self.renderer(name)
        values = self.values(renderer, k)
        image = image_of(renderer(values, seed=seed))
        self.check_image(name, k, seed, image)
        found = torch.autograd.grad(self.loss(image), list(values.values()))
        self.check_gradients(name, k, seed, dict(zip(values, found, strict=True)))

    def begin(self, name: str, k: int, seed: int) -> None:
        """Render now and differentiate later; the renderer may be gone by then."""
        renderer = self.renderer(name)
        values = self.values(renderer, k)
        self.pending = [*self.pending[-3:], (name, k, seed, image_of(renderer(values, seed=seed)), values)]

    def end(self, which: int) -> None:
        if not self.pending:
            return
        name, k, seed, image, values = self.pending.pop(which % len(self.pending))
        self.check_image(name, k, seed, image)
        found = torch.autograd.grad(self.loss(image), list(values.values()))
        self.check_gradients(name, k, seed, dict(zip(values, found, strict=True)))

    def forward(self, name: str, k: int, seed: int) -> None:
        """Tangents against the reference of reverse mode: a direction is the values themselves."""
        renderer = self.renderer(name)
        values = {key: value.detach() for key, value in self.values(renderer, k).items()}
        tangents = {key: torch.ones_like(value) for key, value in values.items()}
        if WALL_POSE in tangents:  # the row below is none of a pose, and turns are another story
            tangents[WALL_POSE] = torch.zeros(4, 4).index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(1.0))
        image, slope = torch.func.jvp(lambda values: image_of(renderer(values, seed=seed)), (values,), (tangents,))
        self.check_image(name, k, seed, image)
        expected = sum((self.references[name, k, seed][1][key] * tangent).sum() for key, tangent in tangents.items())
        size = float(self.loss(slope.abs())) + float(abs(expected))
        assert abs(float(self.loss(slope) - expected)) <= 10 * ROUNDING * size

    def batch(self, name: str, seed: int) -> None:
        renderer = self.renderer(name)
        many = [self.values(renderer, k) for k in (0, 1)]
        values = {key: torch.stack([value[key].detach() for value in many]) for key in many[0]}
        images = image_of(renderer(values, seed=[seed, seed]))
        for k in (0, 1):
            self.check_image(name, k, seed, images[k])

    def edit_in_place(self, name: str, k: int, seed: int) -> None:
        """Give the module's own parameters other values, as an optimiser does, and put the first ones back."""
        renderer = self.renderer(name)
        before = {key: value.detach().clone() for key, value in renderer.values.items()}
        with torch.no_grad():
            for key, value in self.values(renderer, k).items():
                renderer.values[key].copy_(value)
        try:
            self.check_image(name, k, seed, image_of(renderer(seed=seed)))
        finally:
            with torch.no_grad():
                for key, value in before.items():
                    renderer.values[key].copy_(value)

    def copied(self, name: str, how: str) -> None:
        """Go on with a copy; scenes that were taken as they are say that they cannot be pickled."""
        renderer = self.renderer(name)
        if how == "deepcopy":
            self.renderers[name] = copy.deepcopy(renderer)
        elif how == "state_dict":
            fresh = CASES[name].renderer()
            fresh.load_state_dict(renderer.state_dict())
            self.renderers[name] = fresh
        elif CASES[name].ready:
            try:
                self.renderers[name] = pickle.loads(pickle.dumps(renderer))
            except (TorchTransientError, pickle.PicklingError):
                return
        else:
            self.renderers[name] = pickle.loads(pickle.dumps(renderer))

    def mistake(self, name: str, what: int) -> None:
        renderer = self.renderer(name)
        key = CASES[name].keys[0]
        wrong: list[Callable[[], Any]] = [
            lambda: renderer({"no.such.key": torch.ones(1)}),
            lambda: renderer({key: torch.ones(7, 5, 3, 2, 1)}),
            lambda: renderer(seed=1.5),
            lambda: renderer(spp=0),
            lambda: renderer({key: "red"}),
            lambda: renderer(sede=1),
            lambda: tt.load({"type": "scene", "wall": {"type": "no_such_shape"}}).parameters(),
            lambda: tt.TransientRenderer(renderer.scene, ["no.such.key"]),
        ]
        try:
            wrong[what % len(wrong)]()
        except (TorchTransientError, TypeError, KeyError):
            return
        raise AssertionError(f"mistake {what % len(wrong)} was taken")

    def mitsuba_alone(self) -> None:
        """A user's own scene, rendered and let go of in whatever variant is active."""
        if mi.variant() is None:
            mi.set_variant("llvm_ad_rgb")
        image = np.array(mi.render(mi.load_dict({**mi.cornell_box(), "integrator": {"type": "direct"}}), spp=1))
        assert np.all(np.isfinite(image))

    def flags(self, on: bool) -> None:
        dr.set_flag(dr.JitFlag.KernelHistory, on)
        dr.kernel_history_clear()

    def threads(self, count: int) -> None:
        tt.threads(count)

    def collect(self) -> None:
        gc.collect()
        if mi.variant() is not None:
            dr.flush_malloc_cache()

    def plan(self, name: str) -> None:
        tt.plan(CASES[name].scene())

    def in_two_threads(self, first: str, second: str, seed: int) -> None:
        """Renders and derivatives of two scenes, of two variants at times, at once."""
        jobs = [(first, 0), (second, 1)]
        for name, _ in jobs:
            self.renderer(name)
        errors: list[BaseException] = []

        def work(name: str, k: int) -> None:
            try:
                for _ in range(2):
                    self.backward(name, k, seed)
            except BaseException as error:  # noqa: BLE001 - shown by the thread that started this one
                errors.append(error)

        workers = [threading.Thread(target=work, args=job) for job in jobs]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join(60)
        if any(worker.is_alive() for worker in workers):
            faulthandler.dump_traceback(all_threads=True)
            raise AssertionError("two threads wait for each other, or for a third one")
        if errors:
            raise errors[0]

    def interrupted(self, call: Callable[[], None], after: float) -> bool:
        """A timer in place of a user who presses control and C; whether it came in time."""

        def stop(_number: int, frame: Any) -> None:
            self.stopped_at = "".join(traceback.format_stack(frame, limit=8))
            signal.raise_signal(signal.SIGINT)  # as the keyboard does: a change of the variant lets it wait

        previous, derivatives = signal.signal(signal.SIGALRM, stop), torch.is_grad_enabled()
        try:
            try:
                signal.setitimer(signal.ITIMER_REAL, max(after, 1e-4))
                call()
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
        except KeyboardInterrupt:
            return True
        finally:
            signal.signal(signal.SIGALRM, previous)
            # Blocks of torch's own, as no_grad, do not survive an interrupt at their ends.
            torch.set_grad_enabled(derivatives)
        return False


class CaseValues:
    """The first values of a renderer's parameters, remembered by scene: an interrupted edit may leave others."""

    _known: dict[tuple[str, ...], dict[str, torch.Tensor]] = {}  # noqa: RUF012

    @classmethod
    def of(cls, renderer: tt.TransientRenderer) -> dict[str, torch.Tensor]:
        keys = tuple(renderer.values)
        return cls._known.setdefault(keys, {key: renderer.values[key].detach().clone() for key in keys})
