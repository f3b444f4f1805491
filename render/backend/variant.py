"""Choosing the Mitsuba variant and its libLLVM before mitsuba is imported.

Dr.Jit takes the first libLLVM it finds, and versions 14 to 16 abort the whole process on CPUs with
AVX-512 ("Cannot select ... fminimum"), which no Python code can catch. So the library is chosen here:
19 is known to work, other versions from 17 on are tried in a process of their own first.
"""

import ctypes
import functools
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from render.shared.errors import InputError
from render.shared.files import cache_folder, users_cache_folder

KNOWN_GOOD = 19
OLDEST = 17
REMEDY = (
    "install libLLVM 19 (Debian, Ubuntu: sudo apt-get install libllvm19; Fedora: sudo dnf install llvm-libs; "
    "macOS: brew install llvm@19) or set DRJIT_LIBLLVM_PATH to its .so file"
)
_SEARCH = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
)
_PROBE = """
import ctypes, sys
for path in sys.argv[2:]:
    ctypes.CDLL(path)
import mitsuba as mi, drjit as dr
mi.set_variant(sys.argv[1])
scene = mi.load_dict({"type": "scene", "s": {"type": "sphere"}})
x = dr.arange(mi.Float, 64) / 64
ray = mi.Ray3f(mi.Point3f(x, dr.minimum(x, 0.5), 5), mi.Vector3f(0, 0, -1))
assert dr.count(scene.ray_test(ray))[0] > 0
"""
_MISSING = re.compile(r"(\S+\.so[.\d]*): cannot open shared object file")


@dataclass(frozen=True)
class Choice:
    """What `choose` decided: the Mitsuba variant, the libLLVM path (or None) and why, in words."""

    variant: str
    llvm: Path | None
    reason: str


def llvm_version(path: Path) -> int | None:
    """Read the major version of a libLLVM from its file name (`libLLVM.so.19.1`, `libLLVM-17.so.1`)."""
    for name in (path.name, path.resolve().name):
        match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", name)
        if match:
            return int(match.group(1))
    return None


def list_unpacked_folders() -> list[Path]:
    """Return the folders that may hold a libLLVM unpacked by `render.backend.llvm`, the one it unpacks into first.

    A run with a cache of its own uses what was fetched into the user's.
    """
    return list(dict.fromkeys(folder / "llvm" for folder in (cache_folder(), users_cache_folder())))


def find_llvm() -> list[tuple[int, Path]]:
    """Return the (major version, path) of every libLLVM found, each library once, best candidate first."""
    places = [(root, pattern.lstrip("/")) for root in (*list_unpacked_folders(), Path("/")) for pattern in _SEARCH]
    found: dict[Path, tuple[int, Path]] = {}
    for root, pattern in places:
        for path in sorted(root.glob(pattern)):
            version = llvm_version(path)
            if version and path.is_file():
                found.setdefault(path.resolve(), (version, path))
    return sorted(found.values(), key=lambda item: (item[0] != KNOWN_GOOD, -item[0]))


def works(variant: str, llvm: Path | None = None) -> bool:
    """Try a variant in a process of its own, since a bad libLLVM or OptiX aborts instead of raising."""
    environment = dict(os.environ)
    if llvm:
        environment["DRJIT_LIBLLVM_PATH"] = str(llvm)
    others = map(str, load_companions(llvm) if llvm else ())
    command = [sys.executable, "-c", _PROBE, variant, *others]
    try:
        return subprocess.run(command, env=environment, capture_output=True, timeout=120, check=False).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def load_companions(llvm: Path) -> list[Path]:
    """Load the libraries that an unpacked libLLVM needs and the system lacks; return their files, in order.

    The system looks for them in its own folders only, but takes those that are loaded. Any other libLLVM has none.
    """
    root = next((root for root in list_unpacked_folders() if llvm.resolve().is_relative_to(root.resolve())), None)
    if root is None:
        return []
    loaded, wanted = [], [llvm]
    while wanted:
        try:
            ctypes.CDLL(str(wanted[-1]))
        except OSError as error:
            missing = _MISSING.search(str(error))
            files = sorted(root.rglob(missing[1])) if missing else []
            found = next((path for path in files if path.is_file()), None)
            if found is None or found in wanted:
                break  # Dr.Jit says so
            wanted.append(found)
        else:
            loaded.append(wanted.pop())
    return [path for path in loaded if path != llvm]


