"""Numbers that commands take and say, at the edges and one beside them."""

from __future__ import annotations

import importlib
import sys
from types import SimpleNamespace

import click
import pytest
import torch
from click.testing import CliRunner

import torchtransient as tt
from torchtransient import _llvm
from torchtransient.checks import positive
from torchtransient.cli import demo, doctor, reconstruct, render
from torchtransient.cli.cost import Counts
from torchtransient.cli.dataset import _share
from torchtransient.cli.doctor import Finding
from torchtransient.cli.main import main
from torchtransient.cli.options import assignments, scene_values
from torchtransient.cli.pictures import write_pictures
from torchtransient.cli.reconstruct import Numbers, _as_words, _check_together, _draw, _grid, _wall_size
from torchtransient.scene.variant import active_variant

# ----------------------------------------------------------------------------------------------------------- options


def convert(kind, text):
    return kind.convert(text, None, None)


def test_lists_of_numbers():
    assert convert(Counts(), "1,4294967295") == (1, 2**32 - 1) and convert(Counts(), (3,)) == (3,)
    for wrong in ("0", "4,4294967296", "1.5", "", "4,,5"):
        with pytest.raises(click.BadParameter, match="expected whole numbers from 1 to 4294967295"):
            convert(Counts(), wrong)
    pair = Numbers(float, 2, "WIDTH[,HEIGHT]")
    assert convert(pair, "1.5") == (1.5,) and convert(pair, "1.5,0.25") == (1.5, 0.25) and convert(pair, (2,)) == (2,)
    for wrong in ("0", "1,0", "-1", "1,2,3", "a", ""):
        with pytest.raises(click.BadParameter, match=r"expected WIDTH\[,HEIGHT\], greater than zero"):
            convert(pair, wrong)


def test_shares_of_machines():
    assert (
        _share(None, None, None) is None and _share(None, None, "0/1") == (0, 1) and _share(None, None, "2/3") == (2, 3)
    )
    for wrong in ("3/3", "1", "1/", "/2", "-1/2", "a/2", "4/3"):
        with pytest.raises(click.BadParameter, match="I from 0 to K - 1"):
            _share(None, None, wrong)


def test_values_of_scenes():
    assert assignments(["a=1", "b=x=y"], "--set") == {"a": "1", "b": "x=y"}
    for wrong, words in (
        (["a"], "expected NAME=VALUE"),
        (["=1"], "expected NAME=VALUE"),
        (["a=1", "a=2"], "given twice"),
    ):
        with pytest.raises(click.BadParameter, match=words):
            assignments(wrong, "--set")
    found = scene_values(["a=0.5,0.25", "b=[[1,2],[3,4]]", "c=3"], "--set")
    assert [one.tolist() for one in found.values()] == [[0.5, 0.25], [[1, 2], [3, 4]], 3]
    assert all(one.dtype == torch.float32 for one in found.values())
    for wrong in ("a=red", "a=[1,", "a='x'"):
        with pytest.raises(click.BadParameter, match="expected a number, or numbers with commas, for 'a'"):
            scene_values([wrong], "--set")


# ------------------------------------------------------------------------------------------------------------ render


def rendered(before, after, inside=100.0, polarized=False):
    """An output of two channels, whose mean holds ``inside``."""
    transient = torch.tensor([0.75, 1.25])[:, None, None, None].expand(2, 5, 2, 2) * inside / 20
    if polarized:
        transient = torch.stack([transient, *[torch.full_like(transient, 99.0)] * 3])
    return SimpleNamespace(
        polarized=polarized, transient=transient, steady=transient.sum(-3), axis=tt.TimeAxis(1.0, 0.5, 5),
        outside=(before / (before + inside + after), after / (before + inside + after)), cells=None,
    )  # fmt: skip


def test_light_that_the_axis_misses_is_said(capsys):
    render._report_energy(rendered(20.0, 5.0))
    assert capsys.readouterr().out == (
        "note: the axis from 1 m to 3.5 m misses light: 16.0% arrives before it and 4.0% after it.\n"
    )


@pytest.mark.parametrize(("before", "after"), [(0.1001, 0.0), (0.0, 0.1002), (0.0501, 0.0501)])
def test_a_thousandth_may_be_missed(capsys, before, after):
    render._report_energy(rendered(before * 0.99, after * 0.99))
    assert capsys.readouterr().out == ""
    render._report_energy(rendered(before * 1.01, after * 1.01))
    assert "misses light" in capsys.readouterr().out


