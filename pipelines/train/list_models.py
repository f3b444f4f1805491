"""`sdps models`: the learned models, with parameter counts, roles and what they are trained on."""

import argparse
import json
import sys


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps models`."""
    parser.add_argument("--role", choices=("lighting", "normals", "pixels"), default=None)
    parser.add_argument("--json", action="store_true", help="print JSON")


def main(args: argparse.Namespace) -> int:
    """Print the registry."""
    from pipelines.shared.text_tables import render_text
    from sdps.models.registry import COMBINATIONS, MODELS

    models = {name: item for name, item in MODELS.items() if args.role in (None, item.role)}
    if args.json:
        listed = [
            {"name": name, "role": item.role, "parameters": item.parameters, "paper": item.paper,
             "lights": item.lights, "summary": item.summary, "reconstruction": item.reconstruction,
             "recipe": dict(item.recipe)}
            for name, item in models.items()
        ]  # fmt: skip
        sys.stdout.write(json.dumps(listed, indent=2) + "\n")
        return 0
    rows = [
        [name, f"{item.parameters:,}", item.role, item.paper or "-", item.lights or "-", item.summary]
        for name, item in models.items()
    ]
    header = ["model", "parameters", "role", "paper", "trained on lights of", "what it is"]
    sys.stdout.write(render_text("Models", header, rows, left={0, 2, 3, 4, 5}))
    if args.role is None:
        rows = [
            [name, f"{pair.parameters():,}", " + ".join(pair.members()), pair.paper or "-", pair.summary]
            for name, pair in COMBINATIONS.items()
        ]
        header = ["combination", "parameters", "models", "paper", "what it is"]
        sys.stdout.write("\n" + render_text("Combinations", header, rows, left={0, 2, 3, 4}))
        sys.stdout.write("\nAny lighting model works with any normal model: --lights NAME --normals NAME.\n")
    return 0
