"""Write the table of parameters into docs/gradients.md: `python docs/make_gradients_page.py`; `--check` only compares.

What it says is what the renderer asks (`torchtransient/plugins/parameters.py`), for one of every plugin in llvm_ad_rgb.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "gradients.md"
BEGIN, END = "<!-- parameter-table:begin -->", "<!-- parameter-table:end -->"
VARIANT = "llvm_ad_rgb"
ANY_KEY = "*"
KINDS = ("Shape", "Sensor", "Emitter", "BSDF", "Texture", "Volume", "Medium", "PhaseFunction")


def state_of(effect: Any) -> str:
    """The state of a derivative in a few words."""
    if not effect.supported:
        return "none"
    if effect.biased:
        return "biased"
    return "right"


def why(effect: Any, condition: str = "") -> str:
    """What the state does not say by itself."""
    from torchtransient.plugins.parameter_effect import CORRECT

    reason = effect.reason.removeprefix(CORRECT).removeprefix("; ")
    return "; ".join(part for part in (condition, reason) if part)


def seen_parameters() -> dict[str, dict[tuple[str, str], Any]]:
    """By kind of plugin, what every real-valued parameter of every plugin does: (class, key) -> effect."""
    import mitsuba as mi

    from tools.every_plugin import every_plugin
    from torchtransient.plugins.parameter_effect import lineage
    from torchtransient.plugins.parameters import can_carry_gradients, effect_of

    found: dict[str, dict[tuple[str, str], Any]] = {kind: {} for kind in KINDS}
    with tempfile.TemporaryDirectory() as folder:
        for description in every_plugin(Path(folder)).values():
            params = mi.traverse(mi.load_dict(description))
            for name, (handle, cpptype, node, flags) in params.properties.items():
                kind = next((kind for kind in KINDS if isinstance(node, getattr(mi, kind))), None)
                if kind is None:
                    continue
                value = handle if cpptype is None else mi.get_property(handle, cpptype, node)
                key = name.rsplit(".", 1)[-1]
                effect = effect_of(node, key, flags)
                if can_carry_gradients(value) or effect.stand_in:
                    found[kind].setdefault((lineage(node)[0], key), effect)
                if key == "vertex_positions":  # ours, beside those of Mitsuba
                    found[kind].setdefault((lineage(node)[0], "to_world"), effect_of(node, "to_world"))
    return found


def conditional_rows() -> list[tuple[str, str, str, Any]]:
    """(class, key, condition, effect) of the rows that count under a condition."""
    from torchtransient.plugins.parameter_effect import all_rows

    return [(cls, key, entry.condition, entry.effect) for cls, key, entry in all_rows() if entry.when]


def row(classes: str, key: str, moves: tuple[bool, bool, bool], state: str, reason: str) -> str:
    """One line of the table."""
    name = "any" if key == ANY_KEY else f"`{key}`"
    cells = [classes, name, *("yes" if flag else "-" for flag in moves), state, reason]
    return "| " + " | ".join(cells) + " |"


def moves_of(effect: Any) -> tuple[bool, bool, bool]:
    return effect.moves_length, effect.moves_silhouette, effect.moves_medium


def table() -> str:
    """The generated part of the page."""
    lines = [
        "| class | key | length | silhouette | extinction | derivative | why |",
        "|---|---|---|---|---|---|---|",
    ]
    values: dict[str, list[str]] = {}
    none: dict[str, list[str]] = {}
    for entries in seen_parameters().values():
        rows: dict[tuple[Any, ...], list[str]] = {}
        for (cls, key), effect in entries.items():
            if not effect.supported and not effect.moves:
                none.setdefault(cls, []).append(key)
            elif effect.moves or effect.biased:
                reason = why(effect).replace(f" ({cls})", "")
                rows.setdefault((key, moves_of(effect), state_of(effect), reason), []).append(cls)
            else:
                values.setdefault(cls, []).append(key)
        lines += [row(", ".join(classes), *cells) for cells, classes in rows.items()]
    alike: dict[tuple[Any, ...], list[str]] = {}
    for cls, key, condition, effect in conditional_rows():
        alike.setdefault((key, moves_of(effect), state_of(effect), why(effect, condition)), []).append(cls)
    lines += [row(", ".join(classes), *cells) for cells, classes in alike.items()]
    lines += ["", "Move nothing, and their derivatives are right: " + listed(values) + "."]
    lines += ["", "Move nothing and have no derivative (Mitsuba marks them so): " + listed(none) + "."]
    return "\n".join(lines)


def listed(by_class: dict[str, list[str]]) -> str:
    """Classes with their keys, in one sentence."""
    return "; ".join(f"{cls} " + ", ".join(f"`{key}`" for key in keys) for cls, keys in sorted(by_class.items()))


def page_with(text: str, content: str) -> str:
    """The page with ``text`` between the markers."""
    head, rest = content.split(BEGIN)
    return f"{head}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="fail when the page says something else")
    arguments = parser.parse_args()

    import torchtransient  # noqa: F401, I001  finds an LLVM before Dr.Jit does
    import mitsuba as mi

    from torchtransient import plugins

    mi.set_variant(VARIANT)
    plugins.sync()
    mi.set_log_level(mi.LogLevel.Error)
    old = PAGE.read_text(encoding="utf-8")
    new = page_with(table(), old)
    if arguments.check and new != old:
        print(f"{PAGE}: the table of parameters has changed; run python {Path(__file__).name}", file=sys.stderr)
        return 1
    if not arguments.check:
        PAGE.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
