"""Any order of calls gives the numbers of fresh renderers: drawn by hypothesis, which shrinks what fails, and by a
seed where an order cannot be repeated to the letter (interrupts at random moments, two threads).
"""

from __future__ import annotations

import gc
import random
import threading
import time
from collections.abc import Callable

import hypothesis
import mitsuba as mi
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from support.call_orders import CASES, FACTORS, SEEDS, VARIANTS, Calls
from torchtransient.plugins import _registry, guards
from torchtransient.plugins.drjit_pool import engine_lock

pytestmark = pytest.mark.filterwarnings("ignore")

NAMES = st.sampled_from(sorted(CASES))
VALUES = st.integers(0, len(FACTORS) - 1)
SEED = st.sampled_from(SEEDS)
COPIES = ("deepcopy", "pickle", "state_dict")


def at_rest() -> None:
    """What every call leaves behind it: nobody holds a lock, messages and the collector are as they were."""
    locked: list[str] = []

    def ask() -> None:
        locks = {"engine": engine_lock, "registry": _registry._state.changes, "collection": guards._lock}
        for name, lock in locks.items():
            if lock.acquire(timeout=5):
                lock.release()
            else:
                locked.append(f"{name}: {lock}")

    asking = threading.Thread(target=ask)
    asking.start()
    asking.join()
    assert not locked, f"a call that has ended holds {locked}; the main thread is {threading.main_thread().ident}"
    assert gc.isenabled(), "a call that has ended has stopped the collector"
    assert mi.logger().log_level() == mi.LogLevel.Warn


class AnyOrder(RuleBasedStateMachine):
    """Rules are calls; each one compares its own answer."""

    def __init__(self) -> None:
        super().__init__()
        Calls.prepare()
        self.calls = Calls()

    @invariant()
    def rest(self) -> None:
        at_rest()

    @rule(name=NAMES, k=VALUES, seed=SEED)
    def render(self, name, k, seed):
        self.calls.render(name, k, seed)

    @rule(name=NAMES, k=VALUES, seed=SEED)
    def render_without_derivatives(self, name, k, seed):
        self.calls.render_without_derivatives(name, k, seed)

    @rule(name=NAMES, k=VALUES, seed=SEED)
    def backward(self, name, k, seed):
        self.calls.backward(name, k, seed)

    @rule(name=NAMES, k=VALUES, seed=SEED)
    def begin(self, name, k, seed):
        self.calls.begin(name, k, seed)

    @rule(which=st.integers(0, 3))
    def end(self, which):
        self.calls.end(which)

    @rule(name=NAMES, k=VALUES, seed=SEED)
    def forward(self, name, k, seed):
        self.calls.forward(name, k, seed)

    @rule(name=NAMES, seed=SEED)
    def batch(self, name, seed):
        self.calls.batch(name, seed)

    @rule(name=NAMES, k=VALUES, seed=SEED)
    def edit_in_place(self, name, k, seed):
        self.calls.edit_in_place(name, k, seed)

    @rule(name=NAMES, how=st.sampled_from(COPIES))
    def copied(self, name, how):
        self.calls.copied(name, how)

    @rule(name=NAMES)
    def load(self, name):
        self.calls.load(name)

    @rule(name=NAMES)
    def let_go(self, name):
        self.calls.let_go(name)

    @rule(name=NAMES, what=st.integers(0, 7))
    def mistake(self, name, what):
        self.calls.mistake(name, what)

    @rule(variant=st.sampled_from(VARIANTS))
    def switch(self, variant):
        self.calls.switch(variant)

    @rule()
    def mitsuba_alone(self):
        self.calls.mitsuba_alone()

    @rule(on=st.booleans())
    def flags(self, on):
        self.calls.flags(on)

    @rule(count=st.sampled_from((1, 2)))
    def threads(self, count):
        self.calls.threads(count)

    @rule()
    def collect(self):
        self.calls.collect()

    @rule(name=NAMES)
    def plan(self, name):
        self.calls.plan(name)

    def teardown(self) -> None:
        self.calls.flags(False)


def in_any_order(examples: int, steps: int, number: int) -> None:
    # Nothing is kept of earlier runs: the test of a number is the same one every time.
    run_state_machine_as_test(
        hypothesis.seed(number)(type(f"AnyOrder{number}", (AnyOrder,), {})),
        settings=settings(
            max_examples=examples, stateful_step_count=steps, deadline=None, database=None,
            suppress_health_check=list(HealthCheck), print_blob=False,
        ),
    )  # fmt: skip


@pytest.mark.slow
def test_any_order():
    in_any_order(3, 20, 0)


@pytest.mark.soak
@pytest.mark.parametrize("number", range(1, 17))
def test_many_orders(number):
    """400 in all, in parts that each end before a test counts as one that waits for ever."""
    in_any_order(25, 50, number)


def drawn_call(draw: random.Random, calls: Calls) -> tuple[str, Callable[[], None], bool]:
    """A call, what it is called, and whether an interrupt may cut it: torch's own `jvp` does not survive one."""
    name, other, k, seed = draw.choice(list(CASES)), draw.choice(list(CASES)), draw.randrange(3), draw.choice(SEEDS)
    made: dict[str, tuple[Callable[[], None], bool]] = {
        "load": (lambda: calls.load(name), True),
        "let go": (lambda: calls.let_go(name), True),
        "switch": (lambda: calls.switch(draw.choice(VARIANTS)), False),  # Mitsuba's own work
        "render": (lambda: calls.render(name, k, seed), True),
        "without derivatives": (lambda: calls.render_without_derivatives(name, k, seed), True),
        "backward": (lambda: calls.backward(name, k, seed), True),
        "begin": (lambda: calls.begin(name, k, seed), True),
        "end": (lambda: calls.end(k), True),
        "forward": (lambda: calls.forward(name, k, seed), False),
        "batch": (lambda: calls.batch(name, seed), True),
        "edit": (lambda: calls.edit_in_place(name, k, seed), True),
        "copy": (lambda: calls.copied(name, draw.choice(COPIES)), True),
        "mistake": (lambda: calls.mistake(name, draw.randrange(8)), True),
        "plan": (lambda: calls.plan(name), True),
        "two threads": (lambda: calls.in_two_threads(name, other, seed), False),
        "threads": (lambda: calls.threads(draw.choice((1, 2))), False),
        "collect": (calls.collect, False),
        "Mitsuba alone": (calls.mitsuba_alone, False),
    }
    kind = draw.choice(sorted(made))
    return f"{kind} {name}", *made[kind]


def with_interrupts(seed: int, steps: int) -> int:
    Calls.prepare()
    draw, calls, took, interrupts, said = random.Random(seed), Calls(), {}, 0, []
    for _ in range(steps):
        kind, call, may_stop = drawn_call(draw, calls)
        stop = may_stop and draw.random() < 0.5
        said.append(f"{kind}{' interrupted' if stop else ''}")
        started = time.perf_counter()
        try:
            if stop:
                interrupts += calls.interrupted(call, draw.random() * took.get(kind, 0.02))
            else:
                call()
                took[kind] = time.perf_counter() - started
            at_rest()
        except BaseException as error:
            error.add_note(f"seed {seed}, after {said[-12:]}; the last interrupt came at\n{calls.stopped_at}")
            raise
    return interrupts


@pytest.mark.slow
def test_orders_with_interrupts_and_threads():
    assert with_interrupts(0, 60) > 3


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(1, 41))
def test_many_orders_with_interrupts_and_threads(seed):
    assert with_interrupts(seed, 500) > 50