@pytest.mark.parametrize("polarized", [False, True])
def test_the_overview_shows_the_intensity(monkeypatch, tmp_path, polarized):
    shown = []
    monkeypatch.setattr(tt.vis, "plot_overview", lambda *images, **more: shown.append((images, more)))
    output = rendered(0.0, 0.0, polarized=polarized)
    options = {"overview": tmp_path / "a.png", "peak_time": None, "rainbow": None, "video": None, "pixel": (1, 0)}
    write_pictures(output, None, options, "title")
    (((transient, steady, axis), more),) = shown
    plain = rendered(0.0, 0.0)
    assert torch.equal(transient, plain.transient) and torch.equal(steady, plain.steady) and axis == plain.axis
    assert more == {"path": tmp_path / "a.png", "pixel": (1, 0), "title": "title", "errors": None}


# ------------------------------------------------------------------------------------------------------- reconstruct


def test_numbers_in_words():
    assert _as_words(0.123456) == "0.1235" and _as_words(7) == "7" and _as_words("text") == "text"
    assert _as_words([-1e-12, 2.5, 3]) == "0 2.5 3"
    assert _wall_size({}) == {} and _wall_size({"wall_size": (2.0,)}) == {"wall_size": 2.0}
    assert _wall_size({"wall_size": (2.0, 3.0)}) == {"wall_size": (2.0, 3.0)}


def grid(method="bp", **options):
    given = dict.fromkeys(("voxels", "extent", "bounds", "depths")) | options
    return _grid("capture", method, given)


def test_voxels_that_are_asked_for(monkeypatch):
    asked = []
    module = importlib.import_module("torchtransient.nlos.reconstruct")
    monkeypatch.setattr(module, "default_grid", lambda *at, **more: asked.append((at, more)))
    assert grid() is None and not asked
    for options, size, extent, planes in (
        ({"voxels": (7,)}, 7, None, None), ({"voxels": (7, 5)}, (7, 5), None, None),
        ({"voxels": (7, 5, 3)}, (7, 5), None, 3), ({"extent": (2.0,)}, None, 2.0, None),
        ({"extent": (2.0, 3.0), "depths": (1.0, 2.0)}, None, (2.0, 3.0), None),
    ):  # fmt: skip
        grid(**options)
        expected = {"depths": options.get("depths"), "size": size, "extent": extent, "planes": planes}
        assert asked.pop() == (("capture",), expected)
    with pytest.raises(
        click.UsageError, match=r"--method fk has a voxel behind each point.*leave out --voxels and --ext"
    ):
        grid("fk", voxels=(7,), extent=(1.0,))


def test_voxels_between_bounds():
    bounds = (-1.0, -2.0, 0.5, 1.0, 2.0, 1.5)
    for voxels in ((4,), (4, 6, 3)):
        found = grid(bounds=bounds, voxels=voxels)
        assert found == tt.reconstruction.VoxelGrid.bounds((bounds[:3], bounds[3:]), voxels if len(voxels) == 3 else 4)
    for voxels in (None, (4, 6)):
        with pytest.raises(click.UsageError, match="--bounds needs --voxels N or X,Y,Z"):
            grid(bounds=bounds, voxels=voxels)


OPTIONS = {
    "gamma": 1.0, "threshold": 0.5, "no_picture": False, "picture": None, "bounds": None, "depths": None,
    "extent": None, "times": None, "camera": None, "slab": None, "slab_snr": None,
}  # fmt: skip


def test_options_that_belong_together():
    for fine in ({}, {"no_picture": True}, {"picture": "a.png"}, {"bounds": 1}, {"depths": 1, "extent": 1},
                 {"times": 1, "camera": "confocal"}, {"slab": 1, "slab_snr": 2.0}):  # fmt: skip
        _check_together(OPTIONS | fine)
    for wrong, words in (
        ({"no_picture": True, "picture": "a.png"}, "--no-picture writes none"),
        ({"bounds": 1, "depths": 1}, "--bounds says"),
        ({"bounds": 1, "extent": 1}, "--bounds says"), ({"times": 1}, "--times is for"),
        ({"times": 1, "camera": "direct"}, "--times is for"), ({"slab_snr": 2.0}, "--slab-snr needs --slab"),
    ):  # fmt: skip
        with pytest.raises(click.UsageError, match=words):
            _check_together(OPTIONS | wrong)
    for wrong in ({"gamma": 0.0}, {"threshold": 1.5}):
        with pytest.raises(tt.errors.UnitError):
            _check_together(OPTIONS | wrong)
    assert positive("--gamma", 2.2) == 2.2


