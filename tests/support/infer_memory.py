"""Run by a test in a process of its own: infer a folder of photographs, print the peak memory and the time.

Usage: python tests/support/infer_memory.py PHOTOGRAPHS MODELS
"""

import json
import sys
import tempfile
import time

from lab.shared.memory import peak_bytes
from sdps.api import infer, load


def main(folder: str, models: str) -> None:
    """Infer, save, and print one line of JSON."""
    began = time.perf_counter()
    result = infer(load(folder), "sdps", models=models, refine=False)
    with tempfile.TemporaryDirectory() as out:
        result.save(out)
    peak = peak_bytes() / 2**30
    print(json.dumps({"peak_gib": peak, "seconds": time.perf_counter() - began}))  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
