"""What an interrupt cuts off in the middle of being put back is put back by the next call, of whatever scene."""

from __future__ import annotations

import functools
import gc
import random
import signal

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from support.interrupts import moments_of
from support.marks import long
from tools.small_room import COLOUR, VARIANT, WALL_POSE, make_room
from torchtransient import _collection
from torchtransient._collection import no_collection
from torchtransient.errors import SceneError, ShapeError, TorchTransientWarning
from torchtransient.plugins import unfinished
from torchtransient.plugins.drjit_pool import engine_lock
from torchtransient.plugins.interrupted import interrupts_wait
from torchtransient.plugins.unfinished import afterwards, make_good
from torchtransient.rendering.interrupts import quiet
from torchtransient.rendering.variant import active_variant
from torchtransient.scene.description import _search_path
from torchtransient.scene.load import Scene

# What ends calls: the moments in these functions are the ones that leave something behind.
ENDS = {
    "__exit__", "_exit_wrapper", "_carry_out", "afterwards", "leave", "_settle", "restore", "_update", "put_back",
    "_follow", "as_before", "values_of", "_same", "no_collection", "session_of", "active_variant", "at_work",
    "take_filter", "quiet", "put_back_log_level", "interrupts_wait", "named_errors", "<lambda>", "_as_at_call",
    "_scenes_as_at_call", "lent_to",
}  # fmt: skip


def ready():
    """Two scenes, of a renderer and of Mitsuba, and the calls that are interrupted."""
    mi.set_variant(VARIANT)
    renderer = tt.TransientRenderer(make_room(), [COLOUR, WALL_POSE], spp=2, temporal_filter="tent", freeze=False)
    scene = mi.load_dict(make_room())
    seen = tt.wrap(lambda params: mi.render(scene, params, spp=2, seed=0)[0], mi.traverse(scene))
    shared = tt.TransientRenderer(tt.load(scene), [COLOUR], spp=2, freeze=False)

    def backward(of=renderer):
        of(seed=0).transient.mean().backward()

    def of_a_twin():
        backward(tt.TransientRenderer(make_room(), [COLOUR, WALL_POSE], spp=2, freeze=False))

    def wrapped():
        seen({COLOUR: torch.full((3,), 0.5, requires_grad=True)}).mean().backward()

    jobs = {"backward": backward, "twin": of_a_twin, "wrapped": wrapped, "shared": functools.partial(backward, shared)}
    return jobs, tt.TransientRenderer(make_room(), [COLOUR], spp=2, freeze=False)


def pushed(renderer):
    """A forward derivative: Dr.Jit builds it into every object alive, and refuses where one of them is attached."""
    x = torch.full((3,), 0.5)
    return torch.func.jvp(lambda x: renderer({COLOUR: x}, seed=0).transient, (x,), (x,))


def check_moments(chosen, names):
    """Interrupts at ``chosen(moments)`` of each job leave all other calls as they were."""
    jobs, renderer = ready()
    level, expected = mi.logger().log_level(), pushed(renderer)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, *KINDS)}
    for name in names:
        jobs[name]()
        moments = moments_of(jobs[name])
        ends = [n for n, (_, function) in enumerate(moments) if function in ENDS]
        interrupted = 0
        for n in chosen(ends):
            where = f"{name}, interrupted at {n} of {len(moments)}, {moments[n]}"
            try:
                moments_of(jobs[name], n)
            except KeyboardInterrupt:
                interrupted += 1
            assert gc.isenabled(), where
            found = pushed(renderer)
            for one, other in zip(found, expected, strict=True):
                torch.testing.assert_close(one, other, msg=where)
            assert mi.variant() == VARIANT and mi.logger().log_level() == level, where
            assert gc.isenabled() and not _collection._traces and not unfinished._owed, where
            assert {number: signal.getsignal(number) for number in handlers} == handlers, where
        assert interrupted > len(ends) / 20 or interrupted > 3


