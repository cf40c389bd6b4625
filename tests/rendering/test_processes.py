"""Other processes: spawned data loaders, distributed training, pickles that travel."""

from __future__ import annotations

import pickle
import subprocess
import sys
import textwrap

import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room


def run(script: str, *arguments: str) -> str:
    """Run a script file's text in a fresh interpreter; returns what it prints."""
    result = subprocess.run(
        [sys.executable, *arguments, "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-4000:]
    return result.stdout.strip()


@pytest.mark.slow
def test_a_fresh_process_gives_the_same_tensor_and_takes_a_pickle(tmp_path, room_scene):
    plain = tt.render(room_scene, spp=16, seed=1).transient
    renderer = tt.TransientRenderer(room_scene, parameters=[COLOUR], spp=16)
    with torch.no_grad():
        renderer.values[COLOUR].mul_(0.5)
    (tmp_path / "renderer.pkl").write_bytes(pickle.dumps(renderer))
    torch.save(renderer(seed=2).transient.detach().contiguous(), tmp_path / "expected.pt")
    total, squares, *printed = run(f"""
        import torchtransient as tt
        from tools.small_room import make_room
        out = tt.render(make_room(), spp=16, seed=1).transient
        print(repr(out.double().sum().item()), repr(out.double().square().sum().item()))
        import pickle, torch
        renderer = pickle.loads(open({str(tmp_path / "renderer.pkl")!r}, "rb").read())
        out = renderer(seed=2).transient
        out.sum().backward()
        expected = torch.load({str(tmp_path / "expected.pt")!r})
        print(torch.equal(out.detach(), expected), len(list(renderer.parameters())))
    """).split()
    assert printed == ["True", "1"]
    # Threads add to a bin in any order: the last bits may differ between processes.
    torch.testing.assert_close(float(total), plain.double().sum().item(), rtol=1e-6, atol=0)
    torch.testing.assert_close(float(squares), plain.double().square().sum().item(), rtol=1e-6, atol=0)
    assert make_room()["sensor"]["film"]["temporal_bins"] == plain.shape[1]


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
    result = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=240, check=False)
    assert result.returncode == 0, result.stderr[-4000:]
    assert result.stdout.strip() == "[(2, 3, 24, 3, 4), (2, 3, 24, 3, 4)] True"


@pytest.mark.slow
def test_distributed_data_parallel_on_two_ranks(tmp_path):
    script = tmp_path / "ddp.py"
    script.write_text(
        textwrap.dedent(f"""
        import sys
        import torch
        import torch.distributed as dist
        import torch.multiprocessing as mp
        import torchtransient as tt
        from torch.nn.parallel import DistributedDataParallel
        from tools.small_room import COLOUR, make_room

        def gradient(renderer, seed, wrap):
            module = DistributedDataParallel(renderer) if wrap else renderer
            module(seed=seed).transient.square().sum().backward()
            return renderer.values[COLOUR].grad.clone()

        def make():
            return tt.TransientRenderer(tt.load(make_room(), variant={VARIANT!r}), parameters=[COLOUR], spp=16)

        def work(rank, store):
            torch.set_num_threads(1)
            dist.init_process_group("gloo", init_method="file://" + store, rank=rank, world_size=2)
            torch.save(gradient(make(), rank, wrap=True), store + f".{{rank}}")
            dist.destroy_process_group()

        if __name__ == "__main__":
            store = sys.argv[1]
            mp.spawn(work, args=(store,), nprocs=2)
            found = [torch.load(store + f".{{rank}}") for rank in range(2)]
            expected = (gradient(make(), 0, wrap=False) + gradient(make(), 1, wrap=False)) / 2
            same = torch.equal(found[0], found[1]) and torch.allclose(found[0], expected, rtol=1e-4)
            print(same, bool(expected.abs().min() > 0))
        """)
    )
    command = [sys.executable, str(script), str(tmp_path / "store")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert result.returncode == 0, result.stderr[-4000:]
    assert result.stdout.strip() == "True True"
