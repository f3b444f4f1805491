"""Fetching a libLLVM that works, where the machine has none."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from render.backend.variant import KNOWN_GOOD, REMEDY, find_llvm, works
from render.shared.errors import InputError
from render.shared.files import cache_folder

PACKAGE = f"libllvm{KNOWN_GOOD}"


def fetch() -> str:
    """Install Debian's libLLVM 19: with apt-get as root, else unpacked into the cache folder.

    Returns:
        What was done, in words.

    Raises:
        InputError: no apt, no network or no such package; the message says what to install.
    """
    if shutil.which("apt-get") is None:
        raise InputError(f"this machine has no apt-get; {REMEDY}")
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        # The lists of a fresh container are empty; an update that fails may still leave usable old lists.
        subprocess.run(["apt-get", "update", "-qq"], capture_output=True, check=False)
        _run(["apt-get", "install", "-y", "-qq", "--no-install-recommends", PACKAGE])
        done = f"installed the Debian package {PACKAGE}"
    else:
        target = cache_folder() / "llvm"
        with tempfile.TemporaryDirectory() as folder:
            _run(["apt-get", "download", "-qq", PACKAGE], cwd=folder)
            target.mkdir(parents=True, exist_ok=True)
            for package in Path(folder).glob("*.deb"):
                _run(["dpkg", "-x", str(package), str(target)])
        done = f"unpacked the Debian package {PACKAGE} into the cache folder"
    found = [path for version, path in find_llvm() if version == KNOWN_GOOD]
    if not found or not works("llvm_ad_rgb", found[0]):
        raise InputError(f"{done}, but {'it does not work' if found else 'no library was found in it'}; {REMEDY}")
    return done


def _run(command: list[str], cwd: str | None = None) -> None:
    """Run a command, turning its failure into one line."""
    result = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if result.returncode:
        lines = (result.stderr or result.stdout).strip().splitlines()
        raise InputError(f"{' '.join(command[:3])} failed ({lines[-1] if lines else 'no message'}); {REMEDY}")
