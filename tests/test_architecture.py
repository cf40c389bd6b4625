"""Imports go down the levels or stay in their room, without circles; the two pillars meet in `rendering/`. Errors are
the library's own for what users do; bare ones of Python only where they stay inside.

Every import of every file is read with `ast`, the ones inside functions too. Tests share through `tests/support`, and
benchmarks and `tools` do without tests.
"""

from __future__ import annotations

import ast
import builtins
import functools
import gc
import re
from collections.abc import Iterator
from pathlib import Path

import torchtransient
from support import walks
from support.sweeps import together

PACKAGE = Path(torchtransient.__file__).parent
TESTS = Path(__file__).parent
BENCHMARKS = sorted((TESTS.parent / "benchmarks").glob("*.py"))
TOOLS = sorted(p for p in (TESTS.parent / "tools").rglob("*.py") if p.parent.name != "mutants")  # which runs tests
# Rooms by level: an import goes down, or stays in its room.
LEVEL = {
    "errors": 0, "_llvm": 0, "checks": 0, "units": 0, "axes": 0, "capture": 0, "interfaces": 0,
    "pulses": 0, "gates": 0, "stokes": 0, "tensor_record": 0, "floating": 0, "modules": 0, "volume_methods": 0,
    "array_files": 0, "chirps": 0,
    "plugins": 1, "sensing": 1, "reconstruction": 1, "losses": 1, "metrics": 1, "vis": 1,
    "parametrize": 1, "geometry": 1,
    "scenes": 2,
    "scene": 3,
    "rendering": 4,
    "files": 5, "motion": 5, "nlos": 5, "data": 5, "accuracy": 5, "testing": 5, "training": 5,
    "cli": 6,
    "__main__": 7,
}  # fmt: skip
# Rooms that everything may import, and imports within a level: likelihoods are those of the sensors, captures are
# records with axes, data sets hold captures, whose simulations are files.
BASIC = {"errors", "checks", "units"}
BESIDE = {
    "gates": {"pulses"}, "chirps": {"axes", "pulses"}, "capture": {"axes", "tensor_record"},
    "losses": {"sensing"}, "metrics": {"losses", "reconstruction"},
    "nlos": {"files"}, "data": {"files", "nlos"}, "testing": {"accuracy"},
}  # fmt: skip
# Packages that a room does without: the one pillar's world in the other, and at level 0 everything bound to a variant.
MITSUBA, TORCH = {"mitsuba", "drjit"}, {"torch", "kornia"}
TORCH_PILLAR = {"sensing", "reconstruction", "losses", "metrics", "parametrize", "geometry", "vis"}
WITHOUT_MITSUBA = {*TORCH_PILLAR, "scenes", *(room for room, level in LEVEL.items() if level == 0 and room[0] != "_")}
WITHOUT_TORCH = {"plugins", "scenes", "errors", "interfaces", "volume_methods"}
HEAVY = {
    "matplotlib", "h5py", "kornia", "scipy", "imageio", "imageio_ffmpeg", "PIL", "click", "rich", "hdf5plugin",
    "zstandard", "webdataset", "ray", "bokeh", "playwright", "tensorboard", "IPython",
}  # fmt: skip
FILES = sorted(PACKAGE.rglob("*.py"))
MOST_LINES = {"file": 800, "function": 160}


@functools.cache
def syntax_of(path: Path) -> ast.Module:
    """Syntax tree of a file, which nothing changes meanwhile."""
    gc.disable()  # which walks through all trees kept so far, over and over: 80 % of the time
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    finally:
        gc.enable()


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a syntax tree without its expressions, which are nine nodes of ten and hold no statements."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.expr | ast.arguments):
            yield node
            yield from statements(node)


def dotted(path):
    return ".".join(("torchtransient", *path.relative_to(PACKAGE).with_suffix("").parts))


