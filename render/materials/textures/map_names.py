"""Which picture of a folder is which PBR map, by the names that shops and programs give them.

The kind stands at the end of the name: `Bricks012_2K-JPG_NormalGL`, `brick_nor_gl_4k`, `T_Floor_ORM`,
`metallicRoughness`. Behind it only resolutions, formats and the like may follow. Case and separators do not matter.
"""

import re
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

from render.shared.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".tga", ".bmp", ".webp")
_UNREAD = (".exr", ".hdr")
_PICTURES = (*SUFFIXES, *_UNREAD, ".gif", ".jp2", ".psd", ".avif", ".heic")

GL, DX = "gl", "dx"
_ALPHA = 3
_COLOUR = ("color", "base color", "albedo", "diff", "diffuse", "col", "base colour", "colour", "diffuse color", "bc")
_ROUGH, _METAL = ("roughness", "rough"), ("metalness", "metallic", "metal")
_GLOSS = ("gloss", "glossiness", "smoothness")
_OCCLUSION = ("ambient occlusion", "occlusion", "ao")
_NORMAL = ("normal", "nor", "normals", "nrm", "norm", "nrml", "n")
_CONVENTIONS = {GL: ("gl", "ogl", "opengl", "open gl"), DX: ("dx", "directx", "direct x", "d3d")}
_BEHIND = re.compile(
    r"(?:_(?:\d+k?|\d+x\d+|\d*bits?|u?int\d+|jpe?g|png|tiff?|tga|bmp|webp|exr|srgb|linear|raw|map|tex|texture|v\d+|lod\d+"
    r"|ogl|open_?gl|gl|direct_?x|dx|d3d))+$"
)
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[0-9])(?=[A-Z][a-z])|(?<=[A-Z])(?=[A-Z][a-z])")


@dataclass(frozen=True)
class Source:
    """Where a map comes from.

    Attributes:
        path: The picture.
        channel: Which channel of it, 0 to 3, the last for alpha; None for the whole picture.
        inverted: Whether 1 stands for 0, as in a map of gloss.
        convention: Of a normal map, `gl` or `dx`; empty where the name does not say.
    """

    path: Path
    channel: int | None = None
    inverted: bool = False
    convention: str = ""


@dataclass(frozen=True)
class Maps:
    """The maps of a folder.

    Attributes:
        sources: By kind: colour, roughness, metallic, normal, height.
        unused: All other pictures of the folder, by name.
    """

    sources: dict[str, Source]
    unused: tuple[Path, ...]

    @property
    def paths(self) -> tuple[Path, ...]:
        """The pictures that are used, each once, by name."""
        return tuple(sorted({source.path for source in self.sources.values()}))


def find(folder: Path) -> Maps:
    """Find out by their names which map each picture of a folder is.

    A map of its own goes before one that shares its picture with others, as in `_ORM`.

    Raises:
        InputError: no base colour, two pictures of one kind, or one in a format that is not read.
    """
    pictures = sorted(path for path in folder.iterdir() if path.suffix.lower() in _PICTURES and path.is_file())
    pictures = [path for path in pictures if not path.name.startswith(".")]
    found: dict[str, tuple[int, Source]] = {}
    unread: dict[str, Path] = {}
    for path in pictures:
        for kind, rank, source in _read_kinds(path):
            if path.suffix.lower() not in SUFFIXES:
                unread[kind] = path
            elif kind not in found or rank < found[kind][0]:
                found[kind] = (rank, source)
            elif rank == found[kind][0]:
                raise InputError(f"{folder}: {kind}: both {found[kind][1].path.name} and {path.name}; keep one of them")
    for kind, path in unread.items():
        if kind not in found:
            raise InputError(f"{path}: {kind}: maps must be {', '.join(SUFFIXES)}; download it as PNG or JPG")
    if "colour" not in found:
        there = ", ".join(path.name for path in pictures[:5]) + (", ..." if len(pictures) > 5 else "")
        raise InputError(
            f"{folder}: no base colour map; expected a picture named like Bricks_Color.jpg or brick_diff_2k.png"
            + (f", found {there}" if there else "")
        )
    sources = {kind: source for kind, (_, source) in found.items()}
    used = {source.path for source in sources.values()}
    return Maps(sources, tuple(path for path in pictures if path not in used))


