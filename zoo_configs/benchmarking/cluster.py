"""A benchmark on a Ray cluster: a run is a Ray task, and the folder is storage that all machines share."""

from __future__ import annotations

import logging
import os
import socket
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from zoo_configs.benchmarking.child import Ending, RunProcess, Task
from zoo_configs.benchmarking.local import GRACE, POLL, check_storage, stop
from zoo_configs.errors import CommandError, reason
from zoo_configs.training.runs import CHECKPOINT_FOLDER
from zoo_configs.training.state import State, note

GIGABYTE = 1e9
TOKEN = ".benchmark-"  # begins the names of the files by which machines find out whether they share a folder
BEGINNINGS_FILE = ".beginnings"
MOST_LOST = 10  # beginnings of a run from one checkpoint
SETTLING = 10.0  # seconds until what one machine has written is seen by others (NFS caches folders for some)
# What must be of one version on all machines: a run may begin on one and go on on another.
ALIKE = ("bulletarm-gym", "torch", "stable-baselines3", "gymnasium", "pybullet", "numpy")


@dataclass(frozen=True)
class Share:
    """
    What a run takes of a machine.

    :param cpus: Cores, the threads of a run
    :param gpus: GPUs; a fraction lets runs share one
    :param memory: Gigabytes
    """

    cpus: float
    gpus: float
    memory: float

    def as_options(self) -> dict[str, Any]:
        """As Ray takes it."""
        return {"num_cpus": self.cpus, "num_gpus": self.gpus, "memory": int(self.memory * GIGABYTE)}

    def fits(self, resources: Mapping[str, float]) -> bool:
        """Whether a machine has as much."""
        memory = resources.get("memory", 0.0) / GIGABYTE
        return (
            self.cpus <= resources.get("CPU", 0.0)
            and self.gpus <= resources.get("GPU", 0.0)
            and self.memory <= memory
        )


