"""Wrappers that adapt environments to other libraries."""

import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from copy import deepcopy
from dataclasses import replace
from functools import reduce
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import ClipAction, DiscretizeAction, RescaleAction, TimeLimit
from gymnasium.wrappers.utils import rescale_box
from numpy.typing import NDArray
from PIL import Image

from bulletarm_gym.config_checks import ParameterError, check_argument, integer, mapping, optional, rule
from bulletarm_gym.registry import time_limit_spec

WHITE = 255
"""Maximum value of a channel."""
IMAGE_AXES = 3
"""Number of axes of an observed image: channels, rows, columns."""
OWN = rule("an environment of this package", lambda env: hasattr(env.unwrapped, "scene"))
"""Check of wrapped environments."""
UNLIMITED = 2**31 - 1
"""Limit (steps) of an environment made with ``max_episode_steps=-1``."""


class ImageObservation(
    gymnasium.ObservationWrapper[NDArray[np.uint8], Any, dict[str, NDArray[Any]]], RecordConstructorArgs
):
    """Combine all observations into one uint8 image, as in libraries for Atari games.

    Each channel of each image becomes a channel, in the order of the observation space. Then each number,
    such as ``holding``, becomes a constant channel. The bounds of its space are mapped to 0 and 255 and
    values between them are rounded: 1.6 mm per count for heightmaps from 0 to 0.4 m. Images of other sizes
    are resized to ``size`` by linear interpolation, with averaging if they become smaller.

    :param env: environment with a ``Dict`` of images (channels, rows, columns) and vectors, all of them
        bounded
    :param size: side length (pixels) of the image, by default that of the largest image
    :param channels_last: return (size, size, channels), as in RLlib, instead of (channels, size, size)
    :raises ValueError: an observation of ``env`` cannot be part of an image; ``size`` is not positive
    """

    def __init__(
        self,
        env: gymnasium.Env[dict[str, NDArray[Any]], Any],
        size: int | None = None,
        channels_last: bool = False,
    ) -> None:
        RecordConstructorArgs.__init__(self, size=size, channels_last=channels_last)
        gymnasium.ObservationWrapper.__init__(self, env)
        self._boxes = _image_boxes(env.observation_space)
        sides = [side for box in self._boxes.values() for side in box.shape[1:]]
        self.size = check_argument("size", size, optional(integer(1))) or max(sides)
        count = len(self.channels)
        self._axis = -1 if channels_last else 0
        shape = (self.size, self.size, count) if channels_last else (count, self.size, self.size)
        self.observation_space = spaces.Box(0, WHITE, shape, np.uint8)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels: ``"heightmap"``, or ``"in_hand_0"`` if an observation has several."""
        counts = [(name, box.shape[0]) for name, box in self._boxes.items()]
        return tuple(
            name if count == 1 else f"{name}_{number}" for name, count in counts for number in range(count)
        )

    def observation(self, observation: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """Return the image, (channels, size, size) or, with ``channels_last``, (size, size, channels)."""
        layers = (layer for name, box in self._boxes.items() for layer in _scaled(observation[name], box))
        image = np.stack([np.rint(WHITE * self._resized(layer)) for layer in layers], self._axis)
        return image.astype(np.uint8)

    def images(self, observations: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """Return the images of n observations, such as a demonstrated episode.

        :param observations: an array (n, ...) for each key
        """
        rows = zip(*observations.values(), strict=True)
        return np.stack([self.observation(dict(zip(observations, row, strict=True))) for row in rows])

    def _resized(self, layer: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a channel in the size of the image; a number becomes a constant channel."""
        shape = (self.size, self.size)
        if layer.ndim == 0 or layer.shape == shape:
            return np.broadcast_to(layer, shape)
        return np.asarray(Image.fromarray(layer).resize(shape, Image.Resampling.BILINEAR))


def _image_boxes(space: spaces.Space[Any]) -> dict[str, spaces.Box]:
    """Return the spaces that are combined: images, then vectors.

    :raises ValueError: the space has no image, or a part that cannot be a channel
    """
    named: dict[str, Any] = dict(space) if isinstance(space, spaces.Dict) else {}
    kinds = {
        name: len(box.shape) if isinstance(box, spaces.Box) and box.is_bounded() else 0
        for name, box in named.items()
    }
    images = {name: box for name, box in named.items() if kinds[name] == IMAGE_AXES}
    other = [f"{name!r}: {box}" for name, box in named.items() if kinds[name] not in (1, IMAGE_AXES)]
    if other or not images:
        must = "a Dict of images (channels, rows, columns) and vectors of numbers with finite bounds"
        raise ValueError(f"env must observe {must}, got {other[0] if other else space}")
    return {**images, **named}


