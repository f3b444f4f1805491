"""What the worker makes of a run for other programs, on demand: the exports of `sdps export`."""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.app.common.archives import pack
from pipelines.app.pages.photo_questions import find_poses, make_arguments, speak_plainly
from render.shared.errors import InputError
from render.shared.files import read_json
from render.shared.progress import stage

if TYPE_CHECKING:
    from sdps.photos import Photographs

_EXPORTS = "exports"
ASKED = "asked.json"
"""In a run: what was asked for."""


def list_exports() -> list[dict[str, str]]:
    """Return every export: its name, for whom it is, and what is written."""
    from sdps.surface.exports.registry import EXPORTS

    rows = []
    for name, export in EXPORTS.items():
        who, what = export.about.split(": ", 1)
        rows.append({"name": name, "who": who, "what": what})
    return rows


def export(place: str, number: int, name: str) -> dict[str, Any]:
    """Write an export of a run, unless it is there, as one file or a ZIP of several.

    Args:
        place: The set's folder.
        number: Of the run.
        name: Of the export.

    Returns:
        `file`, its path in the run's folder, and `name`, what to call it.

    Raises:
        InputError: an unknown name, a run that is gone, or what the run lacks for it.
    """
    from sdps.surface.exports.registry import EXPORTS, split_names, write_exports
    from sdps.surface.exports.saved_result import read_result

    names = split_names(name)
    if len(names) > 1:
        raise InputError(f"export {', '.join(names)}: one at a time; ask for each")
    (name,) = names
    run = Path(place) / "runs" / str(number)
    made = run / _EXPORTS / name
    stage("export")
    if not made.is_dir():
        with speak_plainly(run / "files"), tempfile.TemporaryDirectory(dir=run) as temporary:
            result = read_result(run / "files")
            if EXPORTS[name].from_pictures:
                result = replace(result, pictures=_read_again(Path(place), run))
            write_exports(result, [name], Path(temporary))
            made.parent.mkdir(exist_ok=True)
            shutil.move(Path(temporary) / name, made)
    files = [path for path in made.rglob("*") if path.is_file()]
    if len(files) == 1:
        return {"file": str(files[0].relative_to(run)), "name": files[0].name}
    archive = made.with_suffix(".zip")
    pack(made, archive)
    return {"file": str(archive.relative_to(run)), "name": archive.name}


def _read_again(place: Path, run: Path) -> "Photographs":
    """Return the photographs of a run as it read them."""
    from pipelines.infer import look_through

    answers = read_json(run / ASKED, "find the surface again")
    _, pose = find_poses(place, answers)
    return look_through(make_arguments(place, pose, answers), pose, lambda text: None)[0]
