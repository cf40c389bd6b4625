"""Connections to a cluster and its actors, without one."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import pytest

import torchtransient as tt
from support.fake_recipe import FakeRecipe
from torchtransient.data.generation import ray_engine
from torchtransient.data.generation.crew import Member
from torchtransient.data.generation.ledger import Ledger
from torchtransient.data.generation.ray_engine import Board, RayCrew, RayWorker, ShardActor
from torchtransient.data.generation.run_log import RunLog, SampleBar
from torchtransient.data.generation.settings import Settings, description
from torchtransient.errors import MissingPackageError, TorchTransientError, TorchTransientWarning


class FakeRay:
    """What is asked of the package until actors are there."""

    def __init__(self, broken=False):
        self.connected, self.broken = False, broken

    def is_initialized(self):
        return self.connected

    def init(self, **_):
        self.connected = True

    def shutdown(self):
        self.connected = False

    def cluster_resources(self):
        if self.broken:
            raise ConnectionError("the cluster is gone")
        return {"CPU": 2.0}

    def kill(self, _):
        pass

    def remote(self, **_):
        class Actor:
            @staticmethod
            def remote():
                return object()

        return lambda kind: Actor


def crew(tmp_path, monkeypatch, ray, workers):
    monkeypatch.setattr(ray_engine, "ray_package", lambda: ray)
    ledger = Ledger(2, RunLog(tmp_path), SampleBar(0, 0, shown=False))
    settings = Settings(FakeRecipe(), str(tmp_path), 4, "exact", "blosc2", 2)
    return ray_engine.RayCrew(settings, workers, ledger, None, None)


def test_a_connection_that_fails_later_is_ended(tmp_path, monkeypatch):
    ray = FakeRay(broken=True)
    with pytest.raises(ConnectionError):
        crew(tmp_path, monkeypatch, ray, 1)
    assert not ray.connected


def test_fewer_workers_than_were_asked_for_are_told(tmp_path, monkeypatch, recwarn):
    ray = FakeRay()
    with crew(tmp_path, monkeypatch, ray, 2) as made:
        assert made.wanted == 2 and not recwarn.list
    with pytest.warns(TorchTransientWarning, match="2 processors, and 5 workers were asked for; 2 are started"):
        made = crew(tmp_path, monkeypatch, ray, 5)
    assert made.wanted == 2 and ray.connected
    made.close(stopped=False)
    assert not ray.connected
    (told,) = (json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines())
    assert (told["event"], told["asked"], told["workers"]) == ("fewer workers", 5, 2)


# ------------------------------------------------------------------------------------------------------------- actors

RECIPE = FakeRecipe(shape=(1, 2, 2, 3))


def settings_of(folder, recipe=RECIPE):
    return Settings(recipe, str(folder), 4, "exact", "none", 0)


def described(folder):
    return description(settings_of(folder), 2, RECIPE.maker().about(), None)


@pytest.fixture
def logged():
    """A ledger, and what it logs."""
    lines = []
    ledger = Ledger(2, lambda *words, **facts: lines.append((*words, facts)), SampleBar(0, 0, shown=False))
    return ledger, lines


class RayError(Exception):
    pass


class TaskError(RayError):
    pass


class Actor:
    """An actor whose answers are awaited as its calls."""

    def __init__(self):
        self.tasks = []
        self.begin = SimpleNamespace(remote=lambda: (id(self), "begin"))
        self.do = SimpleNamespace(remote=self._do)

    def _do(self, task):
        self.tasks.append(task)
        return (id(self), len(self.tasks))


@pytest.fixture
def cluster(monkeypatch, logged, tmp_path):
    """A crew of actors that are played: ``answers`` by what is awaited, ``board`` what was said."""
    ray = SimpleNamespace(answers={}, board=Board(), killed=[], waits=[], connected=True, init=[], actors=[])
    ray.exceptions = SimpleNamespace(RayError=RayError, RayTaskError=TaskError)
    ray.is_initialized = lambda: ray.connected
    ray.cluster_resources = lambda: {"CPU": 3.0}
    ray.shutdown = lambda: setattr(ray, "connected", False)
    ray.kill = lambda actor, no_restart=None: ray.killed.append((actor, no_restart))
    said = SimpleNamespace(heard=SimpleNamespace(remote=lambda: "heard"),
                           say=SimpleNamespace(remote=lambda *words: ray.board.say(*words)))  # fmt: skip

    def remote(**options):
        if options["num_cpus"] == 0:
            assert options["max_restarts"] == options["max_task_retries"] == -1
            return lambda kind: SimpleNamespace(remote=lambda: said)
        assert options == {"num_cpus": 1, "max_restarts": 0, "max_task_retries": 0}
        return lambda kind: SimpleNamespace(remote=made)

    def made(*given):
        ray.actors.append((Actor(), given))
        return ray.actors[-1][0]

    def get(ref):
        if ref == "heard":
            return ray.board.heard()
        if isinstance(ray.answers.get(ref), Exception):
            raise ray.answers[ref]
        return ray.answers.get(ref)

    def wait(refs, num_returns, timeout):
        ray.waits.append((list(refs), num_returns, timeout))
        return [ref for ref in refs if ref in ray.answers][:1], None

    ray.remote, ray.get, ray.wait = remote, get, wait
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", ray.exceptions)
    crew = RayCrew(settings_of(tmp_path), 2, logged[0], None, None)
    return SimpleNamespace(ray=ray, crew=crew, said=said)


def test_actors_are_handed_shards(cluster, logged):
    ray, crew = cluster.ray, cluster.crew
    logged[0].add([5])
    crew.workers += [crew.start(), crew.start()]
    first, second = crew.workers
    assert [given[2] for _, given in ray.actors] == [1, 2] and ray.actors[0][1][1] is cluster.said
    ray.answers[first.awaited] = ("ready",)
    crew.look()
    assert ray.waits == [([first.awaited or (id(first.actor), "begin"), second.awaited], 1, 0.5)]
    assert first.ready and first.awaited is None and not second.ready
    first.hand(("shard", logged[0].take(), {}, {}, []))
    assert first.actor.tasks == [("shard", 5, {}, {}, [])]
    # What stands on the board comes before the result; of who is gone it is not heard.
    ray.board.say(1, "begin", 5, 8)
    ray.board.say(1, "end", 5, 8, None)
    ray.board.say(9, "begin", 5, 8)
    ray.answers = {first.awaited: ("wrote", 5, 2, 1, 70)}
    crew.look()
    assert first.shard is None and (logged[0].samples, logged[0].failed, logged[0].bytes) == (1, 1, 70)
    assert ray.board.heard() == []


def test_actors_that_are_gone(cluster, logged):
    ray, crew = cluster.ray, cluster.crew
    logged[0].add([5])
    crew.workers.append(crew.start())
    worker = crew.workers[0]
    worker.ready, worker.shard, worker.sample = True, logged[0].take(), 8
    ray.answers[worker.awaited] = RayError("lines\nThe actor died.")
    crew.look()
    assert crew.workers == [] and ray.killed == [(worker.actor, True)] and logged[0]._blame[5, 8] == 1
    assert logged[1] == [("death", {"shard": 5, "sample": 8, "how": "by RayError: The actor died."})]
    # Later words of it are not those of another one.
    ray.board.say(1, "begin", 5, 8)
    crew.workers.append(crew.start())
    crew.look()
    assert crew.workers[0].sample is None


@pytest.mark.parametrize(
    ("error", "for_good"),
    [(RayError("away"), False), (RayError("the creation task failed"), True), (TaskError("no module"), True)],
)
def test_actors_that_do_not_start(cluster, error, for_good):
    crew = cluster.crew
    crew.workers.append(crew.start())
    cluster.ray.answers[crew.workers[0].awaited] = error
    if not for_good:
        crew.look()
        assert crew.workers == []
        return
    with pytest.raises(TorchTransientError, match=rf"by {type(error).__name__}: .* All machines of the cluster need"):
        crew.look()


def test_a_crew_that_awaits_nothing(cluster, monkeypatch):
    slept = []
    monkeypatch.setattr(ray_engine, "time", SimpleNamespace(sleep=slept.append))
    crew = cluster.crew
    crew.workers.append(crew.start())
    crew.workers[0].awaited = None
    crew.look()
    assert slept == [0.5] and cluster.ray.waits == []
    crew.close(stopped=False)
    # The connection is that of who made it.
    assert crew.workers == [] and len(cluster.ray.killed) == 2 and cluster.ray.connected


@pytest.mark.parametrize(("address", "where"), [(None, "Ray: away"), ("host:1", "Ray at 'host:1': away")])
def test_no_connection(cluster, tmp_path, logged, address, where):
    ray, given = cluster.ray, []

    def init(**options):
        given.append(options)
        raise ConnectionError("away")

    ray.connected, ray.init = False, init
    with pytest.raises(TorchTransientError, match=f"no connection to a cluster of {where}"):
        RayCrew(settings_of(tmp_path), 2, logged[0], None, address)
    assert given[0].get("address") == address and given[0]["log_to_driver"] is False


def test_what_an_actor_does(cluster, tmp_path):
    with tt.threads(1):
        actor = ShardActor(settings_of(tmp_path), cluster.said, 6)
        assert actor.begin() == ("ready",)
        kind, measured = actor.do(("measure", range(2), {}))
        assert kind == "measured" and measured.standard_error == 0.25
        assert cluster.ray.board.heard()[:2] == [(6, "begin", -1, 0), (6, "end", -1, 0, None)]
        wrote = actor.do(("shard", 1, described(tmp_path), {2: "given up"}, []))
        assert wrote == ("wrote", 1, 2, 1, (tmp_path / "shard-000001.h5").stat().st_size)
        assert (6, "end", 1, 2, "given up") in cluster.ray.board.heard()
        assert actor.do(("shard", 1, {"about": {}}, {}, []))[:2] == ("fatal", "KeyError")
        broken = ShardActor(settings_of(tmp_path, FakeRecipe(unbuilt="no light")), cluster.said, 1)
        assert broken.begin()[:3] == ("fatal", "SceneError", "no light")


def test_without_ray(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingPackageError, match="needs the package ray"):
        ray_engine.ray_package()
    assert RayWorker.__mro__[1] is Member
