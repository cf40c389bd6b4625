"""Page of a fit for a browser: one file with its curves and pictures, and a slider over the steps."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchtransient.array_files.part_files import replacing
from torchtransient.checks import check_folder
from torchtransient.vis.files import Image, pillow

# The page, with DATA in the place of its numbers.
_PAGE = Path(__file__).with_name("fit_page.html")
# Points that are drawn of a curve.
_MOST_POINTS = 1000


@dataclass(frozen=True)
class Curve:
    """Numbers `y` at `x`, a label and a colour `#rrggbb`; `band`: lower and upper ends at each `x`."""

    label: str
    colour: str
    x: Sequence[float]
    y: Sequence[float]
    dashed: bool = False
    band: tuple[Sequence[float], Sequence[float]] | None = None


@dataclass(frozen=True)
class Panel:
    """Curves with common axes."""

    title: str
    x_label: str
    curves: Sequence[Curve]
    log: bool = False


@dataclass(frozen=True)
class Picture:
    """An RGB image (H, W, 3) uint8 with its title."""

    title: str
    image: Image


@dataclass(frozen=True)
class Moment:
    """Pictures and panels of a position of the slider."""

    step: int
    pictures: Sequence[Picture]
    panels: Sequence[Panel] = field(default=())


def write_page(
    path: str | Path, panels: Sequence[Panel], moments: Sequence[Moment], fixed: Sequence[Picture], who: str
) -> None:
    """Write a page with a slider over moments.

    Args:
        path: the file.
        panels: curves over the steps.
        moments: positions of the slider.
        fixed: pictures that stay.
        who: beginning of messages.

    Raises:
        StorageError: when it cannot be written.
    """
    data = {
        "panels": [_panel(panel) for panel in panels],
        "fixed": [_picture(picture) for picture in fixed],
        "moments": [
            {
                "step": moment.step,
                "pictures": [_picture(picture) for picture in moment.pictures],
                "panels": [_panel(panel) for panel in moment.panels],
            }
            for moment in moments
        ],
    }
    # "</script>" in a name would end the script.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    with replacing(check_folder(path, who), who) as unfinished:
        unfinished.write_text(_PAGE.read_text(encoding="utf-8").replace("DATA", text, 1), encoding="utf-8")


def _panel(panel: Panel) -> dict[str, Any]:
    curves = []
    for curve in panel.curves:
        every = max(1, -(-len(curve.x) // _MOST_POINTS))
        rows = [curve.x, curve.y, *(curve.band or ())]
        x, y, *band = ([_number(value) for value in row[::every]] for row in rows)
        entry = {"label": curve.label, "colour": curve.colour, "x": x, "y": y, "dashed": curve.dashed}
        curves.append(entry | ({"band": band} if band else {}))
    return {"title": panel.title, "x": panel.x_label, "log": panel.log, "curves": curves}


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _picture(picture: Picture) -> dict[str, str]:
    written = io.BytesIO()
    pillow().fromarray(picture.image).save(written, format="PNG")
    return {"title": picture.title, "png": base64.b64encode(written.getvalue()).decode()}
