"""Measure the duration and the memory of one gradient update of baselines, or the overhead of ``train``.

python tools/measure_updates.py --baseline equi_sacfd sacfd --preset cpu --data docs/data/updates.csv
python tools/measure_updates.py --baseline sacfd --preset quick --overhead 300 --data docs/data/overhead.csv

With --overhead, the program trains each baseline five times with model.learn() and five times with
train_experiment(), alternately and without evaluations, and compares the CPU seconds of the process.
"""

import argparse
import contextlib
import io
import multiprocessing
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn
from torch.profiler import profile

from bulletarm_gym.check.machine import describe_machine, load_average
from measurements import Row, keep, number, provenance, show, words
from sb3_extensions.encoders.cnn import precision
from sb3_extensions.equivariant.convolution import PlainConv2d
from sb3_extensions.equivariant.layers import EquivariantConv2d
from sb3_extensions.spatial_dqn import SpatialDQN
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.arguments import Parser, add_env_kwargs, positive_int
from zoo_configs.environments import known_env_id, register_environments
from zoo_configs.experiments.config import ExperimentConfig, resolve
from zoo_configs.experiments.families import family_of, task_name
from zoo_configs.training.objects import parsed
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.train import train_experiment

KEY = ("baseline", "preset", "env", "env_kwargs", "device")
OVERHEAD_KEY = ("baseline", "preset", "env", "env_kwargs", "timesteps")
DEFAULT_ENV = "BulletArm/CloseLoopBlockPicking-v0"
PARTS = {
    "gradients_of_convolutions": ("convolution_backward",),
    "convolutions": ("convolution",),
    "pooling": ("max_pool", "aten::maximum"),
}
"""Parts of an update and substrings of the names of their PyTorch operators; the first match counts."""
REST = "rest"
EXPERT_EPISODES = 5
PROFILED_UPDATES = 5
COMPARED_PASSES = 30
PAIRS = 5
NOT_OF_THE_MODEL = ("n_envs", "n_timesteps", "monitor_kwargs")
"""Hyperparameters of the training loop."""


def main() -> None:
    """Run the program."""
    args = parse()
    register_environments()
    env_id = known_env_id(args.env)
    overrides = {"env_kwargs": args.env_kwargs}
    print(f"{describe_machine()}; {env_id}, preset {args.preset}")
    rows = []
    for baseline in args.baseline:
        experiment = resolve(baseline, args.preset, env_id, overrides)
        if args.overhead:
            rows.append(keep(overhead(experiment, args), args.data, OVERHEAD_KEY))
        else:
            with multiprocessing.get_context("spawn").Pool(1) as pool:  # a process keeps its peak memory
                rows.append(keep(pool.apply(update, (experiment, args)), args.data, KEY))
    show(rows)


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--baseline", nargs="+", required=True, help="baselines")
    add("--preset", default="cpu", help="preset (default: cpu)")
    add("--env", default=DEFAULT_ENV, help=f"environment id (default: {DEFAULT_ENV})")
    add("--seconds", type=float, default=5.0, help="duration of each measurement (default: 5)")
    add("--overhead", type=positive_int, metavar="N", help="measure the overhead of trainings of N steps")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("--num-threads", type=positive_int, help="number of PyTorch threads (default: PyTorch's)")
    add("--data", type=Path, metavar="FILE", help="CSV to add the measurements to")
    add_env_kwargs(parser)
    return parser.parse_args()


def make_model(experiment: ExperimentConfig, device: str = "auto", **changes: Any) -> Any:
    """Return the untrained model of an experiment in one environment.

    :param changes: changed hyperparameters
    """
    hyperparams = {**parsed(experiment.hyperparams), **changes}
    env = gym.make(experiment.env_id, **hyperparams.pop("env_kwargs"))
    for name in NOT_OF_THE_MODEL:
        hyperparams.pop(name, None)
    return algorithm_classes()[experiment.algo](env=env, seed=0, device=device, **hyperparams)


def update(experiment: ExperimentConfig, args: argparse.Namespace) -> Row:
    """Measure one update of a baseline."""
    register_environments()
    if args.num_threads:
        th.set_num_threads(args.num_threads)
    load = load_average()
    skipped = {name: 0 for name in ("pretrain_steps", "contrastive_steps") if name in experiment.hyperparams}
    model = make_model(experiment, args.device, expert_episodes=EXPERT_EPISODES, **skipped)
    model.learn(1)

    def train() -> None:
        model.train(1, model.batch_size)
        if model.device.type == "cuda":
            th.cuda.synchronize(model.device)

    update_ms = 1e3 * median_time(train, args.seconds)
    return {
        **name_of(experiment, args),
        "device": model.device.type,
        "network": family_of(experiment.env_id).baselines[experiment.label].network,
        "threads": str(th.get_num_threads()),
        "update_ms": number(update_ms, 1),
        "peak_gigabytes": number(peak_gigabytes(model.device), 1),
        **{name: number(share, 3) for name, share in shares(train, model.device.type == "cuda").items()},
        "equivariant_over_plain": number(compare_convolutions(model), 2),
        "load": number(load, 1),
        **provenance(model.device.type),
    }


