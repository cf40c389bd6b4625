"""Connections to a cluster, without one."""

from __future__ import annotations

import json

import pytest

from support.fake_recipe import FakeRecipe
from torchtransient.data.generation import ray_engine
from torchtransient.data.generation.ledger import Ledger
from torchtransient.data.generation.run_log import RunLog, SampleBar
from torchtransient.data.generation.settings import Settings
from torchtransient.errors import TorchTransientWarning


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
    settings = Settings(FakeRecipe(), str(tmp_path), 4, "exact", "blosc2", None, 2)
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
