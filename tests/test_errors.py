"""Errors of the library: their bases, and what they say of missing packages. Which errors its files may raise stands in
test_architecture.py, which reads them all.
"""

from __future__ import annotations

import importlib

import pytest

import torchtransient
from torchtransient import errors

BASES = {
    "ShapeError": ValueError, "UnitError": ValueError, "SceneError": ValueError, "StorageError": ValueError,
    "ArgumentError": ValueError, "MissingPackageError": ImportError, "VariantError": RuntimeError,
    "DeviceError": RuntimeError, "GradientError": RuntimeError, "PluginRegistrationError": RuntimeError,
    "UnknownKeyError": KeyError, "PhysicsError": ValueError,
}  # fmt: skip


def test_errors_have_the_bases_of_python():
    for name, base in BASES.items():
        assert issubclass(getattr(errors, name), (errors.TorchTransientError))
        assert issubclass(getattr(errors, name), base)
    own = {n for n, v in vars(errors).items() if isinstance(v, type) and issubclass(v, errors.TorchTransientError)}
    assert own == {*BASES, "TorchTransientError"}


PICTURES = {
    "gradient_picture": ("matplotlib", lambda vis, cube: vis.gradient_picture(cube[:, 0])),
    "streak": ("matplotlib", lambda vis, cube: vis.streak(cube, row=0)),
    "a time under frames": ("PIL", lambda vis, cube: vis.frames(cube, axis=AXIS, stamp=True)[0]),
}
AXIS = torchtransient.TimeAxis(1.0, 0.5, 4)


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_say_which_package_they_need(monkeypatch, name):
    torch = importlib.import_module("torch")
    package, call = PICTURES[name]
    missing = {"matplotlib": ("matplotlib", "matplotlib.figure", "matplotlib.colors"), "PIL": ("PIL",)}[package]
    for module in missing:
        monkeypatch.setitem(importlib.import_module("sys").modules, module, None)
    with pytest.raises(errors.MissingPackageError, match=r"pip install 'torchtransient\[vis\]'"):
        call(torchtransient.vis, torch.rand(3, 4, 5, 6))
