"""The `sdps` command: parse, build, run. Mistakes of the user end in one line and exit code 2."""

import argparse
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from render.shared.errors import InputError, unknown
from render.shared.storage import address


class Command(NamedTuple):
    """A command, loaded only when it is the one that is run.

    Attributes:
        module: Module.
        about: One line of help.
        declare: Function of the module that adds flags to a parser.
        run: Function of the module that takes the parsed flags and returns the exit code.
        stores: Whether its folders may be addresses in object storage.
        hidden: Whether it is an earlier name, which works and is not listed.
        example: One line or two that end its help.
        starts: What is said before the module is loaded, where that takes seconds.
    """

    module: str
    about: str
    declare: str = "add_arguments"
    run: str = "main"
    stores: bool = False
    hidden: bool = False
    example: str = ""
    starts: str = ""


class Group(NamedTuple):
    """Commands under a common first word."""

    about: str
    commands: Mapping[str, Command]


DATA = Group("plan, check, preview, describe, export, relight and import data folders", {
    "plan": Command("pipelines.data.plan", "plan the scenes of a preset; estimate disk and time", stores=True,
                    example="sdps data plan --preset small --set data.size=64"),
    "status": Command("pipelines.data.status", "show what is done, failed and left, and the rate", stores=True,
                      example="sdps data status out/small/data"),
    "validate": Command("pipelines.data.validate", "check every shard of a folder", stores=True,
                        example="sdps data validate out/small/data --workers 2"),
    "preview": Command("pipelines.data.preview",
                       "write contact sheets and a page with light, material and shape statistics", stores=True,
                       example="sdps data preview out/small/data --count 48"),
    "card": Command("pipelines.data.card", "write the dataset card and Croissant JSON", stores=True,
                    example="sdps data card out/small/data --license cc-by-4.0 --creator 'A. Name'"),
    "export": Command("pipelines.data.exchange", "write scenes in a layout other loaders read", stores=True,
                      example="sdps data export out/small/data --layout psfcn --out out/psfcn"),
    "relight": Command("pipelines.data.relight", "mix images under many lights from a light stage",
                       example="sdps data relight out/stage/data --environments studio --out out/relit"),
    "import": Command("pipelines.data.exchange", "turn PS-FCN trees and DiLiGenT folders into shards",
                      "add_import_arguments", "import_main",
                      example="sdps data import DiLiGenT/pmsData --layout diligent --crop --out out/diligent"),
    "pack": Command("pipelines.data.pack", "pack scenes into WebDataset tars for streaming", stores=True,
                    example="sdps data pack out/small/data --out out/packed"),
})  # fmt: skip

_MATERIALS = Command("pipelines.rendering.catalogue", "list the built-in materials", "add_material_arguments",
                     "materials_main", example="sdps list materials --category metal --out out")  # fmt: skip
_SHAPES = Command("pipelines.rendering.catalogue", "list the shape families", "add_shape_arguments", "shapes_main",
                  example="sdps list shapes --out out")  # fmt: skip
_MODELS = Command("pipelines.rendering.catalogue", "list the learned models", "add_model_arguments", "models_main",
                  example="sdps list models --role normals")  # fmt: skip

LIST = Group("list what there is: materials, shapes, models, light sets, presets", {
    "materials": _MATERIALS,
    "shapes": _SHAPES,
    "models": _MODELS,
    "light-sets": Command("pipelines.rendering.catalogue", "list the light sets and distributions", "add_no_arguments",
                          "light_sets_main", example="sdps list light-sets"),
    "presets": Command("pipelines.rendering.catalogue", "list the presets", "add_no_arguments", "presets_main",
                       example="sdps list presets"),
})  # fmt: skip

EVALUATE = Group("score methods on rendered scenes and real photographs, and write the report", {
    "merltest": Command("pipelines.evaluate.merltest", "render and score MERL-Test scenes",
                        example="sdps evaluate merltest --preset small"),
    "diligent": Command("pipelines.evaluate.benchmarks.diligent", "score methods on DiLiGenT's objects, by folder",
                        example="sdps evaluate diligent DiLiGenT/pmsData"),
    "gourd-apple": Command("pipelines.evaluate.benchmarks.measured_lights", "score lights on Gourd&Apple",
                           "add_gourd_apple_arguments", example="sdps evaluate gourd-apple datasets/GourdApple"),
    "light-stage": Command("pipelines.evaluate.benchmarks.measured_lights",
                           "score lights on the Light Stage Data Gallery", "add_light_stage_arguments",
                           example="sdps evaluate light-stage datasets/LightStage"),
    "uw": Command("pipelines.evaluate.benchmarks.uw",
                  "score uncalibrated methods on photographs of the University of Washington",
                  example="sdps evaluate uw datasets/psmImages"),
    "classical": Command("pipelines.evaluate.classical", "compare the classical methods on rendered scenes",
                         example="sdps evaluate classical --out out/classical"),
    "report": Command("pipelines.evaluate.report.page", "collect everything evaluated into one page",
                      example="sdps evaluate report out/small"),
})  # fmt: skip

