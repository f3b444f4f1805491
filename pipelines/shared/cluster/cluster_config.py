"""The flags `--cluster` and `--cluster-config`, and what they may say."""

import argparse
import re
from dataclasses import dataclass, field
from typing import Any

from render.shared.config import build, check_fields, read_yaml
from render.shared.errors import InputError, unknown

BATCH = {"slurm": ("SLURMCluster", "sbatch"), "pbs": ("PBSCluster", "qsub"), "lsf": ("LSFCluster", "bsub")}
"""Batch systems: the class of dask-jobqueue, and the command that submits a job."""
KUBERNETES = "kubernetes"
_LOCAL = re.compile(r"local:([1-9][0-9]{0,3})")
_ADDRESS = re.compile(r"(tcp|tls|ws|wss|ucx)://\S+:\d+")


@dataclass(frozen=True, kw_only=True)
class ClusterConfig:
    """What `--cluster-config` holds.

    Attributes:
        jobs: Jobs to submit to a batch system, or pods to start.
        patience: Seconds a run waits for a lost scheduler to answer again before it ends.
        job: What each job is: the arguments of `dask_jobqueue.SLURMCluster` and its like, or of
            `dask_kubernetes.operator.KubeCluster`.
    """

    jobs: int = 1
    patience: float = 300.0
    job: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self, "at least 1", "jobs")
        check_fields(self, "not negative", "patience")


@dataclass(frozen=True, kw_only=True)
class ClusterChoice:
    """A cluster as the flags name it.

    Attributes:
        name: An address, `local:N`, a batch system, or `kubernetes`.
        config: What its file says.
        file: That file, for messages.
    """

    name: str
    config: ClusterConfig = field(default_factory=ClusterConfig)
    file: str = "--cluster-config"

    def __post_init__(self) -> None:
        if not (self.name in (*BATCH, KUBERNETES) or self.local or _ADDRESS.fullmatch(self.name)):
            if re.match(r"[a-z]+://", self.name) or self.name.startswith("local"):
                raise InputError(f"--cluster {self.name}: expected tcp://HOST:PORT or local:N, N from 1 to 9999")
            raise unknown("cluster", self.name, [*BATCH, KUBERNETES], "or give tcp://HOST:PORT or local:N")
        if self.name in (*BATCH, KUBERNETES) and not self.config.job:
            raise InputError(f"--cluster {self.name}: needs --cluster-config FILE with the section `job`")

    @property
    def local(self) -> int:
        """Number of workers on this machine; 0 for other clusters."""
        match = _LOCAL.fullmatch(self.name)
        return int(match.group(1)) if match else 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of commands that can work on a cluster."""
    where = "a scheduler's tcp://HOST:PORT, local:N, slurm, pbs, lsf or kubernetes (default: this machine alone)"
    parser.add_argument("--cluster", default=None, metavar="WHERE", help=f"work on a Dask cluster: {where}")
    parser.add_argument("--cluster-config", default=None, metavar="FILE",
                        help="YAML file: jobs, patience, and what a job is (job)")  # fmt: skip


def from_arguments(args: argparse.Namespace) -> ClusterChoice | None:
    """Return the cluster the flags name, if they name one.

    Raises:
        InputError: not a cluster, or a bad file.
    """
    if args.cluster is None:
        if args.cluster_config is not None:
            raise InputError("--cluster-config: goes with --cluster")
        return None
    if getattr(args, "workers", 0):
        raise InputError("--workers: is for processes of this machine; the cluster decides how many it has")
    if args.cluster_config is None:
        return ClusterChoice(name=args.cluster)
    file = args.cluster_config
    try:
        config = build(ClusterConfig, read_yaml(file))
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(file) else f"{file}: {text}") from error
    return ClusterChoice(name=args.cluster, config=config, file=file)
