"""How the films of a call become jobs: which go together, what each is told, what is refused. Nothing is rendered."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import pytest

from torchtransient.errors import ArgumentError, SceneError
from torchtransient.interfaces import BACKWARD, FORWARD, RENDER
from torchtransient.rendering import carry_out, engine
from torchtransient.rendering import films as choices
from torchtransient.rendering.recordings import (
    LARGE,
    LAUNCHED,
    NO_FREEZING,
    OWN_ENTRY,
    PROGRESS,
    SWITCHED_OFF,
    NotRecordedError,
)
from torchtransient.rendering.seeds import Item


def items(*entries, sensors=1):
    """One for each entry and sensor, with seeds that tell them apart."""
    return [
        Item(entry, sensor, 10 * n + 1, 10 * n + 5)
        for n, (entry, sensor) in enumerate((e, s) for e in entries for s in range(sensors))
    ]


def session_of(several, entries=100, **job):
    given = {"items": several, "spp": 3, "spp_grad": 7, "freeze": True} | job
    return SimpleNamespace(
        job=SimpleNamespace(**given), entries=lambda item: entries, slots=SimpleNamespace(slots=[]), scene="scene",
        params="params",
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- groups


@pytest.mark.parametrize(
    ("several", "entries", "sizes"),
    [
        (items(0), 100, [1]),
        # Entries of a batch have values of their own, sensors of an entry have not.
        (items(0, 1, 2), 100, [1, 1, 1]),
        (items(0, 1, sensors=3), 100, [3, 3]),
        (items(0, 0, 1, 0), 100, [2, 1, 1]),
        # Sixteen at once, and large films one by one.
        (items(0, sensors=16), 100, [16]),
        (items(0, sensors=17), 100, [16, 1]),
        (items(0, sensors=35), 100, [16, 16, 3]),
        (items(0, sensors=3), 2**18 - 1, [3]),
        (items(0, sensors=3), 2**18, [1, 1, 1]),
        ([], 100, []),
    ],
)
def test_items_that_go_together(several, entries, sizes):
    groups = list(carry_out.groups_of(session_of(several, entries)))
    assert [len(group) for group in groups] == sizes
    assert [pair for group in groups for pair in group] == list(enumerate(several))


# ------------------------------------------------------------------------------------------------- why one is traced


def test_why_a_call_is_traced():
    """In the order in which it is said."""
    group = list(enumerate(items(4)))
    slot = SimpleNamespace(key="a.radius", is_number_of_kernels=lambda: False)

    def why(freeze=True, number=False, report=None, lent=False):
        session = session_of([], freeze=freeze)
        session.slots.slots = [slot, SimpleNamespace(key="a.alpha", is_number_of_kernels=lambda: number)]
        return carry_out.refusal(session, group, lambda n: report, lent)

    assert why() is None
    assert why(freeze=False, number=True, report=print, lent=True) == SWITCHED_OFF
    assert why(number=True, report=print, lent=True) == "traced: numbers of a.alpha become part of the kernels"
    assert why(report=print, lent=True) == PROGRESS and why(lent=True) == LARGE
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        assert why(number=True) == NO_FREEZING
    assert carry_out.refusal(session_of([]), group) is None


# ------------------------------------------------------------------------------------------------------------- jobs


class Integrator:
    """Notes what it is told."""

    def __init__(self):
        self.told = []

    def prepared(self, scene, sensor, seed, spp, kind, grad_in):
        film = SimpleNamespace(hold=lambda arrays: self.told.append(("hold", sensor, arrays)))
        return SimpleNamespace(sensor=sensor, said=(scene, sensor, seed, spp, kind, grad_in), film=film)

    def run(self, job, progress=None):
        self.told.append((*job.said, progress))


def render(self, *_arguments, **_options):
    """Stands in for those of the library's base."""


render.__module__ = Integrator.__module__ = "torchtransient.plugins.integrators.base"
for name in ("render", "render_backward", "render_forward"):
    setattr(Integrator, name, render)


def carried(kind, several, integrator=None, recordings=None, **job):
    """(what is said, what was done in its order)."""
    session, done = session_of(several, **job), []
    session.integrator = integrator or Integrator()
    session.integrator.told = done
    session.recordings = recordings
    said = carry_out.carry_out(
        session, kind, list(enumerate(several)), lambda item: done.append(("install", item.sensor)),
        lambda n, item: done.append(("collect", n)), lambda n: (f"steady {n}", f"response {n}"),
    )  # fmt: skip
    return said, done


@pytest.mark.parametrize("kind", [RENDER, FORWARD, BACKWARD])
def test_traced_jobs(kind):
    """Each with its seed and samples. Derivatives use up what leads to the values, which are installed for each."""
    said, done = carried(kind, items(0, sensors=2), freeze=False)
    assert said == [SWITCHED_OFF] * 2

    def told(n):
        seed, spp = (10 * n + 1, 3) if kind == RENDER else (10 * n + 5, 7)
        return ("scene", n, seed, spp, kind, (f"steady {n}", f"response {n}"), None)

    again = [] if kind == RENDER else [("install", 1)]
    assert done == [("install", 0), told(0), ("collect", 0), *again, told(1), ("collect", 1)]


@pytest.mark.parametrize("kind", [RENDER, FORWARD, BACKWARD])
def test_recorded_jobs(kind):
    """All at once; gradients have arrived together."""
    ran = []

    def run(jobs):
        ran.append([job.said[1:4] for job in jobs])
        return LAUNCHED, [[n] for n in range(len(jobs))]

    said, done = carried(kind, items(0, sensors=3), recordings=SimpleNamespace(run=run))
    assert said == [LAUNCHED] * 3
    assert ran == [[(n, 10 * n + 1, 3) if kind == RENDER else (n, 10 * n + 5, 7) for n in range(3)]]
    each = [step for n in range(3) for step in (("hold", n, [n]), ("collect", n))]
    assert done == [("install", 0), *([("collect", 2)] if kind == BACKWARD else each)]


