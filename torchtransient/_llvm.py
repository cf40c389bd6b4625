"""Find an LLVM that Dr.Jit can use, before Dr.Jit is imported.

Dr.Jit compiles kernels for the CPU with an LLVM shared library that it looks for once, during `import drjit`. LLVM 15
and 16 are accepted there and then abort the whole process at the first larger kernel on x86-64; 14 and older are
refused. So the search happens here, first: `bind()` points `DRJIT_LIBLLVM_PATH` to a good library and imports Dr.Jit.
No library is loaded to learn its version: the name of its file has it (`libLLVM.so.19.1`), and another process asks
where it does not, which takes 30 ms.

Importing the package never fails for want of an LLVM, since CUDA and scalar variants do without. `ensure_llvm()`
raises the error, and is called wherever an `llvm_*` variant is about to be used. Users who render with Mitsuba alone
never come there: they get a warning at the import.
"""

from __future__ import annotations

import glob
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

from torchtransient.errors import VariantError, VariantWarning

MIN_MAJOR = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"
HOW_TO_INSTALL = (
    "Install one: pip install 'torchtransient[cpu]' (Linux x86-64), or with the system's package manager "
    "(apt install llvm-19, dnf install llvm-libs, brew install llvm, conda install -c conda-forge llvmdev). "
    "`torchtransient doctor` checks the result."
)

# libLLVM-15.so.1, libLLVM-14.0.6.so, libLLVM.so.18.1, libLLVM-17.dylib, libLLVM.dylib, LLVM-C.dll
_NAME = re.compile(
    r"(?:libLLVM|LLVM-C)(?:-(?P<dash>\d+(?:\.\d+)*))?(?:git|rc\d*)?\.(?:so|dylib|dll)(?:\.(?P<dot>\d+(?:\.\d+)*))?$"
)
_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
library.LLVMContextCreate
if not hasattr(library, "LLVMGetVersion"):  # came with LLVM 16
    print(15)
else:
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*(ctypes.byref(n) for n in numbers))
    print(*(n.value for n in numbers), sep=".")
"""


@dataclass(frozen=True)
class LLVMLibrary:
    """LLVM shared library: path, and version `(major, ...)`, empty if unknown."""

    path: str
    version: tuple[int, ...]

    @property
    def is_good(self) -> bool:
        """Dr.Jit can work with the library."""
        return bool(self.version) and self.version[0] >= MIN_MAJOR

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version)) or 'of unknown version'} ({self.path})"


@dataclass
class _Outcome:
    """Result of `bind()`."""

    chosen: LLVMLibrary | None = None
    refused: tuple[LLVMLibrary, ...] = ()
    problem: str | None = None  # why nothing was chosen
    too_late: bool = False  # Dr.Jit had been imported before
    own: str | None = None  # the user's setting of the variable


_outcome = _Outcome()


def bind() -> None:
    """Choose an LLVM and import Dr.Jit with it. Never raises; called once, by the package's `__init__`.

    Where Dr.Jit has one already that would end the process, VariantWarning says so.
    """
    own = _outcome.own = os.environ.get(VARIABLE)
    if "drjit" in sys.modules:
        _outcome.too_late = True
        _warn_of_bound()
        return
    if own:
        _check_own(own)
    else:
        _search()
    if _outcome.chosen is not None:
        # It stays set, so that worker processes which import Mitsuba before us find the same library.
        os.environ[VARIABLE] = _outcome.chosen.path
        import drjit as drjit
    elif _outcome.refused or own:
        # Dr.Jit would take the bad library and abort later. A path that cannot exist switches its LLVM off instead;
        # the user's own setting comes back afterwards.
        os.environ[VARIABLE] = os.path.join(os.sep, "no usable LLVM", "run `torchtransient doctor`")
        try:
            import drjit as drjit
        finally:
            del os.environ[VARIABLE]
            if own:
                os.environ[VARIABLE] = own


def _warn_of_bound() -> None:
    version = _bound_version()
    if version and version[0] < MIN_MAJOR:
        # The line to move is the one that imports this package.
        warnings.warn(_too_late_message(version), VariantWarning, stacklevel=4)


def _bound_version() -> tuple[int, ...]:
    """Return the version of the LLVM that Dr.Jit has bound, empty without one."""
    import drjit as dr

    version = tuple(int(n) for n in dr.detail.llvm_version())
    return version if version[0] > 0 else ()


def users_choice() -> str | None:
    """Return the user's own `DRJIT_LIBLLVM_PATH` from before the package was imported, None if unset."""
    return _outcome.own or None


def ensure_llvm() -> LLVMLibrary:
    """Return the LLVM that Dr.Jit has bound. Called before an `llvm_*` variant is set.

    Raises:
        VariantError: without a usable LLVM; the message says which package to install.
    """
    version = _bound_version()
    if version and version[0] >= MIN_MAJOR:
        path = _outcome.chosen.path if _outcome.chosen else os.environ.get(VARIABLE, "found by Dr.Jit itself")
        return LLVMLibrary(path, version)
    if _outcome.too_late:
        raise VariantError(_too_late_message(version))
    if _outcome.chosen is not None:
        raise VariantError(
            f"llvm variants need LLVM >= {MIN_MAJOR}; {_outcome.chosen} was found but Dr.Jit could not load it "
            f"(its message stands on stderr). {HOW_TO_INSTALL}"
        )
    raise VariantError(_outcome.problem or f"llvm variants need LLVM >= {MIN_MAJOR}. {HOW_TO_INSTALL}")


