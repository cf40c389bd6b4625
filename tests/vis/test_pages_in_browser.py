"""Pages of `tt.vis.view` in Chromium: what they show is what the results hold, by mouse and by keyboard."""

from __future__ import annotations

import math
import re
import threading
from contextlib import contextmanager

import h5py
import numpy as np
import pytest
import torch

import torchtransient as tt
from support import view_cases as cases
from support.browser import SCREEN, Shown, chromium
from torchtransient.files import write_result
from torchtransient.vis.pages.server import serving

pytestmark = pytest.mark.browser
# Numbers are printed with four digits.
PRINTED = 6e-4


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture
def show(browser, tmp_path):
    """Open the page of something in a window without a network."""
    opened = []

    def open_page(x, **settings):
        path = tmp_path / f"page{len(opened)}.html"
        tt.vis.view(x, path, **settings)
        context = browser.new_context(viewport=SCREEN, offline=True)
        opened.append(context)
        shown = Shown(context.new_page()).open(path.as_uri())
        assert all(url.startswith(("file:", "data:", "blob:")) for url in shown.asked)
        return shown

    yield open_page
    for context in opened:
        context.close()


def pick(shown, row, column, extent=None, size=None):
    """Click a pixel of the picture, and return its place among the rows of the table."""
    if extent is None:
        x, y = column + 0.5, row + 0.5
    else:
        left, right, low, high = extent
        x = left + (column + 0.5) / size[1] * (right - left)
        y = low + (row + 0.5) / size[0] * (high - low)
    name = f"row {row}, column {column}"
    if not any(found[0].endswith(name) for found in shown.rows()):
        shown.click("picture", x, y)
    names = [found[0] for found in shown.rows()]
    return next(n for n, found in enumerate(names) if found.endswith(name))


def near(shown, value, expected):
    assert value == pytest.approx(expected, rel=shown.stated_error + PRINTED, abs=shown.stated_floor)


def brightest(light, number=0):
    """(t, row, column) of one of the brightest entries of (T, H, W)."""
    flat = int(light.flatten().argsort(descending=True)[number])
    return tuple(int(n) for n in np.unravel_index(flat, tuple(light.shape)))


# ------------------------------------------------------------------------------------------------ numbers, by kind

PLAIN = {
    "colour": lambda: (cases.front(3), {"axis": cases.AXIS}),
    "grey": lambda: (cases.front(1), {"axis": cases.AXIS}),
    "without an axis": lambda: (cases.front(1), {}),
    "counts": lambda: (cases.counts(), {"axis": cases.AXIS}),
    "many counts": lambda: (cases.counts(20_000), {"axis": cases.AXIS}),
    "many channels": lambda: (cases.front(5), {"axis": cases.AXIS}),
    "gates": lambda: (cases.result(gated=cases.front(3)[:, :6]), {}),
}


@pytest.mark.parametrize("name", PLAIN)
def test_light(show, name):
    x, settings = PLAIN[name]()
    cube = (x if isinstance(x, torch.Tensor) else x.gated).mean(0)
    shown = show(x, **settings)
    for number in (0, 17, 160):
        t, row, column = brightest(cube, number)
        place = pick(shown, row, column)
        shown.go(t)
        found = shown.rows()[place]
        near(shown, found[1], float(cube[t, row, column]))
        near(shown, found[3], float(cube[:, row, column].sum()))
    assert ("counts" in name) == (shown.stated_error == 0)


def test_times_peaks_and_accumulated_light(show):
    cube = cases.front(3)
    light = cube.mean(0)
    shown = show(cube, axis=cases.AXIS)
    t, row, column = brightest(light, 5)
    place = pick(shown, row, column)
    peak = float(cases.AXIS.centers_opl[light[:, row, column].argmax()])
    assert shown.rows()[place][4] == pytest.approx(peak, rel=PRINTED)
    shown.go(t)
    said = shown.page.locator("text=/optical path length [0-9]/").inner_text()
    metres, nanoseconds = float(cases.AXIS.centers_opl[t]), float(cases.AXIS.centers_s[t]) * 1e9
    assert f"{metres:.4g}"[:4] in said
    assert float(said.split("=")[1].split()[0]) == pytest.approx(nanoseconds, rel=PRINTED)
    shown.toggle("accumulate")
    for t in (20, 7, 8):
        shown.go(t)
        near(shown, shown.rows()[place][1], float(light[: t + 1, row, column].sum()))
    shown.select("show", "peak time")
    assert shown.rows()[place][1] == pytest.approx(peak, rel=PRINTED)


