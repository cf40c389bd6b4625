"""Pages of `tt.vis.view` without a browser: codes, sizes, files, and what is refused."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support import view_cases as cases
from support.sweeps import together
from torchtransient.errors import ArgumentError, MissingPackageError, ShapeError, StorageError, UnitError
from torchtransient.vis.pages.codes import NOT_FINITE, PHASE, RATIO, table_of
from torchtransient.vis.pages.layout import PIXEL_COLOURS, colour_maps

# ---------------------------------------------------------------------------------------------------------- codes


def decoded(table, x):
    return torch.from_numpy(table.values[table.encode(x)])


def test_light_is_within_its_error():
    """At any scale; finer where it has few decades; numbers of both signs."""
    for scale in (1e-30, 1.0, 1e30):
        x = scale * torch.logspace(-9, 0, 4001)
        table = table_of("light", [x])
        found = decoded(table, x)
        kept = x >= table.floor * (1 + 1e-3)
        assert float((found[kept] / x[kept] - 1).abs().max()) <= table.error
        assert bool((found[x < table.floor * (1 - 2e-3)] == 0).all())
        # Six powers of ten in 253 steps.
        assert table.error == pytest.approx(10 ** (3 / 253) - 1, rel=0.05)
    both = torch.cat([torch.logspace(-3.9, 0, 500), -torch.logspace(-3.9, 0, 500)])
    for x, most in ((torch.linspace(1.0, 2.0, 1001), 0.004), (both, 0.04)):
        table = table_of("light", [x])
        assert float((decoded(table, x) / x - 1).abs().max()) <= table.error < most


@together("most", [254, 255, 65534])
def test_counts_are_exact(most):
    x = torch.arange(most + 1.0)
    table = table_of("counts", [x])
    assert table.error == 0
    assert torch.equal(decoded(table, x), x)
    assert torch.isnan(decoded(table, torch.tensor([math.nan, math.inf]))).all()
    assert table_of("counts", [x + 1.5]).error > 0
    assert table_of("counts", [x + 65535 - most]).error > 0


def test_phases_and_ratios():
    phases = torch.linspace(-math.pi, math.pi, 3001)
    off = decoded(PHASE, phases) - phases
    assert float((off - 2 * math.pi * torch.round(off / (2 * math.pi))).abs().max()) <= PHASE.error * (1 + 1e-5)
    ratios = torch.linspace(-1, 1, 3001)
    assert float((decoded(RATIO, ratios) - ratios).abs().max()) <= RATIO.error * (1 + 1e-5)
    for table in (PHASE, RATIO, table_of("light", [torch.ones(3)]), table_of("x", [-torch.ones(3)])):
        assert set(table.encode(torch.tensor([math.nan, math.inf])).tolist()) == {NOT_FINITE}
        assert math.isnan(table.values[NOT_FINITE])


# ---------------------------------------------------------------------------------------------------------- pages


def test_a_page_needs_nothing_else(tmp_path):
    path = tmp_path / "light.html"
    page = tt.vis.view(cases.front(3), path, axis=cases.AXIS, title="a <b> & c")
    text = path.read_text(encoding="utf-8")
    assert page.path == path
    assert text == page.html
    assert "<title>a &lt;b&gt; &amp; c</title>" in text
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=\"https?:", text)
    assert page.notes[0].startswith("Stored in 8 bits")


def test_pages_have_the_size_that_was_asked_for():
    noise = cases.noise(3, 100, 120, 120)
    large, small = (tt.vis.view(noise, max_megabytes=size) for size in (20, 3))
    assert len(small.html) <= 3e6 < len(large.html) <= 20e6
    assert any("adds up" in note or "averages" in note for note in small.notes)
    assert not any("adds up" in note or "averages" in note for note in large.notes)
    # A line of pixels is binned over time.
    line = tt.vis.view(cases.noise(1, 1024, 1, 4000), max_megabytes=2)
    assert len(line.html) <= 2e6 and any("adds up" in note for note in line.notes)
    assert not any("averages" in note for note in line.notes)


def test_a_size_that_cannot_be_reached_is_said():
    rates = cases.noise(1, 2200, 1, 8, 8)
    page = tt.vis.view(rates, rate_axis=tt.RateAxis(-20.0, 0.01, 2200), max_megabytes=2)
    assert len(page.html) > 2e6
    assert any("larger than max_megabytes=2" in note for note in page.notes)
    assert not any("larger" in note for note in tt.vis.view(rates[:, :4, 0], max_megabytes=2).notes)


def test_notebooks_show_small_pages():
    page = tt.vis.view(cases.front(1), axis=cases.AXIS)
    assert page._repr_html_().startswith("<iframe srcdoc=")
    large = tt.vis.view(cases.noise(3, 100, 160, 160))
    assert "too large for a notebook" in large._repr_html_()


def test_files(tmp_path):
    from torchtransient.files import write_volume

    capture, volume = cases.capture("confocal"), cases.volume()
    capture.write(tmp_path / "capture.h5")
    write_volume(tmp_path / "volume.npz", volume)
    np.save(tmp_path / "light.npy", cases.front(1).numpy())
    for name, x in (("capture.h5", capture), ("volume.npz", volume), ("light.npy", cases.front(1))):
        assert tt.vis.view(tmp_path / name, title="same").html.count("codes-") == tt.vis.view(x).html.count("codes-")


def test_samples_of_a_loader():
    """As those of a list, of which some may be left out."""
    samples = [{"transient": cases.front(1, seed=n)} for n in range(3)]
    loader = torch.utils.data.DataLoader(samples, batch_size=None)
    of_loader, of_list = (tt.vis.view(x, axis=cases.AXIS) for x in (loader, samples))
    assert of_loader.html.count('id="codes-') == of_list.html.count('id="codes-') == 3
    assert "The first 2 of 3 samples." in tt.vis.view(samples, samples=2, axis=cases.AXIS).notes


LATER = SimpleNamespace(transient=cases.front(1), axis=tt.TimeAxis(3.0, 0.1, 24))
REFUSED = {
    "a batch": (lambda: tt.vis.view(torch.ones(2, 3, 5, 4, 4)), ShapeError, "expected light"),
    "nothing": (lambda: tt.vis.view([]), ShapeError, "at least one sample"),
    "another axis": (lambda: tt.vis.view(torch.ones(1, 5, 4, 4), axis=cases.AXIS), ShapeError, "24 bins"),
    "rates": (lambda: tt.vis.view(cases.result(rates=cases.rates()[0])), ShapeError, "rate_axis"),
    "two kinds": (lambda: tt.vis.view((cases.front(1), cases.capture())), ShapeError, "one kind"),
    "two sizes": (lambda: tt.vis.view((cases.front(1), cases.front(1, 4, 4))), ShapeError, "one kind"),
    "frequencies": (lambda: tt.vis.view(cases.phasors()[0], frequencies=[1.0]), ShapeError, "5 frequencies"),
    "rates as a tensor": (lambda: tt.vis.view(cases.rates()[0]), ShapeError, "rate_axis"),
    "three rates of four channels": (lambda: tt.vis.view(cases.noise(4, 3, 5, 4, 4)), ShapeError, "rate_axis"),
    "two axes": (lambda: tt.vis.view((cases.result(transient=cases.front(1)), LATER)), ShapeError, "one axis"),
    "a steady picture": (lambda: tt.vis.view(torch.ones(3, 4, 4)), ShapeError, "steady"),
    "real phasors": (lambda: tt.vis.view(torch.ones(1, 2, 4, 4), frequencies=[1, 2]), ArgumentError, "complex"),
    "a word": (lambda: tt.vis.view({"albedo": 1}), ArgumentError, "expected"),
    "a small size": (lambda: tt.vis.view(torch.ones(1, 5, 4, 4), max_megabytes=1.9), UnitError, "least 2"),
    "a folder": (lambda: tt.vis.view(torch.ones(1, 5, 4, 4), "nowhere/a.html"), StorageError, "nowhere"),
    "an ending": (lambda: tt.vis.view(torch.ones(1, 5, 4, 4), "a.png"), StorageError, r"ends in \.html"),
    "a file": (lambda: tt.vis.view("missing.h5"), StorageError, "missing.h5"),
}  # fmt: skip


@together("name", REFUSED)
def test_refusals(name):
    call, error, words = REFUSED[name]
    with pytest.raises(error, match=words):
        call()


def test_the_server_starts_without_torch():
    """Its import takes longer than to open the file."""
    code = "import sys, torchtransient.vis.pages.server, torchtransient.cli.view; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


def test_bokeh_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "bokeh", None)
    with pytest.raises(MissingPackageError, match=r"torchtransient\[view\]"):
        tt.vis.view(cases.front(1))


# -------------------------------------------------------------------------------------------------------- colours

# What eyes without one kind of cones see, in linear RGB (Machado, Oliveira and Fernandes 2009, severity 1).
TOLD_APART = 4 * 2.3
BLIND = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lab(colours, blindness):
    """CIE L*a*b* of #rrggbb as such eyes see them."""
    screen = np.array([[int(c[k : k + 2], 16) / 255 for k in (1, 3, 5)] for c in colours])
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear @ np.array(BLIND[blindness]).T, 0, 1)
    xyz = linear @ np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]).T
    f = np.cbrt(xyz / [0.9505, 1.0, 1.089])
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], -1)


