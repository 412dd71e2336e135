"""What runs cost, before they are begun: hours from measured updates, gigabytes from the replay buffer."""

from __future__ import annotations

import functools
import statistics
from contextlib import closing
from importlib import resources
from typing import Any, NamedTuple

from zoo_configs.algorithms import algorithm_classes, class_from_path
from zoo_configs.cells.cell import Cell
from zoo_configs.cells.rules import family_of, task_name
from zoo_configs.environments import make_env
from zoo_configs.errors import refused
from zoo_configs.measuring.data_files import SPEED, UPDATES, DataFile, Layout, Record
from zoo_configs.training.options import TrainingOptions

GIGABYTE = 1e9
# Of a process besides its replay buffer (data/updates.csv, peak_gigabytes of the open-loop learners: 0.6 to
# 1.1 with small buffers, of the plain interpreter with PyTorch about a third).
PROCESS_GB = 1.0
SIZED_AS = {"quick": "cpu"}  # presets with networks and batches of another
CHECKPOINTS_KEPT = 3  # two, and the one that is being written
MS_AN_HOUR = 3.6e6


class Cost(NamedTuple):
    """
    What one run takes.

    :param hours: On an idle core or GPU like the one measured; None where nothing has been measured
    :param memory: Gigabytes of main memory
    :param disk: Gigabytes of checkpoints
    """

    hours: float | None
    memory: float
    disk: float


def estimate(cell: Cell, options: TrainingOptions, device: str) -> Cost:
    """
    Estimate a run. Additions to a baseline and its learner are not reckoned, only its network and preset;
    evaluations count with episodes of full length.

    :param cell: What is trained
    :param options: How it is trained
    :param device: ``"cpu"`` or ``"cuda"``
    :return: Its cost
    :raises CommandError: if the environment or the buffer refuses its parameters
    """
    steps = options.n_timesteps if options.n_timesteps > 0 else int(cell.hyperparams["n_timesteps"])
    buffer = _buffer_bytes(cell, steps)
    disk = CHECKPOINTS_KEPT * buffer if options.save_freq > 0 else 0.0
    return Cost(_hours(cell, options, steps, device), PROCESS_GB + buffer / GIGABYTE, disk / GIGABYTE)


def _buffer_bytes(cell: Cell, steps: int) -> float:
    """What a run of so many time steps fills of its replay buffer; the rest takes no memory."""
    from sb3_extensions.replay.buffer import ExpertReplayBuffer
    from zoo_configs.training.objects import import_classes

    hyperparams = cell.hyperparams
    algorithm = algorithm_classes()[cell.algo]
    wanted = hyperparams.get("replay_buffer_class")
    cls = class_from_path(wanted) if wanted else getattr(algorithm, "default_replay_buffer_class", None)
    if cls is None or not issubclass(cls, ExpertReplayBuffer):
        return 0.0
    kwargs: dict[str, Any] = dict(import_classes(hyperparams.get("replay_buffer_kwargs", {})))
    capacity, n_envs = int(hyperparams["buffer_size"]), int(hyperparams.get("n_envs", 1))
    with closing(make_env(cell.env_id, hyperparams.get("env_kwargs", {}))) as env, refused("replay buffer"):
        # Nothing is allocated before the first transition.
        buffer = cls(
            capacity,
            env.observation_space,
            env.action_space,
            "cpu",
            n_envs=n_envs,
            gamma=0.99,
            seed=0,
            **kwargs,
        )
    shown = int(hyperparams.get("expert_episodes", 0)) * _longest_episode(cell)
    return float(buffer.table.nbytes) * min(1.0, (steps + shown) / capacity)


def _hours(cell: Cell, options: TrainingOptions, steps: int, device: str) -> float | None:
    family = family_of(cell.env_id)
    network = family.baselines[cell.baseline].network if cell.baseline else None
    update = _update_ms(SIZED_AS.get(str(cell.preset), str(cell.preset)), str(network), device)
    step = _step_ms(task_name(cell.env_id))
    if update is None or step is None:
        return None
    evaluations = steps // options.eval_freq if options.eval_freq > 0 else 0
    evaluated = evaluations * options.eval_episodes * _longest_episode(cell)
    return (_updates(cell, steps) * update + (steps + evaluated) * step) / MS_AN_HOUR


def _updates(cell: Cell, steps: int) -> float:
    """Gradient steps, those before the first time step included."""
    hyperparams = cell.hyperparams
    per_rollout = hyperparams.get("train_freq", 1)
    frequency = per_rollout[0] if isinstance(per_rollout, list | tuple) else per_rollout
    gathered = int(frequency) * int(hyperparams.get("n_envs", 1))
    gradient_steps = int(hyperparams.get("gradient_steps", 1))
    share = gathered if gradient_steps < 0 else gradient_steps
    return float(hyperparams.get("pretrain_steps", 0)) + steps / gathered * share


def _longest_episode(cell: Cell) -> int:
    env_kwargs = cell.hyperparams.get("env_kwargs", {})
    with closing(make_env(cell.env_id, env_kwargs)) as env:
        config: Any = getattr(env.unwrapped, "config", None)
    return int(getattr(config, "max_steps", 0))


def _update_ms(preset: str, network: str, device: str) -> float | None:
    """The mean over measured baselines with this network."""
    wanted = (preset, network, device)
    rows = _measured("updates.csv", UPDATES)
    found = [
        float(row["update_ms"])
        for row in rows
        if (row["preset"], row["network"], row["device"]) == wanted and not row["env_kwargs"]
    ]
    return statistics.fmean(found) if found else None


def _step_ms(task: str) -> float | None:
    """A time step with the expert."""
    rows = _measured("speed.csv", SPEED)
    return next((float(row["step_ms"]) for row in rows if row["env"] == task and not row["env_kwargs"]), None)


@functools.cache
def _measured(name: str, layout: Layout) -> list[Record]:
    """A file of measurements that comes with the package."""
    with resources.as_file(resources.files("zoo_configs") / "data" / name) as path:
        return DataFile(path, layout).read()