def test_error_bands(show, tmp_path):
    scene = tt.load(tt.scenes.cornell_box(resolution=12, num_bins=40, start_opl=3.5, bin_width_opl=0.15))
    out = tt.render(scene, spp=16, seed=0, errors=True)
    shown = show(out)
    t, row, column = brightest(out.transient.mean(0), 30)
    place = pick(shown, row, column)
    shown.go(t)
    _, value, error, _, _ = shown.rows()[place]
    near(shown, value, float(out.transient.mean(0)[t, row, column]))
    near(shown, error, float(out.error_map()[t, row, column]))
    assert shown.page.get_by_text("± one standard error").count() == 1
    low, high = shown.page.evaluate(
        "(n) => { const data = Bokeh.documents[0].get_model_by_name(`curve_${n}`).data;"
        " return [data.low, data.high].map((v) => Array.from(v)); }",
        place,
    )
    assert (high[t] - low[t]) / 4 == pytest.approx(error, rel=PRINTED)
    again = show(write_result(tmp_path / "box.npz", out))
    place = pick(again, row, column)
    again.go(t)
    assert again.rows()[place][1:3] == pytest.approx((value, error))


def test_polarization(show):
    """Light of the left half has no linear part, and no angle."""
    cube = cases.stokes()
    cube[1:3, :, :, :, :7] = 0
    shown = show(cube, axis=cases.AXIS)
    s0, s1, s2, s3 = cube[:, 0]
    t, row, column = brightest(s0[..., 7:], 9)
    column += 7
    place = pick(shown, row, column)
    shown.go(t)
    at = (t, row, column)
    near(shown, shown.rows()[place][1], float(s0[at]))
    shown.select("show", "degree of polarization")
    degree = float((s1[at] ** 2 + s2[at] ** 2 + s3[at] ** 2).sqrt() / s0[at])
    assert shown.rows()[place][1] == pytest.approx(degree, abs=0.004 * math.sqrt(3) + 1e-3)
    shown.select("show", "angle of linear polarization")
    angle = 0.5 * math.degrees(math.atan2(float(s2[at]), float(s1[at])))
    off = (shown.rows()[place][1] - angle + 90) % 180 - 90
    linear = float((s1[at] ** 2 + s2[at] ** 2).sqrt() / s0[at])
    assert abs(off) < 0.5 * math.degrees(0.004 * math.sqrt(2) / linear) + 0.05
    t, row, column = brightest(s0[..., :7])
    place = pick(shown, row, column)
    shown.go(t)
    assert math.isnan(shown.rows()[place][1])
    grey = np.all(np.array(shown.picture()) == 0x88, axis=-1).reshape(cases.H, cases.W)
    assert grey[:, :7].all() and not grey[:, 7:].any()


def test_phasors(show):
    cube, frequencies = cases.phasors()
    shown = show(cube, frequencies=frequencies)
    place = pick(shown, 4, 6)
    for f in (0, 3):
        shown.go(f)
        value = complex(cube[0, f, 4, 6])
        shown.select("show", "amplitude")
        near(shown, shown.rows()[place][1], abs(value))
        shown.select("show", "phase")
        off = (shown.rows()[place][1] - math.degrees(np.angle(value)) + 180) % 360 - 180
        assert abs(off) < 0.72
        shown.select("show", "real part")
        # Phases are within 0.71 degrees.
        assert shown.rows()[place][1] == pytest.approx(value.real, abs=(0.0125 + shown.stated_error) * abs(value))


