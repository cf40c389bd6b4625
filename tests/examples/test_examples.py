"""The training examples run, and their errors fall, at sizes that take seconds."""

import importlib.util
import sys
import tarfile
from pathlib import Path
from types import ModuleType

import mitsuba as mi
import numpy as np
import pytest
import torch

FOLDER = Path(__file__).parents[2] / "training_examples"


def example(name: str) -> ModuleType:
    """One of the example scripts as a module."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)

    sys.modules[name] = module  # dataclasses look their module up while they are made
    spec.loader.exec_module(module)
    return module


def check_line_and_picture(name: str, folder: Path, printed: str) -> None:
    lines = printed.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"{name}: ")
    assert (folder / f"{name}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_fit_albedo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mi.set_variant("llvm_ad_rgb")  # the example's own: with another one active, every step would switch to and fro
    sizes = ["--steps", "14", "--spp", "16", "--resolution", "16", "--target-spp", "256", "--output"]
    fit = example("fit_albedo").main([*sizes, str(tmp_path)])
    check_line_and_picture("fit_albedo", tmp_path, capsys.readouterr().out)
    before, after = (albedos - fit.truth for albedos in (fit.albedos[0], fit.albedos[-1]))
    assert float(after.abs().mean()) < 0.4 * float(before.abs().mean())


@pytest.mark.slow
def test_fit_wall(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mi.set_variant("llvm_ad_mono")
    sizes = ["--steps", "60", "--spp", "16", "--resolution", "6", "--target-spp", "1024", "--output"]
    fit = example("fit_wall").main([*sizes, str(tmp_path)])
    check_line_and_picture("fit_wall", tmp_path, capsys.readouterr().out)
    assert fit.distance_errors[0] == pytest.approx(0.3)
    assert fit.distance_errors[-1] < 0.005
    assert fit.tilt_errors[-1] < 0.25


def test_the_wall_fit_cannot_see_brightness() -> None:
    mi.set_variant("llvm_ad_mono")
    module = example("fit_wall")
    renderer = module.wall_renderer(0.5, 4)
    pose = module.wall_to_world(torch.tensor(4.1), torch.tensor(3.0))
    transient = renderer({module.KEY: pose}, seed=0, spp=16).transient
    brightness = torch.rand((4, 4), generator=torch.Generator().manual_seed(0)) + 0.1
    measured, dimmed = (module.mean_arrival(cube, renderer.axis) for cube in (transient, transient * brightness))
    torch.testing.assert_close(measured, dimmed, rtol=1e-6, atol=1e-6)


FLOOR_SCENE = """<scene version="3.0.0">
    <default name="resx" value="9"/> <default name="resy" value="16"/> <default name="max_depth" value="3"/>
    <integrator type="transient_path">
        <integer name="max_depth" value="$max_depth"/> <boolean name="camera_unwarp" value="true"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="30"/>
        <transform name="to_world"><lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="transient_hdr_film">
            <integer name="width" value="$resx"/> <integer name="height" value="$resy"/>
            <integer name="temporal_bins" value="400"/> <float name="bin_width_opl" value="0.1"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <bsdf type="twosided" id="WoodFloorBSDF"><bsdf type="diffuse">
        <texture name="reflectance" type="bitmap"><string name="filename" value="textures/floor.png"/></texture>
    </bsdf></bsdf>
    <shape type="rectangle" id="floor"><ref id="WoodFloorBSDF"/></shape>
    <emitter type="point"><point name="position" value="0.5, 0, 7.2"/><rgb name="intensity" value="50"/></emitter>
</scene>
"""


@pytest.mark.slow
def test_staircase_with_a_floor_in_place_of_the_house(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The archive of the staircase is not part of the project: this one has its layout, names and flight times."""
    mi.set_variant("llvm_ad_rgb")
    source = tmp_path / "house"
    (source / "textures").mkdir(parents=True)
    (source / "scene.xml").write_text(FLOOR_SCENE)
    # Smooth ramps, one way for red, the other for green: blocks of texels can say them without an error of their own.
    ramp = np.linspace(60, 220, 60)
    colours = np.stack(np.broadcast_arrays(ramp[:, None], ramp[None, :], 140.0), axis=-1)
    mi.Bitmap(colours.astype(np.uint8)).write(str(source / "textures" / "floor.png"))
    archive = tmp_path / "house.tar.gz"
    with tarfile.open(archive, "w:gz") as tar:
        tar.add(source, "house")
    sizes = ["--smoke", "--resolution", "9", "--spp", "64", "--spp-step", "16", "--steps", "20", "--max-depth", "3"]
    recovery = example("staircase").main([str(archive), *sizes, "--output", str(tmp_path / "pictures")])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("staircase: ")
    assert recovery.errors[0] > 0.1
    assert recovery.errors[-1] < 0.25 * recovery.errors[0]
    for name in ("light", "gradient", "recovery"):
        assert (tmp_path / "pictures" / f"staircase_{name}.png").stat().st_size > 2_000  # one panel, with --smoke
    assert (tmp_path / "pictures" / "staircase_light.gif").read_bytes().startswith(b"GIF")


@pytest.mark.slow
def test_bottle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mi.set_variant("llvm_ad_rgb")
    module = example("bottle")
    out = module.main(["--height", "24", "--spp", "8192", "--max-depth", "6", "--output", str(tmp_path)])
    assert capsys.readouterr().out.splitlines()[-1].startswith("bottle: the pulse rises at 0.")
    for name in ("bottle.mp4", "bottle_frames.png", "bottle_peak.png"):
        assert (tmp_path / name).stat().st_size > 2_000  # one panel, with --smoke
    # Slower than in vacuum: the index of water, and what scatters stays behind. The mean of 12 such renders is .775,
    # one deviates by .033: four times that.
    assert 0.64 < module.speed_of_rise(out) < 0.91