COMMANDS: dict[str, Command | Group] = {
    "infer": Command("pipelines.infer", "find normals, lights and a surface in a folder of photographs",
                     example="sdps infer photos --out out/vase\nsdps infer photos --lights lights.lp --mask mask.png",
                     starts="looking at the photographs"),
    "export": Command("pipelines.export_result", "write a result for other programs: normals, heights, lights",
                      example="sdps export out/vase --normals directx\nsdps export out/vase --as height,lp"),
    "app": Command("pipelines.app.app", "serve a local page for photographs, scenes and data", example="sdps app"),
    "doctor": Command("pipelines.doctor", "show what this machine has and what is missing",
                      example="sdps doctor --fix"),
    "demo": Command("pipelines.demo", "render, train, evaluate and regenerate, fitted to this machine",
                    example="sdps demo --out out/demo"),
    "render-data": Command("pipelines.rendering.render_data", "render the training scenes of a preset", stores=True,
                           example="sdps render-data --preset small --out out/small"),
    "data": DATA,
    "list": LIST,
    "train": Command("pipelines.train.train", "train models, by default LCNet, then NENet", stores=True,
                     example="sdps train --preset small --models lcnet,nenet"),
    "evaluate": EVALUATE,
    "regenerate": Command("pipelines.rendering.regenerate", "render test scenes of chosen shapes and materials",
                          example="sdps regenerate --shapes bunny --materials chrome --light-set merltest"),
    "fit-material": Command("pipelines.rendering.fit_material", "fit the built-in model to a MERL .binary table",
                            example="sdps fit-material chrome.binary --out materials"),
    "materials": _MATERIALS._replace(hidden=True),
    "shapes": _SHAPES._replace(hidden=True),
    "models": _MODELS._replace(hidden=True),
    "eval-merltest": EVALUATE.commands["merltest"]._replace(hidden=True),
    "eval-diligent": EVALUATE.commands["diligent"]._replace(hidden=True),
    "eval-lights": Command("pipelines.evaluate.benchmarks.measured_lights",
                           "score lights on Gourd&Apple or Light Stage", hidden=True,
                           example="sdps evaluate gourd-apple datasets/GourdApple"),
    "eval-classical": EVALUATE.commands["classical"]._replace(hidden=True),
    "eval-photos": EVALUATE.commands["uw"]._replace(hidden=True),
    "report": EVALUATE.commands["report"]._replace(hidden=True),
}  # fmt: skip

IN_LAB = ("bench", "bench-checks", "bench-classical", "bench-infer", "bench-surface", "bench-train",
          "eval-figures", "noise", "ship", "shipped-results")  # fmt: skip
"""Commands that `lab` has, which is not installed."""

Commands = Mapping[str, Command | Group]


GROUPS = {
    "what goes in": {"preset", "set", "models", "data", "mask", "images", "gamma", "scale", "anyway", "self-test",
                     "objects"},
    "lights": {"lights", "light-set", "intensities", "frame", "light-distance"},
    "the camera": {"focal", "principal", "pixel-size", "camera-distance"},
    "how it is solved": {"method", "methods", "refine", "discontinuities", "read-out", "light-views", "normal-views",
                         "keep-stray-light", "lighting", "flat", "flatten"},
    "which scenes": {"ids", "split", "limit", "count", "skip-missing", "shard", "retry-failed", "shapes", "materials",
                     "category", "role"},
    "what comes out": {"out", "json", "layout", "bits", "exposure", "mitsuba", "photographs", "tensorboard", "export",
                      "as"},
    "the machine": {"workers", "keep-free", "timeout", "cache-gb", "cluster", "cluster-config", "stream", "precision",
                    "verify"},
}  # fmt: skip
"""Headings of flags in every command's help; a flag that is not here stands under `options`."""


