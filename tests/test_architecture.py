"""Imports go down the levels of the package or stay in their room; the two pillars meet in `render/` only.

Every import of every file is read with `ast`, the ones inside functions too.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import torchtransient

PACKAGE = Path(torchtransient.__file__).parent
LEVEL = {
    "errors": 0, "_llvm": 0, "_collection": 0, "units": 0, "axes": 0, "capture": 0, "interfaces": 0, "pulses": 0,
    "gates": 0, "stokes": 0,
    "plugins": 1, "sensing": 1, "nlos": 1, "losses": 1, "metrics": 1, "vis": 1,
    "scenes": 2,
    "render": 3,
    "data": 4, "accuracy": 4, "testing": 4,
    "cli": 5,
}  # fmt: skip
TORCH_PILLAR = {"sensing", "nlos", "losses", "metrics", "vis"}
MITSUBA = {"mitsuba", "drjit"}
# Packages that a room does without: the one pillar's world in the other, and everything bound to a variant at level 0.
FORBIDDEN = {
    "plugins": {"torch", "kornia"},
    "scenes": {"torch", "kornia", *MITSUBA},
    "errors": {"torch", *MITSUBA},
    "units": MITSUBA,
    "axes": MITSUBA,
    "stokes": MITSUBA,
    "interfaces": {"torch", *MITSUBA},
    **dict.fromkeys(TORCH_PILLAR, MITSUBA),
}
HEAVY = {"matplotlib", "h5py", "kornia", "scipy", "imageio", "imageio_ffmpeg", "PIL", "click", "rich"}
FILES = sorted(PACKAGE.rglob("*.py"))


def dotted(path):
    return ".".join(("torchtransient", *path.relative_to(PACKAGE).with_suffix("").parts))


def room_of(module):
    """The room of a dotted module name inside the package; None for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] != "__init__" else None


def imports(path, package=PACKAGE):
    """Every import of a file as (line, absolute dotted name); `from a import b` gives `a.b`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    here = ("torchtransient", *path.relative_to(package).parent.parts)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            module = ".".join((*base, *((node.module,) if node.module else ())))
            for alias in node.names:
                yield node.lineno, f"{module}.{alias.name}"


def violations(path, package=PACKAGE):
    """What is wrong with the imports of one file, a line each."""
    relative = path.relative_to(package)
    room = relative.parts[0].removesuffix(".py")
    where = f"{relative}:"
    if room == "__init__":
        return
    if room not in LEVEL:
        yield f"{where}1 room '{room}' has no level; see LEVEL in this test and docs"
        return
    for line, name in imports(path, package):
        top = name.split(".")[0]
        if top in FORBIDDEN.get(room, ()):
            yield f"{where}{line} '{room}' must not know {top}"
        if name.startswith("mitsuba.") and not name.startswith("mitsuba.python"):
            yield f"{where}{line} {name}: import mitsuba as mi, and mitsuba.python.ad instead of mitsuba.ad"
        other = room_of(name) if top == "torchtransient" else None
        if other is not None and other in LEVEL and other != room and not is_below(other, room):
            yield f"{where}{line} '{room}' (level {LEVEL[room]}) imports '{other}' (level {LEVEL[other]})"


def is_below(other, room):
    if LEVEL[other] != LEVEL[room]:
        return LEVEL[other] < LEVEL[room]
    # Within a level: `accuracy` quotes the statistics of `testing`, and everything may know errors and units;
    # likelihoods are those of the sensors.
    within = {("accuracy", "testing"), ("gates", "pulses"), ("losses", "sensing")}
    return other in {"errors", "units"} or (room, other) in within


@pytest.mark.parametrize("path", FILES, ids=dotted)
def test_imports(path):
    assert list(violations(path)) == []


@pytest.mark.parametrize("path", [f for f in FILES if f.relative_to(PACKAGE).parts[0] != "cli"], ids=dotted)
def test_heavy_packages_are_imported_where_they_are_used(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    at_top = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    for node in at_top:
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        assert not {n.split(".")[0] for n in names} & HEAVY, f"{path.name}:{node.lineno}"


def test_every_package_has_a_level():
    rooms = {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert rooms <= set(LEVEL)


@pytest.mark.parametrize(
    ("room", "line", "message"),
    [
        ("vis", "import mitsuba as mi", "must not know mitsuba"),
        ("vis", "def f():\n    import drjit", "must not know drjit"),
        ("plugins", "import torch.nn", "must not know torch"),
        ("plugins", "from torch import nn", "must not know torch"),
        ("plugins", "from mitsuba import Float", "import mitsuba as mi"),
        ("plugins", "import mitsuba.ad.integrators", "import mitsuba as mi"),
        ("render", "from mitsuba.ad import Adam", "import mitsuba as mi"),
        ("plugins", "from torchtransient.render import autograd", "imports 'render'"),
        ("plugins", "from ..render import autograd", "imports 'render'"),
        ("plugins", "from .. import render", "imports 'render'"),
        ("plugins", "from torchtransient import vis", "imports 'vis'"),
        ("scenes", "from torchtransient.accuracy import measure", "imports 'accuracy'"),
        ("testing", "from torchtransient.accuracy import measure", "imports 'accuracy'"),
        ("toolbox", "import os", "has no level"),
    ],
)
def test_the_rules_bite(tmp_path, room, line, message):
    path = tmp_path / room / "module.py"
    path.parent.mkdir()
    path.write_text(line + "\n", encoding="utf-8")
    found = list(violations(path, tmp_path))
    assert len(found) == 1
    assert message in found[0]


@pytest.mark.parametrize(
    "line",
    [
        "import mitsuba as mi",
        "import mitsuba.python.ad.integrators.common as common",
        "from mitsuba.python.ad.integrators.common import RBIntegrator",
        "from torchtransient.errors import SceneError",
        "from ..errors import SceneError",
        "from . import _registry",
    ],
)
def test_what_plugins_may_import(tmp_path, line):
    path = tmp_path / "plugins" / "module.py"
    path.parent.mkdir()
    path.write_text(line + "\n", encoding="utf-8")
    assert list(violations(path, tmp_path)) == []
