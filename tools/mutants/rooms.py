"""The rooms of a mutation run: which files are changed, and which tests are to notice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Room:
    """Files and folders of the package, and of the tests."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]

    def files(self, root: Path) -> list[Path]:
        """The sources, one by one."""
        return sorted(_files(root / "torchtransient", self.sources, "*.py"))

    def test_files(self, root: Path) -> list[Path]:
        """The test files."""
        return sorted(_files(root / "tests", self.tests, "test_*.py"))


def _files(root: Path, names: tuple[str, ...], pattern: str) -> Iterator[Path]:
    for name in names:
        path = root / name
        if not path.exists():
            raise FileNotFoundError(f"rooms: {path} is not there; see ROOMS.")
        yield from path.rglob(pattern) if path.is_dir() else [path]


ROOMS = {
    "axes": Room(
        ("axes.py", "gates.py", "pulses.py", "stokes.py", "transform_bins.py", "units.py"),
        ("test_axes.py", "test_gates.py", "test_pulses.py", "test_stokes.py", "test_transform_bins.py",
         "test_units.py"),
    ),
    "accuracy": Room(("accuracy",), ("accuracy",)),
    "losses": Room(("losses",), ("losses",)),
    "metrics": Room(("metrics",), ("metrics",)),
    "sensing": Room(("sensing",), ("sensing",)),
    "films": Room(
        ("plugins/films", "rendering/films.py"),
        ("plugins/test_film.py", "plugins/test_film_interface.py", "plugins/test_film_parts.py",
         "plugins/test_film_renders.py", "plugins/test_gate_table.py", "plugins/test_gated_film.py",
         "plugins/test_phasor_adjoint.py", "plugins/test_phasor_film.py", "plugins/test_pulsed_filter.py",
         "plugins/test_response.py", "plugins/test_wrong_options.py", "rendering/films", "integrators/test_phasors.py",
         "integrators/test_phasor_gradients.py", "integrators/test_large_films.py"),
    ),
    "integrators": Room(
        ("plugins/integrators", "plugins/transport"),
        ("integrators", "transport", "media", "around_corner", "plugins/sampling"),
    ),
    "scene": Room(("scene",), ("scene",)),
    "rendering": Room(("rendering",), ("rendering",)),
    "data": Room(("data",), ("data",)),
    "nlos": Room(("nlos",), ("nlos",)),
    "reconstruction": Room(("reconstruction",), ("reconstruction",)),
    "files": Room(("capture", "files", "array_files"), ("capture", "files")),
    "around_corner": Room(("plugins/around_corner",), ("around_corner", "integrators/test_nlos_path.py", "nlos")),
    "plugins": Room(
        ("plugins/bsdfs", "plugins/emitters", "plugins/sensors", "plugins/shapes", "plugins/sampling",
         *(f"plugins/{name}.py" for name in (
             "cache", "described_scene", "kernel_arrays", "mitsuba_compat", "mitsuba_parameters", "parameter_effect",
             "parameters", "polarized", "properties", "spectral_colours"))),
        ("plugins", "stability", "integrators", "scene/test_black_textures.py", "scene/test_finite_numbers.py",
         "scene/test_texture_uses.py", "transport/test_lambertian.py", "transport/test_triangles.py"),
    ),
    "scenes": Room(("scenes",), ("scenes",)),
    "parametrize": Room(("parametrize", "geometry"), ("parametrize", "geometry")),
    "training": Room(("training",), ("training",)),
    "vis": Room(("vis",), ("vis",)),
    "cli": Room(("cli",), ("cli",)),
}  # fmt: skip
