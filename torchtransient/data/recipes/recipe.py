"""``tt.data.Recipe``: a scene, what varies in it, and what is measured; sample i of it can be made alone."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from torchtransient.checks import count
from torchtransient.data.recipes import recipe_file
from torchtransient.data.recipes.checks import check_recipe, light_outside
from torchtransient.data.recipes.contact_sheet import contact_sheet
from torchtransient.data.recipes.forecast import Cost, forecast
from torchtransient.data.recipes.maker import Maker
from torchtransient.data.recipes.outside_light import OutsideLight
from torchtransient.data.recipes.sample import Sample
from torchtransient.data.recipes.specification import Specification

# What is no part of the description, and stays behind when a recipe is pickled or copied.
_OF_PROCESS = ("_maker", "_parameters", "_outside")


class Recipe(Specification):
    """What may vary in a scene, and what is measured of it. Plain data: pickles, is equal to its copy, and stands in a
    YAML file (:meth:`to_yaml`, :meth:`read`).

    ``scene``: what :func:`torchtransient.load` takes, or :class:`OneOf` several. ``vary``: distributions by key:

    - keys of ``scene.parameters()`` that have a derivative vary as values: nothing is built, traced or compiled anew;
    - entries of a scene dictionary (``box.filename``, ``lamp.bsdf``, a whole node) and ``$names`` of an XML file are
      exchanged: each combination is a *structure*, a scene of its own that is built when it comes;
    - ``device.STAGE.ARGUMENT`` for an argument of a stage of ``device`` (a kind or a number);
    - ``scan``, of a capture: a :class:`Choice` of scans of one shape.

    ``labels``: names of :func:`torchtransient.data.scene_labels` and ``first_return``, of the same scene and camera.
    ``keep``: names of what samples keep, of ``transient`` (``phasor``, ``gated``, ``rates``, ``beats``), ``steady``,
    labels and ``measurement``; None for all. ``["measurement", "depth"]`` makes small data sets.

    ``time_axis``, ``frequencies``, ``gates``, ``rates``, ``chirps``, ``max_depth``, ``spp``, ``sensors``, ``pulse``,
    ``irf``: as in :class:`~torchtransient.TransientRenderer`. ``temporal_filter``: "auto" is that of the scene's film,
    whatever varies. ``variant``: None settles it here as :func:`torchtransient.load` does.

    ``scan``: makes it a capture around a corner: ``scene`` is what is hidden, ``bounces`` and ``energy`` as in
    :class:`~torchtransient.nlos.CaptureRenderer`, and a time axis (or frequencies) has to be given, since what is
    hidden moves.

    ``device``: a :class:`~torchtransient.sensing.Device`, or its name or file: what the transient is measured with. A
    chain of one's own is written as one, see docs/data_sheet_to_chain.md. Its
    draw is ``measurement``, beside the transient itself. ``physics``: "ignore" or "error", as in the renderer.

    ``sampler``: plugin name, as in the renderer. None settles it here: "owen" for scenes that name ``independent`` or
    none, else what they name ("auto" where scenes differ, "scene" where a key of ``vary`` stands for it). "scene" is
    what the scene names, ``independent`` included, which recipes without the entry ``sampler`` have: folders of older
    versions go on with it.

    ``seed``: another one is another data set. Every number of sample i is drawn from (seed, i, key) alone: samples can
    be made in any order, anywhere, and another key leaves the others' draws as they were. ``parameters`` fill the
    $names of an XML scene. ``n``: how many samples a data set has unless :func:`generate` is told otherwise.

    ``plugins``: names of modules with Mitsuba plugins of one's own, which are added
    (:func:`torchtransient.plugins.register_module`) wherever the recipe is made, read or unpickled.

    What is wrong with a recipe is said before anything is rendered: by :meth:`check`, which :func:`generate` and
    :meth:`preview` call first. Raises SceneError, ShapeError, UnitError. Not supported: gradients, and samples of
    different shapes.
    """

    # --------------------------------------------------------------------------------------------------- samples

    # What `check` has found in this process.
    _outside: OutsideLight | None = None

    @functools.cached_property
    def _maker(self) -> Maker:
        return self.maker()

    def maker(self) -> Maker:
        """What makes samples, and keeps the scenes that it has built. One for each process."""
        return Maker(self)

    def sample(self, index: int) -> Sample:
        """Sample ``index``, whatever was made before. Raises the errors of :meth:`check` and of the renderer."""
        return self._maker.sample(index)

    def draw(self, index: int) -> dict[str, Any]:
        """What sample ``index`` draws, by key, without rendering it: numbers as float64 arrays."""
        return self._maker.draw(index)

    # --------------------------------------------------------------------------------------- before it is used

    def check(self, maker: Maker | None = None, *, progress: bool = False) -> OutsideLight:
        """Raise what is wrong with the recipe, before anything is rendered: unknown keys, distributions that do not fit
        them, numbers outside of what is physical, poses whose light leaves the window, a scene without light. Looks at
        the ends of every distribution and at the first 64 samples (of 8 structures at most). ``maker``: whose scenes
        are used, None for the recipe's own.

        Then renders these samples, with 65536 camera paths each at most, and returns how much of their light the time
        window misses; where that is more than 1 % of some of them, it is a PhysicsWarning, too, and where some of them
        fail, a TorchTransientWarning. A recipe that has passed is not looked at again in its process: the same answer
        comes at once, with its warnings.
        """
        if self._outside is None:
            maker = self._maker if maker is None else maker
            check_recipe(self, maker)
            self._outside = light_outside(self, maker, progress)
        self._outside.warn("recipe")
        return self._outside

    def cost(self, samples: int = 5, *, progress: bool = False) -> Cost:
        """Forecast the cost of a sample: entries that are built anew, values, seconds, bytes, and the light outside of
        the window that :meth:`check` finds. Renders some ``samples`` of each structure that comes first. ``str`` of it
        is a table.
        """
        return forecast(self, self._maker, samples, progress, self.check(progress=progress))

    def preview(self, samples: int = 16, path: str | Path | None = None, *, progress: bool = False) -> Any:
        """A contact sheet of the first samples: the steady picture (or what stands for it), labels, and the light over
        time. ``path``: where to write it (.png, .pdf, .svg), else the matplotlib figure is returned. Needs matplotlib.
        """
        self.check(progress=progress)
        return contact_sheet(self, self._maker, range(count("preview: samples", samples)), path, progress)

    # ------------------------------------------------------------------------------------------------- as plain data

    def to_dict(self) -> dict[str, Any]:
        """The recipe as data that JSON can hold; :meth:`from_dict` makes an equal recipe of it."""
        return recipe_file.to_dict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], folder: str | Path | None = None) -> Self:
        """A recipe from plain data: what :meth:`to_dict` made, or what a YAML file says. ``folder``: where files that
        it names are looked up, None for where they were. Raises SceneError for unknown and wrong entries.
        """
        with recipe_file.faults_said():
            scene, arguments = recipe_file.from_dict(data, folder)
            return cls(scene, **arguments)

    def to_yaml(self, path: str | Path | None = None) -> str:
        """As YAML text, also written to ``path``."""
        return recipe_file.to_yaml(self, path)

    @classmethod
    def read(cls, source: str | Path) -> Self:
        """A recipe from a YAML or JSON file, or YAML text. Nothing is executed. Raises SceneError, StorageError."""
        return cls.from_dict(*recipe_file.read_file(source))

    def key(self) -> str:
        """A text that stands for all that decides about the samples; files that the recipe names count with what is in
        them.
        """
        return recipe_file.key_of(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Recipe) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.seed, tuple(self.vary)))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _OF_PROCESS}

    def __repr__(self) -> str:
        scenes = "" if self.scenes.names == [""] else f"{len(self.scenes.names)} scenes, "
        return f"tt.data.Recipe({scenes}{self.variant}, varies {', '.join(self.vary) or 'nothing'})"