def curve_of(shown, place):
    """The curve of a pixel as it is drawn."""
    return shown.page.evaluate(
        "(n) => Array.from(Bokeh.documents[0].get_model_by_name(`curve_${n}`).data.y)", place
    )


def test_slow_phasors(show):
    x = cases.slow_phasors()
    shown = show(x)
    place = pick(shown, 4, 9)
    shown.select("frequency", "1.5 /m")
    shown.go(5)
    value = complex(x.slow_phasor[0, 5, 1, 4, 9])
    near(shown, shown.rows()[place][1], abs(value))
    assert "slow time 0.005" in shown.page.locator("text=/slow time [0-9]/").first.inner_text()
    shown.select("show", "phase")
    found, wanted = np.radians(curve_of(shown, place)), np.angle(x.slow_phasor[0, :, 1, 4, 9].numpy())
    assert np.abs(np.angle(np.exp(1j * (found - wanted)))).max() < math.radians(0.72)


def test_rates(show):
    cube, rate_axis = cases.rates()
    shown = show(cases.result(rates=cube, rate_axis=rate_axis))
    light = cube[0]
    t, row, column = brightest(light.sum(0), 3)
    place = pick(shown, row, column)
    shown.go(t)
    near(shown, shown.rows()[place][1], float(light[:, t, row, column].sum()))
    for rate in (2, 6):
        shown.select("rate", f"{float(rate_axis.centers[rate]):.4g} m/s")
        near(shown, shown.rows()[place][1], float(light[rate, t, row, column]))
    shown.select("show", "speed of approach")
    spectrum = light.sum(1)[:, row, column].double()
    speed = -float((spectrum * rate_axis.centers).sum() / spectrum.sum()) / 2
    # Each rate's light is within the stated error; speeds differ by as much of the span of rates at most.
    assert shown.rows()[place][1] == pytest.approx(speed, abs=shown.stated_error * 18 + 1e-3)


def test_beats(show):
    cube = torch.stack([cases.front(1), cases.front(1, seed=3).flip(1)], 1)
    shown = show(cases.result(beats=cube))
    place = pick(shown, 3, 5)
    for chirp in (0, 1):
        shown.select("chirp", ("up chirp", "down chirp")[chirp])
        t = int(cube[0, chirp, :, 3, 5].argmax())
        shown.go(t)
        near(shown, shown.rows()[place][1], float(cube[0, chirp, t, 3, 5]))


WALL = (-1.0, 1.0, -1.0, 1.0)


@pytest.mark.parametrize("kind", ["confocal", "single"])
def test_captures(show, kind):
    capture = cases.capture(kind)
    shown = show(capture)
    for t, row, column in ((3, 5, 7), (11, 0, 2)):
        place = pick(shown, row, column, WALL, (6, 8))
        shown.go(t)
        near(shown, shown.rows()[place][1], float(capture.transient[0, t, row, column]))
    if kind == "single":
        spot = capture.scan.laser_points
        x, y = (shown.page.evaluate(f"Bokeh.documents[0].get_model_by_name('laser').data.{axis}[0]") for axis in "xy")
        assert sorted(map(abs, (x, y))) == pytest.approx(sorted(map(abs, spot[:2].tolist())), abs=1e-6)


def test_exhaustive_captures(show):
    capture = cases.capture("exhaustive")
    shown = show(capture)
    place = pick(shown, 2, 3, WALL, (6, 8))
    shown.go(5)
    for row, column in ((0, 3), (2, 1)):
        shown.click("spots", column, row)
        near(shown, shown.rows()[place][1], float(capture.transient[0, 5, row, column, 2, 3]))


