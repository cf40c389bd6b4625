"""Ten thousand mutants for every reader of files: no signal, no waiting, nothing without a type, no other content."""

from __future__ import annotations

import pytest

from support.mutated_files import run
from support.read_files import READERS

pytestmark = pytest.mark.soak
MUTANTS = dict.fromkeys(READERS, 10_000)


@pytest.mark.parametrize("name", READERS)
def test_ten_thousand_mutants(tmp_path, name):
    report = run([name], tmp_path, MUTANTS[name])[name]
    print(report)  # -s shows it
    assert report.findings == []
    assert report.read + report.refused == MUTANTS[name]
    assert report.refused > MUTANTS[name] / 20
    assert report.grown < 200e6
