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
        unfinished.write_text(_PAGE.replace("DATA", text, 1), encoding="utf-8")


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


_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Fit</title><style>
body { font: 14px sans-serif; margin: 1em 2em; }
.row { display: flex; flex-wrap: wrap; gap: 1em; }
figure { margin: 0; } figcaption { font-size: 12px; }
figure img { width: 220px; image-rendering: pixelated; background: #888; }
svg text { font-size: 10px; fill: #333; } svg .title { font-size: 12px; }
#bar { position: sticky; top: 0; background: white; padding: .4em 0; } #slider { width: 24em; }
</style></head><body>
<div id="bar"><button id="play">play</button> <input id="slider" type="range" min="0" value="0">
<label for="slider" id="step"></label></div>
<div class="row" id="pictures"></div><div class="row" id="pixels"></div><div class="row" id="curves"></div>
<script type="application/json" id="data">DATA</script>
<script>
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const W = 330, H = 210, L = 52, R = 8, T = 20, B = 32;
function make(name, attributes, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  if (text !== undefined) node.textContent = text;
  return node;
}
function ticks(low, high, log) {
  if (log) {
    const first = Math.ceil(Math.log10(low)), last = Math.floor(Math.log10(high)), found = [];
    for (let n = first; n <= last; n += Math.max(1, Math.ceil((last - first) / 4))) found.push(10 ** n);
    return found.length > 1 ? found : [low, high];
  }
  const raw = (high - low) / 4, power = 10 ** Math.floor(Math.log10(raw));
  const size = [1, 2, 5, 10].find((m) => m * power >= raw) * power, found = [];
  for (let n = Math.ceil(low / size); n * size <= high; n++) found.push(n * size);
  return found;
}
function said(v) {
  return v !== 0 && (Math.abs(v) < 1e-3 || Math.abs(v) >= 1e5) ? v.toExponential(1) : Number(v.toPrecision(4));
}
function draw(panel) {
  const svg = make("svg", {width: W, height: H, role: "img", "aria-label": panel.title});
  const all = panel.curves.flatMap((c) => [...c.y, ...(c.band || []).flat()]);
  const ys = all.filter((v) => v !== null && (!panel.log || v > 0));
  const xs = panel.curves.flatMap((c) => c.x);
  let [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  if (!(x1 > x0)) { x0 -= 0.5; x1 += 0.5; }
  if (panel.log) { y0 /= 1.1; y1 *= 1.1; }
  else { const m = 0.05 * (y1 - y0) || 0.05 * Math.abs(y1) || 1; y0 -= m; y1 += m; }
  const scale = (v) => panel.log ? Math.log(v) : v;
  const px = (v) => L + (W - L - R) * (v - x0) / (x1 - x0);
  const py = (v) => H - B - (H - B - T) * (scale(v) - scale(y0)) / (scale(y1) - scale(y0));
  svg.append(make("text", {x: L, y: 13, class: "title"}, panel.title));
  svg.append(make("text", {x: W - R, y: H - 3, "text-anchor": "end"}, panel.x));
  for (const v of ticks(x0, x1, false)) {
    svg.append(make("line", {x1: px(v), x2: px(v), y1: T, y2: H - B, stroke: "#e8e8e8"}));
    svg.append(make("text", {x: px(v), y: H - B + 13, "text-anchor": "middle"}, said(v)));
  }
  for (const v of ys.length ? ticks(y0, y1, panel.log) : []) {
    svg.append(make("line", {x1: L, x2: W - R, y1: py(v), y2: py(v), stroke: "#e8e8e8"}));
    svg.append(make("text", {x: L - 4, y: py(v) + 3, "text-anchor": "end"}, said(v)));
  }
  panel.curves.forEach((curve, n) => {
    const good = (v) => v !== null && (!panel.log || v > 0);
    if (curve.band) {
      const [low, high] = curve.band.map((end) => curve.x.map((v, i) => [v, end[i]]));
      const outline = [...low, ...high.reverse()].filter((p) => good(p[1]));
      const points = outline.map((p) => px(p[0]) + "," + py(p[1])).join(" ");
      svg.append(make("polygon", {points, fill: curve.colour, opacity: 0.2}));
    }
    let path = "", drawing = false;
    curve.x.forEach((v, i) => {
      if (good(curve.y[i])) path += (drawing ? "L" : "M") + px(v).toFixed(1) + " " + py(curve.y[i]).toFixed(1);
      drawing = good(curve.y[i]);
    });
    const dash = curve.dashed ? "4 3" : "none";
    svg.append(make("path", {d: path, fill: "none", stroke: curve.colour, "stroke-dasharray": dash}));
    if (curve.label) svg.append(make("text", {x: W - R - 4, y: T + 10 + 11 * n, "text-anchor": "end",
                                              style: "fill:" + curve.colour}, curve.label));
  });
  if (panel.x === "step") {
    const cursor = make("line", {y1: T, y2: H - B, stroke: "#555", class: "cursor"});
    cursor.place = (step) => { cursor.setAttribute("x1", px(step)); cursor.setAttribute("x2", px(step)); };
    svg.append(cursor);
  }
  return svg;
}
function show(picture) {
  const figure = document.createElement("figure"), image = new Image(), words = document.createElement("figcaption");
  image.src = "data:image/png;base64," + picture.png;
  words.textContent = image.alt = picture.title;
  figure.append(image, words);
  return figure;
}
const slider = document.getElementById("slider"), curves = document.getElementById("curves");
const part = (name) => document.getElementById(name);
curves.append(...data.panels.map(draw));
function go(n) {
  const moment = data.moments[n];
  part("step").textContent = "step " + moment.step;
  part("pictures").replaceChildren(...[...data.fixed, ...moment.pictures].map(show));
  part("pixels").replaceChildren(...moment.panels.map(draw));
  for (const cursor of document.querySelectorAll(".cursor")) if (cursor.place) cursor.place(moment.step);
}
slider.max = data.moments.length - 1;
slider.addEventListener("input", () => go(Number(slider.value)));
let timer = null;
part("play").addEventListener("click", () => {
  clearInterval(timer);
  if (Number(slider.value) === Number(slider.max)) slider.value = 0;
  timer = setInterval(() => {
    if (Number(slider.value) >= Number(slider.max)) { clearInterval(timer); return; }
    slider.value = Number(slider.value) + 1;
    go(Number(slider.value));
  }, 150);
});
if (data.moments.length) { slider.value = slider.max; go(data.moments.length - 1); } else part("bar").hidden = true;
</script></body></html>
"""
