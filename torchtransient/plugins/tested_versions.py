"""The versions of Mitsuba and Dr.Jit that the tests have run with. Another one is warned of, once in a process.

The integrators follow internals of Mitsuba that no interface promises, and several of its errors are worked around: a
patch release can change a number without a message. `torchtransient doctor` shows the same.
"""

from __future__ import annotations

import warnings

from torchtransient.errors import VersionWarning

# A version comes in here when the whole test set, slow tests included, has passed with it.
TESTED: dict[str, tuple[str, ...]] = {"mitsuba": ("3.9.1",), "drjit": ("1.5.0",)}
_said: set[str] = set()


def untested(name: str, version: str) -> str | None:
    """What to say of `version` of the package `name`; None of a tested one, and of a package that is not listed.

    Builds of a tested version, such as "1.5.0+local", are tested ones.
    """
    tested = TESTED.get(name)
    if tested is None or version.partition("+")[0] in tested:
        return None
    return (
        f"{name} {version} was never tested with this version of torchtransient; tested: {', '.join(tested)}. Numbers "
        f"may differ without an error: run the tests, or pip install {name}=={tested[-1]}."
    )


def warn_of_untested() -> None:
    """Give a `VersionWarning` that names each of the two packages whose version is not a tested one: once in a process,
    also where the warning is raised as an error.
    """
    import drjit
    import mitsuba

    found = {"mitsuba": mitsuba.__version__, "drjit": drjit.__version__}
    messages = [message for name, version in found.items() if (message := untested(name, version)) is not None]
    text = " ".join(messages)
    if text and text not in _said:
        _said.add(text)
        warnings.warn(text, VersionWarning, stacklevel=4)