def room_of(module):
    """The room of a dotted module name inside the package; None for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[1] != "__init__" else None


def imports(path, package=PACKAGE):
    """Every import of a file as (line, absolute dotted name); `from a import b` gives `a.b`."""
    here = ("torchtransient", *path.relative_to(package).parent.parts)
    for node in statements(syntax_of(path)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else ()
            module = ".".join((*base, *((node.module,) if node.module else ())))
            for alias in node.names:
                yield node.lineno, f"{module}.{alias.name}"


def import_circles(package=PACKAGE):
    """The sets of modules that import each other, in whatever order and wherever the imports stand, those for types
    included. The package's own `__init__` is left out: it lists public names, and imports them when they are used.
    """
    files = {}
    for path in sorted(package.rglob("*.py")):
        if path.parent == package and path.stem == "__init__":
            continue
        parts = ("torchtransient", *path.relative_to(package).with_suffix("").parts)
        files[".".join(parts).removesuffix(".__init__")] = path
    edges = {}
    for module, path in files.items():
        names = {name for _, name in imports(path, package)}
        # A name of a package that is no module of its own stands in the package's `__init__`.
        edges[module] = {name if name in files else name.rpartition(".")[0] for name in names} & set(files) - {module}
    reached = {module: reachable(module, edges) for module in edges}
    circles = {frozenset(m for m in reached[module] if module in reached[m]) for module in edges}
    return sorted(sorted(circle) for circle in circles if circle)


def reachable(start, edges):
    """All that follows from one node of a graph; the node itself only when a circle leads back to it."""
    found, waiting = set(), list(edges[start])
    while waiting:
        module = waiting.pop()
        if module not in found:
            found.add(module)
            waiting.extend(edges[module])
    return found


def violations(path, package=PACKAGE):
    """What is wrong with the imports of one file, a line each."""
    relative = path.relative_to(package)
    room = relative.parts[0].removesuffix(".py")
    where = f"{relative}:"
    if room == "__init__":
        return
    if room not in LEVEL:
        yield f"{where}1 room '{room}' has no level; see LEVEL in this test"
        return
    for line, name in imports(path, package):
        top = name.split(".")[0]
        if (top in MITSUBA and room in WITHOUT_MITSUBA) or (top in TORCH and room in WITHOUT_TORCH):
            yield f"{where}{line} '{room}' must not know {top}"
        if name.startswith("mitsuba.") and not name.startswith("mitsuba.python"):
            yield f"{where}{line} {name}: import mitsuba as mi, and mitsuba.python.ad instead of mitsuba.ad"
        other = room_of(name) if top == "torchtransient" else None
        if other is not None and other in LEVEL and other != room and not is_below(other, room):
            yield f"{where}{line} '{room}' (level {LEVEL[room]}) imports '{other}' (level {LEVEL[other]})"


def is_below(other, room):
    return LEVEL[other] < LEVEL[room] or other in BASIC or other in BESIDE.get(room, ())


@together("path", FILES, dotted)
def test_imports(path):
    assert list(violations(path)) == []


@together("path", [f for f in FILES if f.relative_to(PACKAGE).parts[0] != "cli"], dotted)
def test_heavy_packages_are_imported_where_they_are_used(path):
    tree = syntax_of(path)
    at_top = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    for node in at_top:
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        assert not {n.split(".")[0] for n in names} & HEAVY, f"{path.name}:{node.lineno}"


def test_no_circle_of_imports():
    circles = import_circles()
    assert circles == []


def test_sizes():
    """A generous limit; what a file holds is a matter of its subject."""
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= MOST_LINES["file"], dotted(path)
        for node in statements(syntax_of(path)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < MOST_LINES["function"], f"{dotted(path)}.{node.name}"


def from_tests(path):
    """What a file takes from the tests: imports of their modules, and paths into their folder."""
    own = {p.stem for p in TESTS.glob("*") if not p.name.startswith("_")} | {"tests"}
    text = path.read_text(encoding="utf-8")
    # Most files name none of them where an import or a path could stand.
    if not re.search(rf"\btests\b|^\s*(?:from|import)\s.*\b(?:{'|'.join(sorted(own))})\b", text, re.MULTILINE):
        return
    for node in ast.walk(syntax_of(path)):
        if isinstance(node, ast.Import):
            yield from (f"import {a.name}" for a in node.names if a.name.split(".")[0] in own)
        elif isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").split(".")[0] in own:
            yield f"from {node.module}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from (f"the path {node.value}" for part in re.split(r"[/\\\\]", node.value) if part == "tests")


@together("path", BENCHMARKS + TOOLS, lambda p: p.relative_to(TESTS.parent).as_posix())
def test_benchmarks_and_tools_do_without_tests(path):
    assert list(from_tests(path)) == []


def test_tests_share_through_their_support():
    """A bare name of another test file depends on which folders are on the path."""
    shared = {p.stem for p in TESTS.rglob("*.py") if p.parent != TESTS} - {"__init__"}
    names = "|".join(sorted(shared))
    named = re.compile(rf"^\s*(?:from\s+(?:{names})\b|import\s+(?:.*[\s,])?(?:{names})\b)", re.MULTILINE)
    for path in TESTS.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        # Most files import none, by the look of it.
        for node in statements(syntax_of(path)) if named.search(text) else ():
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            assert not {n.split(".")[0] for n in names} & shared, f"{path.relative_to(TESTS)}:{node.lineno}"


def test_tests_take_one_door_to_the_core():
    """It names few things, each with a reason; what an author of strategies imports, the toys do. Paths that are
    patched count as imports.
    """
    doors = {"walks.py", "toy_strategies.py", "toy_integrators.py", "test_new_strategies.py", Path(__file__).name}
    core = re.compile(r"plugins\.transport|plugins import transport")
    for path in TESTS.rglob("*.py"):
        if path.name not in doors:
            found = core.search(path.read_text(encoding="utf-8"))
            assert not found, f"{path.relative_to(TESTS)} names the core; see tests/support/walks.py"
    assert len(walks.__all__) <= 25


def test_every_package_has_a_level():
    rooms = {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert rooms <= set(LEVEL)


# ---------------------------------------------------------------------------------------------- errors that are raised


PYTHONS = {
    name for name, value in vars(builtins).items() if isinstance(value, type) and issubclass(value, BaseException)
}
# What a subclass has to define, the protocol of objects and modules, the end of a command.
ALWAYS = {"NotImplementedError", "AttributeError", "SystemExit"}
# Other bare errors of Python that are raised on purpose, by file, and who takes them.
BARE = {
    "checks.py": {"TypeError"},  # a wrong keyword argument, as Python says it
    "capture/capture.py": {"TypeError"},  # caught where tensors are made, and told
    "data/sample.py": {"IndexError"},  # the protocol of sequences, which ends loops
    "data/shards.py": {"ValueError"},  # caught where files are opened, and told with their names
    "data/exports.py": {"ValueError"},  # likewise
    "files/captures/matlab.py": {"ValueError"},  # likewise
    "files/plain_data.py": {"ValueError"},  # likewise
    "files/result_file.py": {"ValueError"},  # likewise
    "nlos/part_file.py": {"ValueError"},  # caught in the same function
    "rendering/films.py": {"KeyError"},  # caught by its callers
    "scene/edits.py": {"RuntimeError"},  # what Mitsuba says, told by its caller with the place
    "vis/videos.py": {"IndexError"},  # the protocol of sequences
}


def raised(tree):
    """(line, name) of every error that a file raises by its name."""
    for node in statements(tree):
        if isinstance(node, ast.Raise) and node.exc is not None:
            error = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            if isinstance(error, ast.Name):
                yield node.lineno, error.id


def bare(path, package=PACKAGE):
    """The errors of Python's own that a file raises and may not, as (line, name)."""
    allowed = {*BARE.get(path.relative_to(package).as_posix(), ()), *ALWAYS}
    tree = syntax_of(path)
    return [(line, name) for line, name in raised(tree) if name in PYTHONS - allowed]


def test_errors_are_typed():
    wrong = {path.relative_to(PACKAGE).as_posix(): found for path in FILES if (found := bare(path))}
    assert not wrong, "raise an error of torchtransient.errors, or list the file and who takes the error"


def test_the_list_of_bare_errors_holds_nothing_else():
    for name, allowed in BARE.items():
        tree = syntax_of(PACKAGE / name)
        assert allowed <= {error for _, error in raised(tree)}, name


@together("path", FILES, lambda path: path.relative_to(PACKAGE).as_posix())
def test_missing_packages_have_their_error(path):
    """What is made of an ImportError says which package to install, in its own type."""
    for node in ast.walk(syntax_of(path)) if "ImportError" in path.read_text(encoding="utf-8") else ():
        if isinstance(node, ast.ExceptHandler) and isinstance(node.type, ast.Name) and node.type.id == "ImportError":
            names = [name for _, name in raised(node)]
            assert set(names) <= {"MissingPackageError", "missing"}, f"{path.name}:{node.lineno}"
