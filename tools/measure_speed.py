"""Measure the environment steps per second of the expert, divided into physics, rendering and the rest.

python tools/measure_speed.py --reference docs/data/reference_rates.csv --data docs/data/speed.csv
python tools/measure_speed.py --env BulletArm/CloseLoopBlockPicking-v0 --env-kwargs randomization:light
"""

import argparse
import csv
import math
import statistics
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
from tqdm import tqdm

from bulletarm_gym.check.environments import measure_calibration
from bulletarm_gym.check.machine import describe_machine, load_average
from measurements import Row, keep, number, provenance, show, words
from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, seed
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments
from zoo_configs.experiments.families import task_name

KEY = ("env", "env_kwargs")


def main() -> None:
    """Run the program."""
    args = parse()
    register_environments(args.gym_packages)
    reference = read_reference(args.reference) if args.reference else {}
    print(describe_machine())
    rows = []
    for env_id in tqdm([known_env_id(name) for name in args.env or our_env_ids()], unit="environment"):
        rows.append(keep(measure(env_id, args, reference.get(env_id)), args.data, KEY))
    show(rows)
    ratios = [float(row["times_reference"]) for row in rows if row["times_reference"]]
    if ratios:
        print(f"ratio: geometric mean {statistics.geometric_mean(ratios):.1f}, minimum {min(ratios):.1f}")


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    add = parser.add_argument
    add("--env", nargs="+", default=[], help="environment ids (default: all of this package)")
    add("--seconds", type=float, default=5.0, help="duration of each measurement (default: 5)")
    add("--seed", type=seed, default=0, help="seed of the first episode (default: 0)")
    add("--reference", type=Path, metavar="FILE", help="CSV of speeds to compare with")
    add("--data", type=Path, metavar="FILE", help="CSV to add the measurements to")
    add_env_kwargs(parser)
    add_packages(parser)
    return parser.parse_args()


def read_reference(path: Path) -> dict[str, float]:
    """Return the reference's steps per second times the time (us) of a simulation step, by environment id.

    :param path: CSV with the columns ``env_id``, ``yardstick_step_us`` and ``steps_per_second``
    """
    with path.open(encoding="utf-8", newline="") as file:
        return {
            row["env_id"]: float(row["steps_per_second"]) * float(row["yardstick_step_us"])
            for row in csv.DictReader(file)
        }


def measure(env_id: str, args: argparse.Namespace, reference: float | None = None) -> Row:
    """Measure one environment.

    :param reference: steps per second of the reference times the time (us) of a simulation step
    """
    load, step_us = load_average(), measure_calibration()
    with closing(make_env(env_id, args.env_kwargs)) as env:
        Meter(env).play(args.seed)  # compiles and fills caches
        meter = Meter(env)
        while meter.stepping + meter.resetting < args.seconds:
            meter.play(args.seed + 1 + meter.episodes)
    scaled = math.nan if reference is None else reference / step_us
    figures = meter.figures()
    return {
        "env": task_name(env_id),
        "env_kwargs": words(args.env_kwargs),
        "calibration_us": number(step_us, 1),
        **figures,
        "reference_steps_per_second": number(scaled, 1),
        "times_reference": number(meter.steps / meter.stepping / scaled, 1),
        "load": number(load, 1),
        **provenance(),
    }


class Meter:
    """Plays episodes of the expert and adds up the durations of their parts (seconds)."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env
        self.unwrapped: Any = env.unwrapped
        self.parts: Mapping[str, float] = self.unwrapped.measure()
        self.stepping = self.resetting = self.expert = self.physics = self.rendering = 0.0
        self.steps = self.unsimulated = self.episodes = self.successes = 0

    def play(self, seed: int) -> None:
        """Play one episode."""
        start = time.perf_counter()
        self.env.reset(seed=seed)
        begin, before, over = time.perf_counter(), dict(self.parts), False
        while not over:
            action, simulated = self._action(), self.parts["physics"]
            _, _, terminated, truncated, info = self.env.step(action)
            over = terminated or truncated
            self.steps += 1
            self.unsimulated += self.parts["physics"] == simulated
        self.stepping += time.perf_counter() - begin
        self.resetting += begin - start
        self.physics += self.parts["physics"] - before["physics"]
        self.rendering += self.parts["rendering"] - before["rendering"]
        self.episodes += 1
        self.successes += bool(info["is_success"])

    def _action(self) -> Any:
        begin = time.perf_counter()
        action = self.unwrapped.expert_action()
        self.expert += time.perf_counter() - begin
        return action

    def figures(self) -> Row:
        """Return the columns of the file that the episodes determine."""
        rest = self.stepping - self.physics - self.rendering
        durations = {
            "step_ms": self.stepping,
            "physics_ms": self.physics,
            "rendering_ms": self.rendering,
            "rest_ms": rest,
            "without_expert_ms": self.stepping - self.expert,
        }
        return {
            "steps_per_second": number(self.steps / self.stepping, 1),
            **{name: number(1e3 * seconds / self.steps, 2) for name, seconds in durations.items()},
            "unsimulated": number(self.unsimulated / self.steps, 3),
            "reset_ms": number(1e3 * self.resetting / self.episodes, 2),
            "success": number(self.successes / self.episodes, 3),
            "episodes": str(self.episodes),
        }


if __name__ == "__main__":
    main()
