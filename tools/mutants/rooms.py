"""Rooms of a mutation run: the files that are changed, and the tests that are to notice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Room:
    """Glob patterns of files in the package, and of test files in ``tests``; a folder stands for all files in it.

    Patterns rather than names of files, so that moved files need no edit here.
    """

    sources: tuple[str, ...]
    tests: tuple[str, ...]

    def files(self, root: Path) -> list[Path]:
        """Return the sources in a checkout."""
        return sorted(set(_files(root / "torchtransient", self.sources, "*.py")))

    def test_files(self, root: Path) -> list[Path]:
        """Return the test files in a checkout."""
        return sorted(set(_files(root / "tests", self.tests, "test_*.py")))


def _files(root: Path, patterns: tuple[str, ...], inside: str) -> Iterator[Path]:
    for pattern in patterns:
        paths = list(root.glob(pattern))
        if not paths:
            raise FileNotFoundError(f"rooms: no file matches {root / pattern}; see ROOMS.")
        for path in paths:
            yield from path.rglob(inside) if path.is_dir() else [path]


def _same(*folders: str) -> Room:
    """Return a room whose tests stand in folders of the same names."""
    return Room(folders, folders)


ROOMS = {
    "root": Room(("[!_]*.py",), ("test_*.py",)),
    "accuracy": _same("accuracy"),
    "losses": _same("losses"),
    "metrics": _same("metrics"),
    "sensing": _same("sensing"),
    "films": Room(
        ("plugins/films", "rendering/films.py"),
        ("plugins/test_*film*.py", "plugins/test_*gate*.py", "plugins/test_phasor*.py",
         "plugins/test_response.py", "plugins/test_wrong_options.py", "rendering/films",
         "integrators/test_*phasor*.py", "integrators/test_plain_images.py", "motion/test_beat_lines.py"),
    ),
    "integrators": Room(
        ("plugins/integrators", "plugins/transport"),
        ("integrators", "transport", "media", "around_corner", "plugins/sampling"),
    ),
    "scene": _same("scene"),
    "rendering": _same("rendering"),
    "data": _same("data"),
    "nlos": _same("nlos"),
    "reconstruction": _same("reconstruction"),
    "files": Room(("capture", "files", "array_files"), ("capture", "files")),
    "around_corner": Room(("plugins/around_corner",), ("around_corner", "integrators/test_nlos*.py", "nlos")),
    "plugins": Room(
        ("plugins/bsdfs", "plugins/emitters", "plugins/sensors", "plugins/shapes", "plugins/sampling",
         "plugins/[!_]*.py"),
        ("plugins", "stability", "integrators", "scene/test_*texture*.py", "scene/test_finite*.py",
         "transport/test_lambertian.py", "transport/test_triangles.py"),
    ),
    "scenes": _same("scenes"),
    "parametrize": _same("parametrize", "geometry"),
    "training": _same("training"),
    "vis": _same("vis"),
    "cli": _same("cli"),
}  # fmt: skip
