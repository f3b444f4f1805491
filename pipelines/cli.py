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
    """

    module: str
    about: str
    declare: str = "add_arguments"
    run: str = "main"
    stores: bool = False
    hidden: bool = False


class Group(NamedTuple):
    """Commands under a common first word."""

    about: str
    commands: Mapping[str, Command]


DATA = Group("plan, check, preview, describe, export, relight and import data folders", {
    "plan": Command("pipelines.data.data_plan", "plan the scenes of a preset; estimate disk and time", stores=True),
    "status": Command("pipelines.data.data_status", "show what is done, failed and left, and the rate", stores=True),
    "validate": Command("pipelines.data.data_validate", "check every shard of a folder", stores=True),
    "preview": Command("pipelines.data.data_preview",
                       "write contact sheets and a page with light, material and shape statistics", stores=True),
    "card": Command("pipelines.data.data_card", "write the dataset card and Croissant JSON", stores=True),
    "export": Command("pipelines.data.data_exchange", "write scenes in a layout other loaders read", stores=True),
    "relight": Command("pipelines.data.data_relight", "mix images under many lights from a light stage"),
    "import": Command("pipelines.data.data_exchange", "turn PS-FCN trees and DiLiGenT folders into shards",
                      "add_import_arguments", "import_main"),
    "pack": Command("pipelines.data.data_pack", "pack scenes into WebDataset tars for streaming", stores=True),
})  # fmt: skip

EVALUATE = Group("score methods on rendered scenes and real photographs, and write the report", {
    "merltest": Command("pipelines.evaluate.merltest", "render and score MERL-Test scenes"),
    "diligent": Command("pipelines.evaluate.benchmarks.diligent", "score methods on DiLiGenT's objects, by folder"),
    "gourd-apple": Command("pipelines.evaluate.benchmarks.measured_lights", "score lights on Gourd&Apple",
                           "add_gourd_apple_arguments"),
    "light-stage": Command("pipelines.evaluate.benchmarks.measured_lights",
                           "score lights on the Light Stage Data Gallery", "add_light_stage_arguments"),
    "uw": Command("pipelines.evaluate.benchmarks.uw",
                  "score uncalibrated methods on photographs of the University of Washington"),
    "classical": Command("pipelines.evaluate.classical", "compare the classical methods on rendered scenes"),
    "report": Command("pipelines.evaluate.report.page", "collect everything evaluated into one page"),
})  # fmt: skip

COMMANDS: dict[str, Command | Group] = {
    "infer": Command("pipelines.infer", "find normals, lights and a surface in a folder of photographs"),
    "app": Command("pipelines.app.app", "serve a local page for photographs, scenes and data"),
    "doctor": Command("pipelines.doctor", "show what this machine has and what is missing"),
    "demo": Command("pipelines.demo", "render, train, evaluate and regenerate, fitted to this machine"),
    "render-data": Command("pipelines.rendering.render_data", "render the training scenes of a preset", stores=True),
    "data": DATA,
    "models": Command("pipelines.train.list_models", "list the learned models"),
    "train": Command("pipelines.train.train", "train models, by default LCNet, then NENet", stores=True),
    "evaluate": EVALUATE,
    "regenerate": Command("pipelines.rendering.regenerate", "render test scenes of chosen shapes and materials"),
    "fit-material": Command("pipelines.rendering.fit_material", "fit the built-in model to a MERL .binary table"),
    "materials": Command(
        "pipelines.rendering.catalogue", "list the built-in materials", "add_material_arguments", "materials_main"
    ),
    "shapes": Command("pipelines.rendering.catalogue", "list the shape families", "add_shape_arguments", "shapes_main"),
    "eval-merltest": EVALUATE.commands["merltest"]._replace(hidden=True),
    "eval-diligent": EVALUATE.commands["diligent"]._replace(hidden=True),
    "eval-lights": Command("pipelines.evaluate.benchmarks.measured_lights",
                           "score lights on Gourd&Apple or Light Stage", hidden=True),
    "eval-classical": EVALUATE.commands["classical"]._replace(hidden=True),
    "eval-photos": EVALUATE.commands["uw"]._replace(hidden=True),
    "report": EVALUATE.commands["report"]._replace(hidden=True),
}  # fmt: skip

IN_LAB = ("bench", "bench-checks", "bench-classical", "bench-infer", "bench-surface", "bench-train",
          "eval-figures", "noise", "ship", "shipped-results")  # fmt: skip
"""Commands that `lab` has, which is not installed."""

Commands = Mapping[str, Command | Group]


class _Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line."""

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
        told: dict[str, Any] = {"description": f"{about[0].upper()}{about[1:]}."} | ({} if hidden else {"help": about})
        child = children.add_parser(name, **told)
        if name != wanted:
            continue
        if isinstance(command, Group):
            _add_commands(child, command.commands, words[1:], f"{name} command")
        else:
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
    except BrokenPipeError:  # the reader of a list closed early, e.g. `sdps materials | head`
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