@pytest.mark.parametrize("kind", [RENDER, BACKWARD])
def test_jobs_that_could_not_be_recorded_are_traced(kind):
    def run(jobs):
        raise NotRecordedError("traced: the first call")

    said, done = carried(kind, items(0), recordings=SimpleNamespace(run=run))
    assert said == ["traced: the first call"]
    installs = [("install", 0)] * (1 if kind == RENDER else 2)
    assert done[:-2] == installs and done[-1] == ("collect", 0) and done[-2][0] == "scene"


def test_scenes_that_a_recording_has_broken_are_dropped():
    dropped = []
    session = session_of([], options="options", scene=SimpleNamespace(drop=dropped.append))
    carry_out.check_whole(session, NotRecordedError("whole"))
    assert dropped == []
    error = NotRecordedError("torn")
    error.broken = True
    with pytest.raises(SceneError, match=r"changed the type of an attribute .* torn"):
        carry_out.check_whole(session, error)
    assert dropped == ["options"]


@pytest.mark.parametrize(
    ("kind", "method", "expected"),
    [
        (RENDER, "render", (("scene",), {"seed": 1, "spp": 3, "develop": False, "progress_callback": None})),
        (BACKWARD, "render_backward", (("scene", "params", ("steady 0", "response 0")), {"seed": 5, "spp": 7})),
        (FORWARD, "render_forward", (("scene", "params"), {"seed": 5, "spp": 7, "develop": False})),
    ],
)
def test_integrators_with_an_entry_of_their_own_are_called_by_it(kind, method, expected):
    called = []

    class Own(Integrator):
        pass

    def entry(self, *arguments, **options):
        called.append((arguments, options))

    setattr(Own, method, entry)
    said, done = carried(kind, items(0), integrator=Own())
    arguments, options = expected
    assert said == [OWN_ENTRY] and called == [(arguments, {"sensor": 0} | options)]
    assert done == [("install", 0), ("collect", 0)]
    other = FORWARD if kind == RENDER else RENDER
    assert carried(other, items(0), integrator=Own(), freeze=False)[0] == [SWITCHED_OFF] and len(called) == 1


# ------------------------------------------------------------------------------------------------------------- films


def sensors_of(*films):
    def film(settings):
        choice, shape, channels = settings
        return SimpleNamespace(choice=choice, cube_shape=lambda: shape, channel_names=lambda: channels)

    return [SimpleNamespace(film=lambda settings=settings: film(settings)) for settings in films]


def test_films_of_one_call_measure_the_same(monkeypatch):
    monkeypatch.setattr(engine, "layout_of_film", lambda film: film.choice)
    one = ("histogram", (2, 3, 5, 1), ("R", "G"))
    assert choices.layout_of_film is not engine.layout_of_film
    assert engine.check_items(sensors_of(one, one), items(0, 1, sensors=2)) == "histogram"
    for other in (("phasors", *one[1:]), ("histogram", (2, 3, 4, 1), one[2]), (*one[:2], ("R", "B"))):
        with pytest.raises(SceneError, match=r"sensors: films rendered in one call .* sensor 0: histogram of shape"):
            engine.check_items(sensors_of(one, other), items(0, sensors=2))
        # What is not rendered does not count.
        assert engine.check_items(sensors_of(one, other), items(0, 1)) == "histogram"
    for number in (-1, 2):
        with pytest.raises(ArgumentError, match=f"sensors: the scene has 2, numbered from 0; got {number}"):
            engine.check_items(sensors_of(one, one), [Item(0, number, 1, 1)])


# ------------------------------------------------------------------------------------------------- tangents of a batch


def test_tangents_of_an_item():
    """Those of its entry, and those that all entries share."""
    each, shared = [[1.0], [2.0], [3.0]], [7.0, 8.0]
    assert engine._tangents_of(Item(2, 0, 0, 0), [each, shared], [True, False]) == [[3.0], shared]


def test_cotangents_that_are_broken_by_item():
    import torch

    one = torch.ones(3, 2)
    broken = one.clone()
    broken[1, 0] = torch.nan
    job = SimpleNamespace(items=items(0, 1, 2))
    assert engine._broken_items(job, [one]) == [] == engine._broken_items(job, [one, one])
    for given in ([broken], [one, broken], [broken, one], [broken, broken]):
        assert engine._broken_items(job, given) == [job.items[1]]
    single = SimpleNamespace(items=items(4))
    assert engine._broken_items(single, [one, broken]) == single.items and engine._broken_items(single, [one]) == []


def test_slopes_are_asked_of_every_film(monkeypatch):
    """Where a value that needs a gradient can change a path length."""
    asked = []
    monkeypatch.setattr(engine, "check_slope", lambda *given: asked.append(given))
    infos = {"pose": SimpleNamespace(moves_path_length=True), "colour": SimpleNamespace(moves_path_length=False)}
    film = SimpleNamespace(has_slope=False, response_name="box", slope_remedy="remedy")
    session = SimpleNamespace(film=lambda item: film)
    for needs, count in (((True, False), 2), ((False, True), 0), ((True, True), 2), ((False, False), 0)):
        asked.clear()
        scene = SimpleNamespace(known_parameters=lambda: infos)
        session.job = SimpleNamespace(keys=("pose", "colour"), needs=needs, scene=scene, items=items(0, 1))
        engine._check_slope(session)
        assert asked == [(["pose"], False, "box", "remedy")] * count
