"""Memory of this machine that can still be taken, and sizes in words."""

from __future__ import annotations

from pathlib import Path


def available_memory() -> int | None:
    """Return the bytes that this process can still take, within the limit of its container; None if the system has
    no figure.
    """
    limits = [limit for limit in (_meminfo_available(), _cgroup_available()) if limit is not None]
    return min(limits) if limits else None


def size_in_words(count: float) -> str:
    """Return bytes in words, "1.5 GiB".

    Args:
        count: number of bytes.
    """
    for unit, scale in (("TiB", 2**40), ("GiB", 2**30), ("MiB", 2**20)):
        if count >= scale:
            return f"{count / scale:.4g} {unit}"
    return f"{count / 2**10:.4g} KiB"


def _meminfo_available() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    for line in lines:
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _cgroup_available() -> int | None:
    root = Path("/sys/fs/cgroup")
    try:
        limit = (root / "memory.max").read_text(encoding="ascii").strip()
        used = int((root / "memory.current").read_text(encoding="ascii"))
        cache = 0
        for line in (root / "memory.stat").read_text(encoding="ascii").splitlines():
            if line.startswith("inactive_file "):
                cache = int(line.split()[1])
    except (OSError, ValueError):
        return None
    return None if limit == "max" else max(0, int(limit) - used + cache)
