"""Parameters and sampled values of an episode, which options of a reset can narrow."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import OPEN_LOOP, EnvConfig
from bulletarm_gym.config_checks import Refused, check_argument, choice, scale_range
from bulletarm_gym.control import Control
from bulletarm_gym.randomization import Randomization, randomization
from bulletarm_gym.scene import Scene
from bulletarm_gym.scene.state import EpisodeState
from bulletarm_gym.tasks import Task

Action = NDArray[np.float64]
INFO_PREFIX = "randomization/"
"""Beginning of the keys of sampled values in ``info``."""


class EpisodeParameters:
    """Parameters and sampled values of the current episode.

    :param config: the environment's parameters
    :param task: its task
    :param scene: its scene
    :param control: its control
    """

    def __init__(self, config: EnvConfig, task: Task, scene: Scene, control: Control[Any]) -> None:
        self._config, self._task, self._scene, self._control = config, task, scene, control
        self._is_open_loop = config.control == OPEN_LOOP
        self._limits = Randomization.of(config.randomization, self._is_open_loop)
        self._state = EpisodeState()
        self.info: dict[str, float] = {}
        """Entries of ``info``: the sampled values."""

    # Options

    def narrowed(self, options: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
        """Return the narrowed parameters in the options of a reset.

        :raises ValueError: a value is not valid or not within the parameter of the environment
        """
        checks = {
            "object_scale_range": self._scale_range,
            "num_objects": choice(
                *(n for n in self._task.defaults.allowed_objects if n <= self._config.num_objects)
            ),
            "randomization": self._randomization,
        }
        found = {
            name: check_argument(name, options[name], checks[name]) for name in checks if name in options
        }
        return tuple((name, value) for name, value in found.items() if value != getattr(self._config, name))

    def _scale_range(self, value: Any) -> Any:
        low, high = self._config.object_scale_range
        narrow = scale_range(value)
        if not low <= narrow[0] <= narrow[1] <= high:
            raise Refused(f"a number or [low, high] within {[low, high]}")
        for obj in self._scene.all_objects:
            if not obj.fitting(*narrow):
                scales = ", ".join(f"{scale:g}" for scale in sorted({*obj.scales}))
                raise Refused(f"a range with a loaded scale of {obj.slot.name!r}, one of {scales}")
        return narrow

    def _randomization(self, value: Any) -> Any:
        given = {**self._limits.varied, **value} if isinstance(value, Mapping) else value
        plain = randomization(self._is_open_loop)(given)
        if not Randomization.of(plain, self._is_open_loop).is_within(self._limits):
            raise Refused(f"within the ranges of the environment, {self._limits.varied}")
        return plain

    # Beginning

    def begin(self, narrowed: tuple[tuple[str, Any], ...], rng: np.random.Generator) -> None:
        """Set the parameters of an episode, and sample its values.

        :param narrowed: narrowed parameters, see :meth:`narrowed`
        """
        chosen = dict(narrowed).get("randomization", self._config.randomization)
        is_same = chosen == self._config.randomization
        ranges = self._limits if is_same else Randomization.of(chosen, self._is_open_loop)
        values = ranges.sample(rng, list(self._limits.varied))
        self.state = EpisodeState(narrowed, tuple(values.items()))

    @property
    def state(self) -> EpisodeState:
        """Narrowed parameters, sampled values and the last action; setting it changes task and scene.

        :raises ValueError: the scene has no objects of the narrowed sizes
        """
        return self._state

    @state.setter
    def state(self, state: EpisodeState) -> None:
        if state.narrowed != self._state.narrowed:
            self._narrow(dict(state.narrowed))
        self._scene.set_sampled(dict(state.sampled))
        self.info = {INFO_PREFIX + key: value for key, value in state.sampled}
        self._state = state

    def _narrow(self, parameters: Mapping[str, Any]) -> None:
        config = replace(self._config, **parameters)
        slots = type(self._task)(config).bodies(config) if "num_objects" in parameters else None
        self._scene.narrow(config.object_scale_range, slots)
        vars(self._task).clear()  # attributes depend on the parameters
        self._task.__init__(config)  # type: ignore[misc]

    def limit_steps(self, config: EnvConfig) -> None:
        """Set parameters that differ from the present ones in ``max_steps``."""
        self._config = config
        self._task.config = replace(config, **dict(self._state.narrowed))

    # Actions

    @property
    def changes_actions(self) -> bool:
        """Whether actions have noise or a delay."""
        values = self._scene.sampled
        return bool(values.get("action_noise") or values.get("action_delay"))

    def executed(self, action: ArrayLike, rng: np.random.Generator) -> Action:
        """Return the action that the robot executes, with delay and noise.

        :raises ValueError: the action has the wrong shape or is not finite
        """
        values, sequence = self._scene.sampled, self._control.sequence
        is_opening = np.array([name == "p" for name in sequence], np.float64)
        numbers = np.array(self._control.numbers(action))
        executed = numbers
        if delay := values.get("action_delay", 0.0):
            before = np.array(self._state.last_action or is_opening)  # no motion, open gripper
            executed = (1.0 - delay) * numbers + delay * before
            self._state = replace(self._state, last_action=tuple(numbers.tolist()))
        noise = values.get("action_noise", 0.0) * rng.standard_normal(len(numbers))
        return executed + noise * (1.0 - is_opening)