@pytest.mark.parametrize(("flip", "axes"), [(None, ()), ("x", (-1,)), ("y", (-2,)), ("xy", (-1, -2))])
def test_pictures_of_volumes(monkeypatch, flip, axes):
    """From behind, with the axes turned that are asked for; depths of what is brighter than nothing."""
    shown, looked = [], []
    picture = torch.arange(24.0).reshape(2, 3, 4) - 9
    depth = torch.arange(12.0).reshape(3, 4)

    def depth_map(values, given, threshold):
        looked.append((values, given, threshold))
        return SimpleNamespace(depth=depth, mask=depth > 5)

    monkeypatch.setattr(tt.nlos, "depth_map", depth_map)
    monkeypatch.setattr(tt.vis, "volume_views", lambda values, path, **more: shown.append((values, path, more)))
    boxes = SimpleNamespace(depths=(1.0, 2.0), extent=(3.0, 4.0))
    volume = SimpleNamespace(picture=lambda: picture, grid=boxes, directions=None, method="fk",
                             metadata={"capture": "a.mat"})  # fmt: skip
    _draw(volume, "a.png", {"flip": flip, "threshold": 0.25, "gamma": 2.0})
    assert torch.equal(looked[0][0], picture.clamp_min(0)) and looked[0][1:] == (boxes, 0.25)
    ((values, path, more),) = shown
    assert torch.equal(values, picture.flip(axes)) and path == "a.png"
    assert torch.equal(more["depth"], depth.flip(axes)) and torch.equal(more["mask"], (depth > 5).flip(axes))
    assert (more["depths"], more["extent"], more["gamma"]) == ((1.0, 2.0), (3.0, 4.0), 2.0)
    assert (more["title"], more["normals"]) == ("a.mat, fk", None)
    assert reconstruct.METHODS["bp"].free_grid and not reconstruct.METHODS["fk"].free_grid


# ------------------------------------------------------------------------------------------------------------ doctor


@pytest.mark.parametrize(
    ("plain", "gets"),
    [
        (f"{_llvm.MIN_MAJOR}.0.0", None), (f"{_llvm.MIN_MAJOR - 1}.1.0", f"LLVM {_llvm.MIN_MAJOR - 1}.1.0"),
        ("-1.-1.-1", "no LLVM"), ("0.0.0", "no LLVM"), ("nothing", "no LLVM"), (None, "no LLVM"),
    ],
)  # fmt: skip
def test_what_other_programs_get(monkeypatch, plain, gets):
    monkeypatch.setattr(doctor, "_run", lambda command, environment: (1, "99", "") if plain is None else (0, plain, ""))
    notes = [finding.text for finding in doctor.llvm()[1:]]
    assert len(notes) == (gets is not None)
    assert gets is None or f"gets {gets}." in notes[0]


@pytest.mark.parametrize(
    ("code", "errors", "text"),
    [
        (0, "words", "renders and differentiates"), (-11, "a\nb\n", "the process was ended by SIGSEGV: b"),
        (-200, "", "the process was ended by 200: no message"), (1, "  a\n  b  ", "failed:   b"),
    ],
)  # fmt: skip
def test_how_a_trial_ended(monkeypatch, code, errors, text):
    monkeypatch.setattr(doctor, "_run", lambda command, environment: (code, "", errors))
    found = doctor.probe("llvm_ad_rgb")
    assert found == Finding("ok" if code == 0 else "problem", "llvm_ad_rgb", text)


def test_problems_of_all_parts_are_counted(monkeypatch):
    bad, fine = Finding("problem", "a", "b"), Finding("ok", "c", "d")
    for number, words in ((0, ""), (1, "1 problem found."), (3, "3 problems found.")):
        for n, part in enumerate(("versions", "llvm", "variants")):
            found = [bad, fine] if n < number else [fine]
            monkeypatch.setattr(doctor, part, lambda *_, found=found: found)
        result = CliRunner().invoke(main, ["doctor"])
        assert result.exit_code == (number > 0) and words in result.stderr


