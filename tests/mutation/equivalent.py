"""Changes that no test can notice, each with the reason: they are not counted.

Read from ``equivalent.txt``: the file, the lines of the change, and a line of proof that begins with ``=``; entries are
divided by empty lines.
"""

from __future__ import annotations

from pathlib import Path


def proofs() -> dict[tuple[str, str], str]:
    """The reasons by (path, changed lines)."""
    found = {}
    text = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8")
    for entry in text.strip().split("\n\n"):
        path, *lines, proof = entry.split("\n")
        if not proof.startswith("= ") or not lines or not all(line[:1] in "+-" for line in lines):
            raise ValueError(f"equivalent.txt: expected a path, lines of a change and '= proof', got {entry!r}.")
        found[path, "\n".join(lines)] = proof[2:]
    return found
