"""The flags that say how networks are used, the same for every command, and what was used in words."""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, get_args

from sdps.core.lighting import ReadOut
from sdps.core.precision import PRECISIONS
from sdps.inference.inference_config import VIEWS, InferenceConfig

if TYPE_CHECKING:
    from sdps.methods.runner import Runner


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare a flag per option of `InferenceConfig` that is a matter of choice, with its defaults."""
    default = InferenceConfig()
    parser.add_argument("--read-out", default=default.read_out, choices=get_args(ReadOut),
                        help="how light classes become lights (the paper: centre; default: %(default)s)")  # fmt: skip
    parser.add_argument("--precision", default=default.precision, metavar="|".join(PRECISIONS),
                        help="arithmetic of networks (default: auto, what is faster; see `sdps doctor`)")  # fmt: skip
    counts = ", ".join(map(str, VIEWS))
    parser.add_argument("--light-views", type=int, default=default.light_views, metavar="N",
                        help=f"turned views lights are averaged over: {counts} (default: the method's)")  # fmt: skip
    parser.add_argument("--normal-views", type=int, default=default.normal_views, metavar="N",
                        help="the same for normals, each at full cost (default: the method's)")  # fmt: skip
    parser.add_argument("--keep-stray-light", dest="stray_light", action="store_false",
                        help="do not remove the light that reaches shadowed parts of the object")  # fmt: skip


def describe(runners: Sequence["Runner"], config: InferenceConfig) -> str:
    """Say how networks were used, where there are any."""
    estimator = next((runner.estimator for runner in runners if runner.estimator), None)
    if estimator is None:
        return ""
    views = [
        f"{what} averaged over {count} views"
        for what, count in (("lights", config.light_views), ("normals", config.normal_views))
        if count is not None
    ]
    stray = "stray light taken off" if config.stray_light else "stray light left on"
    parts = [f"light classes read out by {config.read_out} unless a row says otherwise", *views, stray]
    return f" Networks: {', '.join(parts)}; {estimator.arithmetic.describe()}."