def test_volumes(show):
    volume = cases.volume()
    shown = show(volume)
    light = volume.picture()
    z, row, column = brightest(light)
    opened_at = shown.page.evaluate("torchtransient.state.t")
    place = pick(shown, row, column, (-0.7, 0.7, -0.5, 0.5), (10, 14))
    shown.go(z)
    near(shown, shown.rows()[place][1], float(light[z, row, column]))
    assert opened_at == z
    assert shown.rows()[place][4] == pytest.approx(float(volume.grid.depths[z]), rel=PRINTED)
    # The slices pass through the voxel: the brightest colour of both stands at its place.
    above, side = (np.array(shown.picture(name), float).sum(-1) for name in ("slice_above", "slice_side"))
    assert above.reshape(12, 14)[z, column] == above.max()
    assert side.reshape(10, 12)[row, z] == side.max()
    before = shown.picture("turning")
    shown.page.evaluate("Bokeh.documents[0].get_model_by_name('turn').value = 120")
    shown.settle()
    turned = shown.picture("turning")
    assert turned != before
    shown.page.evaluate("Bokeh.documents[0].get_model_by_name('threshold').value = 0.9")
    shown.settle()
    lit = [sum(sum(colour) > 60 for colour in picture) for picture in (turned, shown.picture("turning"))]
    assert lit[1] < lit[0] / 4


def test_samples_of_a_data_set(show):
    samples = [{"transient": cases.front(1, seed=n)} for n in range(3)]
    shown = show(samples, axis=cases.AXIS)
    place = pick(shown, 5, 4)
    shown.go(9)
    for n in (2, 0):
        shown.select("sample", f"sample {n}")
        near(shown, shown.rows()[place][1], float(samples[n]["transient"][0, 9, 5, 4]))


def test_two_results(show):
    a, b = cases.front(3), cases.front(3, seed=8, speed=14.0)
    shown = show((a, b), axis=cases.AXIS)
    mean_a, mean_b = a.mean(0), b.mean(0)
    t, row, column = brightest(mean_a, 40)
    pick(shown, row, column)
    shown.go(t)
    found = {name: value for name, value, *_ in shown.rows() if name.endswith(f"row {row}, column {column}")}
    near(shown, found[f"A row {row}, column {column}"], float(mean_a[t, row, column]))
    near(shown, found[f"B row {row}, column {column}"], float(mean_b[t, row, column]))
    shown.select("result", "A − B")
    values = {name: value for name, value, *_ in shown.rows()}
    at = (t, row, column)
    stated = float(re.search(r"A − B is within ([\d.]+) % of \|A\| \+ \|B\|", shown.notes).group(1)) / 100
    spare = (stated + PRINTED) * float(mean_a[at] + mean_b[at])
    assert values[f"A − B row {row}, column {column}"] == pytest.approx(float(mean_a[at] - mean_b[at]), abs=spare)


# ------------------------------------------------------------------------------------------------------ pictures


def test_colours_of_the_picture(show):
    cube = cases.front(3)
    shown = show(cube, axis=cases.AXIS)
    t = brightest(cube.mean(0))[0]
    shown.go(t)
    linear = cube[:, t].flatten(1)
    seen = np.array(shown.picture(), float)
    # White is the same for all pixels: what is below it has the shares of the numbers, by the curve of sRGB.
    level = np.where(seen / 255 <= 0.04045, seen / 255 / 12.92, ((seen / 255 + 0.055) / 1.055) ** 2.4)
    inside = ((seen > 40) & (seen < 255)).all(-1)
    assert inside.sum() > 5
    ratio = level[inside] / linear.T.numpy()[inside]
    assert ratio.max() / ratio.min() < 1.12
    before = shown.picture()
    changes = (("brightness", "logarithmic"), ("show", "rainbow"), ("show", "intensity"), ("colour map", "viridis"))
    for label, value in changes:
        shown.select(label, value)
        after = shown.picture()
        assert after != before
        before = after


def test_what_is_not_finite_is_magenta_and_has_no_peak(show):
    cube = cases.front(1)
    cube[0, :, 2, 3] = math.nan
    cube[0, 9, 5, 6] = math.inf
    shown = show(cube, axis=cases.AXIS)
    shown.press("Home")
    assert shown.picture()[2 * cases.W + 3] == [255, 0, 255]
    assert shown.picture().count([255, 0, 255]) == 1
    assert "in 2 of 140 pixels" in shown.notes
    place, once, other = pick(shown, 2, 3), pick(shown, 5, 6), pick(shown, 7, 9)
    assert math.isnan(shown.rows()[place][4]) and math.isnan(shown.rows()[once][4])
    assert not math.isnan(shown.rows()[other][4])
    shown.select("show", "peak time")
    assert math.isnan(shown.rows()[once][1])