def test_variants_are_tried_where_there_is_an_llvm(monkeypatch):
    gpu = [Finding("note", "cuda_ad_rgb", "none")]
    monkeypatch.setattr(doctor, "cuda", lambda: gpu)
    monkeypatch.setattr(doctor, "probe", lambda variant: Finding("ok", variant, "tried"))
    for good, text in ((True, "tried"), (False, "not tried, since no usable LLVM was found")):
        built, tried, *rest = doctor.variants(good)
        assert built.subject == "variants" and (tried.subject, tried.text) == ("llvm_ad_rgb", text) and rest == gpu


@pytest.mark.parametrize(("version", "state"), [((3, 11), "ok"), ((3, 12, 1), "ok"), ((3, 10, 9), "problem")])
def test_versions_of_python(monkeypatch, version, state):
    monkeypatch.setattr(doctor, "sys", SimpleNamespace(version_info=version, executable=sys.executable))
    assert doctor.versions()[0].state == state


# -------------------------------------------------------------------------------------------------------------- demo


class Linear(torch.nn.Module):
    """A transient that is a pattern times a colour."""

    def __init__(self, pattern, start):
        super().__init__()
        self.colour, self.pattern, self.seeds = torch.nn.Parameter(torch.tensor(start)), pattern, []
        self.values = {demo.KEY: self.colour}

    def forward(self, seed):
        self.seeds.append(seed)
        return SimpleNamespace(transient=self.pattern * self.colour[:, None, None, None])


@pytest.mark.slow
def test_the_fit_of_a_colour():
    """Means over 2 bins and 8 x 8 pixels, relative to their size and the mean; the way there is kept as numbers."""
    torch.manual_seed(0)
    pattern = torch.rand(3, 4, 16, 24) + 0.1
    truth, start = torch.tensor([0.7, 0.2, 0.9]), [0.4, 0.4, 0.4]
    renderer = Linear(pattern, start)
    fit = demo.fit_colour(renderer, pattern * truth[:, None, None, None], 40)
    means = pattern.reshape(3, 2, 2, 2, 8, 3, 8).mean((2, 4, 6))
    wanted, given = means * truth[:, None, None, None], means * 0.4
    assert fit.losses[0] == pytest.approx(float((((given - wanted) / (wanted + wanted.mean())) ** 2).mean()), rel=1e-5)
    assert fit.colours[0] == pytest.approx(start) and len(fit.losses) == len(fit.colours) == 40
    assert renderer.seeds == list(range(40))
    assert fit.found == pytest.approx(truth.tolist(), abs=0.01) and fit.losses[-1] < 1e-3 * fit.losses[0]
    assert all(type(number) is float for number in fit.found)
    # Colours stay between nothing and all.
    bright = demo.fit_colour(Linear(pattern, [0.9] * 3), pattern * 1.5, 8)
    assert bright.found == [1.0, 1.0, 1.0] and max(max(colour) for colour in bright.colours) == 1.0


@pytest.mark.slow
def test_samples_of_the_demo(monkeypatch, tmp_path):
    """Of the truth sixteen times those of a step; two steps."""
    asked = []
    call, made = tt.TransientRenderer.__call__, tt.render

    def called(self, *arguments, **settings):
        asked.append(settings.get("spp", self.spp))
        return call(self, *arguments, **settings)

    monkeypatch.setattr(tt.TransientRenderer, "__call__", called, raising=False)
    monkeypatch.setattr(
        tt, "render", lambda scene, spp, **more: asked.append(("truth", spp)) or made(scene, spp=2, **more)
    )
    monkeypatch.setattr(tt.vis.FitMonitor, "save", lambda *_: None)
    monkeypatch.setattr("torchtransient.vis.pictures.plot_overview", lambda *_, **__: None)
    arguments = ["demo", "-o", str(tmp_path / "demo"), "--resolution", "8", "--spp", "3", "--steps", "2"]
    with active_variant("llvm_ad_mono"):  # in which the box has no colours
        result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert asked[0] == ("truth", 48)
    assert [spp for spp in asked[1:] if spp != 2] == [3, 3]
