"""Public names: what `torchtransient` and its rooms export, at run time and for a type checker."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
import types
import typing
from pathlib import Path

import pytest

import torchtransient as tt
from support.sweeps import together

ROOT = Path(tt.__file__).parent
PAGES = sorted([ROOT.parent / "README.md", ROOT.parent / "CHANGELOG.md", *(ROOT.parent / "docs").glob("*.md")])
# What the library promises to have (section "Public API" of its design).
CONTRACT = """
    Scene TimeAxis FrequencyAxis Gate Pulse Plan RenderOutput RenderStats TransientRenderer load render plan threads
    cost_of_accuracy accuracy data errors geometry losses metrics nlos parametrize scenes sensing stokes training
    units vis scenes.cornell_box scenes.nlos_z nlos.Scan nlos.Capture nlos.simulate nlos.FK nlos.LCT nlos.DirectionalLCT
    nlos.Backprojection nlos.FilteredBackprojection nlos.PhasorField data.Recipe data.Uniform data.Turn data.generate
    data.TransientDataset data.OnlineDataset
"""

# The stage of a device is a sensor, a response, a code or a plain value, as its description says; a function of the
# user's own gives what it gives.
OF_ANY_TYPE = {"sensing.build_stage", "wrap"}


def exported(tree):
    """The names that statements `from ... import X as X` give away, and the modules that they stand in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if alias.name == alias.asname:
                    yield alias.name, node.module


def rooms():
    """The public modules of the library."""
    return {name: value for name in tt._LAZY if isinstance(value := getattr(tt, name), types.ModuleType)}


def names_of(room):
    """The public names of a module: what a package exports, and what a single file defines."""
    tree = ast.parse(Path(room.__file__).read_text(encoding="utf-8"))
    return list(dict(exported(tree)) if hasattr(room, "__path__") else defined(tree))


def defined(tree):
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
        for target in targets:
            name = getattr(target, "name", getattr(target, "id", "_"))
            if not name.startswith("_"):
                yield name


def public_names():
    """Every public name, as a user writes it behind `tt.`."""
    for name in tt._LAZY:
        yield name
    for name, room in rooms().items():
        yield from (f"{name}.{inner}" for inner in names_of(room))


def found(dotted):
    value = tt
    for part in dotted.split("."):
        value = getattr(value, part)
    return value