@pytest.mark.slow
def test_interrupts_where_scenes_are_put_back():
    def chosen(ends):
        last = ends[-120:]  # of the backward pass
        return random.Random(0).sample(last, 4)

    check_moments(chosen, ("backward",))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["backward", "twin", "wrapped", "shared"])
def test_interrupts_wherever_something_is_put_back(name):
    check_moments(lambda ends: sorted(random.Random(1).sample(ends, min(150, len(ends)))), (name,))


def test_another_scene_after_an_interrupt(monkeypatch):
    """Forward mode refuses where any object alive is attached: the interrupted scene is none any more."""
    jobs, renderer = ready()
    expected = pushed(renderer)
    with monkeypatch.context() as patched:
        patched.setattr("torchtransient.scene.load.Scene._settle", interrupt_at_the_end())
        with pytest.raises(KeyboardInterrupt):
            jobs["backward"]()
    for one, other in zip(pushed(renderer), expected, strict=True):
        torch.testing.assert_close(one, other)


def interrupt_at_the_end():
    """In place of what puts back: an interrupt, once there is something attached."""
    from torchtransient.rendering import scene_handle

    own = scene_handle.Scene._settle

    def cut_off(scene, *args):
        if scene._unsettled:
            raise KeyboardInterrupt
        return own(scene, *args)

    return cut_off


@pytest.mark.slow
@pytest.mark.parametrize("name", long(["render", "parameters", "wrapped", "backward"], ["backward"]))
def test_kept_tracebacks_keep_nothing_else(name):
    """As sys.last_traceback and notebooks do: an interrupt at the beginning of a block's __exit__ leaves it unended."""
    jobs, renderer = ready()
    mi.set_variant("llvm_ad_mono")  # a call switches, and back
    calls = {
        "render": lambda: renderer(seed=0),
        "parameters": lambda: tt.load(make_room(), variant=VARIANT).parameters(),
        "wrapped": jobs["wrapped"],
        "backward": jobs["backward"],
    }
    call = calls[name]
    call()
    moments = moments_of(call)
    ends = [n for n, (file, function) in enumerate(moments) if file == "contextlib.py" and function == "__exit__"]
    kept = []
    for n in random.Random(0).sample(ends, 4):
        try:
            moments_of(call, n)
        except KeyboardInterrupt as interrupt:
            kept.append(interrupt)
        where = f"interrupted at {n} of {len(moments)}"
        assert not engine_lock._is_owned() and gc.isenabled() and not unfinished._owed, where
        assert mi.variant() == "llvm_ad_mono", where
    assert kept


def test_blocks_of_mitsubas_own_calls_are_not_forgotten():
    """A progress report of Mitsuba's own render that renders with the library: a call in no call, but in a trace."""
    seen = []
    with no_collection():
        tt.render(make_room(), spp=1, seed=0)
        seen.append(gc.isenabled())
        with active_variant(VARIANT), no_collection(of_call=True):
            pass
        seen.append(gc.isenabled())
    assert seen == [False, False] and gc.isenabled()


# ------------------------------------------------------------------------------------------------------- the ledger


def test_what_was_put_back_is_not_put_back_again():
    done = []
    with afterwards(lambda: done.append(1)):
        assert not done
    make_good()
    assert done == [1]


def test_the_last_change_is_put_back_first_and_before_the_next_call():
    done, broken = [], [True]

    def put_back(name):
        if broken[0]:
            raise KeyboardInterrupt
        done.append(name)

    first, second = afterwards(lambda: put_back("first")), afterwards(lambda: put_back("second"))
    with pytest.raises(KeyboardInterrupt), first, second:
        pass
    assert not done
    with pytest.raises(KeyboardInterrupt), active_variant(VARIANT):
        raise AssertionError("never reached")
    broken[0] = False
    with active_variant(VARIANT):
        assert done == ["second", "first"]
        with active_variant(VARIANT), afterwards(lambda: put_back("third")), active_variant(VARIANT):
            assert len(done) == 2  # calls inside of the call
    assert done == ["second", "first", "third"]


