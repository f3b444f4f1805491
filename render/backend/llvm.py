"""Fetching a libLLVM that works, where the machine has none: into the user's cache folder, without root."""

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from render.backend.variant import KNOWN_GOOD, OLDEST, REMEDY, find_llvm, list_unpacked_folders, works
from render.shared.errors import InputError
from render.shared.files import atomic_folder

_PACKAGE = re.compile(r"libllvm(\d+)(?:t64)?")
_TRIED = 3  # versions, at most
_OF_THE_SYSTEM = ("libc6_", "gcc-")  # packages that every machine has, and no other copy may stand in for


def fetch() -> str:
    """Download a libLLVM and what it needs from the distribution, as Debian packages, and unpack them.

    Nothing is installed and the system stays as it is, whoever runs this: apt works on lists of its own.

    Returns:
        What was done, in words.

    Raises:
        InputError: no apt, no network or no such package; the message says what to install.
    """
    if shutil.which("apt-get") is None or shutil.which("dpkg-deb") is None:
        raise InputError(f"libLLVM cannot be fetched (this machine has no apt-get); {REMEDY}")
    target = list_unpacked_folders()[0]
    with tempfile.TemporaryDirectory() as folder:
        settings = _prepare(Path(folder))
        said = _run(["apt-get", *settings, "update"], fail=False)
        names = _packages(_run(["apt-cache", *settings, "pkgnames", "libllvm"], fail=False))
        if not names:
            raise InputError(f"libLLVM cannot be fetched (apt lists none from {OLDEST} on: {_last(said)}); {REMEDY}")
        for name in names[:_TRIED]:
            _unpack(name, target, Path(folder) / "cache" / "archives", settings)
            found = [path for _, path in find_llvm() if path.is_relative_to(target)]
            if found and works("llvm_ad_rgb", found[0]):
                return f"unpacked the package {name} and what it needs into {target}; nothing was installed"
    shutil.rmtree(target, ignore_errors=True)
    raise InputError(f"fetched {', '.join(names[:_TRIED])}, but no test render passed; {REMEDY}")


def _prepare(folder: Path) -> list[str]:
    """Return the options of an apt that has its lists and packages below a folder, and no package installed.

    So it downloads all that a package needs, even what the system has, and takes no lock of the system's.
    """
    for place in ("state/lists/partial", "cache/archives/partial"):
        (folder / place).mkdir(parents=True)
    (folder / "status").touch()
    options = {
        "Dir::State": folder / "state", "Dir::State::status": folder / "status", "Dir::Cache": folder / "cache",
        "Debug::NoLocking": "true", "APT::Sandbox::User": "root", "APT::Update::Post-Invoke": "",
    }  # fmt: skip
    return ["-qq", *(word for key, value in options.items() for word in ("-o", f"{key}={value}"))]


def _packages(listed: str) -> list[str]:
    """Return the packages of a libLLVM that may work, best first, from all their names."""
    found = [(int(match[1]), match[0]) for name in listed.split() if (match := _PACKAGE.fullmatch(name))]
    found = [(version, name) for version, name in found if version >= OLDEST]
    return [name for _, name in sorted(found, key=lambda item: (item[0] != KNOWN_GOOD, -item[0]))]


def _unpack(name: str, target: Path, archives: Path, settings: list[str]) -> None:
    """Download a package and all it needs, and unpack them in place of what was unpacked before."""
    for old in archives.glob("*.deb"):
        old.unlink()
    _run(["apt-get", *settings, "install", "--download-only", "-y", "--no-install-recommends", name])
    with atomic_folder(target) as folder:
        for package in sorted(archives.glob("*.deb")):
            if not package.name.startswith(_OF_THE_SYSTEM):
                _run(["dpkg-deb", "-x", str(package), str(folder)])


def _run(command: list[str], *, fail: bool = True) -> str:
    """Run a command and return what it said; with `fail`, turn its failure into one line."""
    environment = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    result = subprocess.run(
        command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    said = result.stdout + result.stderr
    if result.returncode and fail:
        words = [word for word in command if word[:1] != "-" and "=" not in word]
        raise InputError(f"libLLVM cannot be fetched ({' '.join(words[:2])}: {_last(said)}); {REMEDY}")
    return said


def _last(said: str) -> str:
    """Return the last line of what a command said."""
    return (said.strip().splitlines() or ["no message"])[-1]
