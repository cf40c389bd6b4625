"""The command line: results, messages, exit status."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from support.sweeps import together
from torchtransient.__main__ import main
from torchtransient.files import read_result

VARIANT = "llvm_ad_rgb"  # what the commands take when none is active, as in a process of their own
SCENE = """<scene version="3.0.0">
  <default name="res" value="8"/>
  <integrator type="transient_path"><integer name="max_depth" value="3"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="transient_hdr_film">
      <integer name="width" value="$res"/><integer name="height" value="$res"/>
      <integer name="temporal_bins" value="40"/>
      <float name="start_opl" value="3"/><float name="bin_width_opl" value="0.2"/>
    </film>
    <sampler type="independent"><integer name="sample_count" value="16"/></sampler>
  </sensor>
  <bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.5"/></bsdf>
  <shape type="rectangle"><ref id="grey"/></shape>
  <emitter type="point" id="lamp"><point name="position" x="0" y="1" z="3"/><rgb name="intensity" value="5"/></emitter>
</scene>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.xml").write_text(SCENE, encoding="utf-8")
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_render_to_a_tolerance(folder):
    result = run("render", "box.xml", "-o", "out.npz", "--rtol", 0.1, "--seed", 3, "--quiet", "--set",
                 "grey.reflectance.value=0.5,0.5,0.5")  # fmt: skip
    assert result.exit_code == 0, result.output
    renderer = tt.TransientRenderer("box.xml", ["grey.reflectance.value"])
    expected = renderer.to_tolerance({"grey.reflectance.value": [0.5] * 3}, rtol=0.1, seed=3, progress=False)
    stored = read_result(folder / "out.npz")
    assert torch.allclose(stored.transient, expected.output.transient, rtol=1e-5, atol=1e-9)
    assert stored.metadata["stats"]["spp"] == expected.spp and stored.metadata["tolerance"]["reached"] is True
    assert "of 90% of the bins with light, reached" in result.output and f"{expected.error:.3g}" in result.output
    short = run("render", "box.xml", "-o", "out.npz", "--rtol", 1e-5, "--max-seconds", 0.2, "--quiet")
    assert short.exit_code == 0 and "not reached" in short.output and "max_seconds" in short.output
    for options in (("--max-seconds", 1), ("--rtol", 0.1, "--spp", 4), ("--rtol", 2), ("--rtol", 0.1, "--errors")):
        wrong = run("render", "box.xml", *options)
        assert wrong.exit_code == 2 and options[0] in wrong.output


def test_render_of_a_plan(folder):
    """The picture, the reasons and the settings are those of ``torchtransient plan``; options go before them."""
    options = ("--num-bins", 30, "--seed", 3)
    result = run("render", "box.xml", "-o", "out.npz", "--plan", "--quiet", *options)
    assert result.exit_code == 0, result.output
    plan = tt.plan("box.xml", num_bins=30, seed=3)
    expected, stored = plan.renderer()(seed=3), read_result(folder / "out.npz")
    assert stored.axis == plan.time_axis and stored.axis.num_bins == 30
    torch.testing.assert_close(stored.transient, expected.transient)
    assert run("plan", "box.xml", *options).stdout.splitlines()[:6] == result.stdout.splitlines()[:6]
    assert stored.metadata["plan"]["max_depth"] == plan.max_depth
    assert stored.metadata["stats"]["variant"] == plan.variant == "llvm_ad_mono"


def test_render_of_a_plan_for_gates(folder):
    """The film of the scene says what is planned; with --rtol until its error is met."""
    histogram = SCENE[SCENE.index('<film type="trans') : SCENE.index("</film>")]
    film = '<film type="gated_hdr_film"><string name="gates" value="rectangular 7 7.5"/>'  # the shortest way is 7.07 m
    film += '<integer name="width" value="8"/><integer name="height" value="8"/>'
    (folder / "gated.xml").write_text(SCENE.replace(histogram, film), encoding="utf-8")
    result = run("render", "gated.xml", "-o", "out.npz", "--plan", "--error", "relative", "--rtol", 0.5, "--seed", 3,
                 "--quiet")  # fmt: skip
    assert result.exit_code == 0, result.output
    stored = read_result(folder / "out.npz")
    assert stored.gates == (tt.Gate.rectangular(7.0, 7.5),) and float(stored.gated.sum()) > 0
    assert stored.metadata["plan"]["outputs"] == ["gates"] and stored.metadata["tolerance"]["reached"] is True
    assert "Russian roulette: none" in result.stdout and "reached" in result.stdout


