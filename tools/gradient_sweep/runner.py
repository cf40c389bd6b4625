"""The sweep as a whole: settings shared out among processes, results in a file of JSON lines that a later run goes on
from.

A process takes a batch of settings of one variant and is then replaced: what a process has loaded stays a target of
its virtual calls. One that dies is replaced too, and the setting that it died of is a result.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tools.gradient_sweep.compare import QUICK, Effort, Result
from tools.gradient_sweep.settings import Setting, all_settings
from tools.gradient_sweep.worker import results_of

ROOT = Path(__file__).parents[2]
BATCH = 24
# A scene has a few dozen parameters of a few seconds each.
SILENCE = 1800.0


class ResultFile:
    """JSON lines: results, and a line ``{"done": setting}`` behind the last one of each setting, with its time."""

    def __init__(self, path: Path):
        self.path = path
        self._lock = threading.Lock()

    def write(self, line: dict[str, Any]) -> None:
        """Append one line."""
        with self._lock, self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def lines(self) -> list[dict[str, Any]]:
        """Read all lines; a last line that was cut off is dropped."""
        found = []
        for line in self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else ():
            try:
                found.append(json.loads(line))
            except json.JSONDecodeError:
                continue
        return found

    def done(self) -> set[str]:
        """Settings that are finished."""
        return {line["done"] for line in self.lines() if "done" in line}

    def results(self) -> list[dict[str, Any]]:
        """Results of finished settings, in the order of the sweep."""
        done, order = self.done(), {setting.name: i for i, setting in enumerate(all_settings())}
        last: dict[tuple[str, str, str], dict[str, Any]] = {}
        for line in self.lines():
            if "key" in line and line["setting"] in done and line["setting"] in order:
                last[line["setting"], line["key"], line["tangent"]] = line
        return sorted(last.values(), key=lambda line: order[line["setting"]])


def batches(settings: Iterable[Setting], size: int = BATCH) -> list[list[Setting]]:
    """Batches of one variant each."""
    by_variant: dict[str, list[Setting]] = {}
    for setting in settings:
        by_variant.setdefault(setting.variant, []).append(setting)
    return [group[i : i + size] for group in by_variant.values() for i in range(0, len(group), size)]


def sweep(
    settings: Sequence[Setting],
    results: ResultFile,
    processes: int = 2,
    quick: bool = False,
    progress: Callable[[str], None] = lambda name: None,
) -> None:
    """Run the settings that the file does not have yet. ``quick``: one round of few samples. ``progress`` is
    called with the name of each setting that is done.
    """
    done = results.done()
    left = [setting for setting in settings if setting.name not in done]
    with ThreadPoolExecutor(processes) as pool:
        for future in [pool.submit(_run_batch, batch, results, quick, progress) for batch in batches(left)]:
            future.result()


def _run_batch(batch: list[Setting], results: ResultFile, quick: bool, progress: Callable[[str], None]) -> None:
    waiting = [setting.name for setting in batch]
    while waiting:
        finished, words = _run_process(waiting, results, quick, progress)
        waiting = waiting[len(finished) :]
        if waiting:
            lost = waiting.pop(0)
            results.write(Result(lost, "", "", "error", note=f"the process died: {words}").as_dict())
            results.write({"done": lost})
            progress(lost)


def _run_process(
    names: list[str], results: ResultFile, quick: bool, progress: Callable[[str], None]
) -> tuple[list[str], str]:
    """The settings that a process has finished, and its last words."""
    module = "tools.gradient_sweep"
    command = [sys.executable, "-m", module, "--worker", *(["--quick"] if quick else [])]
    finished: list[str] = []
    with tempfile.TemporaryFile("w+", encoding="utf-8") as said:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, text=True, encoding="utf-8", cwd=ROOT
        )
        guard = threading.Timer(SILENCE * len(names), process.kill)
        guard.start()
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write("\n".join(names))
        process.stdin.close()
        for text in process.stdout:
            line = json.loads(text)
            results.write(line)
            if "done" in line:
                finished.append(line["done"])
                progress(line["done"])
        process.wait()
        guard.cancel()
        said.seek(0)
        return finished, said.read()[-400:]


def work(quick: bool) -> None:
    """Run a worker process: names of settings from the standard input, JSON lines to the standard output."""
    by_name = {setting.name: setting for setting in all_settings()}
    output = sys.stdout
    sys.stdout = sys.stderr  # what others print must not come between the lines
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.stdin.read().splitlines():
            started, computed = time.monotonic(), time.process_time()
            try:
                for result in results_of(by_name[name], Path(folder), QUICK if quick else Effort()):
                    print(json.dumps(result.as_dict()), file=output, flush=True)
            except Exception as error:  # noqa: BLE001  a scene that cannot be built is a result
                failed = Result(name, "", "", "error", note=f"{type(error).__name__}: {error}")
                print(json.dumps(failed.as_dict()), file=output, flush=True)
            took = {"seconds": time.monotonic() - started, "cpu_seconds": time.process_time() - computed}
            print(json.dumps({"done": name, **took}), file=output, flush=True)