def name_of(experiment: ExperimentConfig, args: argparse.Namespace) -> Row:
    """Return the columns that identify an experiment."""
    names = {"baseline": experiment.label, "preset": str(experiment.preset)}
    return {**names, "env": task_name(experiment.env_id), "env_kwargs": words(args.env_kwargs)}


def median_time(function: Callable[[], None], seconds: float) -> float:
    """Return the median duration (s) of calls made for some seconds; the first call does not count."""
    end, times = time.perf_counter() + seconds, list[float]()
    function()
    while not times or time.perf_counter() < end:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def peak_gigabytes(device: th.device) -> float:
    """Return the peak memory of the GPU or of the process."""
    if device.type == "cuda":
        return th.cuda.max_memory_allocated(device) / 1e9
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6)  # bytes on macOS, kilobytes on Linux


def shares(function: Callable[[], None], on_gpu: bool) -> dict[str, float]:
    """Return the fraction of the computing time of each part."""
    spent = attrgetter("self_device_time_total" if on_gpu else "self_cpu_time_total")
    with profile() as profiler:
        for _ in range(PROFILED_UPDATES):
            function()
    seconds = dict.fromkeys((*PARTS, REST), 0.0)
    for event in profiler.key_averages():
        if event.device_type.name == "CPU":  # the time of a kernel is also that of its operator
            names = (part for part, marks in PARTS.items() if any(mark in event.key for mark in marks))
            seconds[next(names, REST)] += spent(event)
    total = sum(seconds.values())
    return {part: value / total for part, value in seconds.items()}


def convolutional_part(model: Any) -> tuple[nn.Module, Callable[[], object], str | None]:
    """Return the module with the convolutions, a call that runs it, and its autocast type."""
    observations = model.replay_buffer.sample(model.batch_size).observations
    if isinstance(model, SpatialDQN):
        indices, _ = model.q_net.greedy(observations)
        return model.q_net, lambda: model.q_net.values(observations, indices), model.q_net.autocast
    encoder = model.actor.features_extractor.encoder
    return encoder, lambda: model.actor(observations), getattr(encoder, "autocast", None)


def compare_convolutions(model: Any) -> float:
    """Return the time of the equivariant convolutions over that of plain ones of the same width.

    :return: ratio of forward and backward passes; NaN without equivariant convolutions
    """
    module, forward, autocast = convolutional_part(model)
    layers = [layer for layer in module.modules() if isinstance(layer, EquivariantConv2d)]
    inputs: dict[nn.Module, th.Tensor] = {}

    def note(layer: nn.Module, given: tuple[th.Tensor, ...], _: th.Tensor) -> None:
        inputs.setdefault(layer, given[0].detach())

    hooks = [layer.register_forward_hook(note) for layer in layers]
    forward()
    for hook in hooks:
        hook.remove()
    totals = np.zeros(2)
    for layer, features in inputs.items():
        channels = (features.shape[1], layer.out_type.size)
        plain = PlainConv2d(*channels, layer.kernel_size, layer.stride, layer.padding)
        passes = [one_pass(layer, features, autocast), one_pass(plain, features, autocast)]
        times = np.array([[duration(run) for run in passes] for _ in range(COMPARED_PASSES)])
        totals += np.median(times, axis=0)
    return float(totals[0] / totals[1]) if layers else float("nan")


def duration(function: Callable[[], None], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the duration (s) of a call."""
    start = clock()
    function()
    return clock() - start


def one_pass(module: nn.Module, features: th.Tensor, autocast: str | None) -> Callable[[], None]:
    """Return a function that runs a convolution forward and backward."""
    device = features.device
    module, features = module.to(device), features.float().requires_grad_()

    def run() -> None:
        with precision(autocast, device.type):
            outputs = module(features)
        outputs.float().sum().backward()
        if device.type == "cuda":
            th.cuda.synchronize(device)

    return run


def overhead(experiment: ExperimentConfig, args: argparse.Namespace) -> Row:
    """Compare the CPU seconds of ``train_experiment`` and ``model.learn()`` in one environment."""
    if args.num_threads:
        th.set_num_threads(args.num_threads)
    experiment = replace(experiment, hyperparams={**experiment.hyperparams, "n_envs": 1})
    options = TrainingOptions.of(experiment, {"n_timesteps": args.overhead, "eval_freq": 0, "verbose": 0})

    def bare() -> None:
        make_model(experiment, args.device).learn(args.overhead).env.close()

    def zoo() -> None:
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
            train_experiment(experiment, 0, args.device, folder, options=options)

    zoo()  # compiles and fills caches
    times: dict[Any, list[float]] = {bare: [], zoo: []}
    for pair in range(PAIRS):
        for train in (bare, zoo) if pair % 2 == 0 else (zoo, bare):
            times[train].append(duration(train, time.process_time))
    ratios = sorted(ours / theirs - 1 for ours, theirs in zip(times[zoo], times[bare], strict=True))
    return {
        **name_of(experiment, args),
        "timesteps": str(args.overhead),
        "bare_seconds": number(statistics.median(times[bare]), 1),
        "train_seconds": number(statistics.median(times[zoo]), 1),
        "overhead": number(statistics.median(ratios), 3),
        "least": number(ratios[0], 3),
        "greatest": number(ratios[-1], 3),
        **provenance(),
    }


if __name__ == "__main__":
    main()
