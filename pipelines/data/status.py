"""`sdps data status`: what of a data folder is done, failed and left, and when it will be finished."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from render.planning import budget
from render.planning.folder_state import folder_state
from render.records.mirror import open_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of `sdps data status`."""
    parser.add_argument("folder", type=Path, help="data folder, e.g. out/small/data")
    parser.add_argument("--verify", action="store_true", help="check every shard by its hash")
    parser.add_argument("--json", action="store_true", help="print JSON")


def main(args: argparse.Namespace) -> int:
    """Print the state of the folder."""
    with open_folder(args.folder) as folder:
        state = folder_state(folder, verify=args.verify)
    sys.stdout.write(json.dumps(state, indent=2) + "\n" if args.json else render_text(state))
    return 0


def render_text(state: dict[str, Any]) -> str:
    """Lay out a state for people."""
    lines = [
        f"{state['folder']}: {state['done']:,} of {state['scenes']:,} scenes done, {state['failed']:,} failed, "
        f"{state['left']:,} left"
    ]
    if state["damaged"]:
        lines[0] += f" ({state['damaged']:,} of them damaged or unfinished on disk)"
    for reason, count in state["reasons"].items():
        lines.append(f"failed: {count:,} x {reason}")
    if state["overall_per_hour"]:
        lines.append(
            f"rate: {state['recent_per_hour'] or 0:,.0f} scenes/hour over the last {budget.RECENT}, "
            f"{state['overall_per_hour']:,.0f} overall; last one {budget.duration(state['seconds_since_last'])} ago"
        )
    if state["left"] and state["seconds_left"]:
        lines.append(f"left: about {budget.duration(state['seconds_left'])} at this rate")
    free = f", {budget.gigabytes(state['bytes_free'])} free" if state["bytes_free"] is not None else ""
    place = "disk" if free else "store"
    lines.append(
        f"{place}: {budget.gigabytes(state['bytes_used'])} used, about {budget.gigabytes(state['bytes_needed'])} more "
        f"needed{free}"
    )
    return "\n".join(lines) + "\n"
