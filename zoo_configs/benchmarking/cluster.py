"""A benchmark on a Ray cluster: each run is a Ray task; all machines share the folder."""

import contextlib
import logging
import os
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from zoo_configs.benchmarking.process import GRACE, POLL, ExitCode, JobProcess, check_storage, stop
from zoo_configs.benchmarking.run import GIGABYTE
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError, reason
from zoo_configs.files import check_writable
from zoo_configs.provenance import versions
from zoo_configs.training.runs import Run
from zoo_configs.training.state import State, set_status

CONNECTING_SECONDS = 15.0
CONNECT = "import logging, ray, sys; ray.init(address=sys.argv[1], logging_level=logging.ERROR)"
TOKEN = ".benchmark-"
"""Prefix of the files by which machines find out whether they share a folder."""
STARTS_FILE = ".starts"
MAX_STARTS = 10
"""Number of times that a run starts from the same checkpoint."""
SETTLING_SECONDS = 10.0
"""Duration until the other machines see a new file: NFS caches folders."""
RESOURCES = {"CPU": "num_cpus", "GPU": "num_gpus", "memory": "memory"}
"""Option of a Ray task, by resource of a machine."""
Resources = Mapping[str, float]
"""Options of a Ray task: ``num_cpus``, ``num_gpus`` and ``memory`` (bytes)."""


def check_address(address: str) -> None:
    """Raise ``CommandError`` if Ray is not installed or no cluster answers within ``CONNECTING_SECONDS``."""
    if find_spec("ray") is None:
        raise CommandError("--ray needs Ray: pip install 'bulletarm-gym[cluster]'")
    command, why = [sys.executable, "-c", CONNECT, address], f"no answer within {CONNECTING_SECONDS:g} s"
    try:  # in another process, because ``ray.init`` retries a dead address for many minutes
        subprocess.run(command, capture_output=True, text=True, timeout=CONNECTING_SECONDS, check=True)
    except subprocess.SubprocessError as error:
        if isinstance(error, subprocess.CalledProcessError):
            why = (error.stderr.strip().splitlines() or [f"exit code {error.returncode}"])[-1]
        advice = "Start one with `ray start --head`. If it asks for a token, set RAY_AUTH_MODE=token"
        raise CommandError(f"--ray: no Ray cluster at {address} ({why}). {advice}") from error


def machines() -> list[dict[str, Any]]:
    """Return Ray's descriptions of the machines that can train."""
    import ray

    found: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return [node for node in found if node["Alive"] and node["Resources"].get("CPU", 0) > 0]


def check_resources(resources: Mapping[Path, Resources]) -> None:
    """Raise ``CommandError`` if no machine is large enough for a run, which would wait forever."""
    nodes = [node["Resources"] for node in machines()]
    for folder, needed in resources.items():
        if not any(
            all(needed[key] <= node.get(part, 0.0) for part, key in RESOURCES.items()) for node in nodes
        ):
            raise CommandError(
                f"no machine of the cluster is large enough for {folder}: {needed['num_cpus']:g} CPU, "
                f"{needed['num_gpus']:g} GPU, {needed['memory'] / GIGABYTE:.1f} GB (--cpus, --gpus, --memory)"
            )


@contextmanager
def connected(address: str, folder: Path, gym_packages: Sequence[str]) -> Iterator[Path]:
    """Connect to a Ray cluster, check its machines, and provide a file by which they recognize the folder."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    (token := folder / f"{TOKEN}{uuid.uuid4().hex}").touch()
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        check = ray.remote(num_cpus=0, max_retries=3)(check_machine)
        for node in machines():
            strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            here = check.options(scheduling_strategy=strategy)
            where = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            _result(here.remote(token, tuple(gym_packages), versions()), where)
        yield token
    finally:
        ray.shutdown()
        token.unlink(missing_ok=True)


def check_machine(token: Path, gym_packages: Sequence[str], required: Mapping[str, str]) -> None:
    """Raise ``CommandError`` if a machine of the cluster cannot train, or continue runs of the others."""
    _check_shared(token)
    check_writable(token, "--log-folder")
    register_environments(gym_packages)
    own = versions()
    if others := [
        f"{name} {own[name]}, required {required[name]}" for name in own if own[name] != required[name]
    ]:
        raise CommandError(f"other versions: {'; '.join(others)}")


def _result(reference: Any, what: str) -> Any:
    """Return the result of a Ray task; raise ``CommandError``, which starts with ``what``, if it failed."""
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        raise CommandError(f"{what}: {reason(getattr(error, 'cause', None) or error)}") from error


def _check_shared(token: Path) -> None:
    last = time.monotonic() + SETTLING_SECONDS
    while not token.exists():
        if time.monotonic() > last:
            where = f"{token.parent} at this path"
            raise CommandError(f"{socket.gethostname()} must mount {where}, as all machines")
        time.sleep(POLL)


def train(job: Run, token: Path, directory: Path) -> int:
    """
    Train one run on a machine of the cluster and return its exit code; Ray would repeat a failed task.

    :param directory: Working directory of the benchmark, to which its relative paths refer
    """
    _check_shared(token)
    with contextlib.suppress(OSError):  # without relative paths no machine needs it
        os.chdir(directory)
    if _starts(job, token) > MAX_STARTS:
        error = f"lost {MAX_STARTS} times at the same checkpoint. It may need more memory"
        set_status(job.folder, State.FAILED, error)
        return int(ExitCode.FAILED)
    visible = {name: os.environ[name] for name in ("CUDA_VISIBLE_DEVICES",) if name in os.environ}
    process = JobProcess(job, visible)
    try:
        while not process.wait(POLL):  # Ray can interrupt between short waits
            pass
    finally:
        stop([process])
    return int(process.exit_code())


def _starts(job: Run, token: Path) -> int:
    """Count the starts of a run from its newest checkpoint in this benchmark."""
    newest = " ".join(sorted(path.name for path in job.checkpoint_folder.glob("[!.]*")))
    job.folder.mkdir(parents=True, exist_ok=True)
    with (job.folder / STARTS_FILE).open("a+", encoding="utf-8") as file:
        file.write(f"{token.name} {newest}\n")
        file.seek(0)
        return file.read().splitlines().count(f"{token.name} {newest}")


def run_on_ray(
    jobs: Sequence[Run], resources: Mapping[Path, Resources], token: Path, look: Callable[[], None]
) -> None:
    """
    Train runs on the connected cluster. A run that is lost with its machine resumes on another one.

    :raises CommandError: if the storage is full, or a machine cannot read it; the runs are interrupted
    :raises KeyboardInterrupt: after Ctrl-C, when the runs have stopped
    """
    import ray

    remote = ray.remote(max_retries=-1, retry_exceptions=False)(train)
    running = {}
    for job in jobs:
        options = {**resources[job.folder], "name": str(job.folder)}
        running[remote.options(**options).remote(job, token, Path.cwd())] = job.folder
    try:
        while running:
            ended, _ = ray.wait(list(running), num_returns=1, timeout=POLL)
            for reference in ended:
                run_folder = running.pop(reference)
                check_storage(_result(reference, str(run_folder)), run_folder)
            look()
    finally:
        for reference in running:
            ray.cancel(reference, force=False)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=GRACE)
