"""Vector environments of several tasks, and starting states for the members of vector environments.

``gymnasium.make_vec(id, num_envs=n, vectorization_mode="async")`` runs environments of one task in processes.
``reset(options={"state": state})`` begins all members at the same state.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from copy import deepcopy
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import SyncVectorEnv, VectorEnv
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config_checks import check_argument, instance, integer, rule
from bulletarm_gym.scene.state import EnvState

TASK_ID = "task_id"
"""Observation that is 1 for the task of an environment and 0 for the other tasks."""
Observation = dict[str, NDArray[Any]]


def make_multi_task_vec(
    ids: Iterable[str | EnvSpec],
    envs_per_task: int = 1,
    vec_env_cls: Callable[[list[Callable[[], gymnasium.Env[Any, Any]]]], Any] = SyncVectorEnv,
    **kwargs: Any,
) -> Any:
    """Make a vector environment of several tasks with common spaces, for one policy.

    Its members are wrapped in :class:`CommonSpaces` and have the order of ``ids``.

    :param ids: ids or specs, all with open-loop or all with closed-loop control
    :param envs_per_task: number of members with each id
    :param vec_env_cls: class of Gymnasium or Stable-Baselines3, such as ``AsyncVectorEnv`` or ``DummyVecEnv``
    :param kwargs: parameters of all environments
    :return: instance of ``vec_env_cls``
    :raises ValueError: ``ids`` is empty or mixes open and closed loop, images of one name have different
        shapes, or an environment already observes ``task_id``
    """
    check_argument("envs_per_task", envs_per_task, integer(1))
    names = rule("a list of at least one id", bool, lambda ids: [] if isinstance(ids, str) else list(ids))
    ids = check_argument("ids", ids, names)
    observations, sequences, controls = zip(*(_describe(env_id, kwargs) for env_id in ids), strict=True)
    if len(set(controls)) > 1:
        raise ValueError(f"ids must all have one kind of control, got {', '.join(controls)}")
    common = {
        "observation_space": _common_observation_space(observations),
        "action_sequence": _common_sequence(sequences),
    }
    members = [partial(_make_task, env_id, kwargs, {**common, "task": n}) for n, env_id in enumerate(ids)]
    return vec_env_cls([member for member in members for _ in range(envs_per_task)])


def _describe(env_id: str | EnvSpec, kwargs: Mapping[str, Any]) -> tuple[spaces.Dict, str, str]:
    """Return the observation space, the action sequence and the kind of control of an id."""
    with closing(gymnasium.make(env_id, **kwargs)) as env:
        core: Any = env.unwrapped
        return core.observation_space, core.action_sequence, core.config.control


def _make_task(env_id: str | EnvSpec, kwargs: Mapping[str, Any], common: Mapping[str, Any]) -> "CommonSpaces":
    return CommonSpaces(gymnasium.make(env_id, **kwargs), **common)


class CommonSpaces(gymnasium.ObservationWrapper[Observation, Any, Observation], RecordConstructorArgs):
    """Give the environment of one task the spaces of several tasks.

    Observations that the environment lacks are zeros, and vectors are padded with zeros. Numbers of an action
    that the environment lacks have no effect, and are 0 in the actions of the expert.

    :param env: environment of this package
    :param observation_space: observations of all tasks, with a number for each task as ``task_id``
    :param action_sequence: meaning of each number of an action, one character each, for all tasks
    :param task: number of the environment's task, from 0 on
    :raises ValueError: ``action_sequence`` lacks a character of the environment's, or ``task`` is too large
    """

    def __init__(
        self,
        env: gymnasium.Env[Observation, Any],
        observation_space: spaces.Dict,
        action_sequence: str,
        task: int,
    ) -> None:
        RecordConstructorArgs.__init__(
            self, observation_space=observation_space, action_sequence=action_sequence, task=task
        )
        gymnasium.ObservationWrapper.__init__(self, env)
        space: Any = observation_space
        own = env.get_wrapper_attr("action_sequence")
        contains = rule(f"text with the characters of {own!r}", lambda text: not Counter(own) - Counter(text))
        check_argument("action_sequence", action_sequence, contains)
        task = check_argument("task", task, integer(0, space[TASK_ID].shape[0] - 1))
        self.observation_space = deepcopy(space)
        self.action_sequence = action_sequence
        self.action_space = spaces.Box(-1.0, 1.0, (len(action_sequence),), np.float32)
        self._places = _places(own, action_sequence)
        self._task_id = np.eye(space[TASK_ID].shape[0], dtype=np.float32)[task]

    def step(self, action: ArrayLike) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Carry out an action of all tasks.

        :raises ValueError: the action has the wrong shape
        """
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action must have the shape {self.action_space.shape}, got {action.shape}")
        return super().step(action[self._places])

    def observation(self, observation: Observation) -> Observation:
        """Return an observation of the environment as one of all tasks."""
        observation = {**observation, TASK_ID: self._task_id}
        common: Any = self.observation_space
        return {name: _padded(observation.get(name), box) for name, box in common.items()}

    def revert_action(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return an action of the environment as one of all tasks."""
        padded = np.zeros(self.action_space.shape or (), np.float32)
        padded[self._places] = action
        return padded


def _places(sequence: str, common: str) -> list[int]:
    """Return the index in a common action sequence of each number of an action."""
    places: list[int] = []
    for name in sequence:
        places.append(next(n for n, other in enumerate(common) if other == name and n not in places))
    return places


def _common_sequence(sequences: Sequence[str]) -> str:
    """Return the shortest sequence that contains each sequence, ordered as the longest ones."""
    longest_first = sorted(sequences, key=len, reverse=True)
    names = dict.fromkeys("".join(longest_first))
    return "".join(name * max(sequence.count(name) for sequence in sequences) for name in names)


def _common_observation_space(observations: Sequence[spaces.Dict]) -> spaces.Dict:
    """Return the space of the observations of all tasks and ``task_id``."""
    names = dict.fromkeys(name for space in observations for name in space)
    if TASK_ID in names:
        raise ValueError(f"observation must have sensors with other names than {TASK_ID!r}")
    boxes = {name: _common_box(name, [space.get(name) for space in observations]) for name in names}
    return spaces.Dict({**boxes, TASK_ID: spaces.Box(0.0, 1.0, (len(observations),), np.float32)})


def _common_box(name: str, boxes: Sequence[Any]) -> spaces.Box:
    """Return the common space of an observation. A box is None if a task lacks the observation."""
    kinds = {(box.shape, box.dtype.name) for box in boxes if box is not None}
    lengths, types = {len(shape) for shape, _ in kinds}, {dtype for _, dtype in kinds}
    if len(types) > 1 or (len(kinds) > 1 and lengths != {1}):
        raise ValueError(f"ids must observe {name!r} with one type and shape, got {sorted(kinds)}")
    (shape, dtype) = max(kinds)
    empty: Any = spaces.Box(0, 0, shape, dtype)
    low, high = ([_padded(box and getattr(box, end), empty) for box in boxes] for end in ("low", "high"))
    return spaces.Box(np.min(low, axis=0), np.max(high, axis=0), dtype=dtype)


def _padded(values: NDArray[Any] | None, box: spaces.Box) -> NDArray[Any]:
    """Return a new array with the shape of a space, padded with zeros."""
    padded = np.zeros(box.shape, box.dtype)
    if values is not None:
        padded[tuple(map(slice, values.shape))] = values
    return padded


def reset_to_states(envs: VectorEnv[Any, Any, Any], states: Iterable[EnvState]) -> tuple[Any, dict[str, Any]]:
    """Begin the episodes of a vector environment, each member at its own state.

    :param envs: vector environment of Gymnasium
    :param states: one state for each member
    :return: observations and infos, as ``envs.reset()`` returns them
    :raises ValueError: the number of states differs from that of the members, or ``envs`` has
        ``shared_memory=False``
    """
    if not getattr(envs.unwrapped, "shared_memory", True):
        # Its workers reset ended members again at the next step: findings/gymnasium_async_resets_twice.sh
        raise ValueError("envs must have shared_memory=True, got shared_memory=False")
    states = list(check_argument("states", states, instance(Iterable)))
    if len(states) != envs.num_envs:
        raise ValueError(f"states must be {envs.num_envs} states, one per member, got {len(states)}")
    envs.reset()  # the first reset must be of all members
    infos: dict[str, Any] = {}
    for number, state in enumerate(states):
        mask = np.arange(envs.num_envs) == number
        observations, later = envs.reset(options={"state": state, "reset_mask": mask})
        _merge(infos, later, mask)
    return observations, infos


def _merge(infos: dict[str, Any], later: Mapping[str, Any], mask: NDArray[np.bool_]) -> None:
    """Add the infos of the members in a mask."""
    for name, entry in later.items():
        if isinstance(entry, dict):
            _merge(infos.setdefault(name, {}), entry, mask)
        else:
            infos.setdefault(name, entry)[mask] = entry[mask]
