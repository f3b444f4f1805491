"""The peak memory that the benchmarks tell."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell")
ROOT = Path(__file__).resolve().parent.parent


def peak_of(code: str) -> int:
    """Run code in a process of its own and return its peak."""
    code = f"from lab.shared.memory import peak_bytes\n{code}\nprint(peak_bytes())"
    command = [sys.executable, "-c", code]
    return int(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)


def test_the_peak_outlives_what_made_it() -> None:
    assert peak_of("b'1' * 200_000_000") > 200_000_000


def test_a_process_does_not_inherit_its_parents_peak() -> None:
    held = np.ones(25_000_000)
    assert 1e6 < peak_of("") < 0.5 * held.nbytes