class NotShared(Exception):
    """A machine does not see the benchmark's folder."""


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """
    Join a Ray cluster.

    :param address: Its address, None for the one that this machine belongs to
    :return: Context manager
    :raises CommandError: if Ray is not installed, or there is no cluster
    """
    try:
        import ray
    except ImportError as error:
        raise CommandError("--ray needs Ray: pip install 'bulletarm-gym[cluster]'") from error
    try:
        ray.init(address=address or "auto", log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        where = f"at {address}" if address else "on this machine"
        advice = "ray start --head begins one; where it asks for a token, set RAY_AUTH_MODE=token"
        raise CommandError(f"--ray: no Ray cluster {where} ({reason(error)}); {advice}") from error
    try:
        yield
    finally:
        ray.shutdown()


def machines() -> list[dict[str, Any]]:
    """
    The machines of the cluster that can train.

    :return: What Ray says of each
    """
    import ray

    found: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return [node for node in found if node["Alive"] and node["Resources"].get("CPU", 0) > 0]


def check_shares(shares: Mapping[str, Share]) -> None:
    """
    Look whether every run finds a machine; one that does not would wait for ever.

    :param shares: What each run takes, by its name
    :raises CommandError: if there is none that is large enough
    """
    resources = [node["Resources"] for node in machines()]
    for name, share in shares.items():
        if not any(share.fits(of_node) for of_node in resources):
            raise CommandError(
                f"no machine of the cluster has what {name} takes: {share.cpus:g} CPU, "
                f"{share.gpus:g} GPU, {share.memory:.1f} GB (--cpus, --gpus, --memory)"
            )


@contextmanager
def shared_folder(folder: Path, gym_packages: Sequence[str]) -> Iterator[str]:
    """
    Look on every machine whether it shares the folder, and has the same versions.

    :param folder: The benchmark's folder
    :param gym_packages: Packages that must be found there as well
    :return: Context manager of the name of a file in it, by which machines that join later know it
    :raises CommandError: if one does not, naming it
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def ask(node: Mapping[str, Any]) -> Any:
        strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        remote = ray.remote(num_cpus=0, max_retries=3)(answer).options(scheduling_strategy=strategy)
        try:
            return ray.get(remote.remote(folder, token, node["NodeID"], tuple(gym_packages)))
        except ray.exceptions.RayError as error:
            return f"cannot work: {reason(getattr(error, 'cause', None) or error)}"

    token = f"{TOKEN}{uuid.uuid4().hex}"
    (folder / token).touch()
    try:
        for node in machines():
            check_answer(folder, token, node, ask(node))
        yield token
    finally:
        for path in folder.glob(f"{token}*"):
            path.unlink(missing_ok=True)


def answer(folder: Path, token: str, node: str, gym_packages: Sequence[str]) -> dict[str, str] | str:
    """
    On a machine of the cluster: say whether the folder is seen, by a file in it.

    :param folder: The benchmark's folder
    :param token: The file that stands in it
    :param node: What the machine is called
    :param gym_packages: Packages that must be found
    :return: Versions, or what is wrong
    """
    from zoo_configs.environments import register_environments

    if not _appears(folder / token):
        return f"does not see {folder} as this machine does"
    try:
        (folder / f"{token}-{node}").touch()
        register_environments(gym_packages)
    except (CommandError, OSError) as error:
        return reason(error)
    return {name: metadata.version(name) for name in ALIKE}


def check_answer(folder: Path, token: str, node: Mapping[str, Any], said: Any) -> None:
    """
    Judge what a machine has answered.

    :param folder: The benchmark's folder
    :param token: The file that stands in it
    :param node: What Ray says of the machine
    :param said: Its answer
    :raises CommandError: if it cannot train here
    """
    where = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
    if isinstance(said, str):
        advice = "all machines must have it mounted at this path" if "does not see" in said else ""
        raise CommandError(f"{where} {said}" + (f": {advice}" if advice else ""))
    if not _appears(folder / f"{token}-{node['NodeID']}"):
        raise CommandError(f"{where} has a folder {folder} of its own: all machines must share one")
    ours = {name: metadata.version(name) for name in ALIKE}
    if other := [name for name in ALIKE if said[name] != ours[name]]:
        theirs = ", ".join(f"{name} {said[name]} (here {ours[name]})" for name in other)
        raise CommandError(f"{where} has other versions: {theirs}")


def _appears(path: Path) -> bool:
    last = time.monotonic() + SETTLING
    while not path.exists():
        if time.monotonic() > last:
            return False
        time.sleep(POLL)
    return True


def train(task: Task, token: str) -> int:
    """
    On a machine of the cluster: train one run in a process of its own. What the run does wrong is in its
    folder and no error of this task, which Ray would repeat.

    :param task: The run
    :param token: The file that stands in the benchmark's folder
    :return: How it ended
    :raises NotShared: if the folder is not to be seen
    """
    if not _appears(task.folder / token):
        raise NotShared(
            f"{socket.gethostname()} does not see {task.folder}: all machines must have it mounted there"
        )
    if not _gets_on(task, token):
        note(task.place, State.FAILED, f"lost {MOST_LOST} times at the same place: does it need more memory?")
        return int(Ending.FAILED)
    visible = {name: os.environ[name] for name in ("CUDA_VISIBLE_DEVICES",) if name in os.environ}
    process = RunProcess(replace(task, environ=visible))
    try:
        while not process.wait(POLL):  # in short waits, between which Ray can interrupt
            pass
    finally:
        stop([process])
    return int(process.ending())


def _gets_on(task: Task, token: str) -> bool:
    """
    Count how often a run has begun at the same checkpoint in one benchmark. Ray repeats for ever what is lost
    for ever, such as a run that takes more memory than there is.
    """
    checkpoints = task.place / CHECKPOINT_FOLDER
    newest = " ".join(sorted(path.name for path in checkpoints.glob("[!.]*")))
    task.place.mkdir(parents=True, exist_ok=True)
    with (task.place / BEGINNINGS_FILE).open("a+", encoding="utf-8") as file:
        file.write(f"{token} {newest}\n")
        file.seek(0)
        return file.read().splitlines().count(f"{token} {newest}") <= MOST_LOST


def run_on_ray(
    tasks: Sequence[Task], shares: Mapping[str, Share], token: str, look: Callable[[], None]
) -> None:
    """
    Train runs on the cluster that is connected. One whose worker or machine is lost begins again elsewhere,
    from its last checkpoint; one that fails for itself does not stop the others.

    :param tasks: The runs, in the order in which they are begun
    :param shares: What each takes, by its name
    :param token: From :func:`shared_folder`
    :param look: Called now and then
    :raises CommandError: if the storage is full, or a machine does not see it; the runs can go on
    :raises KeyboardInterrupt: after Ctrl-C, when the runs have stopped
    """
    import ray

    remote = ray.remote(max_retries=-1, retry_exceptions=False)(train)
    running = {}
    for task in tasks:
        name = task.member.name
        running[remote.options(**shares[name].as_options(), name=name).remote(task, token)] = task
    try:
        while running:
            ended, _ = ray.wait(list(running), num_returns=1, timeout=POLL)
            for reference in ended:
                _take(reference, running.pop(reference))
            look()
    finally:
        for reference in running:
            ray.cancel(reference, force=False)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=GRACE)


def _take(reference: Any, task: Task) -> None:
    import ray

    try:
        check_storage(Ending(ray.get(reference)), task)
    except ray.exceptions.RayTaskError as error:
        raise CommandError(f"{task.member.name}: {reason(error.cause or error)}") from error
    except ray.exceptions.RayError as error:
        raise CommandError(f"{task.member.name}: the cluster is lost: {reason(error)}") from error
