"""How long one gradient update of a baseline takes, and what the time goes to."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn
from torch.profiler import profile

from bulletarm_gym.machine import load_average
from sb3_extensions.encoders.cnn import precision
from sb3_extensions.equivariant.convolution import PlainConv2d
from sb3_extensions.equivariant.layers import EquivariantConv2d
from sb3_extensions.spatial_dqn import SpatialDQN
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cells.cell import Cell
from zoo_configs.training.objects import parsed

# Parts of an update, by what names of PyTorch's operators contain; the first that fits counts.
PARTS = {
    "gradients of convolutions": ("convolution_backward",),
    "convolutions": ("convolution",),
    "pooling": ("max_pool", "aten::maximum"),
}
REST = "rest"
EXPERT_EPISODES = 5  # enough to sample a batch from
PROFILED_UPDATES = 5
COMPARED_PASSES = 30
# What belongs to the run, not to the model.
RUN_KEYS = ("n_envs", "n_timesteps", "monitor_kwargs")
# What comes before the first step of a run, and would only be waited for.
BEFORE_TRAINING = {"pretrain_steps": 0, "contrastive_steps": 0}


@dataclass(frozen=True)
class UpdateSpeed:
    """
    Time of one update of a baseline, in milliseconds.

    :param update_ms: The median update
    :param shares: Share of each part in the computing time, adding up to 1
    :param convolution_ratio: Forward and backward passes through the equivariant convolutions of the actor's
        encoder or of the Q network, over those through plain ones of the same width; ``None`` without
        equivariant ones
    :param peak_gigabytes: Greatest memory of the process until then, on a GPU of the GPU
    :param device: Type of the PyTorch device
    :param threads: Of PyTorch
    :param load: Load average of the machine when it began
    """

    update_ms: float
    shares: dict[str, float]
    convolution_ratio: float | None
    peak_gigabytes: float
    device: str
    threads: int
    load: float


@dataclass(frozen=True)
class Network:
    """
    What of a model has convolutions, and how it is run.

    :param module: The convolutions' parent
    :param forward: A pass through it
    :param autocast: Its precision, see :func:`~sb3_extensions.encoders.cnn.precision`
    """

    module: nn.Module
    forward: Callable[[], object]
    autocast: str | None

    @classmethod
    def of(cls, model: Any) -> Network:
        """The Q network of a spatial Q algorithm, the encoder of an actor."""
        observations = model.replay_buffer.sample(model.batch_size).observations
        if isinstance(model, SpatialDQN):
            indices, _ = model.q_net.greedy(observations)
            return cls(model.q_net, lambda: model.q_net.values(observations, indices), model.q_net.autocast)
        encoder = model.actor.features_extractor.encoder
        return cls(encoder, lambda: model.actor(observations), getattr(encoder, "autocast", None))


def make_model(cell: Cell, device: str = "auto", **changes: Any) -> BaseAlgorithm:
    """
    Build the model of a cell outside a run, in one environment.

    :param cell: The cell
    :param device: PyTorch device
    :param changes: Hyperparameters that win over the cell's, those that the algorithm has
    :return: The untrained model
    """
    hyperparams = parsed(cell.hyperparams)
    env = gym.make(cell.env_id, **hyperparams.pop("env_kwargs"))
    for key in RUN_KEYS:
        hyperparams.pop(key, None)
    hyperparams.update(changes)
    model: BaseAlgorithm = algorithm_classes()[cell.algo](env=env, seed=0, device=device, **hyperparams)
    return model


def measure_update(cell: Cell, seconds: float, device: str = "auto") -> UpdateSpeed:
    """
    Let a baseline update itself for a while.

    :param cell: The cell
    :param seconds: How long
    :param device: PyTorch device
    :return: What was measured
    """
    busy = load_average()
    before = {key: value for key, value in BEFORE_TRAINING.items() if key in cell.hyperparams}
    model: Any = make_model(cell, device, expert_episodes=EXPERT_EPISODES, **before)
    model.learn(1)

    def update() -> None:
        model.train(1, model.batch_size)
        if model.device.type == "cuda":
            th.cuda.synchronize(model.device)

    times = list(_times(update, seconds))
    peak = _peak_gigabytes(model.device)
    model.env.close()
    return UpdateSpeed(
        update_ms=1e3 * _median(times),
        shares=_shares(update, model.device.type == "cuda"),
        convolution_ratio=_compare_convolutions(model),
        peak_gigabytes=peak,
        device=model.device.type,
        threads=th.get_num_threads(),
        load=busy,
    )


def _peak_gigabytes(device: th.device) -> float:
    if device.type == "cuda":
        return th.cuda.max_memory_allocated(device) / 1e9
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6)  # macOS counts bytes, Linux kilobytes


def _times(function: Callable[[], None], seconds: float) -> Iterator[float]:
    end = time.perf_counter() + seconds
    function()  # the first takes longer
    while True:
        start = time.perf_counter()
        function()
        yield time.perf_counter() - start
        if time.perf_counter() > end:
            return


def _median(times: list[float]) -> float:
    return float(th.tensor(times).median())


def _shares(update: Callable[[], None], on_gpu: bool) -> dict[str, float]:
    """Profile some updates: the time of the device that computes."""
    spent = attrgetter("self_device_time_total" if on_gpu else "self_cpu_time_total")
    with profile() as profiler:
        for _ in range(PROFILED_UPDATES):
            update()
    seconds = dict.fromkeys((*PARTS, REST), 0.0)
    for event in profiler.key_averages():
        if event.device_type.name != "CPU":
            continue  # a kernel, whose time is also that of the operator that launched it
        names = (part for part, marks in PARTS.items() if any(mark in event.key for mark in marks))
        seconds[next(names, REST)] += spent(event)
    total = sum(seconds.values())
    return {part: value / total for part, value in seconds.items()}


def _compare_convolutions(model: Any) -> float | None:
    """Time equivariant convolutions and plain ones in turn, so that both meet the same machine."""
    network = Network.of(model)
    convolutions = [layer for layer in network.module.modules() if isinstance(layer, EquivariantConv2d)]
    if not convolutions:
        return None
    inputs: dict[nn.Module, th.Tensor] = {}

    def note(layer: nn.Module, given: tuple[th.Tensor, ...], _: th.Tensor) -> None:
        inputs.setdefault(layer, given[0].detach())

    hooks = [layer.register_forward_hook(note) for layer in convolutions]
    network.forward()
    for hook in hooks:
        hook.remove()
    ours = theirs = 0.0
    for layer in convolutions:
        features = inputs[layer]
        channels = (features.shape[1], layer.out_type.size)
        plain = PlainConv2d(*channels, layer.kernel_size, layer.stride, layer.padding)
        passes = [_pass(module, features, network.autocast) for module in (layer, plain)]
        times: tuple[list[float], list[float]] = ([], [])
        for _ in range(COMPARED_PASSES):
            for one, its_times in zip(passes, times, strict=True):
                start = time.perf_counter()
                one()
                its_times.append(time.perf_counter() - start)
        ours, theirs = ours + _median(times[0]), theirs + _median(times[1])
    return ours / theirs


def _pass(module: nn.Module, features: th.Tensor, autocast: str | None) -> Callable[[], None]:
    """Forward and backward through a convolution, as within its network."""
    device = features.device
    module, features = module.to(device), features.float().requires_grad_()

    def run() -> None:
        """Pass once; a GPU is waited for."""
        with precision(autocast, device.type):
            outputs = module(features)
        outputs.float().sum().backward()
        if device.type == "cuda":
            th.cuda.synchronize(device)

    return run
