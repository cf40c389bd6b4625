"""Render and draw the picture of docs/data.md, the first samples of its recipe: `python docs/make_data_pictures.py`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "data.md"
OUT = Path(__file__).parent / "images" / "data"
SAMPLES = 12


def main() -> None:
    """The recipe is that of the page's first block."""
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)[0]
    # Not what stands under `if __name__ == "__main__":`.
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(code, str(PAGE), "exec"), names)
    OUT.mkdir(parents=True, exist_ok=True)
    names["recipe"].preview(SAMPLES, OUT / "preview.png")
    print(names["recipe"].cost())


if __name__ == "__main__":
    main()
