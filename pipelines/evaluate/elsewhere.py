"""Objects evaluated on the workers of a cluster; what they find is kept here, as if it had been found here."""

import hashlib
import tempfile
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.evaluate.evaluation import Entry, Evaluation, TestObject, code_identity
from pipelines.shared.cluster.cluster_config import ClusterChoice
from pipelines.shared.cluster.mapped import mapped
from render.running.cluster_worker import Mismatch
from render.shared.files import atomic_path
from render.shared.progress import progress_bar
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.method import Method
from sdps.methods.pretrained import shipped_folder
from sdps.methods.runner import Runner


class Weights(NamedTuple):
    """A weights file: its name, and its bytes where it is not one that every worker has."""

    name: str
    data: bytes


class Job(NamedTuple):
    """An object, with its images, and the methods to run on it.

    Attributes:
        item: The object.
        methods: The methods, with the identity of each as it is here.
        weights: The files of their networks, by the name that methods know them by.
        config: How networks are used.
        keep: Methods whose normal maps are kept.
    """

    item: TestObject
    methods: tuple[tuple[Method, str], ...]
    weights: dict[str, Weights]
    config: InferenceConfig
    keep: tuple[str, ...]


def evaluate_elsewhere(
    cluster: ClusterChoice,
    evaluation: Evaluation,
    items: Iterable[tuple[TestObject, Collection[str]]],
    total: int,
    runners: Sequence[Runner],
    config: InferenceConfig,
) -> None:
    """Run methods on a cluster's workers on the objects that an evaluation has no results of.

    Args:
        cluster: The cluster; left alone where all results are known.
        evaluation: What takes the results.
        items: Objects, each with the methods whose normal maps are kept; asked for one by one.
        total: Their number.
        runners: The methods.
        config: How networks are used.

    Raises:
        InputError: the cluster fails, or a worker computes on another kind of processor.
    """
    methods = tuple((runner.method, runner.identity()) for runner in runners)
    weights = {name: _packed(path) for runner in runners for name, path in runner.files.items()}
    with progress_bar(total=total, desc="evaluate", unit="object") as bar:

        def left() -> Iterator[tuple[TestObject, Collection[str]]]:
            for item, keep in items:
                if evaluation.lacks(item, runners, keep):
                    yield item, keep
                else:
                    bar.update()

        remaining = left()
        first = next(remaining, None)
        if first is None:
            return
        jobs = _jobs(chain([first], remaining), methods, weights, config)
        for entries in mapped(cluster, evaluate_there, jobs, code_identity):
            for entry in entries:
                evaluation.adopt(entry)
            bar.update()


def _jobs(
    items: Iterable[tuple[TestObject, Collection[str]]],
    methods: tuple[tuple[Method, str], ...],
    weights: dict[str, Weights],
    config: InferenceConfig,
) -> Iterator[Job]:
    """Yield jobs, images read when a job is sent: few are in memory, and what is too large for it is left to us."""
    for item, keep in items:
        images = item.load()  # (L, H, W, 3)
        if isinstance(images, np.ndarray):
            yield Job(replace(item, load=partial(np.asarray, images)), methods, weights, config, tuple(keep))


def evaluate_there(job: Job) -> list[Entry]:
    """Run the methods of a job on this worker.

    Raises:
        Mismatch: results would be filed as another machine's.
    """
    runners = []
    for method, identity in job.methods:
        runners.append(Runner(method, lambda name: _unpacked(job.weights[name]), job.config))
        if runners[-1].identity() != identity:
            raise Mismatch(
                f"runs {method.name} on another kind of processor than this machine; use workers of its kind"
            )
    with tempfile.TemporaryDirectory() as folder:
        evaluation = Evaluation(Path(folder))
        evaluation.results(job.item, runners, job.keep)
        return list(evaluation.entries())


@cache
def _packed(path: Path) -> Weights:
    """Return what a worker needs to have a weights file; those of the package it has."""
    ours = path.resolve().parent == shipped_folder().resolve()
    return Weights(path.name, b"" if ours else path.read_bytes())


@cache
def _place() -> "tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="sdps-weights-")  # gone with this process


def _unpacked(weights: Weights) -> Path:
    """Return the place of a weights file on this worker, the same for the same bytes, so that it is loaded once."""
    if not weights.data:
        return shipped_folder() / weights.name
    path = Path(_place().name) / f"{hashlib.sha256(weights.data).hexdigest()[:16]}-{weights.name}"
    if not path.is_file():
        with atomic_path(path) as temporary:
            temporary.write_bytes(weights.data)
    return path
