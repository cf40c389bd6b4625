"""Which variant a scene is built in, that the user's own choice is left alone, and other processes."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import mitsuba as mi
import pytest
import torch

import torchtransient as tt  # isort: skip

from tools.small_room import COLOUR, VARIANT


def run(script: str, *arguments: str) -> str:
    """Run a script, or what the arguments name, in a fresh interpreter; returns what it prints."""
    command = [sys.executable, *(arguments or ("-c", textwrap.dedent(script)))]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout.strip()


def test_import_scenes_and_load_need_no_variant():
    """Nor is anything said of the versions that are installed here."""
    printed = run("""
        import warnings
        import torchtransient as tt
        from torchtransient.errors import VersionWarning
        from tools.small_room import make_room
        warnings.simplefilter("error", VersionWarning)
        import mitsuba as mi
        assert mi.variant() is None
        tt.scenes.cornell_box()
        tt.scenes.nlos_room()
        assert mi.variant() is None
        scene = tt.load(make_room())
        assert mi.variant() is None
        renderer = tt.TransientRenderer(scene, spp=4)
        import sys
        compiler = "torch._dynamo" in sys.modules
        print(float(renderer(seed=0).steady.sum()) > 0, scene.variant, mi.variant())
        print("torch._dynamo" in sys.modules, compiler)
    """)
    # With no variant active there is none to go back to: the scene's stays. Nor does a render import torch's compiler.
    assert printed == "True llvm_ad_rgb llvm_ad_rgb\nFalse False"


def test_other_active_variant_is_restored_and_does_not_matter(room_scene):
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=16)

    def run_once():
        x = renderer.values[COLOUR].detach().clone().requires_grad_()
        out = renderer({COLOUR: x}, seed=0).transient
        during = mi.variant()
        out.square().sum().backward()
        return out.detach(), x.grad, during

    with mi.variant_context(VARIANT):
        expected, slope, _ = run_once()
    with mi.variant_context("llvm_ad_mono"):
        for _ in range(2):
            out, other_slope, during = run_once()
            assert during == "llvm_ad_mono" and mi.variant() == "llvm_ad_mono"
            assert torch.equal(out, expected)
            torch.testing.assert_close(other_slope, slope)


def test_variant_is_restored_after_an_error(room):
    room["wall"]["type"] = "rectangel"
    with mi.variant_context("llvm_ad_mono"):
        with pytest.raises(tt.errors.SceneError, match="rectangel"):
            tt.TransientRenderer(tt.load(room, variant=VARIANT))
        assert mi.variant() == "llvm_ad_mono"


@pytest.mark.slow
def test_fork_before_rendering_is_fine_and_after_it_is_refused():
    printed = run("""
        import os, torchtransient as tt
        from tools.small_room import make_room
        scene = tt.load(make_room())
        child = os.fork()
        if child == 0:
            os._exit(0 if float(tt.render(scene, spp=4, seed=0).steady.sum()) > 0 else 1)
        before = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        renderer = tt.TransientRenderer(scene, spp=4)
        renderer(seed=0)
        child = os.fork()
        if child == 0:
            try:
                renderer(seed=0)
            except tt.errors.VariantError as error:
                os._exit(7 if "spawn" in str(error) else 8)
            os._exit(9)
        print(before, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """)
    assert printed == "0 7"


@pytest.mark.slow
def test_spawned_data_loader(tmp_path):
    # A script of its own: spawned workers import the main module anew.
    script = tmp_path / "loader.py"
    script.write_text(
        textwrap.dedent(f"""
        import torch
        import torchtransient as tt
        from torch.utils.data import DataLoader, Dataset
        from tools.small_room import COLOUR, make_room

        class Rooms(Dataset):
            def __init__(self):
                scene = tt.load(make_room(), variant={VARIANT!r})
                self.renderer = tt.TransientRenderer(scene, parameters=[COLOUR], spp=16)

            def __len__(self):
                return 4

            def __getitem__(self, index):
                with torch.no_grad():
                    colour = torch.full((3,), 0.2 * (index + 1))
                    return self.renderer({{COLOUR: colour}}, seed=index).transient

        if __name__ == "__main__":
            rooms = Rooms()
            loader = DataLoader(rooms, batch_size=2, num_workers=1, multiprocessing_context="spawn")
            batches = list(loader)
            expected = torch.stack([rooms[i] for i in range(4)])
            print([tuple(b.shape) for b in batches], torch.allclose(torch.cat(batches), expected, rtol=1e-4, atol=1e-6))
        """)
    )
    assert run("", str(script)) == "[(2, 3, 24, 3, 4), (2, 3, 24, 3, 4)] True"