def _scaled(value: NDArray[Any], box: spaces.Box) -> NDArray[np.float32]:
    """Return values relative to their bounds, from 0 to 1."""
    low, high = box.low.astype(np.float32), box.high.astype(np.float32)
    scaled: NDArray[np.float32] = (np.asarray(value, np.float32) - low) / (high - low)
    return scaled


class InstructionInfo(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Add ``info["instruction"]`` to the result of ``reset()``: one of the sentences that describe the task.

    A sentence is sampled at every reset; the seed of a reset determines it and the later ones.

    :param env: an environment of this package, perhaps wrapped
    :raises ValueError: ``env`` is of another package
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(check_argument("env", env, OWN))
        self._instruction_rng = np.random.default_rng()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, see :meth:`~bulletarm_gym.env.ManipulationEnv.reset`."""
        if seed is not None:
            self._instruction_rng = np.random.default_rng(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        sentences = self.get_wrapper_attr("instructions")
        chosen = sentences[int(self._instruction_rng.integers(len(sentences)))]
        return observation, {**info, "instruction": chosen}


class GoalObservation(gymnasium.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Goal-conditioned environment with the interface of Gymnasium-Robotics' ``GoalEnv``.

    Observations are a ``Dict`` of ``observation``, ``achieved_goal`` and ``desired_goal``, one vector each.
    The reward is 1 in every step after which the goal is reached, else 0. As in Gymnasium-Robotics, an
    episode continues after success, so that relabelled transitions have correct rewards and ends. It
    terminates if the scene is invalid, and is truncated after ``max_steps``.

    :param env: environment that observes vectors, such as ``joint_state``, and whose task defines
        :meth:`~bulletarm_gym.tasks.Task.goals`: Block Reaching, Block Pushing, Block Pulling, Block Stacking
    :raises ValueError: ``env`` observes images or is of another package, or the task has no goals
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self._core: Any = check_argument("env", env, OWN).unwrapped
        self._inner = env.observation_space
        parts = self._inner.values() if isinstance(self._inner, spaces.Dict) else [self._inner]
        if not all(isinstance(space, spaces.Box) and len(space.shape) == 1 for space in parts):
            raise ValueError(f"env must observe vectors, got {self._inner}. Use 'joint_state'.")
        arguments = {**self._core._arguments, "render_mode": None}
        with closing(type(self._core)(**arguments)) as begun:  # goals can depend on the memory of an episode
            begun.reset(seed=0)
            achieved, _ = begun.task.goals(begun.scene)
        goal = spaces.Box(-np.inf, np.inf, np.shape(achieved), np.float64)
        observation = spaces.flatten_space(self._inner)
        self.observation_space = spaces.Dict(observation=observation, achieved_goal=goal, desired_goal=goal)

    def step(self, action: Any) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Carry out an action; the reward is that of :meth:`compute_reward`."""
        observation, _, terminated, truncated, info = self.env.step(action)
        if terminated and info["is_success"]:
            episode = self._core._episode
            terminated, episode.ended = False, episode.steps >= self._core.config.max_steps
            truncated = truncated or episode.ended
        found = self.observation(observation)
        reward = self.compute_reward(found["achieved_goal"], found["desired_goal"], info)
        return found, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> Any:
        """Return 1.0 where the goal is reached, else 0.0.

        :param achieved_goal: (..., n)
        :param desired_goal: (..., n)
        :param info: not used
        :return: (...,) float64
        """
        error = self._core.task.goal_error(achieved_goal, desired_goal)
        return np.less(error, 1.0).astype(np.float64)[()]

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any, info: dict[str, Any]) -> bool:
        """Return True if the scene is invalid. This does not depend on the goals."""
        return not info["is_valid"]

    def compute_truncated(self, achieved_goal: Any, desired_goal: Any, info: dict[str, Any]) -> bool:
        """Return False: goals do not truncate an episode, only its number of steps does."""
        return False

    def observation(self, observation: Any) -> dict[str, NDArray[Any]]:
        """Return an observation of the environment with both goals."""
        achieved, desired = (np.array(goal, float) for goal in self._core.task.goals(self._core.scene))
        flat: Any = spaces.flatten(self._inner, observation)
        return {"observation": flat, "achieved_goal": achieved, "desired_goal": desired}


