"""A scene that was saved and read again is compared with the values that were to be written."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from torchtransient.rendering.saving import save

from torchtransient.errors import SceneError


def test_what_is_read_back_is_compared(monkeypatch):
    """Keys of either side, and numbers; colours of spectra by what they look like."""
    numbers = {f"k{n}": np.array([float(n)]) for n in range(7)} | {"s.value": np.array([1.0]), "t": np.array([1.0])}
    owners = {key: (None, None, key, None) for key in numbers}
    built = SimpleNamespace(params=SimpleNamespace(properties=owners))
    asked = []
    again = SimpleNamespace(built=lambda options: asked.append(options) or built)
    monkeypatch.setattr(save, "_options", lambda scene, keys: keys)
    monkeypatch.setattr(save, "_numbers", lambda built: dict(numbers))
    monkeypatch.setattr(save, "keeps_coefficients", lambda owner, key: key == "value" and owner in ("s.value", "t"))
    monkeypatch.setattr(save, "same_spectra", lambda a, b: a[0] == 2)

    def compare(**changes):
        wanted = dict(numbers) | changes
        save._compare(again, {key: value for key, value in wanted.items() if value is not None}, ("a",))

    compare()
    compare(**{"s.value": np.array([2.0])})
    assert asked == [("a",)] * 2
    for key, value in (("k1", np.array([2.0])), ("k1", None), ("new", np.array([2.0])), ("t", np.array([2.0])),
                       ("s.value", np.array([3.0])), ("k1", np.array([1.0, 1.0]))):  # fmt: skip
        with pytest.raises(SceneError, match=rf"scene\.save: {key} cannot be said in XML: what was read back is"):
            compare(**{key: value})
    changed = {f"k{n}": np.array([9.0]) for n in range(6)}
    with pytest.raises(SceneError, match=r"k0, k1, k2, k3, k4 \.\.\. cannot"):
        compare(**changed)
    del changed["k5"]
    with pytest.raises(SceneError, match=r"k0, k1, k2, k3, k4 cannot"):
        compare(**changed)

    def fail(options):
        raise SceneError("no such lobe")

    again.built = fail
    with pytest.raises(SceneError, match=r"what was written does not load\. Leave .* no such lobe"):
        compare()
