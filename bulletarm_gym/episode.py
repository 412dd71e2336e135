"""Random numbers, parameters and sampled values of an episode."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.config_checks import Refused, check_argument, choice, interval
from bulletarm_gym.control import Control
from bulletarm_gym.observations.depth_noise import ERRORS, measured_depths
from bulletarm_gym.randomization import NAMES, Randomization
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation.camera import Measure
from bulletarm_gym.tasks import Task

ARRANGEMENT, AFTER_ACTION, PLAN, RANDOMIZATION, COLOURS, NOISE = range(6)
"""Independent streams of an episode's random numbers."""
BLOCK = 32
"""Number of steps whose noise is sampled at once, because making a generator takes long."""

Narrowed = tuple[tuple[str, Any], ...]
Sampled = tuple[tuple[str, float], ...]


class Episode:
    """The current episode. Its seed is None before the first one."""

    def __init__(self, task: Task, scene: Scene, control: Control[Any]) -> None:
        self._task, self._scene, self._control = task, scene, control
        self._limits = self._ranges(scene.config.randomization)
        self._slots = [obj.slot for obj in scene.all_objects]
        self._start = [float(name == "p") for name in control.sequence]  # at rest, with an open gripper
        self.seed: int | None = None
        self.steps, self.ended = 0, False
        self.narrowed: Narrowed = ()
        self.sampled: Sampled = ()
        self.last_action: tuple[float, ...] = ()
        self._noise_of: tuple[int | None, int] = (None, 0)
        self.info: dict[str, float] = {}
        """Sampled values as entries of ``info``."""

    def check_running(self) -> int:
        """Return the seed of the episode.

        :raises gymnasium.error.ResetNeeded: no episode has begun
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self._scene.world.check_open()
        if self.seed is None:
            raise gymnasium.error.ResetNeeded("no episode has begun. Call reset() first.")
        return self.seed

    def rng(self, stream: int, step: int | None = None) -> np.random.Generator:
        """Return the generator of a stream at a step, by default the current one."""
        assert self.seed is not None
        return np.random.default_rng((self.seed, self.steps if step is None else step, stream))

    def _noise(self) -> tuple[int, list[float]]:
        """Return the seed of the depth noise and standard normal numbers for the action of this step."""
        block, number = divmod(self.steps, BLOCK)
        if self._noise_of != (self.seed, block):
            rng, self._noise_of = self.rng(NOISE, block), (self.seed, block)
            seeds = rng.integers(np.iinfo(np.int64).max, size=BLOCK).tolist()
            errors = rng.standard_normal((BLOCK, len(self._control.sequence))).tolist()
            self._noises = list(zip(seeds, errors, strict=True))
        return self._noises[number]

    @property
    def measure(self) -> Measure | None:
        """Errors of depth cameras at the current step, or None without errors."""
        values = self._scene.sampled
        is_noisy = any(values.get(name) for name in ERRORS)
        return partial(measured_depths, values, self._noise()[0]) if is_noisy else None

    def checked(self, options: Mapping[str, Any]) -> Narrowed:
        """Return valid names and values of the parameters that options of a reset narrow."""
        if not options:
            return ()
        config = self._scene.config
        counts = (n for n in self._task.defaults.allowed_objects if n <= config.num_objects)
        checks = {
            "object_scale_range": self._check_scales,
            "num_objects": choice(*counts),
            "randomization": self._check_randomization,
        }
        chosen = {n: check_argument(n, options[n], check) for n, check in checks.items() if n in options}
        return tuple((n, value) for n, value in chosen.items() if value != getattr(config, n))

    def _check_scales(self, value: Any) -> list[float]:
        first, last = interval(*self._scene.config.object_scale_range)(value)
        for obj in self._scene.all_objects:
            if not obj.fitting(first, last):
                scales = sorted({obj.slot.scales[index] for index in obj.choices})
                raise Refused(f"a range with a loaded scale of {obj.slot.name!r}, one of {scales}")
        return [first, last]

    def _check_randomization(self, value: Any) -> Any:
        ranges = self._ranges({**self._limits.varied, **value} if isinstance(value, Mapping) else value)
        for name in NAMES:
            check_argument(name, list(getattr(ranges, name)), interval(*getattr(self._limits, name)))
        return self._scene.config.randomization if ranges == self._limits else ranges.varied

    def _ranges(self, value: Any) -> Randomization:
        return Randomization.of(value, self._scene.config.control == OPEN_LOOP)

    def begin(self, narrowed: Narrowed) -> None:
        """Sample the values of an episode with narrowed parameters, before its objects are arranged."""
        ranges = self._ranges(dict(narrowed).get("randomization", self._scene.config.randomization))
        names = list(self._limits.varied)
        sampled = ranges.sample(self.rng(RANDOMIZATION), names) if names else {}
        self.set(narrowed, tuple(sampled.items()), ())

    def randomize(self) -> None:
        """Change the properties of the arranged bodies by the sampled values."""
        if self.sampled:
            self._scene.randomize(self.rng(COLOURS))

    def set(self, narrowed: Narrowed, sampled: Sampled, last_action: tuple[float, ...]) -> None:
        """Set the parameters and values of an episode, also in the task and the scene."""
        if narrowed != self.narrowed:
            chosen, config = dict(narrowed), self._scene.config
            count = chosen.get("num_objects", config.num_objects)
            if count != self._task.config.num_objects:
                vars(self._task).clear()  # attributes of a task depend on its parameters
                self._task.__init__(replace(config, num_objects=count))  # type: ignore[misc]
                self._slots = self._task.bodies(self._task.config)
            self._scene.narrow(chosen.get("object_scale_range", config.object_scale_range), self._slots)
        self.narrowed, self.sampled, self.last_action = narrowed, sampled, last_action
        self.info = {f"randomization/{key}": value for key, value in sampled}
        self._scene.set_sampled(dict(sampled))

    def executed(self, action: ArrayLike) -> ArrayLike:
        """Return the action that the robot executes, with the delay and the noise."""
        delay, noise = (self._scene.sampled.get(f"action_{name}", 0.0) for name in ("delay", "noise"))
        if not (delay or noise):
            return action
        numbers, before = self._control.numbers(action), self.last_action or self._start
        self.last_action = tuple(numbers) if delay else ()
        numbers = [(1.0 - delay) * n + delay * last for n, last in zip(numbers, before, strict=True)]
        errors = zip(numbers, self._noise()[1], self._control.sequence, strict=True)
        return [n + noise * error * (name != "p") for n, error, name in errors]
