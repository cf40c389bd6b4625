"""A run that is killed again and again, also while it writes a checkpoint, ends with the weights of one that was not
killed.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import textwrap

import pytest
import torch

STEPS, EVERY = 12, 2
SCRIPT = """
    import io, os, random, signal, sys
    from pathlib import Path
    import torch
    from torch import nn
    import torchtransient as tt
    from torchtransient import training
    from tools.small_room import COLOUR, GREY, VARIANT, make_room
    from torchtransient.training import checkpoint

    name, kill_step, kill_where, workers = sys.argv[1:]
    kill_step, workers = int(kill_step), int(workers)
    step = 0

    def die(where):
        if step == kill_step and where == kill_where:
            os.kill(os.getpid(), signal.SIGKILL)

    plain_save, plain_replace = torch.save, os.replace

    def save(content, file):
        whole = io.BytesIO()
        plain_save(content, whole)
        file.write(whole.getvalue()[:2000])
        file.flush()
        die("half written")
        file.write(whole.getvalue()[2000:])
        die("before synchronising")

    def replace(*paths):
        die("before replacing")
        plain_replace(*paths)
        die("after replacing")

    torch.save, checkpoint.os.replace = save, replace

    def main():
        global step
        torch.manual_seed(0)
        renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), [COLOUR, GREY], spp=4)
        network = nn.Sequential(nn.Flatten(), nn.LazyLinear(8), nn.SiLU(), nn.Dropout(0.3), nn.Linear(8, 3))
        vary = {COLOUR: tt.data.Uniform([0.1] * 3, [0.9] * 3)}
        dataset = tt.data.RecipeDataset(tt.data.Recipe(make_room(), vary, spp=4, variant=VARIANT), 10)
        batches = training.Batches(len(dataset), 3)
        loader = batches.loader(dataset, workers=workers, renders=True)
        network(dataset[0]["transient"][None])
        model = nn.ModuleDict({"network": network, "renderer": renderer})
        renderer.values[COLOUR].requires_grad_(False)
        optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, T_max=STEPS)
        noise = torch.Generator().manual_seed(3)
        parts = {"model": model, "optimizer": optimizer, "schedule": schedule, "batches": batches, "noise": noise}
        path, losses, seeds = Path(name), [], training.Seeds(0)
        if path.exists():
            found = training.load_checkpoint(path, parts)
            losses = found.values["losses"]
            assert found.step == batches.step
        first = batches.step
        print("from", first, flush=True)
        for step, batch in zip(range(first, STEPS), loader):
            die("before the step")
            given = batch["transient"] + 0.1 * torch.rand(batch["transient"].shape, generator=noise)
            colour = torch.sigmoid(network(given))
            out = renderer({COLOUR: colour}, seed=seeds(step, batch["index"]))
            loss = tt.losses.squared_loss(out.transient, torch.ones_like(out.transient))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            losses.append(loss.item())
            batches.step = step + 1
            if batches.step % EVERY == 0:
                training.save_checkpoint(path, parts, step=batches.step, values={"losses": losses})
        plain_save({"weights": {k: v for k, v in model.state_dict().items()}, "losses": losses}, name + ".end")

    if __name__ == "__main__":
        with training.ranks(threads=1):
            main()
"""


def start(script, *arguments):
    done = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode in (0, -signal.SIGKILL), done.stderr[-4000:]
    return done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    "workers", [pytest.param(0, marks=pytest.mark.soak), pytest.param(1, marks=pytest.mark.slow)]
)
def test_ends_with_the_weights_of_a_run_that_was_not_stopped(tmp_path, workers):
    script = tmp_path / "run.py"
    text = textwrap.dedent(SCRIPT).replace("STEPS", str(STEPS)).replace("EVERY", str(EVERY))
    script.write_text(text)
    whole, killed = tmp_path / "whole.pt", tmp_path / "killed.pt"
    assert start(script, whole, -1, "nowhere", 0)[0]
    # Each of these once, at random steps that it comes to; a checkpoint is written at every odd one.
    numbers = random.Random(workers)
    wheres = ["before the step", "half written", "before synchronising", "before replacing", "after replacing"]
    numbers.shuffle(wheres)
    begun = []
    for where in wheres if workers == 0 else wheres[:3]:
        done = int(begun[-1]) if begun else 0
        step = numbers.choice([n for n in range(done, min(done + 4, STEPS)) if n % EVERY == 1])
        finished, said = start(script, killed, step, where, workers)
        assert not finished, (where, step)
        begun.append(said.split()[1])
        # What is left is a whole checkpoint, or none yet; what was half written stands beside it.
        parts = list(tmp_path.glob(".killed.pt.*.part"))
        assert bool(parts) == (where not in ("before the step", "after replacing")) or where == "before the step"
    finished, said = start(script, killed, -1, "nowhere", workers)
    assert finished
    assert int(said.split()[1]) > 0, begun
    one, other = (torch.load(f"{path}.end") for path in (whole, killed))
    assert one["losses"] == other["losses"]
    assert len(one["losses"]) == STEPS
    for name, weight in one["weights"].items():
        assert torch.equal(weight, other["weights"][name]), name