def never():
    raise ValueError("gone")


def test_what_a_handler_of_a_signal_raises_is_no_failure():
    """It may be any exception, as the TimeoutError of an alarm."""
    done, alarms = [], [TimeoutError("an alarm"), TimeoutError("another")]

    def put_back():
        if alarms:
            raise alarms.pop()
        done.append(1)

    alarms.pop()
    with pytest.raises(TimeoutError, match="an alarm"), afterwards(put_back):
        pass
    assert done == [1] and not unfinished._owed
    alarms.append(TimeoutError("later"))
    unfinished._owed["left"] = put_back
    with pytest.raises(TimeoutError, match="later"), active_variant(VARIANT):
        raise AssertionError("never reached")
    assert done == [1, 1] and not unfinished._owed


@pytest.mark.parametrize("handled", [None, KeyboardInterrupt()])
def test_what_cannot_be_put_back_is_said_once(handled):
    """Also by a call in the except block of an interrupt, where people write checkpoints."""
    with pytest.raises(ValueError, match="gone"), afterwards(never):
        pass
    assert not unfinished._owed
    unfinished._owed["left"] = never
    try:
        if handled is not None:
            raise handled
        put_back_what_is_left_and_say("ValueError: gone.*load that scene again")
    except KeyboardInterrupt:
        put_back_what_is_left_and_say("ValueError: gone.*load that scene again")
    assert not unfinished._owed


def put_back_what_is_left_and_say(words):
    with pytest.warns(TorchTransientWarning, match=words) as said, active_variant(VARIANT):
        pass
    assert said[0].filename == __file__


def test_an_error_beside_an_interrupt_is_no_interrupt():
    with pytest.raises(ValueError, match="gone"), afterwards(never):
        raise KeyboardInterrupt
    assert not unfinished._owed


def test_a_frame_that_ends_late_changes_nothing():
    """A traceback that is kept keeps the frames that have something to put back: that has been done by then."""
    done = []
    block = afterwards(lambda: done.append(1))
    block.__enter__()
    make_good()  # as the next call
    block.__exit__(None, None, None)
    assert done == [1]


def test_what_is_done_meanwhile_is_left_out():
    """One thing that is put back may let go of the frame that was to put back another."""
    done, late = [], afterwards(lambda: done.append("late"))
    late.__enter__()
    early = afterwards(lambda: late.__exit__(None, None, None))
    early.__enter__()
    assert make_good() == [] and done == ["late"]
    early.__exit__(None, None, None)
    assert done == ["late"]


@pytest.mark.slow
def test_scenes_are_put_back_in_their_variant(monkeypatch):
    """A plugin in Python computes with the types of the active variant when its parameters change."""
    renderer, active = tt.TransientRenderer(tt.load(make_room(), variant="llvm_ad_mono"), [WALL_POSE], spp=2), []
    out = renderer(seed=0).transient.sum()
    own, once = Scene._settle, [True]

    def cut_off(scene, options):
        if scene._unsettled and once:
            once.clear()
            raise KeyboardInterrupt
        if scene._unsettled:
            active.append(mi.variant())
        own(scene, options)

    mi.set_variant(VARIANT)
    monkeypatch.setattr(Scene, "_settle", cut_off)
    with pytest.raises(KeyboardInterrupt):
        out.backward()
    assert active == ["llvm_ad_mono"] and mi.variant() == VARIANT and not unfinished._owed


def test_the_call_that_builds_a_scene_puts_back_first():
    done = []
    unfinished._owed["left"] = lambda: done.append(1)
    assert not done and tt.load(make_room()).parameters() and done == [1]
    for ask in (lambda: tt.threads(tt.threads().drjit), lambda: tt.render(make_room(), spp=1)):
        unfinished._owed["left"] = lambda: done.append(1)
        ask()
        assert done.pop() == 1 and not unfinished._owed


