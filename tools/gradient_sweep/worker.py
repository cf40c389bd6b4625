"""One process of the sweep: settings in, results out."""

from __future__ import annotations

import gc
import traceback
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from tools.gradient_sweep.compare import Effort, Result, judge
from tools.gradient_sweep.measure import Subject, quiet
from tools.gradient_sweep.settings import Setting
from torchtransient.errors import TorchTransientError
from torchtransient.plugins.parameter_effect import UNCHECKED
from torchtransient.scene.load import load
from torchtransient.scene.parameters import ParameterInfo


def results_of(setting: Setting, folder: Path, effort: Effort) -> Iterator[Result]:
    """Everything that the sweep finds in one scene."""
    import mitsuba as mi

    from torchtransient import plugins

    if mi.variant() != setting.variant:
        mi.set_variant(setting.variant)
    plugins.sync()
    with quiet():
        scene = load(setting.make(folder), variant=setting.variant)
        for key, info in scene.parameters().items():
            if setting.takes(key) and info.shape is not None and info.kind not in ("plain", "integer"):
                both_modes = effort.in_both_modes(f"{setting.name}: {key}")
                for result in _results_of_key(scene, key, info, for_setting(effort, setting), both_modes):
                    result.setting = setting.name
                    yield result
    del scene
    gc.collect()


def for_setting(effort: Effort, setting: Setting) -> Effort:
    """Inside others poses are looked at along one direction, this one here and that one there."""
    if setting.is_bare or effort.directions < 2:
        return effort
    return replace(effort, directions=1, first_direction=zlib.crc32(setting.name.encode()) % 2)


def _results_of_key(scene: Any, key: str, info: ParameterInfo, effort: Effort, both_modes: bool) -> Iterator[Result]:
    for result in _judgements(scene, key, info, effort, both_modes):
        result.table = info.reason.removesuffix(f"; {UNCHECKED}")
        # No edge moves against another in the sweep's scenes.
        result.biased = info.always_biased
        result.place = list(info.place)
        yield result


def _judgements(scene: Any, key: str, info: ParameterInfo, effort: Effort, both_modes: bool) -> Iterator[Result]:
    if not info.differentiable:
        yield Result("", key, "", "refused")
        return
    try:
        subject = Subject(scene, key)
        for tangent in effort.chosen(subject.tangents()):
            yield judge(subject, tangent, effort, both_modes)
    except TorchTransientError as error:
        yield Result("", key, "", "error", note=f"{type(error).__name__}: {error}")
    except Exception:  # noqa: BLE001  one parameter that fails must not end the sweep
        yield Result("", key, "", "error", note=traceback.format_exc(limit=3))