def test_names_for_type_checkers_are_those_of_the_run():
    tree = ast.parse((ROOT / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {
        name: f"{module}.{name}" if module == "torchtransient" else module
        for name, module in exported(ast.Module(block.body, []))
    }
    assert seen == tt._LAZY


def test_every_name_is_there():
    assert set(CONTRACT.split()) <= set(public_names())
    assert all(found(name) is not None for name in public_names())
    assert set(tt._LAZY) <= set(dir(tt))
    assert (ROOT / "py.typed").is_file()
    with pytest.raises(AttributeError, match="'torchtransient' has no attribute 'rendr'"):
        found("rendr")


def test_the_room_of_the_renderer_hides_nothing():
    importlib.import_module("torchtransient.rendering.functional")
    assert inspect.isfunction(tt.render)


@together("page", PAGES, lambda page: page.stem)
def test_names_of_the_pages_exist(page):
    named = set(re.findall(r"\btt((?:\.[A-Za-z]\w*)+)(?![\w*]|\.\w)", page.read_text(encoding="utf-8")))
    missing = []
    for name in sorted(named):
        try:
            found(name.lstrip("."))
        except AttributeError:
            missing.append(name)
    assert not missing


def test_every_name_has_a_type():
    """No public function without annotations, or with a result that could be anything."""
    for name in public_names():
        value = found(name)
        if not inspect.isfunction(value):
            continue
        hints = value.__annotations__
        named = set(inspect.signature(value).parameters)
        assert named | {"return"} == set(hints), name
        assert hints["return"] not in ("Any", "object", typing.Any, object) or name in OF_ANY_TYPE, name


def hints_of(value):
    """(name of a function or method, argument, annotation as it is written), of a public name."""
    methods = {k: getattr(v, "__func__", v) for k, v in members_of(value).items()}
    for function in [value.__init__, *methods.values()] if inspect.isclass(value) else [value]:
        for argument, hint in getattr(function, "__annotations__", {}).items():
            yield f"{function.__qualname__}({argument})", argument, str(hint)


def test_rows_of_numbers_are_typed_as_they_are_taken():
    """Arrays and tensors are taken where lists are, and type checkers know it (`quantities.Numbers`)."""
    lists_alone = {
        f"{place}: {hint}"
        for name in public_names()
        for place, argument, hint in hints_of(found(name))
        if argument != "return" and re.search(r"(?<!\[)Sequence\[float\]", hint)
    }
    assert lists_alone == set()


@pytest.mark.soak
def test_a_type_checker_knows_every_name(tmp_path):
    """`mypy --strict` on a script that uses every public name."""
    names = list(public_names())
    script = tmp_path / "script.py"
    script.write_text("\n".join(["import torchtransient as tt", *(f"reveal_type(tt.{name})" for name in names)]))
    wrong = tmp_path / "wrong.py"
    wrong.write_text("import torchtransient as tt\ntt.rendr\ntt.sensing.SPUD\n")
    # Errors in the package itself stay unsaid, as they do for a package that is installed.
    options = ["--strict", "--cache-dir", str(tmp_path / "cache"), "--config-file", "", "--follow-imports=silent"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, script.name, wrong.name],
        cwd=tmp_path, env={"MYPYPATH": str(ROOT.parent), "PATH": ""}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    errors = [line for line in lines if ": error:" in line]
    assert len(errors) == 2, done.stdout
    assert all(line.startswith("wrong.py:") and "has no attribute" in line for line in errors)
    revealed = [line.partition('Revealed type is "')[2].rstrip('"') for line in lines if line.startswith("script.py:")]
    assert len(revealed) == len(names) > 300
    for name, kind in zip(names, revealed, strict=True):
        if name == "sensing.deepinv_physics" and importlib.util.find_spec("deepinv") is None:
            continue
        assert kind not in ("Any", "builtins.object"), name
        assert not kind.endswith(("-> Any", "-> builtins.object")) or name in OF_ANY_TYPE, f"{name}: {kind}"


# Endings of words that British and American spelling differ in. Units are spelled as the SI brochure does: `per_metre`.
BRITISH = re.compile(
    r"centre|colour|grey|behaviour|neighbour|fibre|favour|catalogue|modell|labell|travell|cancell|licence|defence|"
    r"artefact|analys(e|ing)|programme|learnt|(?<!no)is(e|ed|es|er|ers|ing|ation)(_|$)"
)
# Words that end like these in either spelling.
SAME_IN_BOTH = {"rise", "precise", "otherwise", "promise", "raise", "piecewise"}


def british(name):
    """The British words of an identifier."""
    words = re.findall(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])", name.replace(".", "_"))
    return [word for word in words if BRITISH.search(word.lower()) and word.lower() not in SAME_IN_BOTH]


def members_of(value):
    """The public members of a class by name; nothing of other objects."""
    return {k: getattr(value, k) for k in vars(value) if not k.startswith("_")} if inspect.isclass(value) else {}


def signature_of(value):
    """The parameters of a function or class; nothing of other objects, nor of errors, which have none of their own."""
    if not callable(value) or (inspect.isclass(value) and issubclass(value, BaseException)):
        return {}
    own = inspect.isfunction(value) or inspect.ismethod(value) or inspect.isclass(value)
    return inspect.signature(value).parameters if own else {}


def names_within(name, value):
    """Names of a public object: its own, its members', and those of all arguments."""
    members = members_of(value)
    yield name
    yield from (f"{name}.{member}" for member in {**members, **getattr(value, "__annotations__", {})})
    for member in (value, *members.values()):
        yield from (f"{name}({argument})" for argument in signature_of(member))


def test_names_are_spelled_in_one_way():
    """American, as torch's and Mitsuba's: `polarization`, `center_of_mass`, `color`."""
    wrong = {inner for name in public_names() for inner in names_within(name, found(name)) if british(inner)}
    assert not wrong
    assert [british(name) for name in ("centre_of_mass", "StabilisedRoot", "read_noise", "domain_colors")] == [
        ["centre"], ["Stabilised"], [], []
    ]  # fmt: skip


# What takes more than three arguments by place, and why.
MANY_BY_PLACE = {
    "losses.surface_distance": "two meshes, each of vertices and faces",
    "sensing.emg_cdf": "arguments in the order of its formula: x, mean, sigma, tau",
    "sensing.emg_survival": "as emg_cdf",
}


def by_place(value):
    """The arguments that a function or class takes by place, the object itself left out."""
    places = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [name for name, one in dict(signature_of(value)).items() if one.kind in places and name != "self"]


def test_at_most_three_arguments_are_taken_by_place():
    many = {}
    for name in public_names():
        value = found(name)
        for member, inner in {"": value, **members_of(value)}.items():
            if len(by_place(inner)) > 3:
                many[f"{name}.{member}".rstrip(".")] = by_place(inner)
    assert set(many) == set(MANY_BY_PLACE), many
