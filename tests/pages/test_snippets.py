"""Blocks of Python on pages without a test of their own run as they stand; every page with blocks is run somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.capture_files import grids, made
from support.pages import NOT_RUN, ROOT, Page, all_pages
from support.sweeps import together
from torchtransient.files.captures.matlab import write_mat

VARIANT = "llvm_ad_rgb"
# What makes scenes small.
SMALL = {r"resolution=\d+": "resolution=6", r"spp=\d+": "spp=4"}
# Their blocks stand for themselves: what they promise they assert, or it is tested where it is made.
STANDING_ALONE = ["choosing", "commands", "stability", "faq", "install", "media"]
SCENE = """<scene version="3.0.0">
  <default name="resx" value="8"/>
  <integrator type="transient_path"><integer name="max_depth" value="3"/></integrator>
  <sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    <film type="transient_hdr_film">
      <integer name="width" value="$resx"/><integer name="height" value="4"/> <integer name="temporal_bins" value="40"/>
      <float name="bin_width_opl" value="0.2"/><float name="start_opl" value="6"/><rfilter type="box"/>
    </film></sensor>
  <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.6, 0.1, 0.1"/></bsdf>
  <shape type="rectangle" id="wall"><transform name="to_world"><scale value="3"/></transform><ref id="red"/></shape>
  <emitter type="point"><point name="position" x="-0.5" y="0.3" z="4"/></emitter>
</scene>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path


def test_readme(folder, capsys):
    page = Page("README.md")
    found = page.names()
    assert len(page.programs()) == 1 and "red.reflectance.value" in capsys.readouterr().out
    assert found["out"].transient.shape == (3, 100, 32, 32)
    red, green, _blue = found["renderer"].values["red.reflectance.value"].tolist()
    assert red > 0.42
    assert green < 0.38


@pytest.mark.slow
def test_first_render(folder):
    found = Page("docs/first_render.md").names({**SMALL, r"range\(20\)": "range(2)"})
    assert (folder / "light.gif").stat().st_size > 500 and (folder / "peak.png").stat().st_size > 500
    assert found["counts"].shape == found["out"].transient.shape[1:] and bool((found["counts"] >= 0).all())
    assert bool(torch.isfinite(found["loss"]))


@pytest.mark.slow
def test_light(folder):
    found = Page("docs/light.md").names({r"resolution=\d+": "resolution=4", r"count=20": "count=3"})
    assert found["out"].gated.shape == (3, 3, 4, 4) and found["out"].transient is None
    assert found["late"].gated.shape == (3, 1, 4, 4) and found["late"].gated.sum() > 0


@pytest.mark.slow
def test_phasors(folder):
    found = Page("docs/phasors.md").names(SMALL)
    assert found["out"].phasor.shape == (3, 2, 6, 6)
    assert bool((found["renderer"].values["red.reflectance.value"].grad != 0).all())


@pytest.mark.slow
def test_motion(folder):
    found = Page("docs/motion.md").names(SMALL | {r"spp=\d+": "spp=64"})
    assert found["out"].phasor.shape == (3, 1, 6, 6) and found["velocity"].grad.norm() > 0
    assert found["taps"].shape == (3, 4, 6, 6) and found["rows"].phasor.shape == (3, 1, 6, 6)
    # A beat drops out of what stands still: the box is a thousandth of the picture.
    assert found["out"].phasor.abs().max() < 0.01 * found["rows"].phasor.abs().max()
    assert found["light"].shape == (3, 33, 64, 6, 6) and found["lidar"].beats.shape[:2] == (3, 2)
    assert all(bool((value.grad != 0).any()) for value in found["doppler"].values.values())
    assert found["range_m"].shape == found["approach_m_s"].shape == (3, 6, 6)


@pytest.mark.slow
def test_pictures(folder):
    Page("docs/pictures.md").names({**SMALL, "num_bins=400": "num_bins=10, bin_width_opl=0.8", "every=5": "every=2"})
    assert (folder / "light.mp4").stat().st_size > 500


