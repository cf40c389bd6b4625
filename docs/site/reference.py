"""The reference of every public name: a page for `torchtransient` itself and for each of its rooms, by Sphinx."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from types import ModuleType

import torchtransient as tt

# Rooms that are not names of the package itself, and are named on pages.
MORE = (
    "units", "motion", "files.result_file", "rendering.films", "rendering.labels", "testing", "interfaces", "plugins"
)  # fmt: skip
NOT_PUBLIC = {"annotations", "importlib", "TYPE_CHECKING"}


def rooms() -> dict[str, ModuleType]:
    """Modules by the name that users write: ``tt.losses``; the package first."""
    found = {name: value for name, value in public_of(tt).items() if isinstance(value, ModuleType)}
    more = {name: importlib.import_module(f"torchtransient.{name}") for name in MORE}
    return {"": tt, **dict(sorted({**found, **more}.items()))}


def public_of(module: ModuleType) -> dict[str, object]:
    """Names that a module offers: ``__all__`` where it has one, else what it has without an underscore and did not
    import from elsewhere.
    """
    names = getattr(module, "__all__", None) or [name for name in dir(module) if not name.startswith("_")]
    found = {name: getattr(module, name) for name in names if name not in NOT_PUBLIC}
    return {name: value for name, value in found.items() if is_ours(value)}


def is_ours(value: object) -> bool:
    """Whether it was made in this package; numbers and other plain values count."""
    if isinstance(value, ModuleType):
        return value.__name__.startswith("torchtransient")
    home = getattr(value, "__module__", None)
    return not isinstance(home, str) or home.startswith("torchtransient")


def is_of(value: object, path: str) -> bool:
    """Whether it was made in a module or below it."""
    return str(getattr(value, "__module__", path)).startswith(path)


def shown(value: object) -> list[str]:
    """A value that is no class and no function, in lines of restructured text."""
    if isinstance(value, dict):
        return ["", "A dictionary with the keys " + ", ".join(f"``{key}``" for key in value) + ".", ""]
    return ["", f"``{value!r}``", ""]


def write_reference(folder: Path) -> None:
    """One file in restructured text for each room, and their index."""
    folder.mkdir(parents=True)
    pages = []
    described: dict[int, str] = {}
    for name, module in rooms().items():
        page = name.replace(".", "_") or "torchtransient"
        pages.append(page)
        (folder / f"{page}.rst").write_text(page_of(name, module, described), encoding="utf-8")
    listed = "\n".join(f"   {page}" for page in pages)
    head = "Reference\n=========\n\nEvery public name, by room. ``import torchtransient as tt``.\n\n"
    (folder / "index.rst").write_text(f"{head}.. toctree::\n   :maxdepth: 1\n\n{listed}\n", encoding="utf-8")


def page_of(name: str, module: ModuleType, described: dict[int, str]) -> str:
    """The docstring of the room, its classes, functions and values. ``described``: by identity, where what several
    rooms offer stands already; what is new here is entered.
    """
    path = f"torchtransient.{name}".rstrip(".")
    title = f"tt.{name}" if name else "torchtransient"
    lines = [title, "=" * len(title), "", f".. automodule:: {path}", "   :no-members:", "   :no-index:", ""]
    lines += [f".. currentmodule:: {path}", ""]
    members = {key: value for key, value in public_of(module).items() if not isinstance(value, ModuleType)}
    if name in MORE:  # others have their place in another room
        members = {key: value for key, value in members.items() if is_of(value, path)}
    once = {key: value for key, value in members.items() if inspect.isroutine(value) or inspect.isclass(value)}
    elsewhere = {key: described[id(value)] for key, value in once.items() if id(value) in described}
    described.update({id(value): f"{path}.{key}" for key, value in once.items() if key not in elsewhere})
    members = {key: value for key, value in members.items() if key not in elsewhere}
    functions = {key: value for key, value in members.items() if inspect.isroutine(value)}
    classes = {key: value for key, value in members.items() if inspect.isclass(value)}
    values = {key: value for key, value in members.items() if key not in functions and key not in classes}
    for heading, directive, some in (
        ("Functions", "autofunction", functions), ("Classes", "autoclass", classes), ("Values", "py:data", values),
    ):  # fmt: skip
        if not some:
            continue
        lines += [heading, "-" * len(heading), ""]
        for key in sorted(some):
            lines += [key, "~" * len(key), "", f".. {directive}:: {key}", ""]
            lines += [f"   {line}" for line in shown(some[key])] if directive == "py:data" else []
    if elsewhere:
        lines += ["Offered here too", "-" * 16, ""]
        lines += [f"- :py:obj:`{key} <{place}>`" for key, place in sorted(elsewhere.items())]
        lines.append("")
    return "\n".join(lines)
