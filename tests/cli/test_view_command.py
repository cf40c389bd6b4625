"""`torchtransient view`: a page of one file or two, and a server for large ones that Ctrl-C ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request

import numpy as np
import pytest
from click.testing import CliRunner

from support import view_cases as cases
from support.sweeps import together
from torchtransient.__main__ import main
from torchtransient.cli import view
from torchtransient.files.result_file import Result, write_result


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, seed in (("a", 0), ("b", 1)):
        light = cases.front(3, seed=seed)
        write_result(f"{name}.h5", Result(light, light.sum(1), cases.AXIS))
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(main, ["view", *map(str, arguments)])


def test_a_page(files):
    done = run("a.h5")
    assert done.exit_code == 0, done.output
    assert (files / "a.html").stat().st_size < 20e6
    assert (files / "a.html").as_uri() in done.output
    assert "Stored in 8 bits" in done.output


def test_two_files(files):
    done = run("a.h5", "b.h5", "-o", "both.html")
    assert done.exit_code == 0, done.output
    text = (files / "both.html").read_text(encoding="utf-8")
    assert "A − B" in text or "\\u2212" in text


@together("arguments, words", [
    (("missing.h5",), "missing.h5"), (("a.h5", "b.h5", "a.h5"), "one file or two"),
    (("a.h5", "-o", "nowhere/a.html"), "nowhere"),
])  # fmt: skip
def test_refusals(files, arguments, words):
    done = run(*arguments)
    assert done.exit_code == 2 and words in done.output


def test_a_large_file_is_served_until_it_is_interrupted(files):
    code = (
        "import sys; from torchtransient.cli import view; view._PAGE_BYTES = 1000;"
        "from torchtransient.__main__ import main; sys.argv = ['torchtransient', 'view', 'a.h5']; main()"
    )
    assert view._PAGE_BYTES > 1e8
    # Commands of a shell may ignore interrupts, which processes hand on.
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", start + code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    try:
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        cube = cases.front(3).numpy()
        for what, expected in (("frame/0/c1/9", cube[1, 9].ravel()), ("curve/0/c2/3/4", cube[2, :, 3, 4])):
            with urllib.request.urlopen(address + what) as answer:
                halves = np.frombuffer(answer.read(), np.uint16)
            # Eight bits of each number's fraction, rounded.
            np.testing.assert_allclose((halves.astype(np.uint32) << 16).view(np.float32), expected, rtol=2**-8)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address.replace(address.split("/")[3], "no-token"))
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=30)
        assert process.returncode == 0
        assert "ended." in rest
        assert "Traceback" not in errors
    finally:
        process.kill()
        process.wait()
