"""The quick start of the README runs as it stands, and does what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

import torchtransient as tt

VARIANT = "llvm_ad_rgb"
README = Path(__file__).parents[1] / "README.md"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_quick_start(capsys):
    code, _ = blocks("python")
    names: dict[str, object] = {}
    exec(compile(code, str(README), "exec"), names)
    assert "red.reflectance.value" in capsys.readouterr().out
    assert names["out"].transient.shape == (3, 100, 32, 32)
    red, green, _blue = names["renderer"].values["red.reflectance.value"].tolist()
    assert red > 0.42
    assert green < 0.38


def test_data_set(tmp_path, monkeypatch):
    """The second block goes on where the quick start ends, here with four small samples."""
    monkeypatch.chdir(tmp_path)
    _, code = blocks("python")
    for large, small in (("resolution=32", "resolution=8, spp=4"), ("n=1000", "n=4"), ("batch_size=8", "batch_size=4")):
        assert large in code
        code = code.replace(large, small)
    names: dict[str, object] = {"__name__": "__main__", "tt": tt, "torch": torch}
    exec(compile(code, str(README), "exec"), names)
    (batch,) = names["loader"]
    assert batch["transient"].shape == (4, 3, 200, 8, 8) and batch["normals"].shape == (4, 3, 8, 8)


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README.read_text(encoding="utf-8")))))
def test_links_lead_somewhere(link):
    assert (README.parent / link).exists()


def test_commands_exist():
    from torchtransient.cli.main import COMMANDS

    named = set(re.findall(r"torchtransient (\w+)", " ".join(blocks("sh")) + README.read_text(encoding="utf-8")))
    assert {"doctor", "render", "cost", "demo"} <= named
    assert named & set(COMMANDS) == named - {"as"}