def _too_late_message(version: tuple[int, ...]) -> str:
    has = f"has bound LLVM {'.'.join(map(str, version))}" if version else "has bound no LLVM"
    _search()
    if _outcome.chosen is not None:
        path = _outcome.chosen.path
        advice = f"Import torchtransient before drjit and mitsuba, or set {VARIABLE}={path} before Python starts."
    else:
        advice = f"Then import torchtransient before drjit and mitsuba. {HOW_TO_INSTALL}"
    return (
        f"llvm variants need LLVM >= {MIN_MAJOR} (older ones abort the process); Dr.Jit was imported before "
        f"torchtransient and {has}. {advice}"
    )


def _check_own(path: str) -> None:
    if not os.path.exists(path):
        _outcome.problem = (
            f"{VARIABLE} is set to '{path}', which does not exist. Expected the path of an LLVM shared library "
            f"(libLLVM.so, version >= {MIN_MAJOR}); unset the variable to let torchtransient search. {HOW_TO_INSTALL}"
        )
        return
    library = LLVMLibrary(os.path.realpath(path), library_version(path))
    if library.is_good:
        _outcome.chosen = library
        return
    _outcome.refused = (library,)
    _outcome.problem = (
        f"llvm variants need LLVM >= {MIN_MAJOR} (older ones abort the process); {VARIABLE} points to {library}. "
        f"Point it to a newer one, or unset it to let torchtransient search. {HOW_TO_INSTALL}"
    )


def _search() -> None:
    refused = []
    for path in candidates():
        library = LLVMLibrary(path, library_version(path))
        if library.is_good:
            _outcome.chosen = library
            return
        refused.append(library)
    _outcome.refused = tuple(refused)
    seen = f"only found {'; '.join(map(str, refused))}" if refused else "found none"
    _outcome.problem = (
        f"llvm variants need LLVM >= {MIN_MAJOR} (older ones abort the process); torchtransient {seen}. "
        f"{HOW_TO_INSTALL}"
    )


def candidates() -> Iterator[str]:
    """Yield paths of LLVM shared libraries in the order of preference, each file once, newest first in a folder."""
    seen: set[str] = set()
    pattern = {"darwin": "libLLVM*.dylib", "win32": "LLVM-C.dll"}.get(sys.platform, "libLLVM*.so*")
    for folder in _folders():
        found = [p for p in glob.glob(os.path.join(folder, pattern)) if _NAME.search(os.path.basename(p))]
        for path in sorted(found, key=_age):
            # The real path: a library finds those it depends on beside itself, and not beside a link to it.
            real = os.path.realpath(path)
            if real not in seen and os.path.isfile(real):
                seen.add(real)
                yield real


def _age(path: str) -> tuple[list[int], str]:
    # Both parts of the path may carry the version: /usr/lib/llvm-19/lib/libLLVM.so, libLLVM.so.23.1
    numbers = _version_in_name(os.path.basename(os.path.realpath(path))) or _version_in_folder(path)
    return [-n for n in numbers] or [1], path


def _folders() -> Iterator[str]:
    """Yield glob patterns of folders: the wheel of this environment, conda, then what distributions use."""
    yield os.path.join(sys.prefix, "lib")
    user_base = os.environ.get("PYTHONUSERBASE") or os.path.join(os.path.expanduser("~"), ".local")
    yield os.path.join(user_base, "lib")
    if "CONDA_PREFIX" in os.environ:
        yield os.path.join(os.environ["CONDA_PREFIX"], "lib")
        yield os.path.join(os.environ["CONDA_PREFIX"], "Library", "bin")
    if sys.platform == "darwin":
        for root in ("/opt/homebrew/opt", "/usr/local/opt"):
            yield f"{root}/llvm/lib"
            yield f"{root}/llvm@*/lib"
        yield "/opt/local/libexec/llvm-*/lib"
    elif sys.platform == "win32":
        yield os.path.join(os.environ.get("PROGRAMFILES", "C:\\Program Files"), "LLVM", "bin")
    else:
        yield "/usr/local/lib"
        yield "/usr/lib/llvm-*/lib"
        yield "/usr/lib/llvm*/lib"
        yield "/usr/lib/llvm/*/lib*"
        yield f"/usr/lib/{os.uname().machine}-linux-gnu"  # not those of cross compilers
        yield "/usr/lib64"
        yield "/usr/lib64/llvm*/lib*"
        yield "/usr/lib"
        yield "/opt/rocm/llvm/lib"


def library_version(path: str) -> tuple[int, ...]:
    """Return the version of an LLVM shared library without loading it into this process; empty if unknown.

    Args:
        path: path of the library.
    """
    real = os.path.realpath(path)
    return _version_in_name(os.path.basename(real)) or _version_by_subprocess(real)


def _version_in_name(name: str) -> tuple[int, ...]:
    match = _NAME.search(name)
    if match is None:
        return ()
    text = match["dash"] or match["dot"] or ""
    numbers = tuple(int(n) for n in text.split(".") if n)
    # libLLVM-15.so.1 carries its version before the suffix; a lone small number after it is an interface number.
    return numbers if numbers and (match["dash"] or numbers[0] >= 8) else ()


def _version_in_folder(path: str) -> tuple[int, ...]:
    match = re.search(r"llvm[-@/]?(\d+(?:\.\d+)*)", os.path.realpath(path))
    return tuple(int(n) for n in match[1].split(".")) if match else ()


def _version_by_subprocess(path: str) -> tuple[int, ...]:
    if not sys.executable:
        return ()
    try:
        result = subprocess.run(
            [sys.executable, "-I", "-S", "-c", _PROBE, path], capture_output=True, text=True, timeout=60, check=True
        )
        return tuple(int(n) for n in result.stdout.strip().split("."))
    except (OSError, subprocess.SubprocessError, ValueError):
        return ()
