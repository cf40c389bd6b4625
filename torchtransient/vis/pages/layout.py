"""Figures and controls of a page, as models of bokeh, and its HTML; `view.js` drives the models by their names."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.vis.colour_maps import oklch
from torchtransient.vis.colour_maps import rainbow as rainbow_colours
from torchtransient.vis.files import needed
from torchtransient.vis.pages.content import Content

_SCRIPT = Path(__file__).with_name("view.js")
# Okabe and Ito's colours, which are told apart without red, green or blue cones; lines have dashes of their own too.
PIXEL_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
_DASHES = ("solid", "dashed", "dotted", "dashdot")
# Longer side of the picture, alone and over panels: a window on a screen of 800 rows has some 680 for the page.
_PICTURE, _PICTURE_OVER_PANELS = 440, 330
# Gates that have their start and end along the axis; more would cover each other.
_GATE_TICKS = 6
_OWN = "<div class='own'></div>"
_MODES = {
    "colour": "colour", "light": "intensity", "peak": "peak time", "rainbow": "rainbow",
    "dop": "degree of polarization",
    "aolp": "angle of linear polarization", "real": "real part", "phase": "phase", "speed": "speed of approach",
}  # fmt: skip


def import_bokeh() -> Any:
    """Return the package bokeh. Raises MissingPackageError without it."""
    needed("bokeh.plotting", "bokeh", "view")
    return needed("bokeh", "bokeh", "view")


def modes_of(content: Content) -> dict[str, str]:
    """Return names of the modes of a page by their keys.

    Args:
        content: content of the page.
    """
    first = content.planes[0]
    found = ["colour"] if first.light.shape[0] == 3 else []
    found.append("light")
    found += ["dop", "aolp"] if first.ratios is not None else []
    found += ["real", "phase"] if first.phase is not None else []
    found += ["peak", "rainbow"] if first.phase is None and content.kind != "gates" else []
    found += ["speed"] if content.kind == "rates" else []
    names = {name: _MODES[name] for name in found}
    if first.phase is not None:
        names["light"] = "amplitude"
    if content.kind == "volume":
        names |= {"light": "value", "peak": "depth of the peak"}
    return names


def colour_maps() -> dict[str, list[str]]:
    """Return 256 colours of each map by name, as #rrggbb."""
    import_bokeh()
    from bokeh.palettes import cividis, gray, inferno, viridis

    turns = np.arange(256) / 256
    # Two hues and two lightnesses: a circle that is told apart without red and green cones as well.
    swing = np.cos(2 * np.pi * turns)
    wheel = oklch(0.58 + 0.34 * swing, 0.12 * np.abs(np.sin(2 * np.pi * turns)), np.where(turns < 0.5, 255.0, 60.0))
    sides = np.linspace(-1, 1, 256)
    both = oklch(0.95 - 0.5 * np.abs(sides), 0.14 * np.abs(sides), np.where(sides < 0, 255.0, 50.0))
    drawn = {
        "cyclic": wheel,
        "diverging": both,
        "approach": both[::-1],
        "rainbow": rainbow_colours(np.linspace(0, 1, 256)),
    }
    hexes = {name: [_hex(colour) for colour in colours] for name, colours in drawn.items()}
    return {
        "viridis": list(viridis(256)), "inferno": list(inferno(256)), "cividis": list(cividis(256)),
        "grey": list(gray(256)), **hexes,
    }  # fmt: skip


def _hex(colour: Any) -> str:
    red, green, blue = (round(255 * float(part)) for part in colour)
    return f"#{red:02x}{green:02x}{blue:02x}"


def described(content: Content, tables: dict[str, Any], modes: dict[str, str], maps: dict[str, Any]) -> dict[str, Any]:
    """Return what `view.js` reads about a page, as plain data.

    Args:
        content: content of the page.
        tables: values of codes by the name of the plane.
        modes: names of the modes by key.
        maps: colours by name.
    """
    slider = content.slider
    return {
        "kind": content.kind, "shape": content.shape, "items": len(content.items), "layers": len(content.layers),
        "layerNumbers": content.layer_numbers, "layerGrid": content.layer_grid, "marks": content.marks,
        "channels": content.planes[0].light.shape[0], "extent": content.extent, "stride": content.stride,
        "block": content.block,
        "slider": {
            "name": slider.name, "unit": slider.unit, "centers": slider.centers.tolist(), "second": slider.second,
            "secondUnit": slider.second_unit, "factor": slider.factor, "labels": slider.labels,
        },
        "tables": tables, "maps": maps, "modes": list(modes), "pair": content.items == ("A", "B"),
    }  # fmt: skip


