"""`sdps demo`: the whole line on one preset, its minutes fitted to the machine and said before it starts."""

import argparse
import sys

from pipelines.shared import presets
from pipelines.shared.demo_plan import plan_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps demo`."""
    presets.add_common_arguments(parser, default="demo")
    parser.add_argument("--materials", default="gold-metallic-paint,chrome,lambertian:0.5",
                        help="materials that the bunny is regenerated in")  # fmt: skip
    parser.add_argument("--light-set", default="merltest", help="light set that it is regenerated under")
    parser.add_argument("--lights", dest="light_set", default="merltest", help=argparse.SUPPRESS)  # its earlier name


def main(args: argparse.Namespace) -> int:
    """Plan, say so, and run the commands of the line one after the other."""
    preset, out = presets.from_arguments(args)
    plan = plan_of(preset, out)
    sys.stdout.write(plan.describe(preset))
    sys.stdout.flush()
    settings = [word for item in (*plan.overrides(preset), *args.overrides) for word in ("--set", item)]
    common = ["--preset", args.preset, *settings, "--out"]
    commands = (
        ["render-data", *common, str(out)],
        ["train", *common, str(out)],
        ["evaluate", "merltest", *common, str(out)],
        ["regenerate", *common, str(out / "regenerated"), "--shapes", "bunny", "--materials", args.materials,
         "--light-set", args.light_set],
    )  # fmt: skip
    from pipelines.cli import main as run

    for command in commands:
        code = run(command)
        if code:
            return code
    sys.stdout.write(f"open {out / 'report.html'}\n")
    return 0