def test_render_with_error_bars(folder):
    result = run("render", "box.xml", "-o", "out.npz", "--errors", "--overview", "out.png", "--seed", 3, "--quiet")
    assert result.exit_code == 0, result.output
    expected = tt.render("box.xml", seed=3, errors=True)
    stored = read_result(folder / "out.npz")
    assert torch.allclose(stored.standard_error(), expected.standard_error())
    assert f"sum known to {expected.relative_error():.2%}" in result.output
    assert (folder / "out.png").stat().st_size > 0


def test_render_writes_what_the_library_renders(folder):
    result = run("render", "box.xml", "-o", "out.h5", "--overview", "out.png", "--seed", 3, "--quiet")
    assert result.exit_code == 0, result.output
    stored = read_result(folder / "out.h5")
    expected = tt.render("box.xml", seed=3)
    assert torch.equal(stored.transient, expected.transient)
    assert torch.equal(stored.steady, expected.steady)
    assert stored.axis == tt.TimeAxis(3.0, 0.2, 40)
    assert stored.metadata["stats"]["spp"] == 16
    assert (folder / "out.png").read_bytes()[:4] == b"\x89PNG"
    assert "out.h5: 3 x 40 x 8 x 8" in result.stdout and "misses" not in result.stdout


GATES = [tt.Gate.rectangular(6.0, 7.0), tt.Gate.gaussian(8.0, 0.5)]


@together("name, option, film, words", [
    ("phasor", ("--frequencies", "0,0.5,-1.25"), {"frequencies": [0.0, 0.5, -1.25]}, "3 x 3 x 8 x 8 (C x F x H x W)"),
    ("gated", ("--gates", "rectangular 6 7; gaussian 8 0.5"), {"gates": GATES}, "3 x 2 x 8 x 8 (C x G x H x W)"),
])  # fmt: skip
def test_render_writes_phasors_and_gates(folder, name, option, film, words):
    result = run("render", "box.xml", "-o", "out.h5", *option, "--seed", 3, "--quiet")
    assert result.exit_code == 0 and words in result.stdout, result.output
    stored, expected = read_result(folder / "out.h5"), tt.render("box.xml", seed=3, **film)
    torch.testing.assert_close(getattr(stored, name), getattr(expected, name))
    assert (stored.frequencies, stored.gates) == (expected.frequencies, expected.gates) and stored.transient is None


MOTION = '<texture type="rigid_motion" name="velocity"><vector name="linear" x="0" y="0" z="2"/></texture>'


@pytest.fixture
def moving(folder):
    """The rectangle comes nearer to camera and lamp."""
    text = SCENE.replace('<shape type="rectangle">', f'<shape type="rectangle" id="wall">{MOTION}')
    (folder / "moving.xml").write_text(text, encoding="utf-8")
    return folder


def test_render_writes_rates(moving):
    rates, axis = tt.RateAxis(-6.0, 0.5, 16), tt.TimeAxis(4.0, 0.5, 10)
    options = ("--rates", "-6:0.5:16", "--start-opl", 4, "--bin-width-opl", 0.5, "--num-bins", 10, "--seed", 3)
    result = run("render", "moving.xml", "-o", "out.h5", "--quiet", *options, "--overview", "all.png")
    assert result.exit_code == 0, result.output
    stored, expected = read_result("out.h5"), tt.render("moving.xml", seed=3, rates=rates, time_axis=axis)
    torch.testing.assert_close(stored.rates, expected.rates)
    assert (stored.rate_axis, stored.axis, stored.transient) == (rates, axis, None)
    light = stored.rates.sum((0, 2, 3, 4))
    assert float(light.sum()) > 0 and float(light[rates.centers > 0].sum()) == 0
    assert "out.h5: 3 x 16 x 10 x 8 x 8 (C x R x T x H x W)" in result.stdout and Path("all.png").is_file()


def test_render_writes_beats(moving):
    chirps = tt.Chirps(1e9, 1e-5, 1550e-9)
    axis = ("--start-opl", -8, "--bin-width-opl", 0.3, "--num-bins", 90)
    result = run("render", "moving.xml", "-o", "out.npz", "--quiet", "--chirps", "1e9:1e-5:1550e-9", *axis, "--seed", 3)
    assert result.exit_code == 0, result.output
    stored = read_result("out.npz")
    assert stored.chirps == chirps and stored.beats.shape == (3, 2, 90, 8, 8)
    assert "(C x 2 x T x H x W)" in result.stdout
    # The up chirp sees what comes nearer before the down chirp does.
    where = (stored.beats.sum((0, 3, 4)) * torch.arange(90.0)).sum(-1)
    assert float(where[0]) < float(where[1])
    refused = run("render", "moving.xml", "--quiet", "--chirps", "1e9:1e-5:1550e-9", "--overview", "a.png")
    assert refused.exit_code == 2 and "leave it out for beats" in refused.output