def test_gates_are_named_by_start_and_end(show):
    gates = tuple(tt.Gate.rectangular(5.0 + n, 6.25 + n) for n in range(3))
    cube = cases.front(1)[:, 6:9]
    shown = show(cases.result(gated=cube, gates=gates))
    shown.go(1)
    assert shown.page.get_by_text("of 0 to 2: gate 6 to 7.25 m").count() == 1
    place = pick(shown, 4, 5)
    start = 5.0 + int(cube[0, :, 4, 5].argmax())
    assert shown.page.locator("td.at").nth(place).inner_text() == f"{start:.4g} to {start + 1.25:.4g} m"


# ------------------------------------------------------------------------------------------------------ controls


def test_keyboard_and_mouse(show):
    shown = show(cases.front(1), axis=cases.AXIS)

    def at():
        return shown.page.evaluate("torchtransient.state.t")

    shown.press("Home")
    assert at() == 0
    shown.press("ArrowRight", "ArrowRight", "ArrowLeft", "Shift+ArrowRight")
    assert at() == 11
    shown.press("End")
    assert at() == cases.AXIS.num_bins - 1
    shown.press("Home")
    shown.page.keyboard.press("Space")
    shown.page.wait_for_function("torchtransient.state.t >= 3")
    shown.page.keyboard.press("Space")
    shown.settle()
    held = at()
    shown.page.wait_for_timeout(200)
    assert at() == held
    # A click into the histogram goes there.
    middle = shown.page.evaluate("Bokeh.documents[0].get_model_by_name('histogram').y_range.end") / 2
    shown.click("histogram", float(cases.AXIS.centers_opl[9]), middle)
    assert at() == 9

    def visible(name):
        return shown.page.evaluate(f"Bokeh.documents[0].get_model_by_name('{name}').visible")

    assert visible("histogram") and not visible("histogram_log")
    shown.toggle("log axis")
    assert visible("histogram_log") and not visible("histogram")


def test_pixels_by_mouse(show):
    cube = cases.front(1)
    shown = show(cube, axis=cases.AXIS)
    pick(shown, 2, 3)
    pick(shown, 7, 9)
    names = [name for name, *_ in shown.rows()]
    shown.drag("picture", (9.5, 7.5), (11.5, 8.5))
    moved = [name for name, *_ in shown.rows()]
    assert [name.replace("row 7, column 9", "row 8, column 11") for name in names] == moved
    shown.go(12)
    near(shown, shown.rows()[-1][1], float(cube[0, 12, 8, 11]))
    shown.click("picture", 11.5, 8.5)
    assert [name for name, *_ in shown.rows()] == moved[:-1]


def test_a_page_fits_the_screen(show):
    """A window on a screen of 1280 x 800 has some 680 rows for the page."""
    spare = 120
    rates, rate_axis = cases.rates()
    for x in (
        cases.front(3, 12, 12), cases.volume(rows=14), cases.capture("exhaustive", size=(8, 8)),
        cases.result(rates=rates[..., : cases.H], rate_axis=rate_axis), cases.slow_phasors(),
        1e-12 * cases.noise(1, 9, 12, 12),
    ):  # fmt: skip
        shown = show(x)
        shown.page.set_viewport_size({"width": SCREEN["width"], "height": SCREEN["height"] - spare})
        size = shown.page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
        assert size[0] <= SCREEN["width"]
        assert size[1] <= SCREEN["height"] - spare


