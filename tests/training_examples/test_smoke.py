"""Every training example has a small run of the same name; those that need no files run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.sweeps import together

FILES = sorted((Path(__file__).parents[2] / "training_examples").glob("*.py"))
SCRIPTS = [path for path in FILES if '__name__ == "__main__"' in path.read_text(encoding="utf-8")]
# Those that have no test of their own which runs them so.
NO_FILES = ("bottle", "denoise_before_fk", "fit_albedo", "fit_glass_index", "fit_wall")


@pytest.mark.parametrize("part", sorted(set(FILES) - set(SCRIPTS)), ids=lambda path: path.stem)
def test_what_is_no_script_is_shared_by_some(part):
    words = (f"import {part.stem}\n", f"from {part.stem} import ")
    imported = [path.stem for path in FILES if any(word in path.read_text(encoding="utf-8") for word in words)]
    assert imported


@together("script", SCRIPTS, lambda path: path.stem)
def test_the_small_run_is_called_smoke(script):
    text = script.read_text(encoding="utf-8")
    # Of the script, or of a part that it shares with others.
    text += "".join(part.read_text(encoding="utf-8") for part in FILES if f"from {part.stem} import " in text)
    assert '"--smoke"' in text
    assert '"--quick"' not in text


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_every_small_run_is_run(script):
    """Here, or in tests of the script's own."""
    tests = [path for path in Path(__file__).parents[1].rglob("test_*.py") if path != Path(__file__)]
    texts = [path.read_text(encoding="utf-8") for path in tests]
    own = any(f'{script.stem}"' in text or f"{script.stem}.py" in text for text in texts if "--smoke" in text)
    assert own or script.stem in NO_FILES


@pytest.mark.slow
@pytest.mark.parametrize("name", NO_FILES)
def test_the_small_run_leaves_a_picture(name, tmp_path):
    (script,) = (path for path in SCRIPTS if path.stem == name)
    command = [sys.executable, str(script), "--smoke", "--output", str(tmp_path)]
    if name == "fit_glass_index":
        command[-1] += "/fit_glass_index.png"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    pictures = list(tmp_path.glob("*.png"))
    assert pictures
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