def test_what_others_set_meanwhile_stays(tmp_path):
    """Of a file resolver and a level of messages: users set them without any lock."""
    before, own = mi.file_resolver(), mi.FileResolver()
    block = _search_path(str(tmp_path))
    block.__enter__()
    mi.set_file_resolver(own)
    try:
        make_good()
        assert mi.file_resolver() is own
        block.__exit__(None, None, None)
        mi.set_file_resolver(before)
        with _search_path(str(tmp_path)):
            assert mi.file_resolver() is not before
        assert mi.file_resolver() is before
    finally:
        mi.set_file_resolver(before)
    level = mi.logger().log_level()
    block = quiet()
    block.__enter__()
    mi.logger().set_log_level(mi.LogLevel.Info)
    make_good()
    assert mi.logger().log_level() == mi.LogLevel.Info
    mi.logger().set_log_level(level)
    block.__exit__(None, None, None)


# ---------------------------------------------------------------------------------- calls in somebody's except block


@pytest.mark.parametrize(
    "handled", [KeyboardInterrupt(), ShapeError("of another call"), ValueError("of another call")]
)
def test_calls_in_an_except_block_raise_their_own_errors(room_scene, monkeypatch, handled):
    def broken(*args, **kwargs):
        raise RuntimeError("a plain mistake")

    renderer = tt.TransientRenderer(room_scene, [COLOUR], spp=2, freeze=False)
    monkeypatch.setattr("torchtransient.plugins.transport.walk.bounce", broken)
    try:
        raise handled
    except (KeyboardInterrupt, ValueError):
        with pytest.raises(SceneError, match="a plain mistake"):
            renderer(seed=0)


@pytest.mark.parametrize("handled", [KeyboardInterrupt(), ShapeError("of another call")])
def test_scenes_that_are_loaded_in_an_except_block(handled):
    try:
        raise handled
    except (KeyboardInterrupt, ValueError):
        room = make_room()
        room["wall"] = {"type": "no_such_plugin"}
        with pytest.raises(RuntimeError, match="no_such_plugin"):
            mi.load_dict(room)
        with pytest.raises(SceneError, match="no_such_plugin"):
            tt.render(room, spp=1)


# --------------------------------------------------------------------------------------------------- signals that wait

KINDS = (signal.SIGTERM, signal.SIGALRM, signal.SIGUSR1)


@pytest.fixture
def handlers():
    """Signals that raise; what they were is put back."""
    before = {number: signal.getsignal(number) for number in KINDS}
    heard = []

    def hear(number, frame):
        heard.append(number)
        raise KeyboardInterrupt(number)

    for number in KINDS:
        signal.signal(number, hear)
    yield heard, hear
    for number, handler in before.items():
        signal.signal(number, handler)


def test_every_signal_that_waits_is_handled(handlers):
    heard, hear = handlers
    block = interrupts_wait()
    block.__enter__()
    for number in (*KINDS, signal.SIGALRM):
        signal.raise_signal(number)
    assert not heard
    with pytest.raises(KeyboardInterrupt):
        block.__exit__(None, None, None)
    assert sorted(heard) == sorted(KINDS)
    assert all(signal.getsignal(number) is hear for number in KINDS)


def test_signals_while_handlers_are_put_back(handlers, monkeypatch):
    """Each of them is put back, and heard, also where one has raised in between."""
    heard, hear = handlers
    own, put_back = signal.signal, []

    def interrupted(number, handler):
        found = own(number, handler)
        if handler is hear and number not in put_back:
            put_back.append(number)
            signal.raise_signal(number)
        return found

    monkeypatch.setattr(signal, "signal", interrupted)
    with pytest.raises(KeyboardInterrupt), interrupts_wait():
        pass
    monkeypatch.undo()
    assert set(put_back) == set(KINDS) <= set(heard)
    assert all(signal.getsignal(number) is hear for number in KINDS)
