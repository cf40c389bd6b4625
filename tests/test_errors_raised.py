"""What the library raises: errors of its own for what users do; bare ones only where they stay inside."""

from __future__ import annotations

import ast
import builtins
import importlib
from pathlib import Path

import pytest

import torchtransient
from support.sweeps import together
from support.syntax import syntax_of
from torchtransient import errors

PACKAGE = Path(torchtransient.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
PYTHONS = {
    name for name, value in vars(builtins).items() if isinstance(value, type) and issubclass(value, BaseException)
}
# Bare errors of Python that are raised on purpose, by file, and who takes them.
BARE = {
    "__init__.py": {"AttributeError"},  # the protocol of modules
    "argument_names.py": {"TypeError"},  # a wrong keyword argument, as Python says it
    "capture/capture.py": {"TypeError"},  # caught where tensors are made, and told
    "capture/metadata.py": {"TypeError"},  # caught by its callers, who know the file
    "data/augmentation/augmented.py": {"AttributeError"},  # the protocol of objects
    "data/reading/sample_draws.py": {"IndexError"},  # the protocol of sequences, which ends loops
    "data/storage/shard_file.py": {"ValueError"},  # caught where files are opened, and told with their names
    "data/storage/web_dataset.py": {"ValueError"},  # likewise
    "files/captures/mat5.py": {"ValueError"},  # likewise
    "files/entries.py": {"ValueError"},  # likewise
    "files/result_file.py": {"ValueError"},  # likewise
    "nlos/part_file.py": {"ValueError"},  # caught in the same function
    "losses/results.py": {"TypeError"},  # a wrong keyword argument, as Python says it
    "plugins/transport/contents.py": {"AttributeError"},  # the protocol of objects
    "plugins/transport/world.py": {"AttributeError"},
    "rendering/films/choices.py": {"KeyError"},  # caught by its callers
    "rendering/translation.py": {"RuntimeError"},  # Mitsuba's, of another plugin's name; caught where scenes are built
    "sensing/base/given.py": {"TypeError"},  # a wrong keyword argument, as Python says it
    "sensing/itof/itof_reading.py": {"AttributeError"},  # the protocol of objects
    "sensing/dead_time/free_running_ring.py": {"AssertionError"},  # what its own calls rule out
    "tensor_record.py": {"AttributeError"},  # the protocol of objects
    "vis/video.py": {"IndexError"},  # the protocol of sequences
}
ABSTRACT = "NotImplementedError"  # what a subclass has to define


def raised(tree):
    """(line, name) of every error that a file raises by its name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and node.exc is not None:
            error = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            if isinstance(error, ast.Name):
                yield node.lineno, error.id


def bare(path, package=PACKAGE):
    """The errors of Python's own that a file raises and may not, as (line, name)."""
    allowed = {*BARE.get(path.relative_to(package).as_posix(), ()), ABSTRACT, "SystemExit"}
    tree = syntax_of(path)
    return [(line, name) for line, name in raised(tree) if name in PYTHONS - allowed]


def test_errors_are_typed():
    wrong = {path.relative_to(PACKAGE).as_posix(): found for path in FILES if (found := bare(path))}
    assert not wrong, "raise an error of torchtransient.errors, or list the file and who takes the error"


def test_the_list_of_bare_errors_holds_nothing_else():
    for name, allowed in BARE.items():
        tree = syntax_of(PACKAGE / name)
        assert allowed <= {error for _, error in raised(tree)}, name


@pytest.mark.parametrize("line", ["raise ValueError('a')", "raise TypeError", "raise ImportError('x') from None"])
def test_a_new_bare_error_is_found(tmp_path, line):
    path = tmp_path / "module.py"
    path.write_text(f"def f():\n    {line}\n", encoding="utf-8")
    assert [number for number, _ in bare(path, tmp_path)] == [2]


@together("path", FILES, lambda path: path.relative_to(PACKAGE).as_posix())
def test_missing_packages_have_their_error(path):
    """What is made of an ImportError says which package to install, in its own type."""
    for node in ast.walk(syntax_of(path)) if "ImportError" in path.read_text(encoding="utf-8") else ():
        if isinstance(node, ast.ExceptHandler) and isinstance(node.type, ast.Name) and node.type.id == "ImportError":
            names = [name for _, name in raised(node)]
            assert set(names) <= {"MissingPackageError", "missing"}, f"{path.name}:{node.lineno}"


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
    "cyclic_map": ("matplotlib", lambda vis, cube: vis.cyclic_map("hsv")),
    "rainbow_map": ("matplotlib", lambda vis, cube: vis.rainbow_map()),
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
