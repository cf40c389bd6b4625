"""An LLVM that Dr.Jit can use is found before Dr.Jit is imported, and a bad one never ends the process."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap

import pytest

from torchtransient import _llvm


def write_library(path):
    """A file by the name of an LLVM, which cannot be loaded."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"not a library")
    return path


def run(code, root, **variables):
    """Run code in a Python that sees the folder `root` as the root of the file system when it searches for LLVM."""
    prologue = f"""
        import glob
        real = glob.glob
        glob.glob = lambda pattern, **options: real({str(root)!r} + pattern, **options)
    """
    environment = {k: v for k, v in os.environ.items() if k != _llvm.VARIABLE} | variables
    command = [sys.executable, "-c", textwrap.dedent(prologue) + textwrap.dedent(code)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)


REFUSED = """
    import torchtransient
    from torchtransient import _llvm
    import mitsuba as mi
    try:
        mi.set_variant("llvm_ad_rgb")
    except ImportError:
        print("inactive")
    try:
        _llvm.ensure_llvm()
    except torchtransient.errors.VariantError as error:
        print(error)
    mi.set_variant("scalar_rgb")
    print(torchtransient.plugins.sync())
"""


def good_library():
    return _llvm.ensure_llvm().path


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so", (15,)),
        ("libLLVM-16.0.6.so.1", (16, 0, 6)),
        ("libLLVM.so.23.1", (23, 1)),
    ],
)
def test_version_from_the_name_of_the_file(tmp_path, name, version):
    path = write_library(tmp_path / name)
    (tmp_path / "link.so").symlink_to(path)
    assert _llvm.library_version(str(path)) == _llvm.library_version(str(tmp_path / "link.so")) == version


@pytest.mark.skipif(sys.platform != "linux", reason="folders of Debian")
def test_a_library_for_another_processor_is_passed_over(tmp_path):
    other = "powerpc64le" if os.uname().machine != "powerpc64le" else "x86_64"
    write_library(tmp_path / f"usr/lib/{other}-linux-gnu/libLLVM-19.so.1")
    result = run("import torchtransient\nprint(*torchtransient._llvm.candidates())", tmp_path)
    assert result.returncode == 0 and str(tmp_path) not in result.stdout, result.stderr


def test_search_finds_a_distribution_library_beside_an_older_one(tmp_path):
    write_library(tmp_path / f"usr/lib/{os.uname().machine}-linux-gnu/libLLVM-15.so.1")
    good = tmp_path / "usr/lib/llvm-19/lib/libLLVM.so"
    good.parent.mkdir(parents=True)
    good.symlink_to(good_library())
    result = run(
        "import torchtransient, os\nprint(torchtransient._llvm.ensure_llvm().path, os.environ['DRJIT_LIBLLVM_PATH'])",
        tmp_path,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [good_library()] * 2


def test_only_an_old_library_switches_llvm_off_instead_of_ending_the_process(tmp_path):
    old = write_library(tmp_path / "usr/lib/llvm-14/lib/libLLVM-14.so.1")
    result = run(REFUSED, tmp_path)
    assert result.returncode == 0, result.stderr
    inactive, message, scalar = result.stdout.strip().splitlines()
    assert inactive == "inactive"
    assert f"LLVM >= 17 (older ones abort the process); torchtransient only found LLVM 14 ({old})" in message
    assert "pip install 'torchtransient[cpu]'" in message
    assert scalar == "scalar_rgb"


@pytest.mark.slow
def test_no_library_at_all(tmp_path):
    # Dr.Jit would search by itself; it is sent to an empty place, as on a machine without any LLVM.
    code = REFUSED.replace("import torchtransient\n", "import drjit, torchtransient\n", 1)
    result = run(code, tmp_path, DRJIT_LIBLLVM_PATH=str(tmp_path / "nothing"))
    assert result.returncode == 0, result.stderr
    inactive, message, scalar = result.stdout.strip().splitlines()
    assert inactive == "inactive"
    assert "Dr.Jit was imported before torchtransient and has bound no LLVM" in message
    assert "pip install" in message
    assert scalar == "scalar_rgb"


@pytest.mark.slow
@pytest.mark.parametrize("exists", [True, False])
def test_the_users_own_choice_is_refused_and_left_as_it_was(tmp_path, exists):
    path = tmp_path / "mine" / "libLLVM-16.so.1"
    if exists:
        write_library(path)
    result = run(
        REFUSED + "\n    import os; print(os.environ['DRJIT_LIBLLVM_PATH'])", tmp_path, DRJIT_LIBLLVM_PATH=str(path)
    )
    assert result.returncode == 0, result.stderr
    inactive, message, _scalar, variable = result.stdout.strip().splitlines()
    assert inactive == "inactive"
    assert variable == str(path)
    expected = f"points to LLVM 16 ({path})" if exists else f"'{path}', which does not exist"
    assert expected in message


@pytest.mark.slow
def test_a_library_that_dr_jit_cannot_load_is_reported(tmp_path):
    fake = write_library(tmp_path / "usr/lib/llvm-19/lib/libLLVM.so.19.1")
    result = run(REFUSED, tmp_path)
    assert result.returncode == 0, result.stderr
    assert f"LLVM 19.1 ({fake}) was found but Dr.Jit could not load it" in result.stdout


@pytest.mark.slow
def test_dr_jit_imported_first_with_an_old_library_is_warned_of_at_the_import(tmp_path):
    code = """
        import warnings
        import mitsuba, drjit
        drjit.detail.llvm_version = lambda: (16, 0, 6)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            import torchtransient
            import torchtransient.errors
        print(len(caught), caught[0].category.__name__, caught[0].filename)
        print(caught[0].message)
    """
    result = run(code, tmp_path)
    assert result.returncode == 0, result.stderr
    first_line, message = result.stdout.strip().splitlines()[-2:]
    assert first_line == "1 VariantWarning <string>"
    assert "imported before torchtransient and has bound LLVM 16.0.6" in message
    assert "import torchtransient before drjit and mitsuba" in message