class _Help(argparse.RawDescriptionHelpFormatter):
    """Help that shows the default of every flag whose text does not."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, value = action.help or "", action.default
        nothing = value in (None, [], "", (), argparse.SUPPRESS) or isinstance(value, bool)
        if nothing or not action.option_strings or "default" in text:
            return text
        if isinstance(value, tuple):
            value = ",".join(map(str, value))
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        return f"{text} (default: {shown.replace('%', '%%')})"


class _Parser(argparse.ArgumentParser):
    """An argument parser that groups flags by `GROUPS`, shows defaults, and whose complaints are one line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"formatter_class": _Help, **settings})
        for title in GROUPS:  # in this order; a group without flags is not shown
            self.add_argument_group(title)

    def add_argument(self, *names: str, **settings: Any) -> argparse.Action:
        """Add a flag to the group its name belongs to."""
        title = next((title for title, words in GROUPS.items() if names and names[0].lstrip("-") in words), None)
        if title is None or not names[0].startswith("-") or settings.get("help") == argparse.SUPPRESS:
            return super().add_argument(*names, **settings)
        group = next(group for group in self._action_groups if group.title == title)
        return group.add_argument(*names, **settings)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see `{self.prog} --help`")


def build_parser(words: Sequence[str], commands: Commands = COMMANDS, program: str = "sdps") -> argparse.ArgumentParser:
    """Return the parser; only the flags of the command that `words` name are declared, so that one module is loaded.

    Args:
        words: What was typed, without the flags.
        commands: What can be run.
        program: How it is called.

    Raises:
        InputError: an unknown command, with the nearest.
    """
    parser = _Parser(prog=program, description="Photometric-stereo data and training (SDPS-Net) with Mitsuba 3.")
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    _add_commands(parser, commands, words, "command")
    return parser


def _add_commands(
    parser: argparse.ArgumentParser, commands: Mapping[str, Command | Group], words: Sequence[str], kind: str
) -> None:
    """Declare the commands of one level, and what follows the one that was typed."""
    wanted = words[0] if words else None
    if wanted is not None and wanted not in commands:
        if wanted in IN_LAB:
            raise InputError(f"{wanted}: not installed with the package; in a clone run `python -m lab {wanted}`")
        raise unknown(kind, wanted, commands)

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    children = parser.add_subparsers(metavar="COMMAND", parser_class=_Parser)
    for name, command in commands.items():
        about = command.about
        hidden = isinstance(command, Command) and command.hidden
        words_of_help: dict[str, Any] = {"description": f"{about[0].upper()}{about[1:]}."}
        if not hidden:
            words_of_help["help"] = about
        if isinstance(command, Command) and command.example:
            words_of_help["epilog"] = "example:\n" + "\n".join(f"  {line}" for line in command.example.splitlines())
        child = children.add_parser(name, **words_of_help)
        if name != wanted:
            continue
        if isinstance(command, Group):
            _add_commands(child, command.commands, words[1:], f"{name} command")
        else:
            if command.starts and len(words) > 1 and command.module not in sys.modules:
                folder = f" in {words[1]}" if Path(words[1]).is_dir() else ""
                sys.stdout.write(f"{command.starts}{folder}\n")
                sys.stdout.flush()
            module = importlib.import_module(command.module)
            getattr(module, command.declare)(child)
            child.set_defaults(run=getattr(module, command.run), stores=command.stores)


def _require_folders(args: argparse.Namespace) -> None:
    """Refuse addresses in object storage where a command wants a folder of this machine.

    Raises:
        InputError: such an address.
    """
    places = [getattr(args, name, None) for name in ("folder", "data", "out")]
    for place in places if not getattr(args, "stores", True) else ():
        if isinstance(place, str | Path) and (url := address(place)):
            raise InputError(f"{url}: this command works in folders of this machine; export or copy the data first")


def version() -> str:
    """Return the installed version, `unknown` where the package is not installed."""
    from importlib import metadata

    try:
        return metadata.version("sdps")
    except metadata.PackageNotFoundError:
        return "unknown"


def main(argv: Sequence[str] | None = None, commands: Commands = COMMANDS, program: str = "sdps") -> int:
    """Run one command and return its exit code: 0 done, 1 something is missing, 2 bad input, 130 stopped."""
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        args = build_parser([word for word in argv if not word.startswith("-")], commands, program).parse_args(argv)
        if args.version:
            sys.stdout.write(f"sdps {version()}\n")
            return 0
        _require_folders(args)
        return args.run(args)
    except InputError as error:
        sys.stderr.write(f"{program}: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f"{program}: stopped; what is finished is kept, run the same command again to go on\n")
        return 130
    except BrokenPipeError:  # the reader of a list closed early, e.g. `sdps list materials | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a name that is too long, a folder that may not be read, a disk that vanished
        if error.filename is None:
            raise
        name = os.fsdecode(error.filename) if isinstance(error.filename, bytes) else error.filename
        sys.stderr.write(f"{program}: {InputError(f'{name}: {error.strerror}; name another file or folder')}\n")
        return 2


if __name__ == "__main__":
    sys.exit(main())