def test_plan(folder, capsys):
    found = Page("docs/plan.md").names({r"spp=\d+": "spp=4"})
    assert "variant: " in capsys.readouterr().out and found["out"].transient.shape[-2:] == (4, 8)


@pytest.mark.slow
def test_polarization(folder):
    found = Page("docs/polarization.md").names({r"spp=\d+": "spp=4"})
    assert found["out"].transient.shape == (4, 1, 40, 4, 8)


@pytest.mark.slow
def test_gradients(folder):
    """The box that is fitted, from 0.2 radians and 7 cm. Of 8 sets of seeds the angle ends at -.0030 +- .0012 and the
    place at 0.4 +- 0.3 mm, as far as a hundred steps come: four deviations. With 128 samples and `independent` numbers
    three sets ended at .0005, .011 and .019.
    """
    found = Page("docs/gradients.md").names()
    turn, x, z = found["x"].detach()[[1, 3, 5]].tolist()
    assert abs(turn) < 0.008 and max(abs(x), abs(z)) < 0.002


@pytest.mark.slow
def test_accuracy(folder, capsys):
    found = Page("docs/accuracy.md").names({"resolution=16": "resolution=4"})
    assert set(found["report"].quantities()) and "red.reflectance.value" in capsys.readouterr().out


@pytest.mark.slow
def test_torch_layer(folder):
    found = Page("docs/torch_layer.md").names({"resx=64": "resx=6", "spp=64": "spp=4"})
    assert found["out"].transient.shape == (3, 40, 4, 6)
    assert bool((found["renderer"].values["wall.to_world"].grad[:3] != 0).any())


def test_capture_files(folder):
    tt.nlos.write_capture("scan.hdf5", made(grids()["confocal"]), format="tal")
    rng = np.random.default_rng(0)
    write_mat(folder / "letter_s.mat", {"meas": rng.poisson(3.0, (4, 4, 9)).astype(np.float32)})
    write_mat(folder / "direct_before.mat", {"direct_before": np.eye(9)[:, 2:3] * 50})
    track = {"data": rng.poisson(3.0, (5, 9)) * 1.0, "xpos": np.linspace(1, 0, 5)[:, None], "zpos": np.ones((5, 1))}
    write_mat(folder / "scan_10-15-19_21-12.mat", track)
    found = Page("docs/capture_files.md").names()
    assert found["capture"].transient.shape == (1, 9, 4, 4) and found["track"].transient.shape == (1, 9, 5)
    assert (folder / "scan.h5").exists() and found["start_s"] < 0


@pytest.mark.parametrize("page", STANDING_ALONE)
def test_pages_that_stand_alone(folder, page):
    smaller = {pattern: small for pattern, small in SMALL.items() if re.search(pattern, Page(f"docs/{page}.md").text)}
    Page(f"docs/{page}.md").names(smaller)


def test_every_page_with_blocks_is_run():
    """By a test that calls ``Page("docs/nlos.md")`` and runs it, or by the one above."""
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")]
    runs = re.compile(r"\.(?:run|names|programs)\(")
    known = {place for text in texts if runs.search(text) for place in re.findall(r'\bPage\("([^"]+)"\)', text)}
    known |= {f"docs/{name}.md" for name in STANDING_ALONE}
    assert [page.place for page in all_pages() if page.programs() and page.place not in known] == []


def test_blocks_that_are_not_run_say_why():
    for page in all_pages():
        for block in page.blocks("python"):
            if block.startswith(NOT_RUN.strip()):
                assert len(block.splitlines()[0].removeprefix(NOT_RUN)) > 10, f"{page}: say why it is not run"


@together("page", all_pages(), repr)
def test_fences_are_closed(page):
    """A block in another spelling (``py``, indented) would be run by nobody."""
    fences = re.findall(r"^( *)(```+)(\w*)", page.text, flags=re.MULTILINE)
    assert len(fences) % 2 == 0
    for indent, _, language in fences[::2]:
        assert language in ("python", "sh", "xml", "yaml", "text", "") and not indent, f"{page}: {language!r}"
    assert Path(page.place).suffix == ".md"
