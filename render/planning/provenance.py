"""Where data come from: versions, commit, what the shards' headers say, and the terms of materials and meshes."""

import importlib.metadata
import platform
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from render.materials import library
from render.materials.textures import textured
from render.planning.plan_counts import IMPORTED, PlanCounts, components
from render.records.manifest import OWN_MESHES, SceneSpec
from render.records.mirror import shard_path
from render.records.shards import read_shard
from render.shared.errors import InputError
from render.shared.seeds import spread_evenly

PACKAGES = ("sdps", "mitsuba", "drjit", "OpenEXR", "numpy")
HEADERS = (*PACKAGES, "commit", "variant", "imported_from", "irradiance", "frame", "normals", "depth", "coverage")
READ = 16  # shards whose headers are read
_OWN = "made by the seeded generators of this package (`render.shapes`); no third-party data"
MESHES = {
    "blobby": _OWN,
    "sculpture": _OWN,
    "sphere": _OWN,
    "bunny": "Stanford Bunny, Stanford University Computer Graphics Laboratory: free for research use with "
    "acknowledgement; commercial use needs permission (https://graphics.stanford.edu/data/3Dscanrep/)",
}
ORIGINAL = "those of the data set it was imported from"
UNSTATED = "not stated by its file; ask its author before sharing the data"


@dataclass(frozen=True)
class Terms:
    """Materials that share a source and terms of use."""

    source: str
    terms: str
    materials: tuple[str, ...]


def versions() -> dict[str, str]:
    """Return the versions of Python and the packages the renderer needs, as installed now."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def commit(folder: Path | None = None) -> str:
    """Return the commit of this package's checkout, with `, modified` when files differ from it; empty outside of one.

    Args:
        folder: A folder in the checkout; the package's own when omitted.
    """
    folder = folder or Path(__file__).parent
    git = shutil.which("git")
    if git is None:
        return ""
    head = _git(git, folder, "rev-parse", "HEAD")
    if head is None:
        return ""
    # An installed copy below someone else's checkout is not in that checkout's index.
    if _git(git, folder, "ls-files", "--error-unmatch", "__init__.py") is None:
        return ""
    changed = _git(git, folder, "status", "--porcelain", "--untracked-files=normal")
    return head.strip() + (", modified" if changed else "")


def _git(git: str, folder: Path, *arguments: str) -> str | None:
    """Run git and return what it prints, or None when it fails."""
    try:
        done = subprocess.run(
            [git, "-C", str(folder), *arguments], capture_output=True, text=True, timeout=30, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


def headers(folder: Path, there: Sequence[SceneSpec]) -> dict[str, str]:
    """Read provenance from the headers of some shards, spread evenly; differing values are listed.

    Shards that cannot be read are skipped; `sdps data validate` lists them.
    """
    found: dict[str, dict[str, None]] = {key: {} for key in HEADERS}
    for scene in spread_evenly(there, READ):
        try:
            header = read_shard(shard_path(folder, scene), scene).provenance
        except InputError:
            continue
        for key in HEADERS:
            if key in header:
                found[key][str(header[key])] = None
    return {key: "; ".join(values) for key, values in found.items() if values}


def material_terms(materials: Sequence[str]) -> list[Terms]:
    """Group materials by source and terms of use, the largest group first; spatially-varying names are taken apart."""
    groups: dict[tuple[str, str], dict[str, None]] = {}
    for name in dict.fromkeys(part for material in materials for part in components(material)):
        groups.setdefault(_terms_of(name), {})[textured.without_seed(name)] = None
    ordered = sorted(groups.items(), key=lambda item: -len(item[1]))
    return [Terms(source, terms, tuple(names)) for (source, terms), names in ordered]


def _terms_of(name: str) -> tuple[str, str]:
    """Return source and terms of one plain material."""
    if name.startswith(f"{IMPORTED}:"):
        return "another data set", ORIGINAL
    try:
        material = library.load(name)
    except InputError:
        return "a file that is not here", UNSTATED
    source = str(getattr(material, "source", "") or "not stated")
    terms = str(getattr(material, "terms", "") or "")
    # An analytic BRDF is a formula, which no one's terms cover.
    return source, terms or ("none needed" if source == "analytic" else UNSTATED)


def mesh_terms(counts: PlanCounts, own: str = "") -> dict[str, str]:
    """Return {shape family or mesh file: terms of use} of a plan; `own` are those of the family `meshes`."""
    known = MESHES | {IMPORTED: ORIGINAL} | ({OWN_MESHES: own} if own else {})
    return {name: known.get(name, UNSTATED) for name in counts.families}
