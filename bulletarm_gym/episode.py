"""Parameters and sampled values of an episode, which options of a reset can narrow."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.config import OPEN_LOOP, EnvConfig
from bulletarm_gym.config_checks import Refused, check_argument, choice, scale_range
from bulletarm_gym.control import Control
from bulletarm_gym.randomization import Randomization
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks import Task

INFO_PREFIX = "randomization/"
"""Beginning of the keys of sampled values in ``info``."""

Narrowed = tuple[tuple[str, Any], ...]
Sampled = tuple[tuple[str, float], ...]


class EpisodeParameters:
    """Parameters and sampled values of the current episode.

    :param config: the environment's parameters
    :param task: its task
    :param scene: its scene
    :param control: its control
    """

    def __init__(self, config: EnvConfig, task: Task, scene: Scene, control: Control[Any]) -> None:
        self._config, self._task, self._scene, self._control = config, task, scene, control
        self._limits = self._ranges(config.randomization)
        self._slots = [obj.slot for obj in scene.all_objects]
        self.narrowed: Narrowed = ()
        self.sampled: Sampled = ()
        self.last_action: tuple[float, ...] = ()
        self._rng: np.random.Generator | None = None
        self.info: dict[str, float] = {}
        """Sampled values as entries of ``info``."""

    def checked(self, options: Mapping[str, Any]) -> Narrowed:
        """Return names and values of the parameters that options of a reset narrow.

        :raises ValueError: a value is not valid or not within the parameter of the environment
        """
        if not options:
            return ()
        counts = (n for n in self._task.defaults.allowed_objects if n <= self._config.num_objects)
        checks = {
            "object_scale_range": self._check_scales,
            "num_objects": choice(*counts),
            "randomization": self._check_randomization,
        }
        chosen = {n: check_argument(n, options[n], check) for n, check in checks.items() if n in options}
        return tuple((n, value) for n, value in chosen.items() if value != getattr(self._config, n))

    def _check_scales(self, value: Any) -> Any:
        (low, high), (first, last) = self._config.object_scale_range, scale_range(value)
        if not low <= first <= last <= high:
            raise Refused(f"a number or [low, high] within {[low, high]}")
        for obj in self._scene.all_objects:
            if not obj.fitting(first, last):
                scales = sorted({obj.slot.scales[index] for index in obj.choices})
                raise Refused(f"a range with a loaded scale of {obj.slot.name!r}, one of {scales}")
        return [first, last]

    def _check_randomization(self, value: Any) -> Any:
        chosen = {**self._limits.varied, **value} if isinstance(value, Mapping) else value
        ranges = self._ranges(chosen)
        if name := ranges.beyond(self._limits):
            limits = list(getattr(self._limits, name))
            raise Refused(f"within the ranges of the environment, that of {name} within {limits}")
        return ranges.varied if chosen != self._config.randomization else chosen

    def _ranges(self, value: Any) -> Randomization:
        return Randomization.of(value, self._config.control == OPEN_LOOP)

    def begin(self, narrowed: Narrowed, generator: Callable[[], np.random.Generator]) -> None:
        """Sample the values of an episode with narrowed parameters, before its objects are arranged.

        :param generator: function that returns the generator of the values
        """
        self._rng, chosen = generator() if self._limits.varied else None, dict(narrowed)
        ranges = self._ranges(chosen["randomization"]) if "randomization" in chosen else self._limits
        sampled = ranges.sample(self._rng, list(self._limits.varied)) if self._rng is not None else {}
        self.set(narrowed, tuple(sampled.items()), ())

    def randomize(self) -> None:
        """Change the properties of the arranged bodies by the sampled values."""
        if self._rng is not None:
            self._scene.randomize(self._rng)

    def set(self, narrowed: Narrowed, sampled: Sampled, last_action: tuple[float, ...]) -> None:
        """Set the parameters and values of an episode, also in the task and the scene."""
        if narrowed != self.narrowed:
            chosen = dict(narrowed)
            count = chosen.get("num_objects", self._config.num_objects)
            if count != self._task.config.num_objects:
                vars(self._task).clear()  # attributes of a task depend on its parameters
                self._task.__init__(replace(self._config, num_objects=count))  # type: ignore[misc]
                self._slots = self._task.bodies(self._task.config)
            scales = chosen.get("object_scale_range", self._config.object_scale_range)
            self._scene.narrow(scales, self._slots)
        self.narrowed, self.sampled, self.last_action = narrowed, sampled, last_action
        self.info = {INFO_PREFIX + key: value for key, value in sampled}
        self._scene.set_sampled(dict(sampled))

    def limit_steps(self, config: EnvConfig) -> None:
        """Set parameters of the environment of which only ``max_steps`` differs."""
        self._config = config
        self._task.config = replace(self._task.config, max_steps=config.max_steps)

    def executed(self, action: ArrayLike, generator: Callable[[], np.random.Generator]) -> ArrayLike:
        """Return the action that the robot executes, with the delay and the noise.

        :param generator: function that returns the generator of the noise
        :raises ValueError: the action has the wrong shape or is not finite
        """
        delay, noise = (self._scene.sampled.get(f"action_{name}", 0.0) for name in ("delay", "noise"))
        if not (delay or noise):
            return action
        numbers = np.array(self._control.numbers(action))
        opening = np.array([float(name == "p") for name in self._control.sequence])
        before = np.array(self.last_action or opening)  # at the start, no motion and an open gripper
        self.last_action = tuple(numbers.tolist()) if delay else ()
        errors = noise * generator().standard_normal(len(numbers)) * (1.0 - opening)
        return (1.0 - delay) * numbers + delay * before + errors