def _read_kinds(path: Path) -> list[tuple[str, int, Source]]:
    """Return the kinds of map that a picture holds by its name, with the rank of that name and where to find them."""
    stem = _words(_CAMEL.sub("_", path.stem))
    cores = [_BEHIND.sub("", each) for each in (stem, _words(path.stem))]
    cores += [core.removesuffix("map") for core in cores]
    names = (name for name in (*_KINDS, *_PACKED) if any(core.endswith(f"_{name}") for core in cores))
    name = max(names, key=lambda name: len(name.replace("_", "")), default="")
    if name in _PACKED:
        rank, channels = _PACKED[name]
        return [(kind, rank, Source(path, place, inverted=place == _ALPHA)) for kind, place in channels.items()]
    if not name:
        return []
    kind, rank = _KINDS[name]
    if kind == "none":
        return []
    if kind == "gloss":
        return [("roughness", rank, Source(path, inverted=True))]
    if kind != "normal":
        return [(kind, rank, Source(path))]
    said = [
        (f"{stem}_".rfind(f"{word}_"), convention)
        for convention, words in _CONVENTIONS.items()
        for word in _spell_words(words)
        if re.search(f"(?:_|{'|'.join(_NORMAL[:-1])}){word}_", f"{stem}_")
    ]
    convention = max(said, default=(0, ""))[1]
    return [(kind, (GL, "", DX).index(convention), Source(path, convention=convention))]


def _words(text: str) -> str:
    """Return a name in small letters, with an underscore before each of its words."""
    return "_" + re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def _spell_words(names: tuple[str, ...]) -> list[str]:
    """Return names of several words with the words apart and together."""
    return [form for name in names for form in dict.fromkeys((name.replace(" ", "_"), name.replace(" ", "")))]


def _list_packed() -> dict[str, tuple[int, dict[str, int]]]:
    """Return the names of pictures that hold several maps: rank, and the channels of roughness and metallic.

    The order of letters or words is that of red, green and blue; occlusion (O, A, AO) is not used. Roughness and
    metallic alone are as in glTF: green and blue.
    """
    found: dict[str, tuple[int, dict[str, int]]] = {}
    for order in permutations("orm"):
        channels = {"roughness": order.index("r"), "metallic": order.index("m")}
        for letter in ("o", "a", "ao"):
            found["".join(order).replace("o", letter)] = (20 + len(found), channels)
        rank = 20 + len(found)
        words = {"o": _spell_words((*_OCCLUSION, "occ")), "r": _spell_words(_ROUGH), "m": _spell_words(_METAL)}
        for first in words[order[0]]:
            for second in words[order[1]]:
                for third in words[order[2]]:
                    found.update(
                        dict.fromkeys((f"{first}_{second}_{third}", f"{first}{second}{third}"), (rank, channels))
                    )
    for metal in _METAL:
        # `rusty_metal_rough` is the roughness of rusty metal, `MetalRough` is a map of both.
        joints = ("",) if metal == "metal" else ("", "_")
        for joint in joints:
            for rough in _ROUGH:
                pairs = (f"{metal}{joint}{rough}", f"{rough}{joint}{metal}")
                found.update(dict.fromkeys(pairs, (90, {"roughness": 1, "metallic": 2})))
            for gloss in _GLOSS:  # of Unity
                found[f"{metal}{joint}{gloss}"] = (95, {"metallic": 0, "roughness": _ALPHA})
    return found


def _kinds() -> dict[str, tuple[str, int]]:
    """Return the names of maps of their own: kind and rank among the names of that kind."""
    names = {"colour": _COLOUR, "roughness": _ROUGH, "metallic": _METAL, "normal": _NORMAL,
             "height": ("displacement", "height", "disp", "bump"),
             "gloss": _GLOSS,
             "none": tuple(f"{first} {gloss}" for first in ("specular", "spec") for gloss in _GLOSS)}  # fmt: skip
    found = {}
    for kind, spellings in names.items():
        for rank, name in enumerate(spellings):
            found.update(dict.fromkeys(_spell_words((name,)), (kind, rank + 10 * (kind == "gloss"))))
    together = [
        f"{base}{word}" for base in _NORMAL[:-1] for words in _CONVENTIONS.values() for word in _spell_words(words)
    ]
    return found | dict.fromkeys(together, ("normal", 0))


_PACKED = _list_packed()
_KINDS = _kinds()
