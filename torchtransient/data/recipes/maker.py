"""What makes the samples of a recipe: scenes that are built once, and calls that are recorded once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import real_array
from torchtransient.data.recipes.distributions import Choice
from torchtransient.data.recipes.kept_scene import Kept, Measures
from torchtransient.data.recipes.sample import Sample
from torchtransient.data.recipes.specification import (
    RENDER,
    SECOND,
    Specification,
    label_of,
    samples_of,
)
from torchtransient.data.recipes.streams import Stream
from torchtransient.data.recipes.structures import SCAN, Structure
from torchtransient.errors import UnitError
from torchtransient.files.plain_data import scan_data

# Structures whose scenes are kept. Mitsuba compiles a method call for all objects that are alive: with 8 scenes of the
# Cornell box a sample takes 350 ms instead of 25, and each new scene compiles anew. To build one takes 50 ms.
MOST_KEPT = 1


class Maker:
    """Makes samples of a recipe, and keeps the scenes that it has built. Same recipe, same sample, whatever was made
    before, on one kind of processor with one thread (``tt.threads(1)``).
    """

    def __init__(self, recipe: Specification) -> None:
        self.recipe = recipe
        self._kept: OrderedDict[str, Kept] = OrderedDict()
        self._measures: Measures | None = None

    def order(self, indices: Iterable[int]) -> list[int]:
        """The same samples, those of one structure one after another, in the order in which structures first come."""
        groups: dict[str, list[int]] = {}
        for index in samples_of(indices):
            groups.setdefault(self.recipe.structure(index).key, []).append(index)
        return [index for group in groups.values() for index in group]

    def kept(self, structure: Structure) -> Kept:
        """The scene of a structure, built unless it is kept."""
        found = self._kept.pop(structure.key, None)
        if found is None:
            # Before the next one is built.
            while len(self._kept) >= MOST_KEPT:
                self._kept.popitem(last=False)
            found = Kept(self.recipe, structure)
        self._kept[structure.key] = found
        return found

    def draw(self, index: int) -> dict[str, Any]:
        """What a sample draws, by key."""
        (index,) = samples_of([index])
        structure = self.recipe.structure(index)
        varied = self.kept(structure).draw(index) if len(self.recipe.exchanged) < len(self.recipe.vary) else {}
        drawn = varied | dict(structure.entries)
        return {key: drawn[key] for key in self.recipe.vary}

    def sample(self, index: int) -> Sample:
        """Sample ``index``. Raises the errors of the renderer, and UnitError for light that is no number."""
        (index,) = samples_of([index])
        # Of sample 0, whichever comes first here: all processes refuse the same samples.
        expected = self.measures()
        structure = self.recipe.structure(index)
        kept = self.kept(structure)
        kept.measures.check(expected, f"sample {index}", "sample 0")
        varied = kept.draw(index)
        seed = kept.seed(index)
        arrays, outside = kept.arrays(index, varied, seed)
        self._check(index, arrays, expected.name)
        return Sample(
            index,
            seed,
            arrays=arrays,
            values=self._values(structure, varied),
            outside=outside,
            structure=structure.text,
        )

    def measures(self) -> Measures:
        """What sample 0 measures, and with it all."""
        if self._measures is None:
            self._measures = self.kept(self.recipe.structure(0)).measures
        return self._measures

    def standard_error(self, index: int) -> float:
        """Relative standard error of a sample: root mean square over the cube of the error of a number, by the root
        mean square of the numbers as they are rendered, so that 1 is noise alone. Of two renders, the sample's and one
        more; 0 for a black sample.
        """
        (index,) = samples_of([index])
        kept = self.kept(self.recipe.structure(index))
        varied = kept.draw(index)
        one, other = (
            kept.light(varied, Stream(self.recipe.seed, index, purpose).seed()) for purpose in (RENDER, SECOND)
        )
        noise, power, second = (float(np.mean(np.abs(x).astype(np.float64) ** 2)) for x in (one - other, one, other))
        # The difference has twice the variance of one render.
        return float(np.sqrt(noise / (power + second))) if power + second > 0 else 0.0

    def about(self) -> dict[str, Any]:
        """How samples are made, plain data. Of several scenes ``plan`` and names of shapes and materials stand under
        the scene's name; of scans that vary all stand in ``scans``, in the order of the choices.
        """
        recipe, first = self.recipe, self.recipe.structure(0)
        # Sample 0's scene last: it is the one that is kept.
        names = sorted(recipe.scenes.names, key=lambda name: name == first.name)
        several = {name: self.kept(Structure(name, "", first.entries)).named() for name in names}
        of_scenes: dict[str, Any] = dict(several[first.name])
        if len(names) > 1:
            of_scenes = {what: {name: several[name][what] for name in recipe.scenes.names} for what in of_scenes}
        found = self.kept(Structure(first.name, "", first.entries)).about() | of_scenes
        if SCAN in recipe.exchanged:
            choices = recipe.vary[SCAN]
            found["scans"] = [scan_data(scan) for scan in choices.values] if isinstance(choices, Choice) else []
        return found

    def forget(self, structure: Structure) -> None:
        """Free the scene of a structure."""
        self._kept.pop(structure.key, None)

    def close(self) -> None:
        """Free the scenes."""
        self._kept.clear()

    def _values(self, structure: Structure, varied: Mapping[str, Any]) -> dict[str, NDArray[Any] | str]:
        found: dict[str, NDArray[Any] | str] = {}
        if self.recipe.scenes.names != [""]:
            found["scene"] = structure.name
        exchanged = dict(structure.entries)
        for key in self.recipe.vary:
            value, distribution = exchanged.get(key, varied.get(key)), self.recipe.vary[key]
            # Of one kind in all samples.
            kinds = distribution.values if isinstance(distribution, Choice) else [value]
            is_number = not any(isinstance(one, bool) or not _is_number(one) for one in kinds)
            text = label_of(distribution, value) if not is_number else ""
            # As the renderer takes them.
            found[key] = text if text else np.asarray(value, dtype=np.float32)
        return found

    def _check(self, index: int, arrays: Mapping[str, NDArray[Any]], measured: str) -> None:
        # Labels have NaN where nothing is seen.
        for name in (measured, "steady", "measurement"):
            if name in arrays and not np.isfinite(arrays[name]).all():
                raise UnitError(f"recipe: sample {index}: {name} has numbers that are not finite.")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.ndarray) or (isinstance(value, list) and real_array(value) is not None)
