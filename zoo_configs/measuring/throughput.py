"""How fast environments step, and what the time goes to."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bulletarm_gym.check.machine import load_average
from zoo_configs.environments import make_env
from zoo_configs.errors import CommandError

if TYPE_CHECKING:
    from bulletarm_gym.check.environments import Yardstick

REFERENCE_FIELDS = ("env_id", "yardstick_step_us", "yardstick_render_ms", "steps_per_second", "reset_ms")


@dataclass(frozen=True)
class Throughput:
    """
    Speed of one environment in one process, its expert included. Times are in milliseconds.

    :param env_id: Id of the environment
    :param yardstick: The machine's speed at that hour
    :param steps: Steps measured
    :param episodes: Episodes measured
    :param success_rate: Share of them that the expert solved
    :param step_ms: A step with the expert's choice of action
    :param expert_ms: Of that, the choice of the action, with the heightmaps it looks at
    :param physics_ms: Of a step, simulation steps of the engine
    :param rendering_ms: Of a step, drawing heightmaps
    :param unsimulated: Share of the steps that needed no simulation step of the engine
    :param reset_ms: A reset
    :param load: Load average of the machine when it began
    """

    env_id: str
    yardstick: Yardstick
    steps: int
    episodes: int
    success_rate: float
    step_ms: float
    expert_ms: float
    physics_ms: float
    rendering_ms: float
    unsimulated: float
    reset_ms: float
    load: float = 0.0

    @property
    def steps_per_second(self) -> float:
        """Steps a second, resets not counted."""
        return 1e3 / self.step_ms

    @property
    def without_expert_ms(self) -> float:
        """A step without the choice of its action."""
        return self.step_ms - self.expert_ms

    @property
    def rest_ms(self) -> float:
        """What is neither physics nor rendering."""
        return self.step_ms - self.physics_ms - self.rendering_ms


def measure_env(
    env_id: str,
    seconds: float,
    seed: int,
    on_episode: Callable[[float], Any],
    env_kwargs: Mapping[str, Any],
) -> Throughput:
    """
    Let the expert act for a while.

    :param env_id: Id of the environment
    :param seconds: How long; whole episodes are played until it is over
    :param seed: Seed of the first episode; each has the next
    :param on_episode: Called after each episode with the seconds it took
    :param env_kwargs: Parameters of the environment
    :return: What was measured
    :raises CommandError: if the environment has no expert
    """
    from bulletarm_gym.check.environments import measure_yardstick  # loads the engine

    busy, yardstick = load_average(), measure_yardstick()
    env = make_env(env_id, env_kwargs)
    try:
        if not hasattr(env.unwrapped, "expert_action"):
            raise CommandError(f"{env_id} has no expert")
        _Meter(env).play(seed)  # fills caches, compiles
        meter = _Meter(env)
        while (before := meter.seconds) < seconds:
            meter.play(seed + 1 + meter.episodes)
            on_episode(meter.seconds - before)
    finally:
        env.close()
    return meter.result(env_id, yardstick, busy)


class _Meter:
    """Plays episodes and adds up what they take, in seconds."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env
        self.own: Any = env.unwrapped
        self.parts: Mapping[str, float] = self.own.measure() if hasattr(self.own, "measure") else {}
        self.stepping = self.resetting = self.expert = self.physics = self.rendering = 0.0
        self.steps = self.unsimulated = self.episodes = self.successes = 0

    @property
    def seconds(self) -> float:
        return self.stepping + self.resetting

    def play(self, seed: int) -> None:
        start = time.perf_counter()
        self.env.reset(seed=seed)
        begin = time.perf_counter()
        before = dict(self.parts)
        over = False
        while not over:
            action, simulated = self._action(), self.parts.get("physics", 0.0)
            _, _, terminated, truncated, info = self.env.step(action)
            over = terminated or truncated
            self.steps += 1
            self.unsimulated += self.parts.get("physics", 0.0) == simulated
        self.stepping += time.perf_counter() - begin
        self.resetting += begin - start
        self.physics += self.parts.get("physics", 0.0) - before.get("physics", 0.0)
        self.rendering += self.parts.get("rendering", 0.0) - before.get("rendering", 0.0)
        self.episodes += 1
        self.successes += bool(info["is_success"])

    def _action(self) -> Any:
        begin = time.perf_counter()
        action = self.own.expert_action()
        self.expert += time.perf_counter() - begin
        return action

    def result(self, env_id: str, yardstick: Yardstick, busy: float) -> Throughput:
        per_step = 1e3 / self.steps  # ms
        return Throughput(
            env_id=env_id,
            yardstick=yardstick,
            steps=self.steps,
            episodes=self.episodes,
            success_rate=self.successes / self.episodes,
            step_ms=self.stepping * per_step,
            expert_ms=self.expert * per_step,
            physics_ms=self.physics * per_step,
            rendering_ms=self.rendering * per_step,
            unsimulated=self.unsimulated / self.steps,
            reset_ms=self.resetting * 1e3 / self.episodes,
            load=busy,
        )


@dataclass(frozen=True)
class ReferenceRate:
    """
    Speed of another implementation, with the yardstick of the hour it was measured in.

    :param yardstick: The machine's speed then
    :param steps_per_second: Steps a second with its expert, resets not counted
    :param reset_ms: A reset, in milliseconds
    """

    yardstick: Yardstick
    steps_per_second: float
    reset_ms: float

    def scaled_to(self, yardstick: Yardstick) -> float:
        """
        Steps a second to be expected of it at another hour.

        :param yardstick: The machine's speed at that hour
        :return: Steps a second, scaled by the simulation step
        """
        return self.steps_per_second * self.yardstick.step_us / yardstick.step_us


def load_reference(path: Path) -> dict[str, ReferenceRate]:
    """
    Read reference rates.

    :param path: CSV with the columns of ``REFERENCE_FIELDS``
    :return: The rates by id
    :raises CommandError: if the file is missing or has other columns
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return {row["env_id"]: _reference_rate(row) for row in csv.DictReader(file)}
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        columns = ",".join(REFERENCE_FIELDS)
        raise CommandError(
            f"--reference takes a CSV with the columns {columns}; {path}: {error!r}"
        ) from error


def _reference_rate(row: dict[str, str]) -> ReferenceRate:
    from bulletarm_gym.check.environments import Yardstick

    yardstick = Yardstick(float(row["yardstick_step_us"]), float(row["yardstick_render_ms"]))
    return ReferenceRate(yardstick, float(row["steps_per_second"]), float(row["reset_ms"]))
