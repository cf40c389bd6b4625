"""Wheel and sdist: what they hold, and that what is installed from them works away from the sources."""

from __future__ import annotations

import importlib.util
import itertools
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import types
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
# Folders whose files are made, not kept, and what a checkout has beside them.
NOT_KEPT = {"__pycache__", "build", "dist", "demo_output", "out"}


def requirements():
    """All that pyproject.toml asks for, but for this package's own extras."""
    project = PROJECT["project"]
    lines = itertools.chain(project["dependencies"], *project["optional-dependencies"].values())
    return [one for one in map(Requirement, lines) if one.name != "torchtransient"]


def run(command, **options):
    """Its output; what went wrong stands in the test's."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def built(source, folder):
    """(wheel, sdist) of a checkout or an unpacked sdist, without the network."""
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)])
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    return built(ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def unpacked(packages, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(packages[1]) as archive:
        archive.extractall(folder, filter="data")
    (source,) = folder.iterdir()
    return source


def kept(folder):
    """Relative paths of the files of a folder, without what running them leaves behind."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in files if not NOT_KEPT & set(path.parts) and not path.name.startswith(".")}


def test_every_dependency_has_a_lower_bound_that_is_installed():
    """`constraints-lowest.txt` has exactly the bounds. Tools that only look at sources are taken as they come."""
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    lowest = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    not_run = {"ruff", "mypy", "build", "hatchling", "sphinx", "myst-parser", "furo", "sphinx-gallery"}
    not_run |= {"mitransient", "y-tal"}  # live in an environment of their own
    for one in requirements():
        (least,) = [part.version for part in one.specifier if part.operator == ">="]
        if one.name not in not_run:
            assert Version(least) == Version(lowest[one.name]) or lowest[one.name].startswith(least), one
    assert lowest.keys() == {one.name for one in requirements()} - not_run


def test_no_yanked_builder_is_allowed():
    """Of hatchling, as PyPI had them in November 2026."""
    (line,) = PROJECT["build-system"]["requires"]
    allowed = SpecifierSet(str(Requirement(line).specifier))
    assert not [v for v in ("1.22.0", "1.26.0", "1.26.1", "1.26.2", "1.30.0", "1.32.1") if v in allowed]
    assert {"1.27.0", "1.28.0", "1.29.0"} <= set(allowed.filter(["1.27.0", "1.28.0", "1.29.0"]))


def links(text):
    """(exclamation mark or none, where it leads) of every link and picture."""
    return re.findall(r"(!?)\[[^\]]*\]\(([^)]+)\)", text)


@pytest.mark.parametrize("address", ["", "https://github.com/OWNER/NAME"])
def test_no_link_of_the_description_is_relative(monkeypatch, address):
    """With an address of the sources each leads to a file of them; without one its text is left. The builder, which is
    not needed for that, may be missing.
    """
    hook = types.SimpleNamespace(MetadataHookInterface=object)
    monkeypatch.setitem(sys.modules, "hatchling.metadata.plugin.interface", hook)
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    readme = (ROOT / "README.md").read_text()
    text = module.long_description(readme, address)
    relative = [(kind, to) for kind, to in links(readme) if not to.startswith("http")]
    assert len(relative) > 10
    begun = f"{address}/blob/HEAD/"
    leading = [(kind, to.removeprefix(begun)) for kind, to in links(text) if address and to.startswith(begun)]
    assert leading == [(kind, to + kind.replace("!", "?raw=true")) for kind, to in relative if address]
    assert all((ROOT / to.partition("?")[0].partition("#")[0]).exists() for _, to in leading)
    assert all(to.startswith("https://") for _, to in links(text)) and "docs/install.md" in text
    assert ("Wig42" in text) == bool(address)


@pytest.mark.slow
def test_the_wheel_has_the_package_and_nothing_else(packages):
    with zipfile.ZipFile(packages[0]) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
        (metadata,) = [name for name in wheel.namelist() if name.endswith("METADATA")]
        said = wheel.read(metadata).decode()
    assert names == {f"torchtransient/{name}" for name in kept(ROOT / "torchtransient")}
    assert {"torchtransient/py.typed", "torchtransient/plugins/swept_parameters.json"} <= names
    assert "Description-Content-Type: text/markdown" in said and "Project-URL" not in said
    assert all(to.startswith("https://") for _, to in links(said)) and "## Quick start" in said
    for line in ("License-Expression: BSD-3-Clause", "License-File: LICENSE", "Requires-Python: >=3.11"):
        assert line in said


@pytest.mark.slow
def test_the_sdist_has_what_tests_need(unpacked):
    for folder in ("torchtransient", "tests", "tools", "docs", "benchmarks", "training_examples"):
        assert kept(unpacked / folder) == kept(ROOT / folder)
    beside = ("README.md", "CHANGELOG.md", "LICENSE", "Makefile", "constraints.txt", "constraints-lowest.txt")
    for name in (*beside, "hatch_build.py"):
        assert (unpacked / name).read_bytes() == (ROOT / name).read_bytes()
    some = ["tests/test_axes.py", "tests/pages/test_links.py"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *some]
    run(command, cwd=unpacked, env={**os.environ, "PYTHONPATH": str(unpacked)})


@pytest.mark.slow
def test_the_sdist_builds_the_same_wheel(packages, unpacked, tmp_path):
    again, _ = built(unpacked, tmp_path)
    with zipfile.ZipFile(packages[0]) as first, zipfile.ZipFile(again) as second:
        assert {i.filename: i.CRC for i in first.infolist()} == {i.filename: i.CRC for i in second.infolist()}


@pytest.mark.slow
def test_what_is_installed_works(packages, tmp_path):
    """With the packages of this environment; `make release-check` does it in an empty one."""
    target = tmp_path / "installed"
    run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(target), str(packages[0])])
    smoke = tmp_path / "smoke.py"
    smoke.write_text((Path(__file__).parent / "smoke.py").read_text())
    said = run(
        [sys.executable, "-W", "error", str(smoke)], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(target)}
    )
    assert str(target) in said
    assert [line.split()[0] for line in said.splitlines()] == ["files", "import", "doctor", "gradient", "sensor"]
