"""``scene_info`` of y-tal's captures: YAML about how a capture was made, and the place for what has no other there."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from torchtransient.axes import FrequencyAxis
from torchtransient.capture import Capture
from torchtransient.errors import StorageError
from torchtransient.files.captures.plain_yaml import read_plain_yaml, write_plain_yaml
from torchtransient.files.plain_data import plain, restored
from torchtransient.plugins.films.transform_bins import transform_bins

# Our part of the information: a JSON text, in which numbers keep every digit.
_OWN = "torchtransient"
# What metadata hold after reading; other entries were added since.
_READ = {"format", "assumed", "scene_info", "tal", "not_read"}
# Kinds of numbers as NumPy writes them.
_DTYPE = re.compile(r"\|b1|[<>|=]([iu][1248]|f(2|4|8|16)|c(8|16))")


def parsed(text: str, what: str) -> Any:
    """``scene_info`` as plain data. Raises StorageError."""
    return _as_json(read_plain_yaml(text, what))


def own_part(info: Any) -> dict[str, Any] | None:
    """What this library has written into it: ``channels``, ``metadata``, ``wall``, ``steady``,
    ``frequencies_per_metre``, ``phasor_start_opl``. None where another program has written it. Raises StorageError for
    what is damaged.
    """
    text = info.get(_OWN) if isinstance(info, Mapping) else None
    if not isinstance(text, str):
        return None
    try:
        own = json.loads(text)
        return dict(own) | {name: restored(own[name], {}) for name in ("wall", "steady")}
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise StorageError(f"capture file: scene_info.{_OWN} is damaged: {error}.") from None


def frequencies(info: Any, own: Mapping[str, Any] | None, count: int, start_opl: float | None) -> FrequencyAxis | None:
    """The frequencies of ``count`` phasors: as this library wrote them, or those that a render of y-tal with these
    settings keeps; None where neither is there.
    """
    if own is not None and own.get("frequencies_per_metre") is not None:
        return FrequencyAxis(tuple(own["frequencies_per_metre"]), own["phasor_start_opl"])
    config = info.get("config") if isinstance(info, Mapping) else None
    if not isinstance(config, Mapping) or config.get("histogram_mode") != "frequency":
        return None
    numbers = [config.get(name) for name in ("wl_mean", "wl_sigma", "num_bins", "bin_width_opl")]
    if any(isinstance(n, bool) or not isinstance(n, int | float) for n in numbers):
        return None
    mean, sigma, bins, width = (float(n) for n in numbers if n is not None)
    # A spectrum has as many lines as H has rows, whatever a damaged text says of bins.
    if not (0 < bins <= 2**31 and bins * width / max(sigma, 1e-300) < 1e3 * (count + 10)):
        return None
    found = transform_bins(mean, sigma, int(bins), width)
    return FrequencyAxis(tuple(found.tolist()), start_opl or 0.0) if len(found) == count else None


def kept_of(capture: Capture) -> dict[str, Any]:
    """What the metadata of a capture that was read keeps for writing it again: ``dtypes`` by name, and where they are
    there ``scene_info_text``, ``volume_format``, ``delta_t``. Whatever else stands there is left out:
    metadata are anyone's.
    """
    given = capture.metadata.get("tal")
    given = given if isinstance(given, Mapping) else {}
    dtypes = given.get("dtypes")
    names = dtypes.items() if isinstance(dtypes, Mapping) else ()
    kept: dict[str, Any] = {"dtypes": {name: kind for name, kind in names if _DTYPE.fullmatch(str(kind))}}
    kinds = {"scene_info_text": str | None, "volume_format": int, "delta_t": float}
    return kept | {name: given[name] for name, kind in kinds.items() if name in given and isinstance(given[name], kind)}


def written(capture: Capture, kept: Mapping[str, Any], what: str) -> str | None:
    """The text for a capture: as it was read where nothing about it has changed, None where there was none."""
    text = kept.get("scene_info_text")
    added = bool(capture.channels or set(capture.metadata) - _READ)
    added = added or capture.scan.wall is not None or capture.steady is not None
    if "scene_info_text" in kept and not added and capture.frequencies == _kept_frequencies(capture, kept, what):
        before = None if text is None else parsed(text, what)
        if capture.metadata.get("scene_info") == before:
            return None if text is None else str(text)
    info: dict[str, Any] = {"original_format": str(capture.metadata.get("format", _OWN))}
    given = capture.metadata.get("scene_info")
    own = {
        "channels": capture.channels, "metadata": dict(capture.metadata),
        "wall": plain(capture.scan.wall, None, "wall"), "steady": plain(capture.steady, None, "steady"),
    }  # fmt: skip
    if capture.frequencies is not None:
        own |= {
            "frequencies_per_metre": capture.frequencies.frequencies, "phasor_start_opl": capture.frequencies.start_opl,
        }  # fmt: skip
    if capture.polarized:
        # Not the variant, which 0.21 looks at: its `read_capture` raises for polarized ones.
        info["is_polarized"] = True
    info |= given if isinstance(given, Mapping) else {}
    return write_plain_yaml(_as_json(info) | {_OWN: json.dumps(own)}, what)


def _kept_frequencies(capture: Capture, kept: Mapping[str, Any], what: str) -> FrequencyAxis | None:
    if capture.frequencies is None:
        return None
    text = kept.get("scene_info_text")
    info = None if text is None else parsed(text, what)
    count, start = capture.frequencies.num_frequencies, capture.frequencies.start_opl
    return frequencies(info, own_part(info), count, start)


def _as_json(data: Any) -> Any:
    """Plain data as JSON has it: names are texts, sequences lists."""
    if isinstance(data, Mapping):
        return {name if isinstance(name, str) else json.dumps(_as_json(name)): _as_json(v) for name, v in data.items()}
    if isinstance(data, list | tuple | set | frozenset):
        return [_as_json(value) for value in data]
    if isinstance(data, bytes):
        return data.hex()
    return data if data is None or isinstance(data, bool | int | float | str) else str(data)