def own_time_limit(env: gymnasium.Env[Any, Any], known: int | None) -> gymnasium.Env[Any, Any]:
    """Replace Gymnasium's ``TimeLimit`` by the environment's own limit, and return the environment.

    ``TimeLimit`` cannot extend the limit, also truncates a success at the limit, and does not follow
    ``set_state()``. Every id names this function as its first wrapper.

    :param known: limit in the spec, the default of ``max_steps``; a limit that is passed to ``make()``
        replaces it
    :raises ParameterError: ``max_steps`` and another ``max_episode_steps`` are passed
    """
    core: Any = env.unwrapped
    passed = sys._getframe(1).f_locals.get("max_episode_steps")  # make() leaves no other trace of it
    spec, limit = core.spec, UNLIMITED if passed == -1 else known
    if isinstance(env, TimeLimit):
        limit, env = env._max_episode_steps, env.env
    if limit is not None and (limit != known or passed is not None):
        if "max_steps" in spec.kwargs and core.config.max_steps not in (known, limit):
            must = "omitted if max_episode_steps is passed"
            raise ParameterError.of("max_steps", core.config.max_steps, must)
        core.limit_steps(limit)
        spec = replace(spec, kwargs={**spec.kwargs, "max_steps": limit})
    if env is not core:
        # LeRobot calls hasattr() on the outermost wrapper only, and else passes no task.
        env.task_description = core.task_description  # type: ignore[attr-defined]
    core.spec = replace(spec, additional_wrappers=(time_limit_spec(core.config.max_steps),))
    return env


class ResetOptions(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Pass the same options to every reset, for a curriculum.

    Vector environments reset their members at the end of episodes without options.

    :param env: environment
    :param options: options of resets, such as ``{"object_scale_range": 0.8}``
    """

    def __init__(self, env: gymnasium.Env[Any, Any], options: Mapping[str, Any] | None = None) -> None:
        RecordConstructorArgs.__init__(self, options=options)
        gymnasium.Wrapper.__init__(self, env)
        self.set_reset_options({} if options is None else options)

    def set_reset_options(self, options: Mapping[str, Any]) -> None:
        """Replace the options from the next reset on.

        :raises ValueError: they are not a dict
        """
        self._reset_options = deepcopy(dict(check_argument("options", options, mapping)))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with the options of this wrapper and passed ones; a state replaces all others."""
        given = {} if options is None else options
        if isinstance(given, Mapping) and "state" not in given:
            given = {**self._reset_options, **given}
        return self.env.reset(seed=seed, options=given)


Inverse = Callable[[Any], Any]


def wrapped_expert(env: gymnasium.Env[Any, Any], expert: Callable[[], Any]) -> Callable[[], Any]:
    """Return an expert with actions in the action space of the outermost wrapper that queried it.

    An environment of Gymnasium has no reference to its wrappers, so they are read from the call stack. A
    wrapper with the action space of its environment changes no actions, unless it is an ``ActionWrapper`` or
    has a method ``revert_action()``.

    :param env: environment whose ``get_wrapper_attr()`` calls this function
    :raises ValueError: a wrapper changes actions in a way that cannot be inverted
    """
    inverses: list[Inverse] = []
    inner: Any = env
    frame = sys._getframe(1)
    while frame is not None and frame.f_code.co_name == "get_wrapper_attr":
        caller = frame.f_locals.get("self")
        if isinstance(caller, gymnasium.Wrapper) and caller.env is inner:
            inverses += _inverses(caller)
            inner = caller
        frame = frame.f_back  # type: ignore[assignment]
    return lambda: reduce(lambda action, inverse: inverse(action), inverses, expert())


def _inverses(wrapper: gymnasium.Wrapper[Any, Any, Any, Any]) -> list[Inverse]:
    """Return the inverse of a wrapper's change of actions; an empty list if it changes none."""
    own: Inverse | None = getattr(wrapper, "revert_action", None)
    if own is not None and not isinstance(wrapper, DiscretizeAction):  # which returns the nearest bin
        return [own]
    if isinstance(wrapper, RescaleAction):
        outer: Any = wrapper.action_space
        inner: Any = wrapper.env.action_space
        _, forward, _ = rescale_box(inner, outer.low, outer.high)
        return [lambda action: forward(action).clip(outer.low, outer.high)]
    same_space = wrapper.action_space == wrapper.env.action_space
    if isinstance(wrapper, ClipAction) or (same_space and not isinstance(wrapper, gymnasium.ActionWrapper)):
        return []
    raise ValueError(
        "expert_action must be queried below wrappers whose change of actions has no known inverse, got "
        f"{type(wrapper).__name__}. Define revert_action(action) in the wrapper, or use env.unwrapped."
    )
