"""``python -m tools.gradient_sweep``: run the sweep, write the page."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from tools.gradient_sweep.page import with_rows_of_the_page, write_files
from tools.gradient_sweep.runner import ResultFile, sweep, work
from tools.gradient_sweep.settings import all_settings


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, default=Path("build/gradient_sweep.jsonl"), help="JSON lines, resumed")
    parser.add_argument("--fresh", action="store_true", help="forget results of an earlier run")
    parser.add_argument(
        "--only",
        default="",
        help="regular expression for the names of settings; with --write the page keeps its rows of the others",
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="one round of few samples")
    parser.add_argument("--list", action="store_true", help="names of the settings, and nothing else")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write page and data of what is done, to docs/")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work(arguments.quick)
        return
    chosen = [setting for setting in all_settings() if re.search(arguments.only, setting.name)]
    if arguments.list:
        print("\n".join(setting.name for setting in chosen))
        return
    from tqdm import tqdm

    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    if arguments.fresh:
        arguments.results.unlink(missing_ok=True)
    file = ResultFile(arguments.results)
    done = len(file.done() & {setting.name for setting in chosen})
    with tqdm(total=len(chosen), initial=done, desc="gradients", unit="scene", smoothing=0.05) as bar:
        sweep(chosen, file, arguments.processes, arguments.quick, lambda name: bar.update())
    if arguments.write:
        rows = file.results()
        if arguments.only:
            rows = with_rows_of_the_page(rows, file.done(), arguments.write)
        write_files(rows, arguments.write)


if __name__ == "__main__":
    main()
