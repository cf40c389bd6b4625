"""Every training example has a small run of the same name, which a test runs."""

from __future__ import annotations

from pathlib import Path

from support.examples import FOLDER
from support.sweeps import together

FILES = sorted(FOLDER.glob("*.py"))
SCRIPTS = [path for path in FILES if '__name__ == "__main__"' in path.read_text(encoding="utf-8")]


@together("part", sorted(set(FILES) - set(SCRIPTS)))
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


@together("script", SCRIPTS, lambda path: path.stem)
def test_every_small_run_is_run(script):
    texts = [path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py")]
    names = (f'small_run("{script.stem}"', f'example("{script.stem}")', f"{script.stem}.py")
    assert any(name in text for text in texts for name in names)
