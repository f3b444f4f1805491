"""`sdps doctor`: what this machine has, what was chosen and why, and a remedy for each thing missing."""

import argparse
import ctypes
import importlib.metadata
import os
import platform
import sys
from pathlib import Path

from render.backend import llvm, variant
from render.planning.budget import free_bytes, gigabytes
from render.shapes.primitives import bunny
from render.shared.errors import InputError

PACKAGES = ("mitsuba", "drjit", "torch", "numpy", "scipy", "trimesh", "OpenEXR", "scikit-image", "safetensors")
DEMO_BYTES = 5_000_000_000
CUDA_TESTED = (
    "half an hour of rendering and training on an H200; `make test-gpu` compares both, and inference, with the CPU's, "
    "and has not run there yet (not tested: several GPUs, torch.compile)"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps doctor`."""
    parser.add_argument(
        "--fix",
        action="store_true",
        help="fetch what is missing into your cache folder, without root: a libLLVM that works, the bunny mesh",
    )


def main(args: argparse.Namespace) -> int:
    """Print the report; exit code 0 when everything needed is there, 1 otherwise."""
    if args.fix:
        _fix()
    lines, problems = examine(Path.cwd())
    width = max(len(name) for name, _ in lines)
    sys.stdout.write("".join(f"{name:<{width}}  {text}\n" for name, text in lines))
    for problem in problems:
        sys.stdout.write(f"missing: {problem}\n")
    return 1 if problems else 0


def _fix() -> None:
    """Fetch a libLLVM where none works, and go on if that fails. The report fetches the mesh."""
    try:
        variant.choose()
    except InputError:
        try:
            sys.stdout.write(f"{llvm.fetch()}\n")
        except InputError as error:
            sys.stdout.write(f"not fetched: {error}\n")


def examine(folder: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the report's (name, text) lines and the remedies for what is missing."""
    from sdps.core.precision import arithmetic
    from sdps.inference.estimator import default_device

    problems: list[str] = []
    lines = [("python", f"{platform.python_version()} ({platform.machine()}, {platform.system()})")]
    for package in PACKAGES:
        try:
            lines.append((package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            lines.append((package, "not installed"))
            problems.append(f"{package}: pip install -c constraints.txt .")
    lines += _variant_lines(problems)
    lines.append(("arithmetic", arithmetic("auto", default_device()).describe()))
    lines.append(("cores", str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count())))
    lines.append(("free disk", _disk_line(free_bytes(folder))))
    try:
        lines.append(("bunny mesh", f"{len(bunny().faces):,} triangles"))
    except InputError as error:
        lines.append(("bunny mesh", "not there"))
        problems.append(f"bunny mesh: {error}")
    return lines, problems


def _disk_line(free: int) -> str:
    """Describe the free bytes; a small disk is not an error, since rendering itself refuses what does not fit."""
    low = f"; the demo takes about {gigabytes(DEMO_BYTES)}, choose another --out" if free < DEMO_BYTES else ""
    return gigabytes(free) + low


def _variant_lines(problems: list[str]) -> list[tuple[str, str]]:
    """Describe the Mitsuba variant, libLLVM, GPU and OptiX."""
    lines = []
    try:
        choice = variant.choose()
        lines.append(("variant", f"{choice.variant}: {choice.reason}"))
        lines.append(("libLLVM", str(choice.llvm or "not needed")))
    except InputError as error:
        lines.append(("variant", "none works"))
        problems.append(f"Mitsuba variant: {error}")
    others = ", ".join(
        f"{version}{' (aborts)' if version < variant.OLDEST else ''}" for version, _ in variant.find_llvm()
    )
    lines.append(("libLLVM found", others or "none"))
    if variant.has_cuda_driver():
        import torch

        name = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "driver present, torch is a CPU build"
        lines.append(("GPU", name))
        lines.append(("OptiX", "library found" if _loads("libnvoptix.so.1") else "libnvoptix.so.1 not found"))
        lines.append(("tested on CUDA", CUDA_TESTED))
    else:
        lines.append(("GPU", "none; everything runs on the CPU"))
    return lines


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