@pytest.mark.parametrize("blindness", BLIND)
def test_colours_are_told_apart(blindness):
    """By four times what an eye just sees (2.3 units of CIELAB, Mahy 1994): curves, and eighths of every map."""
    curves = lab(PIXEL_COLOURS, blindness)
    apart = np.linalg.norm(curves[:, None] - curves[None], axis=-1)[~np.eye(len(curves), dtype=bool)]
    assert apart.min() > TOLD_APART
    for name, colours in colour_maps().items():
        seen = lab(colours, blindness)
        if name == "rainbow":  # the hue of many papers; peak time is the mode without it
            continue
        some = seen[:: 256 // 8]
        steps = np.linalg.norm(some[:, None] - some[None], axis=-1)[~np.eye(len(some), dtype=bool)]
        assert steps.min() > TOLD_APART, name


def test_two_results_of_which_one_has_errors():
    """In either order: the page has no bands, and says so."""
    scene = tt.load(tt.scenes.cornell_box(resolution=4, num_bins=20, bin_width_opl=0.45), variant="llvm_ad_mono")
    with_errors, plain = (tt.render(scene, spp=4, seed=n, errors=n == 0) for n in range(2))
    for pair in ((with_errors, plain), (plain, with_errors)):
        notes = " ".join(tt.vis.view(pair).notes)
        assert "No bands of errors" in notes and "two standard errors" not in notes
    assert "two standard errors" in " ".join(tt.vis.view((with_errors, with_errors)).notes)