def html_of(root: Any, title: str, meta: dict[str, Any], chunks: Sequence[str] = ()) -> str:
    """Return a page with bokeh, ``view.js`` and its data in it.

    Args:
        root: root of bokeh's models.
        title: title of the window.
        meta: data of :func:`described`.
        chunks: script elements with numbers.
    """
    from bokeh.embed import file_html
    from bokeh.resources import INLINE

    # Browsers ask servers for an icon.
    html = file_html(root, INLINE, title=title).replace("<head>", '<head><link rel="icon" href="data:,">', 1)
    head, end, rest = html.rpartition("</body>")
    said = json.dumps(meta).replace("</", "<\\/")
    data = f'<script type="application/json" id="meta">{said}</script>'
    script = f"<script>\n{_SCRIPT.read_text(encoding='utf-8')}\n</script>"
    return "\n".join([head, data, *chunks, script, end + rest])


def layout_of(
    content: Content, modes: dict[str, str], notes: str, title: str, maps: dict[str, list[str]], sums: bool = True
) -> Any:
    """Return the root of the page's models.

    Args:
        content: content of the page.
        modes: names of the modes by key, the first one shown.
        notes: HTML about errors of the numbers and what was left out.
        title: heading of the page.
        maps: colours by name.
        sums: whether sums over bins are at hand.
    """
    m = import_bokeh().models
    bins = content.shape[0]
    heading = m.Div(text=f"<b>{escape(title)}</b> <span style='color:#555'>{notes}</span>", width=1220, name="notes")
    play = m.Button(label="▶ play", name="play", width=80, button_type="primary")
    slider = m.Slider(
        start=0, end=max(1, bins - 1), value=0, step=1, title=None, show_value=False, name="slider", width=560,
        disabled=bins == 1,
    )  # fmt: skip
    where = m.Div(text=_OWN, name="where", width=380, styles={"font-size": "14px", "padding-top": "6px"})
    top = [play, slider, where]
    controls = [
        m.Select(title="show", name="mode", options=list(modes.items()), value=next(iter(modes)), width=170),
        m.Select(
            title="colour map", name="map", options=["inferno", "viridis", "cividis", "grey"], value="inferno", width=90
        ),
        m.Select(title="brightness", name="curve", options=["linear", "logarithmic"], value="linear", width=105),
        m.Slider(title="exposure (stops)", name="exposure", start=-10, end=20, value=0, step=0.5, width=170),
    ]
    flags = [("accumulate", sums and "peak" in modes and content.kind != "volume"), ("log axis", True)]
    switches = [
        m.Toggle(label=name, name=name.replace(" ", "_"), width=100, margin=(20, 5, 5, 5))
        for name, shown in flags
        if shown
    ]
    picks = []
    if len(content.items) > 1:
        pair = content.items == ("A", "B")
        options = [(str(n), name) for n, name in enumerate(content.items)] + ([("difference", "A − B")] if pair else [])
        picks.append(m.Select(title="result" if pair else "sample", name="item", options=options, value="0", width=110))
    if len(content.layers) > 1:
        options = [(str(n), name) for n, name in enumerate(content.layers)]
        if content.kind == "rates":
            options.insert(0, ("all", "all rates"))
        value = options[len(options) // 2][0] if content.layer_grid else options[0][0]
        picks.append(m.Select(title=content.layer_name, name="layer", options=options, value=value, width=130))
    left = m.Row(children=[_picture(content, maps)])
    beside = _volume_panels(content) if content.kind == "volume" else []
    picks += _volume_tools() if content.kind == "volume" else []
    empty: dict[str, Any] = {"x": [], "y": [], "low": [], "high": []}
    curves = [m.ColumnDataSource(data=dict(empty), name=f"curve_{n}") for n in range(len(PIXEL_COLOURS))]
    right = [m.Row(children=controls), m.Row(children=[*switches, *picks])]
    right += [
        _histogram(content, curves, False),
        _histogram(content, curves, True),
        m.Div(text=_OWN, name="readout", width=650),
    ]
    if content.layer_grid:
        beside.append(_laser_grid(content))
    if content.kind == "rates":
        beside.append(_rate_map(content, maps))
    under = [m.Row(children=beside)] if beside else []
    return m.Column(
        children=[
            heading,
            m.Row(children=top),
            m.Row(children=[m.Column(children=[left, *under]), m.Column(children=right)]),
        ],
        name="root",
    )


def _image(figure: Any, name: str, extent: tuple[float, float, float, float], rows: int, columns: int) -> None:
    m = import_bokeh().models
    left, right, low, high = extent
    source = m.ColumnDataSource(
        data={"image": [np.zeros((rows, columns), np.uint32)], "x": [left], "y": [min(low, high)], "dw": [right - left],
              "dh": [abs(high - low)]},
        name=name,
    )  # fmt: skip
    figure.image_rgba("image", x="x", y="y", dw="dw", dh="dh", source=source)


def _event(what: str) -> Any:
    return import_bokeh().models.CustomJS(code=f"window.torchtransient.{what}")


def _picture(content: Content, maps: dict[str, list[str]]) -> Any:
    bokeh = import_bokeh()
    m = bokeh.models
    _, rows, columns = content.shape
    # Pictures have their first row at the top, walls and volumes at the bottom.
    extent = (
        (0.0, float(columns * content.stride), 0.0, float(rows * content.stride))
        if content.extent is None
        else content.extent
    )
    left, right, low, high = extent
    beside = content.kind in ("volume", "rates") or content.layer_grid
    scale = (_PICTURE_OVER_PANELS if beside else _PICTURE) / max(right - left, high - low)
    width, height = max(120, round((right - left) * scale)), max(90, round((high - low) * scale))
    ranges = (high, low) if content.extent is None else (low, high)
    figure = bokeh.plotting.figure(
        frame_width=width, frame_height=height, x_range=m.Range1d(left, right), y_range=m.Range1d(*ranges),
        tools="pan,wheel_zoom,box_zoom,reset,save", active_drag=None, active_scroll=None, name="picture",
        x_axis_label="column" if content.unit == "pixels" else f"x ({content.unit})",
        y_axis_label="row" if content.unit == "pixels" else f"y ({content.unit})", background_fill_color="#888888",
    )  # fmt: skip
    figure.grid.visible = False
    _image(figure, "image", extent, rows, columns)
    if content.marks:
        spots = m.ColumnDataSource(
            data={"x": [p[0] for p in content.marks[:1]], "y": [p[1] for p in content.marks[:1]]}, name="laser"
        )
        figure.scatter("x", "y", source=spots, marker="star", size=14, fill_color="white", line_color="black")
    pixels = m.ColumnDataSource(data={"x": [], "y": [], "colour": []}, name="pixels")
    figure.scatter("x", "y", source=pixels, marker="circle", size=12, fill_alpha=0, line_color="white", line_width=4)
    figure.scatter("x", "y", source=pixels, marker="circle", size=12, fill_alpha=0, line_color="colour", line_width=2.5)
    for name, mapper in (("linear", m.LinearColorMapper), ("log", m.LogColorMapper)):
        bar = m.ColorBar(
            color_mapper=mapper(palette=maps["inferno"], low=1e-3, high=1.0, name=f"bar_{name}"), width=12, padding=4,
            name=f"colorbar_{name}", visible=name == "linear",
        )  # fmt: skip
        figure.add_layout(bar, "right")
    figure.js_on_event("tap", _event("tap(cb_obj.x, cb_obj.y)"))
    for name in ("panstart", "pan", "panend"):
        figure.js_on_event(name, _event(f"drag('{name}', cb_obj.x, cb_obj.y)"))
    return figure


def _histogram(content: Content, curves: list[Any], log: bool) -> Any:
    bokeh = import_bokeh()
    m = bokeh.models
    slider = content.slider
    name = slider.name + (f" ({slider.unit})" if slider.unit else "")
    figure = bokeh.plotting.figure(
        width=665, height=300, tools="xpan,xwheel_zoom,box_zoom,reset,save", active_drag=None, active_scroll=None,
        x_axis_label=name, y_axis_label=content.quantity, y_axis_type="log" if log else "linear",
        name="histogram_log" if log else "histogram", visible=not log,
    )  # fmt: skip
    centers = slider.centers
    step = float(np.abs(np.diff(centers)).min()) if len(centers) > 1 else 1.0
    figure.x_range = m.Range1d(float(centers.min()) - step / 2, float(centers.max()) + step / 2)
    figure.y_range = m.Range1d(0 if not log else 1e-6, 1)
    if slider.labels:
        figure.xaxis.ticker = list(range(0, len(centers), -(-len(centers) // _GATE_TICKS)))
        figure.xaxis.major_label_overrides = dict(enumerate(slider.labels))
    if slider.second:
        figure.extra_x_ranges = {
            "second": m.Range1d(figure.x_range.start * slider.factor, figure.x_range.end * slider.factor)
        }
        figure.add_layout(
            m.LinearAxis(x_range_name="second", axis_label=f"{slider.second} ({slider.second_unit})"), "above"
        )
        for end in ("start", "end"):
            link = m.CustomJS(
                args={"second": figure.extra_x_ranges["second"]},
                code=f"second.{end} = cb_obj.{end} * {slider.factor!r}",
            )
            figure.x_range.js_on_change(end, link)
    for source, colour, dash in zip(curves, PIXEL_COLOURS, _DASHES, strict=True):
        figure.varea("x", "low", "high", source=source, fill_color=colour, fill_alpha=0.25)
        if content.planes[0].phase is None:
            figure.step("x", "y", source=source, mode="center", line_color=colour, line_dash=dash, line_width=1.8)
        else:  # phasors are known at frequencies, not in bins
            figure.line("x", "y", source=source, line_color=colour, line_dash=dash, line_width=1.2)
            figure.scatter("x", "y", source=source, marker="circle", size=7, color=colour)
    figure.add_layout(
        m.Span(dimension="height", location=0.0, line_color="black", line_width=1.5, name=f"cursor_{int(log)}")
    )
    figure.js_on_event("tap", _event("scrub(cb_obj.x)"))
    return figure


def _volume_panels(content: Content) -> list[Any]:
    """Slices through the selected voxel from above and from the side, and a turning projection."""
    depths, rows, columns = content.shape
    assert content.extent is not None  # grids of voxels have one
    left, right, low, high = content.extent
    centers = content.slider.centers
    near, far = float(centers[0]), float(centers[-1]) if depths > 1 else float(centers[0]) + 1.0
    top = _panel("from above", (left, right, near, far), "x (m)", "depth (m)")
    _image(top, "slice_above", (left, right, near, far), depths, columns)
    side = _panel("from the side", (near, far, low, high), "depth (m)", "y (m)")
    _image(side, "slice_side", (near, far, low, high), rows, depths)
    turning = _panel("highest value, turning", (0, 160, 0, 160), "", "")
    turning.axis.visible = False
    _image(turning, "turning", (0, 160, 0, 160), 160, 160)
    return [top, side, turning]


def _volume_tools() -> list[Any]:
    m = import_bokeh().models
    return [
        m.Slider(title="turned by (degrees)", name="turn", start=0, end=355, value=30, step=5, width=150),
        m.Toggle(label="turn", name="turns", width=60, margin=(20, 5, 5, 5)),
        m.Slider(
            title="threshold (of the highest)", name="threshold", start=0, end=0.95, value=0.1, step=0.05, width=160
        ),
    ]


def _laser_grid(content: Content) -> Any:
    """The laser spots of an exhaustive scan; a click chooses one."""
    rows, columns = content.layer_grid  # type: ignore[misc]  # of contents that have one
    figure = _panel("laser spot: click", (-0.5, columns - 0.5, -0.5, rows - 0.5), "column", "row", 240)
    figure.name = "spots"
    m = import_bokeh().models
    spots = [(n % columns, n // columns) for n in range(rows * columns)]
    every = m.ColumnDataSource(data={"x": [x for x, _ in spots], "y": [y for _, y in spots]})
    figure.scatter("x", "y", source=every, size=8, fill_color="#bbbbbb", line_color="#555555")
    chosen = m.ColumnDataSource(data={"x": [], "y": []}, name="spot")
    figure.scatter("x", "y", source=chosen, size=16, marker="star", fill_color="#D55E00", line_color="black")
    figure.js_on_event("tap", _event("spot(cb_obj.x, cb_obj.y)"))
    return figure


def _rate_map(content: Content, maps: dict[str, list[str]]) -> Any:
    """Light of the selected pixel over rates and lengths."""
    bins = content.shape[0]
    rates, centers = content.layer_numbers, content.slider.centers
    step = rates[1] - rates[0] if len(rates) > 1 else 1.0
    width = float(centers[1] - centers[0]) if bins > 1 else 1.0
    extent = (rates[0] - step / 2, rates[-1] + step / 2, float(centers[0]) - width / 2, float(centers[-1]) + width / 2)
    name = content.slider.name + (f" ({content.slider.unit})" if content.slider.unit else "")
    figure = _panel("rates of the selected pixel", extent, "rate (m/s)", name, 320)
    _image(figure, "rate_map", extent, bins, len(rates))
    return figure


def _panel(title: str, extent: tuple[float, float, float, float], across: str, up: str, width: int = 182) -> Any:
    bokeh = import_bokeh()
    m = bokeh.models
    figure = bokeh.plotting.figure(
        title=title, width=width, height=200, x_range=m.Range1d(*extent[:2]), y_range=m.Range1d(*extent[2:]),
        x_axis_label=across, y_axis_label=up, toolbar_location=None, tools="", background_fill_color="#888888",
    )  # fmt: skip
    figure.grid.visible = False
    figure.axis.ticker = m.BasicTicker(desired_num_ticks=4, num_minor_ticks=0)
    return figure
