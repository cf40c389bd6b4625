"""Threads and processes: training steps per second of one process with N threads and of N processes with one each.

Cornell box of 16 bins, one sample per pixel, colour of a wall: renders, and renders with the sum of squares and its
derivative. N is the number of cores. In the first case torch and Dr.Jit have N threads each (`tt.threads(N)`), in the
second one (`tt.threads(1)`), and in the third one process has a single thread. The processes of a case begin together;
cases take turns.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from _runner import ChildProcess, arguments, environment, interleave, ratio, report, summary
from step_cost import KINDS, start


def crew(processes: int, threads: int, requests: dict[str, Any], variant: str) -> list[ChildProcess]:
    """Workers that have loaded every kind of step."""
    found = [start("torchtransient", variant) for _ in range(processes)]
    for worker in found:
        worker.ask(do="threads", count=threads)
        for name, request in requests.items():
            worker.ask(do="load", name=name, **request)
    return found


def together(workers: list[ChildProcess], name: str, count: int) -> Any:
    """Seconds of one step: those in which all workers have made `count` each, over the number of steps."""

    def run(seed: int) -> float:
        with ThreadPoolExecutor(len(workers)) as pool:
            begin = time.perf_counter()
            list(pool.map(lambda worker: worker.ask(do="step", name=name, seed=seed, count=count), workers))
            return (time.perf_counter() - begin) / (count * len(workers))

    return run


def main() -> None:
    options = arguments(__doc__, peer=False).parse_args()
    repeats = options.repeats or (2 if options.quick else 9)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    names = {f"1 process of {cores}": (1, cores), f"{cores} processes of 1": (cores, 1), "1 process of 1": (1, 1)}
    sizes = (8,) if options.quick else (8, 32, 128)
    requests = {
        f"{resolution}^2, {kind.name}": kind.request(resolution, True) for resolution in sizes for kind in KINDS[:2]
    }
    crews = {name: crew(*shape, requests, options.variant) for name, shape in names.items()}
    cases, ratios = {}, []
    for job in requests:
        count = 3 if options.quick else 10 if job.startswith("128") else 60
        seconds = interleave({f"{job}: {name}": together(crews[name], job, count) for name in names}, repeats)
        cases |= {name: summary(values) for name, values in seconds.items()}
        first, second, third = seconds
        ratios += [ratio(seconds, second, first), ratio(seconds, third, first)]
    for workers in crews.values():
        for worker in workers:
            worker.close()
    results = {"cases": cases, "ratios": ratios, "environment": environment(options.variant)}
    report("thread_cost", {"cores": cores, "repeats": repeats, "quick": options.quick}, results, options.json)


if __name__ == "__main__":
    main()
