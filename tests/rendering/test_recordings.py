"""When it is said that no call can be launched, and why. No kernels here."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import pytest

from torchtransient.errors import TorchTransientError
from torchtransient.plugins.frozen_state import NotComparableError
from torchtransient.rendering import recording
from torchtransient.rendering.recording import (
    FIRST,
    LAUNCHED,
    RECORDED,
    SEVERAL,
    NotRecordedError,
    Recording,
    Recordings,
    _difference,
    _short,
)

VARIANT = "llvm_ad_rgb"


def job_of(structure, *, refusal=None, launches=(1,), kind="render"):
    cleared = []

    def state_of(jobs):
        if isinstance(structure, Exception):
            raise structure
        return structure, []

    return SimpleNamespace(
        refusal=refusal, launches=launches, kind=kind, cleared=cleared, integrator=SimpleNamespace(state_of=state_of),
        film=SimpleNamespace(clear=lambda: cleared.append(1)), scene=None,
    )  # fmt: skip


@pytest.fixture
def kept(monkeypatch):
    """Recordings that are launched from the third call of a structure on."""

    def run(self, jobs, arrays):
        self.calls += 1
        if self.calls == 1:
            self.refusal = None
            raise NotRecordedError(FIRST)
        return [["result"]], self.calls > 2

    monkeypatch.setattr(Recording, "run", run)
    return Recordings()


def called(kept, *structure, **more):
    try:
        return kept.run([job_of(structure, **more)])[0]
    except NotRecordedError as error:
        return str(error)


def test_the_first_call_is_traced_and_the_second_recorded(kept):
    assert [called(kept, "a") for _ in range(4)] == [FIRST, RECORDED, LAUNCHED, LAUNCHED]
    assert [called(kept, "b") for _ in range(3)] == [FIRST, RECORDED, LAUNCHED]
    assert len(kept) == 2


def test_what_is_not_recorded(kept):
    """Nothing has been rendered then, and films that would have been are empty."""
    with pytest.raises(NotRecordedError, match=SEVERAL[:30]):
        kept.run([job_of("a", launches=(1, 2))])
    with pytest.raises(NotRecordedError, match="traced: too wide"):
        kept.run([job_of("a", refusal="too wide")])
    with pytest.raises(NotRecordedError, match="cannot be told of a module"):
        kept.run([job_of(NotComparableError("a module"))])
    jobs = [job_of("a"), job_of("a")]
    with pytest.raises(NotRecordedError, match=FIRST):
        kept.run(jobs)
    assert [job.cleared for job in jobs] == [[1], [1]]


def test_structures_that_are_kept(kept, monkeypatch):
    """The last ones that were called: a call keeps its structure."""
    monkeypatch.setattr(recording, "MAX_STRUCTURES", 3)
    for name in "abc":
        called(kept, name)
    called(kept, "a")
    called(kept, "d")
    assert len(kept) == 3
    assert called(kept, "a") == LAUNCHED and called(kept, "b") == FIRST


@pytest.mark.parametrize(("kinds", "after"), [(64, 64), (3, 70), (1, 66)])
def test_calls_in_vain_are_said_once(kept, monkeypatch, kinds, after):
    """After 64, and two more for each kind of call that has come again: none of these is ever launched."""
    run = Recording.run
    monkeypatch.setattr(Recording, "run", lambda self, jobs, arrays: (run(self, jobs, arrays)[0], False))
    for number in range(after - 1):
        assert not said(kept, number % kinds)
    (text,) = said(kept, (after - 1) % kinds)
    assert text.startswith(f"the last {after} renders and derivatives of a scene were all traced anew")
    assert not said(kept, "newer")


def said(kept, *structure):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        called(kept, *structure)
    return [str(one.message) for one in caught]


def test_a_launch_begins_the_count_anew(kept):
    for number in range(40):
        called(kept, "spp", number)
    for _ in range(3):
        called(kept, "same")
    for number in range(61):
        assert not said(kept, "more", number)


def test_why_calls_are_in_vain(kept):
    """The structure of the call of the same kind before; how many kinds take turns; what Dr.Jit refuses."""
    kept._warned = True
    for number in range(63):
        called(kept, ("spp", number), "rest")
    called(kept, ("spp", 1000), "rest", kind="backward")
    kept._warned, kept._unlaunched = False, 100
    (text,) = said(kept, ("spp", 1001), "rest")
    assert "more than 64 kinds of calls take turns, and what they depend on changed from 62 to 1001. Tracing" in text
    few = Recordings()
    called(few, ("spp", 1), "rest")
    few._unlaunched = 100
    (text,) = said(few, ("spp", 2), "rest")
    assert "could use a recording: what they depend on changed from 1 to 2. Tracing" in text
    refusing = Recordings()
    called(refusing, "a")
    next(iter(refusing._by_structure.values())).refusal = "traced: too wide"
    refusing._unlaunched = 100
    (text,) = said(refusing, "a")
    assert "could use a recording: traced: too wide. Tracing" in text
    found = next(iter(refusing._by_structure.values()))
    found.refusal, found.waits = None, "traced: an array waits"
    assert refusing._reason("render", next(iter(refusing._by_structure))) == "traced: an array waits"


def test_what_waits_is_recorded_another_time(monkeypatch):
    one = Recording()
    one.refusal = None

    def fail(scene, arrays):
        raise RuntimeError("collect()")

    monkeypatch.setattr(recording, "not_recordable", lambda error, before: recording.WAITS)
    one._frozen = fail
    with pytest.raises(NotRecordedError, match=recording.WAITS):
        one.run([job_of("a")], [])
    assert one.refusal is None and one.waits == f"traced: Dr.Jit cannot record it: {recording.WAITS}"
    one._frozen = lambda scene, arrays: []
    assert one.run([job_of("a")], []) == ([], True) and one.waits == ""


def test_differences_of_structures():
    assert _difference(("a", ("spp", 3)), ("a", ("spp", 5))) == "what they depend on changed from 3 to 5"
    assert _difference(("a",), ("b",)) == "what they depend on changed from 'a' to 'b'"
    assert _difference(("a",), ("a", "b", "c")) == "what they depend on had 1 parts and has 3"
    assert _difference(("a",), ("a",)) == "types, sizes or flags of the arrays change from call to call"
    assert _short((1, 2, 3)) == "(1, 2, 3)"
    assert _short("x" * 78) == repr("x" * 78) and _short("x" * 79) == "'" + "x" * 76 + "..."


def test_a_recording_that_was_refused_stays_refused():
    one = Recording()
    for refusal in (FIRST, None):
        assert one.refusal == refusal
        if refusal:
            with pytest.raises(NotRecordedError, match=FIRST):
                one.run([job_of("a")], [])
    one.refusal = "traced: too wide"
    for _ in range(2):
        with pytest.raises(NotRecordedError, match="too wide"):
            one.run([job_of("a")], [])
    assert one.calls == 3


def test_drjit_itself_warns_of_nothing(monkeypatch):
    """Not before the largest number of calls: what is in vain is said by the scene."""
    import drjit as dr

    made = []
    monkeypatch.setattr(dr, "freeze", lambda call, **settings: made.append(settings))
    Recording()._freeze()
    assert made == [{"limit": 8, "warn_after": 2**31 - 1}]


def test_errors_of_a_call_are_its_own():
    """And no reason against recordings: the next call is recorded anew."""
    one = Recording()
    one.refusal = None
    for error in (TorchTransientError("broken"), KeyboardInterrupt()):

        def fail(scene, arrays, error=error):
            raise error

        one._frozen = fail
        with pytest.raises(type(error)):
            one.run([job_of("a")], [])
        assert one._frozen is None and one.refusal is None and one._jobs == ()


@pytest.mark.parametrize("word", ["__cause__", "__context__"])
def test_what_failed_is_raised_as_a_traced_call_raises_it(monkeypatch, word):
    """Without the recorder's own error, and with all that it came of."""
    one, first = Recording(), ValueError("first")
    inside, raised = RuntimeError("inside of a loop"), RuntimeError("while it was recorded")
    one.refusal = None

    def fail(scene, arrays):
        raise raised

    for reason, below, expected in ((first, inside, inside), (raised, inside, raised), (first, None, raised)):
        setattr(inside, word, first)
        setattr(raised, word, below)
        one._frozen = fail
        monkeypatch.setattr(recording, "not_recordable", lambda error, before, reason=reason: reason)
        with pytest.raises(RuntimeError) as caught:
            one.run([job_of("a")], [])
        assert caught.value is expected and one.refusal is None
        if expected is inside:
            assert getattr(caught.value, word) is first
            assert caught.value.__suppress_context__ is (word == "__cause__")
    one._frozen = fail
    monkeypatch.setattr(recording, "not_recordable", lambda error, before: "it changes its type")
    with pytest.raises(NotRecordedError, match=r"traced: Dr\.Jit cannot record it: it changes its type") as caught:
        one.run([job_of("a")], [])
    assert caught.value.broken and one.refusal == str(caught.value)