def test_plan_of_rates_and_beats(moving):
    result = run("plan", "moving.xml", "--outputs", "rates", "--json")
    told = json.loads(result.stdout)
    assert told["film"] == "rates" and told["rates"]["rates_num_bins"] == 64
    result = run("plan", "moving.xml", "--chirps", "1e9:1e-5:1550e-9")
    assert result.exit_code == 0 and "a bin for each line of the chirps" in result.stdout
    result = run("plan", "moving.xml", "--outputs", "beats")
    assert result.exit_code == 2 and "Give --chirps" in result.output
    assert "nothing moves" in run("plan", "box.xml", "--outputs", "rates").stdout


def test_options_of_render(folder):
    options = ("--param", "res=6", "--spp", 4, "--set", "grey.reflectance.value=0.1,0.2,0.4", "--variant", VARIANT)
    axis = ("--start-opl", 4, "--bin-width-opl", 0.5, "--num-bins", 8, "--temporal-filter", "tent", "--max-depth", 2)
    result = run("render", "box.xml", *options, *axis, "--quiet")
    assert result.exit_code == 0, result.output
    stored = read_result(folder / "box.h5")
    expected = tt.render(
        tt.load("box.xml", res=6), {"grey.reflectance.value": torch.tensor([0.1, 0.2, 0.4])}, spp=4, seed=0,
        time_axis=tt.TimeAxis(4.0, 0.5, 8), temporal_filter="tent", max_depth=2,
    )  # fmt: skip
    assert stored.transient.shape == (3, 8, 6, 6)
    assert torch.equal(stored.transient, expected.transient)
    assert stored.metadata["set"] == ["grey.reflectance.value=0.1,0.2,0.4"]


def test_light_outside_of_the_axis_is_reported(folder):
    axis = ("--start-opl", 0, "--bin-width-opl", 0.5, "--num-bins", 2)
    result = run("render", "box.xml", *axis, "--quiet")
    assert result.exit_code == 0, result.output
    assert "misses light: 0.0% arrives before it and 100.0% after it" in result.stdout


def test_list_of_parameters(folder):
    result = run("render", "box.xml", "--list-parameters")
    assert result.exit_code == 0 and "grey.reflectance.value" in result.stdout and not (folder / "box.h5").exists()


@pytest.mark.slow
def test_cost(folder):
    options = ("--depth", 2, "--depth", 4, "--bin-width", 0.05, "--integrator", "transient_path", "--sampler", "owen",
               "--gradient", "grey.reflectance.value", "--plot", "cost.png", "--json", "cost.json")  # fmt: skip
    result = run("cost", "box.xml", "--spp", "4,8", "--repeats", 2, *options, "--error", 0.99, "--quiet")
    assert result.exit_code == 0, result.output
    points = json.loads((folder / "cost.json").read_text(encoding="utf-8"))["points"]
    assert {(p["spp"], p["max_depth"], p["integrator"], p["bin_width_opl"]) for p in points} == {
        (spp, depth, "transient_path", 0.05) for spp in (4, 8) for depth in (2, 4)
    }
    assert len({p["quantity"] for p in points}) == 2
    assert all(p["seconds"] > 0 and p["squared_error"] > 0 for p in points)
    assert "recommended for 99.00%: transient: transient_path, owen" in result.stdout
    assert (folder / "cost.png").read_bytes()[:4] == b"\x89PNG"
    result = run("cost", "box.xml", "--spp", "4,8", "--repeats", 2, "--sampler", "owen", "--error", 1e-9, "--quiet")
    assert result.exit_code == 1 and "expected an error of transient that a measured setting reaches" in result.stdout


@pytest.mark.slow
def test_demo_finds_the_colour(folder):
    result = run("demo", "--resolution", 32, "--spp", 16, "--steps", 25)
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.splitlines() if line.split()[:1] in (["red"], ["green"], ["blue"])]
    assert len(rows) == 3
    for _name, start, found, truth in rows:
        assert abs(float(found) - float(truth)) < 0.03
        assert abs(float(start) - float(truth)) > 0.15
    for name in ("cornell_box.png", "fit.png"):
        assert (folder / "demo_output" / name).read_bytes()[:4] == b"\x89PNG"
    assert read_result(folder / "demo_output" / "cornell_box.npz").transient.shape == (3, 100, 32, 32)
    assert str(folder / "demo_output") in result.stdout


def test_demo_where_nothing_can_be_written(folder):
    (folder / "file").write_text("", encoding="utf-8")
    result = run("demo", "-o", "file/inside")
    assert result.exit_code == 2
    assert "cannot be made" in result.stderr


@together("name", main.list_commands(None))
def test_help_of_every_command(name):
    result = run(name, "--help")
    assert result.exit_code == 0 and "Usage" in result.stdout


