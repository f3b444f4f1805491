"""`python -m lab`, run in a clone: benchmarks, the paper's figures, studies of the renderer, releases of weights."""

from collections.abc import Sequence

from pipelines import cli
from pipelines.cli import Command

COMMANDS = {
    "bench": Command("lab.bench.bench", "measure the renderer against Mitsuba's path integrator"),
    "bench-checks": Command("lab.bench.bench_checks", "count false alarms and hits of the photograph checks"),
    "bench-classical": Command("lab.bench.bench_classical", "time the classical methods on a large object"),
    "bench-infer": Command("lab.bench.bench_infer", "time sdps infer on photographs of a large object"),
    "bench-surface": Command("lab.bench.bench_surface", "score and time depth, meshes and relit pictures"),
    "bench-train": Command("lab.bench.bench_train", "measure training against a plain float32 loop"),
    "eval-figures": Command("lab.figures.eval_figures", "make the paper's figures on MERL-Test scenes"),
    "noise": Command("lab.bench.image_noise", "measure the renderer's noise against converged images"),
    "ship": Command("lab.releases.ship", "copy trained weights to where commands find them without being told"),
    "shipped-results": Command("lab.releases.shipped_results", "write down how good the pretrained weights are"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code, as `pipelines.cli.main` does."""
    return cli.main(argv, COMMANDS, "lab")
