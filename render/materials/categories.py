"""Families of the MERL materials, read off their names.

`fabric`, `plastic` and `phenolic` are the groups that the SDPS-Net paper renders (12, 9 and 12 materials).
"""

_SUFFIXES = {
    "fabric": "fabric",
    "fabric2": "fabric",
    "plastic": "plastic",
    "phenolic": "phenolic",
    "acrylic": "acrylic",
    "rubber": "rubber",
    "latex": "rubber",
    "steel": "metal",
}
_NAMES = {
    "metal": (
        "alum-bronze aluminium brass chrome hematite nickel ss440 tungsten-carbide two-layer-gold two-layer-silver"
    ),
    "ceramic": "alumina-oxide silicon-nitrade",
    "stone": "aventurnine black-obsidian pink-jasper white-marble",
    "wood": (
        "cherry-235 colonial-maple-223 fruitwood-241 ipswich-pine-221 natural-209 pickled-oak-260 special-walnut-224"
    ),
    "polymer": "delrin nylon polyethylene polyurethane-foam pvc teflon white-diffuse-bball",
    "felt": "pink-felt",
}


def category(name: str) -> str:
    """Return the family of a MERL material, or `other` for a name that belongs to none."""
    for family, members in _NAMES.items():
        if name in members.split():
            return family
    if "metallic-paint" in name:
        return "metallic-paint"
    if "paint" in name:
        return "paint"
    return _SUFFIXES.get(name.rsplit("-", 1)[-1], "other")
