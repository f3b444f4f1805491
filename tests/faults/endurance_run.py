"""Do the same work many times in one process and watch what it holds: `python tests/faults/endurance_run.py`.

Tasks: `infer` (a folder of photographs, with networks and the files of `sdps infer`), `render` (small scenes, each of
another shape), `train` (steps of one training). After every round, of many after every so many, memory, open files,
threads and child processes are noted; printed as a Markdown table and, with --plot, drawn.
"""

import argparse
import ctypes
import gc
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
for place in (ROOT, ROOT / "tests" / "support"):
    if str(place) not in sys.path:
        sys.path.insert(0, str(place))

from render.shared.progress import progress_bar  # noqa: E402


class Held(NamedTuple):
    """What a process holds.

    Attributes:
        round: After so many rounds.
        memory: MiB resident.
        files: Open file descriptors.
        threads: Threads.
        children: Child processes.
        seconds: Of a round, the mean since the last look.
    """

    round: int
    memory: float
    files: int
    threads: int
    children: int
    seconds: float


def held(number: int = 0, seconds: float = 0.0) -> Held:
    """Look at this process, after what lies unused has gone back to the system."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    process = Path("/proc/self")
    tasks = list((process / "task").iterdir())
    children = sum(len((task / "children").read_text().split()) for task in tasks)
    pages = int((process / "statm").read_text().split()[1])
    memory = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    return Held(number, memory, len(os.listdir(process / "fd")), len(tasks), children, seconds)


def infer(folder: Path) -> Callable[[int], Any]:
    """Return what infers once, the folder of photographs made here."""
    import photo_folders
    from data_folders import light_directions

    import sdps

    images, mask = photo_folders.matte(light_directions(12).astype(float), size=48)
    photo_folders.write_folder(folder / "photos", images, mask, bits=16)

    def once(number: int) -> None:
        found = sdps.infer(sdps.load(folder / "photos"), "sdps", refine=False)
        found.save(folder / "out")

    return once


def render(folder: Path) -> Callable[[int], Any]:
    """Return what renders one small scene: every fourth a new blob, the others a mesh file that was never read."""
    import trimesh

    from render import api

    ball = trimesh.creation.icosphere(3)
    materials = ("chrome", "pink-plastic", "lambertian:0.8")
    lights = np.array([[0.3, 0.2, 0.9], [-0.5, 0.1, 0.8]])

    def once(number: int) -> None:
        shape = f"blobby:{number}"
        if number % 4:
            shape = str(folder / f"{number}.ply")
            stretch = np.random.default_rng(number).uniform(0.5, 1.0, 3)
            trimesh.Trimesh(ball.vertices * stretch, ball.faces).export(shape)
        view = api.render_view(shape, materials[number % 3], lights, size=16, spp=1, seed=number)
        assert np.isfinite(view.images).all()
        Path(shape).unlink(missing_ok=True)

    return once


TASKS = {"infer": infer, "render": render}
TRAIN = "train"


def watch_training(count: int, folder: Path) -> list[Held]:
    """Train a normal network on crops of 16x16, with validations and checkpoints; look at it now and then."""
    from sdps_scenes import write_data

    from sdps.training.stages import NormalStage
    from sdps.training.trainer import train
    from sdps.training.training_config import NormalTraining

    write_data(folder / "data", ("train",) * 6 + ("val", "val"), lights=4, size=32)
    rows, began = [held()], time.perf_counter()

    class Looks:
        def log(self, step: int, values: dict[str, Any]) -> None:
            nonlocal began
            if step > rows[-1].round:  # validations are told for the same step
                rows.append(held(step, (time.perf_counter() - began) / (step - rows[-1].round)))
                began = time.perf_counter()

        def close(self) -> None:
            pass

    config = NormalTraining(
        steps=count, batch_scenes=2, images=2, size=32, crop=16, lights="true", schedule="constant", clip_gradient=1.0,
        log_every=max(1, count // 500), validate_every=max(1, count // 50), validation_scenes=2, workers=0,
        checkpoint_minutes=0.1,
    )  # fmt: skip
    train(NormalStage(config), folder / "data", folder / "out", loggers=[Looks()])
    return rows


def watch(task: str, count: int, folder: Path) -> list[Held]:
    """Do a task `count` times; return what was held before, and after every round, of many after every so many."""
    if task == TRAIN:
        return watch_training(count, folder)
    once = TASKS[task](folder)
    rows, step, began = [held()], max(1, count // 500), time.perf_counter()
    for number in progress_bar(range(1, count + 1), desc=task):
        once(number - 1)
        if number % step == 0 or number == count:
            rows.append(held(number, (time.perf_counter() - began) / (number - rows[-1].round)))
            began = time.perf_counter()
    return rows


def table(task: str, rows: list[Held]) -> str:
    """Lay out about eight of the rounds as Markdown."""
    chosen = sorted({1, 2, *np.linspace(0, len(rows) - 1, 7).astype(int).tolist()})
    lines = [
        f"| {task}, round | memory | open files | threads | child processes | seconds |",
        "|---|---|---|---|---|---|",
    ]
    for number in chosen:
        row = rows[number]
        cells = (
            row.round or "before",
            f"{row.memory:.0f} MiB",
            row.files,
            row.threads,
            row.children,
            f"{row.seconds:.3f}",
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def plot(path: Path, rows: list[Held]) -> None:
    """Draw memory, files and the time of a round over the rounds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    fields = {"memory": "MiB", "files": "", "seconds": "a round"}
    for axes, (field, unit) in zip(figure.subplots(1, 3), fields.items(), strict=True):
        axes.plot([row.round for row in rows], [getattr(row, field) for row in rows])
        axes.set(title=f"{field} {unit}", xlabel="round", ylim=(0, None))
    figure.savefig(path, dpi=100)


def main() -> int:
    """Run a task; 1 where it holds more at the end than after a fifth of the rounds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=(*TASKS, TRAIN), default="infer")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--plot", type=Path, help="picture of memory, files and children")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        rows = watch(args.task, args.count, Path(name))
    sys.stdout.write(table(args.task, rows))
    if args.plot:
        plot(args.plot, rows)
    return int(grown(rows))


def grown(rows: list[Held], slack: float = 1.05) -> bool:
    """Tell whether the last fifth of the rounds holds more than the second, beyond 5 % of memory."""
    fifth = max(len(rows) // 5, 1)
    early, late = rows[fifth : 2 * fifth], rows[-fifth:]
    memory = np.median([row.memory for row in late]) > slack * np.median([row.memory for row in early])
    counts = any(
        max(getattr(row, field) for row in late) > max(getattr(row, field) for row in early)
        for field in ("files", "threads", "children")
    )
    return bool(memory or counts)


if __name__ == "__main__":
    sys.exit(main())