def test_a_page_that_was_binned(show):
    cube = cases.noise(1, 128, 160, 160, seed=2)
    page = tt.vis.view(cube, max_megabytes=2.8)
    assert len(page.html) <= 2.8e6
    shown = show(cube, max_megabytes=2.8)
    times = int(next(note for note in page.notes if "adds up" in note).split("adds up ")[1].split()[0])
    pixels = [int(note.split("averages ")[1].split()[0]) for note in page.notes if "averages" in note]
    side = pixels[0] if pixels else 1
    sums = cube[0].unflatten(0, (-1, times)).sum(1)
    mean = torch.nn.functional.avg_pool2d(sums, side)
    assert side > 1
    shown.click("picture", (13 + 0.5) * side, (11 + 0.5) * side)
    names = [name for name, *_ in shown.rows()]
    ends = [f"{first * side}-{(first + 1) * side - 1}" for first in (11, 13)]
    place = names.index(f"rows {ends[0]}, columns {ends[1]}")
    shown.go(4)
    near(shown, shown.rows()[place][1], float(mean[4, 11, 13]))
    assert times > 1
    assert shown.page.get_by_text(f"of 0 to {128 // times - 1}: bin {4 * times + (times - 1) / 2:g}").count() == 1


# -------------------------------------------------------------------------------------------------------- server


@contextmanager
def served(browser, path):
    """The page of a file that is read as it is looked at, and its address."""
    with serving(path, path.name) as (server, address):
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield Shown(browser.new_page(viewport=SCREEN)).open(address), address
        finally:
            server.shutdown()
            thread.join()


def written(path, axis=cases.AXIS, **arrays):
    with h5py.File(path, "w") as file:
        for name, x in arrays.items():
            file[name] = x.numpy()
        file.attrs.update(start_opl=axis.start_opl, bin_width_opl=axis.bin_width_opl, num_bins=axis.num_bins)
    return path


def test_the_server_of_large_results(browser, tmp_path):
    cube = cases.front(3, 30, 40)
    with served(browser, written(tmp_path / "large.h5", transient=cube)) as (shown, address):
        light = cube.mean(0)
        t, row, column = brightest(light, 70)
        place = pick(shown, row, column)
        shown.go(t)
        near(shown, shown.rows()[place][1], float(light[t, row, column]))
        assert shown.stated_error == 0.002
        peak = float(cases.AXIS.centers_opl[light[:, row, column].argmax()])
        before = shown.picture()
        for mode in ("peak time", "rainbow"):
            shown.select("show", mode)
            assert shown.rows()[place][1] == pytest.approx(peak, rel=PRINTED)
            assert shown.picture() != before
            before = shown.picture()
        refused = shown.page.request.get(address.replace(address.split("/")[3], "a" * 22))
        assert refused.status == 403
        for missing in ("frame/0/c0/99", "frame/0/s1/0", "curve/0/c0/3"):
            assert shown.page.request.get(address + missing).status == 404


def test_the_server_of_polarized_light_and_of_phasors(browser, tmp_path):
    cube = cases.stokes()
    with served(browser, written(tmp_path / "stokes.h5", transient=cube)) as (shown, _):
        s0, s1, s2, s3 = (part[7, 4, 5] for part in cube[:, 0])
        place = pick(shown, 4, 5)
        shown.go(7)
        near(shown, shown.rows()[place][1], float(s0))
        shown.select("show", "degree of polarization")
        assert shown.rows()[place][1] == pytest.approx(float((s1**2 + s2**2 + s3**2).sqrt() / s0), rel=0.005)
        shown.select("show", "angle of linear polarization")
        angle = 0.5 * math.degrees(math.atan2(float(s2), float(s1)))
        assert abs((shown.rows()[place][1] - angle + 90) % 180 - 90) < 0.3
    cube, frequencies = cases.phasors()
    path = written(tmp_path / "phasors.h5", phasor=cube, frequencies_per_metre=frequencies.per_metre)
    with served(browser, path) as (shown, _):
        place = pick(shown, 4, 6)
        shown.go(3)
        value = complex(cube[0, 3, 4, 6])
        near(shown, shown.rows()[place][1], abs(value))
        assert shown.page.get_by_text(f"frequency {frequencies.frequencies[3]:.4g}").count() >= 1
        shown.select("show", "phase")
        assert abs((shown.rows()[place][1] - math.degrees(np.angle(value)) + 180) % 360 - 180) < 0.8
