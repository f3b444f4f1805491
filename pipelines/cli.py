"""The `sdps` command: parse, build, run. Mistakes of the user end in one line and exit code 2."""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from render.errors import InputError, unknown

# command: (module, function that adds flags, function that runs, one line of help)
COMMANDS = {
    "infer": ("infer", "add_arguments", "main", "find normals, lights and a surface in a folder of photographs"),
    "doctor": ("doctor", "add_arguments", "main", "show what this machine has and what is missing"),
    "demo": ("demo", "add_arguments", "main", "render, train, evaluate and regenerate, fitted to this machine"),
    "render-data": ("render_data", "add_arguments", "main", "render the training scenes of a preset"),
    "data": ("data", "add_arguments", "main", "plan, check, preview, describe, export and import data folders"),
    "models": ("models", "add_arguments", "main", "list the learned models"),
    "train": ("train", "add_arguments", "main", "train models, by default LCNet, then NENet"),
    "eval-merltest": ("eval_merltest", "add_arguments", "main", "render and score MERL-Test scenes"),
    "eval-diligent": ("eval_diligent", "add_arguments", "main", "score methods on DiLiGenT's objects, by folder"),
    "eval-lights": ("eval_lights", "add_arguments", "main", "score lighting on Gourd&Apple or the Light Stage gallery"),
    "eval-figures": ("eval_figures", "add_arguments", "main", "make the paper's figures on MERL-Test scenes"),
    "eval-classical": ("eval_classical", "add_arguments", "main", "compare the classical methods on rendered scenes"),
    "eval-photos": (
        "eval_photos",
        "add_arguments",
        "main",
        "score uncalibrated methods on real photographs",
    ),
    "curves": ("curves", "add_arguments", "main", "draw learning curves of runs, and where they are heading"),
    "ship": ("ship", "add_arguments", "main", "copy trained weights to where commands find them without being told"),
    "shipped-results": ("shipped_results", "add_arguments", "main", "write down how good the shipped weights are"),
    "report": ("report", "add_arguments", "main", "collect everything evaluated into one page"),
    "regenerate": ("regenerate", "add_arguments", "main", "render test scenes of chosen shapes and materials"),
    "fit-material": ("fit_material", "add_arguments", "main", "fit the built-in model to a MERL .binary table"),
    "materials": ("catalogue", "add_material_arguments", "materials_main", "list the built-in materials"),
    "shapes": ("catalogue", "add_shape_arguments", "shapes_main", "list the shape families"),
    "noise": ("noise", "add_arguments", "main", "measure the renderer's noise against converged images"),
    "bench-train": ("bench_train", "add_arguments", "main", "measure training against a plain float32 loop"),
    "bench-classical": ("bench_classical", "add_arguments", "main", "time the classical methods on a large object"),
    "bench-checks": ("bench_checks", "add_arguments", "main", "count false alarms and hits of the photograph checks"),
    "bench-infer": ("bench_infer", "add_arguments", "main", "time sdps infer on photographs of a large object"),
    "bench-surface": ("bench_surface", "add_arguments", "main", "score and time depth, meshes and relit pictures"),
    "bench": ("bench", "add_arguments", "main", "measure the renderer against Mitsuba's path integrator"),
}


class _Parser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line."""

    def error(self, message: str) -> None:
        raise InputError(f"{message}; see `{self.prog} --help`")


def build_parser(command: str | None) -> argparse.ArgumentParser:
    """Return the parser; only the flags of `command` are declared, so that others' modules are not loaded."""
    parser = _Parser(prog="sdps", description="Photometric-stereo data and training (SDPS-Net) with Mitsuba 3.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, (module, declare, run, about) in COMMANDS.items():
        child = commands.add_parser(name, help=about, description=about[0].upper() + about[1:] + ".")
        if name == command:
            loaded = importlib.import_module(f"pipelines.{module}")
            getattr(loaded, declare)(child)
            child.set_defaults(run=getattr(loaded, run))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 1 something is missing, 2 bad input, 130 stopped."""
    argv = list(sys.argv[1:] if argv is None else argv)
    command = next((word for word in argv if not word.startswith("-")), None)
    try:
        if command is not None and command not in COMMANDS:
            raise unknown("command", command, COMMANDS)
        parser = build_parser(command)
        args = parser.parse_args(argv)
        if args.command is None:
            parser.print_help()
            return 0
        return args.run(args)
    except InputError as error:
        sys.stderr.write(f"sdps: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("sdps: stopped; what is finished is kept, run the same command again to go on\n")
        return 130
    except BrokenPipeError:  # the reader of a list closed early, e.g. `sdps materials | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
