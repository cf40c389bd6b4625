"""Two processes of torchrun: the gradient of one rank on the joined batch, one run whatever the number of ranks."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest
import torch

SCRIPT = """
    import sys
    import torch
    import torch.distributed as dist
    from torch import nn
    from torch.nn.parallel import DistributedDataParallel
    import torchtransient as tt
    from tools.small_room import COLOUR, GREY, VARIANT, make_room

    class Proposer(nn.Module):
        def __init__(self):
            super().__init__()
            torch.manual_seed(0)
            self.network = nn.Sequential(nn.Linear(5, 8), nn.SiLU(), nn.Linear(8, 3))
            # A parameter of the scene beside the network, in the same module.
            self.renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), [COLOUR, GREY], spp=8)
            # Replaced in every call: DDP would wait for its gradient.
            self.renderer.values[COLOUR].requires_grad_(False)

        def forward(self, measured, seeds):
            return self.renderer({COLOUR: torch.sigmoid(self.network(measured))}, seed=seeds)

    def loss_of(model, samples, step=0):
        measured = torch.randn(64, 5, generator=torch.Generator().manual_seed(1))[samples]
        out = model(measured, tt.training.Seeds(4)(step, samples))
        return out.transient.square().sum((1, 2, 3, 4)).mean()

    def gradients(model):
        return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}

    folder = sys.argv[1]
    with tt.training.ranks(threads=1) as ranks:
        model = Proposer()
        batches = tt.training.Batches(64, 8, rank=ranks.rank, world_size=ranks.size)
        wrapped = DistributedDataParallel(model) if ranks.size > 1 else model
        loss = loss_of(wrapped, batches.samples(0))
        loss.backward()
        found = {"loss": ranks.mean(loss.item()), "gradients": gradients(model)}
        if ranks.size == 1:
            # What float sums can lose is a share of the magnitudes of their terms: of every sample alone.
            magnitude = {}
            for sample in batches.samples(0):
                model.zero_grad()
                (loss_of(model, [sample]) / 8).backward()
                for name, value in gradients(model).items():
                    magnitude[name] = magnitude.get(name, 0) + value.abs()
            found["magnitude"] = magnitude
        # Parts of a rank's batch: exchanged once.
        model.zero_grad()
        own = batches.samples(0)
        half = len(own) // 2
        exchanged = []
        if ranks.size > 1:
            def counted(state, bucket):
                exchanged.append(1)
                gathered = dist.all_reduce(bucket.buffer().div_(ranks.size), async_op=True).get_future()
                return gathered.then(lambda future: future.value()[0])
            wrapped.register_comm_hook(None, counted)
        parts = [own[:half], own[half:]]
        tt.training.accumulate(lambda part: loss_of(wrapped, part), parts, model=wrapped)
        found |= {"in parts": gradients(model), "exchanges": len(exchanged)}
        # A few steps, a checkpoint by all ranks and more steps.
        optimizer = torch.optim.SGD(model.parameters(), lr=1e-3)
        for step in range(1, 4):
            optimizer.zero_grad()
            loss_of(wrapped, batches.samples(step), step).backward()
            optimizer.step()
        torch.manual_seed(100 + ranks.rank)
        noise = torch.Generator().manual_seed(200 + ranks.rank)
        parts = {"model": wrapped, "optimizer": optimizer, "batches": batches, "noise": noise}
        path = f"{folder}/run-{ranks.size}.pt"
        tt.training.save_checkpoint(path, parts, step=4)
        drawn = [torch.rand(1).item(), torch.rand(1, generator=noise).item()]
        tt.training.load_checkpoint(path, parts)
        found["same random numbers"] = [torch.rand(1).item(), torch.rand(1, generator=noise).item()] == drawn
        found["drawn"] = drawn
        found["weights"] = {name: p.detach() for name, p in model.named_parameters()}
        # What goes wrong in one rank is told to all: none waits for the others.
        found["refused"] = []
        odd = {"odd": object() if ranks.rank == ranks.size - 1 else 0}
        for where, values in ((path, odd), (f"{folder}/no/x.pt", {})):
            try:
                tt.training.save_checkpoint(where, parts, step=5, values=values)
            except tt.errors.StorageError as error:
                found["refused"].append(str(error))
        torch.save(found, f"{folder}/{ranks.size}-{ranks.rank}.pt")
"""
EPS = torch.finfo(torch.float32).eps


@pytest.mark.slow
def test_two_ranks_are_one_rank_on_the_joined_batch(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(textwrap.dedent(SCRIPT))
    for count in (1, 2):
        torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
        command = [*torchrun, str(script), str(tmp_path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
        assert done.returncode == 0, done.stderr[-4000:]
    one, first, second = (torch.load(tmp_path / f"{name}.pt") for name in ("1-0", "2-0", "2-1"))
    assert one["loss"] == pytest.approx(first["loss"], rel=16 * EPS)
    assert first["loss"] == second["loss"]
    names = one["gradients"].keys()
    # Values, network and the wall's paint; not the colour that the network proposes.
    assert len(names) == 5
    for name in names:
        bound = 16 * EPS * one["magnitude"][name]  # 8 samples, 2 ranks, a mean: at most 16 roundings of each term
        for kind in ("gradients", "in parts"):
            assert torch.equal(first[kind][name], second[kind][name])
            assert ((first[kind][name] - one["gradients"][name]).abs() <= bound).all(), (kind, name)
        assert (one["gradients"][name].abs() > 100 * bound).any(), name
    # One bucket, at the last of two parts.
    assert (first["exchanges"], one["exchanges"]) == (1, 0)
    for name, weight in first["weights"].items():
        assert torch.equal(weight, second["weights"][name])
        torch.testing.assert_close(weight, one["weights"][name], rtol=1e-4, atol=1e-5)
    # Each rank's own random numbers come back.
    assert first["same random numbers"]
    assert second["same random numbers"]
    assert set(first["drawn"]).isdisjoint(second["drawn"])
    assert "values['odd'] is a object" in one["refused"][0] and one["refused"][1].count("cannot be written") == 1
    assert "was not written. rank 1: " in first["refused"][0] and "values['odd'] is a object" in second["refused"][0]
    assert first["refused"][1] == second["refused"][1] == one["refused"][1]
