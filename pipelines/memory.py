"""The most memory a process has held, for the benchmarks that tell it."""

from pathlib import Path


def peak_bytes() -> int | None:
    """Return the largest resident size this process has had; None where there is no /proc."""
    # Not getrusage, whose maximum a child inherits from the process that started it.
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")), None)
