"""`sdps data`: plan, check, show, describe and exchange data folders."""

import argparse
import importlib

from render.errors import unknown

# command: (module, one line of help)
COMMANDS = {
    "plan": ("data_plan", "write the manifest of a preset and estimate disk and time"),
    "status": ("data_status", "tell what is done, failed and left, and at what rate"),
    "validate": ("data_validate", "check every shard of a folder"),
    "preview": ("data_preview", "write contact sheets and a page with light, material and shape statistics"),
    "card": ("data_card", "write the dataset card and Croissant JSON"),
    "export": ("data_export", "write the scenes in a layout that other loaders read"),
    "import": ("data_import", "turn PS-FCN trees and DiLiGenT folders into shards"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the name of the subcommand; its own flags are declared by its module, loaded when it is run."""
    width = max(map(len, COMMANDS))
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "commands:\n" + "".join(f"  {name:<{width}}  {about}\n" for name, (_, about) in COMMANDS.items())
    parser.add_argument("data_command", nargs="?", metavar="COMMAND",
                        help="see below; `sdps data COMMAND --help` lists its flags")  # fmt: skip
    parser.add_argument("rest", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    parser.set_defaults(parser_class=type(parser), print_help=parser.print_help)


def main(args: argparse.Namespace) -> int:
    """Run the chosen subcommand.

    Raises:
        InputError: no such subcommand, or its own complaints.
    """
    if args.data_command is None:
        args.print_help()
        return 0
    if args.data_command not in COMMANDS:
        raise unknown("data command", args.data_command, COMMANDS)
    name, about = COMMANDS[args.data_command]
    module = importlib.import_module(f"pipelines.{name}")
    parser = args.parser_class(prog=f"sdps data {args.data_command}", description=about[0].upper() + about[1:] + ".")
    module.add_arguments(parser)
    return module.main(parser.parse_args(args.rest))
