"""Names that the loaders of every layout accept.

They consist of ASCII letters, digits and hyphens, so they have no separator, comment or blank, sort alike in every
natural order, and stay apart on file systems that ignore case.
"""

import re
from collections import Counter
from collections.abc import Sequence

_LONGEST = 80
_MATERIAL_FILES = r"\.(ya?ml|binary|bsdf)(?=\+|$)"


def legal_name(name: str) -> str:
    """Turn a scene id, shape or material name into a file name; of paths only the stem of the file is kept."""
    stem = re.sub(_MATERIAL_FILES, "", re.sub(r"[^:+]*[/\\]", "", name))
    return re.sub(r"[^A-Za-z0-9]+", "-", stem).strip("-")[:_LONGEST].strip("-") or "unnamed"


def unique_names(names: Sequence[str]) -> list[str]:
    """Number those names that are equal but for case: `a`, `b`, `A` becomes `a-1`, `b`, `A-2`."""
    counts = Counter(name.casefold() for name in names)
    taken = {name for name, count in counts.items() if count == 1}
    result = []
    for name in names:
        chosen, number = name, 0
        while counts[name.casefold()] > 1 and (number == 0 or chosen.casefold() in taken):
            number += 1
            chosen = f"{name}-{number}"
        taken.add(chosen.casefold())
        result.append(chosen)
    return result
