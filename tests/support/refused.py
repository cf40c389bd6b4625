"""How calls refuse values."""

from __future__ import annotations


def complaint(call, errors, value):
    """(whether a call returned, what is wrong with its error), for a call with a value that may be wrong. Right errors
    are of the kinds ``errors``, and of one line.
    """
    try:
        call()
    except errors as error:
        return False, f"{value!r}: {error}" if "\n" in str(error) else ""
    except Exception as error:  # noqa: BLE001 - what is looked for
        return False, f"{value!r}: {type(error).__name__}: {error}"[:160]
    return True, ""
