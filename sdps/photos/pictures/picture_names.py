"""What a picture's name says it is: a photograph, or a mask, a result or something else that lies among photographs."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

MASK, NORMALS, AMBIENT, DARK = "a mask", "normals", "an ambient picture", "a dark frame"

MESHROOM, UNIPS = "ps_", ".data"
"""Begin and end of the names of folders of poses, as programs lay them out."""

_WORDS = {
    MASK: "mask masks maske masque silhouette silhouettes segmentation",
    NORMALS: "normal normals normalmap normalmaps normalen nrm nrml",
    AMBIENT: "ambient unlit noflash nolight nolights lampoff lightoff lightsoff flashoff",
    DARK: "dark darkframe blackframe",
    "depth": "depth depthmap depths height heights heightmap heightfield disparity displacement",
    "albedo": "albedo albedos basecolor basecolour reflectance",
    "a map of the material": "roughness metallic metalness metallicity",
    "a result": "result results groundtruth gt prediction residual relit confidence",
}
_ROLES = {word: role for role, words in _WORDS.items() for word in words.split()}
_PAIRS = {
    ("base", "color"): "albedo", ("base", "colour"): "albedo", ("ground", "truth"): "a result",
    ("no", "light"): AMBIENT, ("no", "lights"): AMBIENT, ("no", "lamp"): AMBIENT, ("no", "flash"): AMBIENT,
    ("light", "off"): AMBIENT, ("lights", "off"): AMBIENT, ("lamp", "off"): AMBIENT, ("flash", "off"): AMBIENT,
    ("black", "frame"): DARK,
}  # fmt: skip
_HUMPS = re.compile(r"(?<=[^\W\d_A-Z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_NOT = ("no", "non", "not", "without", "un")
_FEW = 3


def split_words(name: str) -> list[str]:
    """Return the words of a file name without its suffix, in lower case; `x.normalMap-01_B` has x, normal, map, b."""
    runs = re.findall(r"[^\W\d_]+", Path(name).stem)
    return [word.lower() for run in runs for word in _HUMPS.sub(" ", run).split()]


def name_layout(folder: str) -> str:
    """Return which program gives folders of poses such names, `MESHROOM` or `UNIPS`; empty for others."""
    name = folder.lower()
    if name.startswith(MESHROOM) and len(name) > len(MESHROOM):
        return MESHROOM
    return UNIPS if name.endswith(UNIPS) and len(name) > len(UNIPS) else ""


def name_roles(names: Sequence[str]) -> dict[str, str]:
    """Return what those pictures are by their names that are not photographs by theirs.

    A word counts where it stands by itself, so `unmasked`, `masked` and `normandy` say nothing. A word that most of the
    names share is the object's, as in `african mask 01.jpg`; then only a name that is nothing but the word counts.

    Args:
        names: All pictures of a folder.

    Returns:
        Names, and a role with its article, such as `a mask`.
    """
    found = {name: marks for name in names if (marks := _marks(name))}
    longer = [name for name in names if not _bare(name)]
    counts = Counter(mark for name in longer for mark in {mark for mark, _ in found.get(name, ())})
    shared = {mark for mark, count in counts.items() if count >= _FEW and 2 * count > len(longer)}
    roles = {}
    for name, marks in found.items():
        said = [role for mark, role in marks if _bare(name) or mark not in shared]
        if said:
            roles[name] = said[-1]  # `normal_mask` is a mask
    return roles


def is_bare(name: str, role: str) -> bool:
    """Tell whether a name is nothing but a role's word, as `mask.png` is."""
    words = split_words(name)
    return len(words) == 1 and _ROLES.get(words[0]) == role and Path(name).stem.isalpha()


def _bare(name: str) -> bool:
    return any(is_bare(name, role) for role in _WORDS)


def _marks(name: str) -> list[tuple[str, str]]:
    """Return the words of a name that mean something, each with its role."""
    words = split_words(name)
    marks = []
    for place, word in enumerate(words):
        before = words[place - 1] if place else ""
        pair = _PAIRS.get((before, word))
        if pair:
            marks.append((f"{before} {word}", pair))
        elif word in _ROLES and before not in _NOT:
            marks.append((word, _ROLES[word]))
    return marks