def test_help_needs_no_torch():
    """Nor does that of `reconstruct`, whose options are many."""
    code = "import sys\nfrom torchtransient.__main__ import main\nfor words in (['-h'], ['reconstruct', '-h']):\n"
    code += "    try:\n        main(words)\n    except SystemExit as stop:\n        assert not stop.code\n"
    code += "heavy = {'torch', 'matplotlib', 'h5py', 'kornia', 'scipy', 'imageio', 'pandas'}\n"
    code += "assert not heavy & set(sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=os.environ)
    assert result.returncode == 0, result.stderr
    assert "doctor" in result.stdout


def test_warnings_are_lines(folder):
    result = run("render", "box.xml", "--quiet", "--spp", 2, "--set", "grey.reflectance.value=1.5,0.5,0.5")
    assert result.exit_code == 0, result.output
    lines = [line for line in result.stderr.splitlines() if line]
    assert len(lines) == 1 and lines[0].startswith("warning: 'grey.reflectance.value' is a share of the light")
    assert ".clamp" not in lines[0]


WRONG = [
    (("missing.xml",), "missing.xml"), (("broken.xml",), "line 2"), (("unknown.xml",), "no_such_film"),
    (("box.xml", "--param", "resx=3"), "resx"), (("box.xml", "--param", "res"), "--param"),
    (("box.xml", "--param", "res=1", "--param", "res=2"), "--param"), (("box.xml", "--set", "a=b"), "--set"),
    (("box.xml", "--set", "gray.reflectance.value=0.1"), "Did you mean 'grey.reflectance.value'"),
    (("box.xml", "--set", "wrong.key=1"), "--list-parameters"), (("box.xml", "--sensor", "2"), "--sensor"),
    (("box.xml", "--set", "grey.reflectance.value=0.1"), "(3,)"), (("box.xml", "--variant", "scalar_rgb"), "llvm"),
    (("box.xml", "--param", "res=60000", "--quiet"), "TiB"), (("box.xml", "-o", "out.exr"), ".npz"),
    (("box.xml", "-o", "nowhere/out.h5"), "nowhere"), (("box.xml", "--overview", "nowhere/out.png"), "nowhere"),
    (("box.xml", "--overview", "out.docx"), ".png"), (("box.xml", "--video", "out.avi"), ".mp4"),
    (("box.xml", "--start-opl", "0", "--bin-width-opl", "-1", "--num-bins", "3"), "bin_width_opl"),
    (("box.xml", "--num-bins", "3"), "--num-bins"), (("box.xml", "--gates", "rectangular 2 1"), "start"),
    (("box.xml", "--gates", "rectangular 1 2", "--overview", "a.png"), "--overview"),
    (("box.xml", "--gates", "rectangular 1 2", "--temporal-filter", "tent"), "gated film"),
    (("box.xml", "--frequencies", "1", "--start-opl", 0, "--bin-width-opl", 1, "--num-bins", 2), "--frequencies"),
    (("box.xml", "--frequencies", "1", "--overview", "a.png"), "--overview"),
    (("box.xml", "--plan", "--gates", "rectangular 6 7", "--overview", "a.png"), "--overview"),
    (("box.xml", "--error", "relative"), "--plan"),
    (("box.xml", "--plan", "--error", "relative", "--frequencies", 1), "--error relative"),
]  # fmt: skip
OTHERS = [
    (("plan", "box.xml", "--gradient", "wrong.key"), "--list-parameters"),
    (("plan", "box.xml", "--outputs", "gates"), "--gates"),
    (("plan", "box.xml", "--outputs", "phasor"), "--frequencies"),
    (("plan", "box.xml", "--outputs", "sound"), "--outputs"), (("cost", "box.xml", "--spp", "4,x"), "N,N"),
    (("cost", "box.xml", "--spp", "0,4"), "N,N"), (("polish",), "No such command"),
]  # fmt: skip


@together("arguments, word", [*((("render", *arguments), word) for arguments, word in WRONG), *OTHERS])
def test_errors_are_one_message_and_status_2(folder, arguments, word):
    """In the words of the command line, before anything is rendered."""
    (folder / "broken.xml").write_text("<scene version='3.0.0'>\n<film", encoding="utf-8")
    (folder / "unknown.xml").write_text(SCENE.replace("transient_hdr_film", "no_such_film"), encoding="utf-8")
    result = run(*arguments)
    assert result.exit_code == 2 and word in result.stderr, result.output
    assert isinstance(result.exception, SystemExit) and not list(folder.glob("*.h5"))
    for python in ("Traceback", "tt.", "print(", "=["):
        assert python not in result.stderr