def has_cuda_driver() -> bool:
    """Return whether the CUDA driver library can be loaded and sees at least one device."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


@functools.cache
def choose() -> Choice:
    """Decide which variant to use: `cuda_ad_rgb` where OptiX works, else `llvm_ad_rgb` with a working libLLVM.

    `SDPS_VARIANT` forces the variant, `DRJIT_LIBLLVM_PATH` the library.

    Raises:
        InputError: no usable libLLVM; the message says what to install.
    """
    forced = os.environ.get("SDPS_VARIANT")
    if forced not in (None, "", "cuda_ad_rgb", "llvm_ad_rgb"):
        raise InputError(f"SDPS_VARIANT={forced}: use cuda_ad_rgb or llvm_ad_rgb")
    if forced != "llvm_ad_rgb" and has_cuda_driver():
        if works("cuda_ad_rgb"):
            return Choice("cuda_ad_rgb", None, "a GPU is visible and OptiX traced a test ray")
        if forced == "cuda_ad_rgb":
            raise InputError("SDPS_VARIANT=cuda_ad_rgb: OptiX failed a test ray; unset SDPS_VARIANT to use the CPU")
    elif forced == "cuda_ad_rgb":
        raise InputError("SDPS_VARIANT=cuda_ad_rgb: no CUDA device is visible; unset SDPS_VARIANT to use the CPU")
    return _choose_llvm("forced by SDPS_VARIANT" if forced else "no GPU with a working OptiX")


def _choose_llvm(why: str) -> Choice:
    """Pick the libLLVM for `llvm_ad_rgb`; `why` says why the GPU is not used."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        path = Path(given)
        version = llvm_version(path)
        if not path.is_file():
            raise InputError(f"DRJIT_LIBLLVM_PATH={given}: no such file; {REMEDY}")
        if version is not None and version < OLDEST:
            raise InputError(f"DRJIT_LIBLLVM_PATH={given}: libLLVM {version} aborts the process; {REMEDY}")
        return Choice("llvm_ad_rgb", path, f"{why}; libLLVM {version or '?'} given by DRJIT_LIBLLVM_PATH")
    candidates = find_llvm()
    for version, path in candidates:
        if version == KNOWN_GOOD:
            return Choice("llvm_ad_rgb", path, f"{why}; libLLVM {version} is known to work")
        if version >= OLDEST and works("llvm_ad_rgb", path):
            return Choice("llvm_ad_rgb", path, f"{why}; libLLVM {version} passed a test render")
    seen = ", ".join(str(version) for version, _ in candidates) or "none"
    raise InputError(
        f"no working libLLVM (found: {seen}; versions before {OLDEST} abort); run `sdps doctor --fix`, which fetches "
        f"one without root, {REMEDY}"
    )


@functools.cache
def load() -> ModuleType:
    """Choose the variant, import mitsuba under it and return the module; later calls return the same.

    Raises:
        InputError: no usable variant.
    """
    choice = choose()
    if choice.llvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(choice.llvm)
        load_companions(choice.llvm)
    import drjit as dr

    # Takes the lock that Dr.Jit's own start-up thread holds, and so waits for its end.
    if choice.llvm and not dr.has_backend(dr.JitBackend.LLVM):
        raise InputError(f"{choice.llvm}: Dr.Jit could not load this libLLVM; {REMEDY}")
    import mitsuba as mi

    mi.set_variant(choice.variant)
    return mi
