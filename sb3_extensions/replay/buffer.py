"""Replay buffer with expert steps: one table of steps, a sampler, n-step returns."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.replay.sampling import make_sampler
from sb3_extensions.replay.step_table import MIN_RING, Observations, Rows, StepTable

logger = logging.getLogger(__name__)

GIGABYTE = 1e9
KEY = "observation"
"""Name of the only entry of observations that are not a Dict."""
EXPERT_ACTION = "sb3_extensions.expert_action"
"""Key in the info of a step: action of the expert in the state before the step, in the policy's units."""
EXPLORED = "sb3_extensions.explored"
"""Key in the info of a step: whether the action was exploratory, not chosen by the policy."""
SUCCESS = "is_success"

AnyObservations = npt.NDArray[Any] | Observations


class ExpertReplayBuffer(ReplayBuffer):
    """
    Replay buffer that stores each observation once and keeps expert steps.

    The episodes of an expert come first (:meth:`add_episode`) and are never overwritten. Floating-point
    images are stored as integers over the bounds of their space; the error is at most half a step, see
    :class:`~sb3_extensions.replay.quantisation.Quantiser`. The buffer also serves SAC, TQC and CrossQ instead
        of
    ``ReplayBuffer`` and ``DictReplayBuffer``.

    The arrays are allocated at the first step. Their size is logged, with a warning if it exceeds the free
    memory.

    :param buffer_size: number of rows for the steps of all environments; an episode of n steps occupies n + 1
    :param observation_space: Box space, or Dict space of Box spaces
    :param action_space: action space
    :param device: PyTorch device of the samples
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: must be False, observations are always stored once
    :param handle_timeout_termination: bootstrap from the last observation of a truncated episode
    :param n_steps: maximum number of rewards in a return before the bootstrap. A return ends at the end of
        the episode and before an exploratory action (https://arxiv.org/abs/1606.02647, traces of Watkins's
        Q(lambda))
    :param gamma: discount factor per step, required if ``n_steps > 1``. With None the samples have no
        discounts
    :param image_dtype: ``"uint8"`` or ``"uint16"``, type of the stored images
    :param sampler: sampler of the steps: ``"uniform"``, ``"shares"``, ``"prioritized"``, one of them with its
        arguments, or an object, see :mod:`sb3_extensions.replay.sampling`
    :param seed: seed of the sampling. With None it is drawn from NumPy's global generator, which the ``seed``
        of a Stable-Baselines3 algorithm sets before it creates its buffer
    :raises ValueError: if an argument is out of its range
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float | None = None,
        image_dtype: str = "uint8",
        sampler: Any = None,
        seed: int | None = None,
    ) -> None:
        # ReplayBuffer's own constructor would allocate its arrays.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False, got True")
        if buffer_size < MIN_RING * n_envs:
            raise ValueError(
                f"buffer_size must be at least {MIN_RING * n_envs} with {n_envs} environments, "
                f"got {buffer_size}"
            )
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.image_dtype = image_dtype
        self.set_discount(gamma, n_steps)
        self._is_dict = isinstance(observation_space, spaces.Dict)
        keyed = dict(observation_space.items()) if isinstance(observation_space, spaces.Dict) else {}
        self.table = StepTable(
            buffer_size, n_envs, keyed or {KEY: observation_space}, self._columns(), image_dtype
        )
        self.sampler = make_sampler(sampler)
        self.reset()
        self.seed(int(np.random.randint(2**31)) if seed is None else seed)

    def _columns(self) -> dict[str, tuple[tuple[int, ...], npt.DTypeLike]]:
        """Return the shape and type of each column of the table."""
        return {
            "action": ((self.action_dim,), np.dtype(self._maybe_cast_dtype(self.action_space.dtype))),
            "expert_action": ((self.action_dim,), np.float32),  # NaN if unknown
            "explored": ((), np.bool_),
            "succeeded": ((), np.bool_),
            "reward": ((), np.float32),
            "done": ((), np.float32),
        }

    def set_discount(self, gamma: float | None, n_steps: int) -> None:
        """
        Set the discount of the returns.

        :param gamma: discount factor per step
        :param n_steps: maximum number of rewards in a return
        :raises ValueError: if ``n_steps`` is not positive, or greater than 1 without ``gamma``
        """
        if n_steps < 1:
            raise ValueError(f"n_steps must be at least 1, got {n_steps}")
        if n_steps > 1 and gamma is None:
            raise ValueError(f"gamma must be a number with n_steps={n_steps}, got None")
        self.gamma, self.n_steps = gamma, n_steps

    def seed(self, seed: int) -> None:
        """
        Seed the sampling.

        :param seed: seed
        """
        self.rng = np.random.default_rng(seed)

    def reset(self) -> None:
        """Remove all steps."""
        super().reset()
        self.expert_size = 0
        self.table.clear()
        self.sampler.setup(self.table)
        # Of the last step of each environment: the observation that followed, None after reset()
        self._next_obs: Observations | None = None
        self._is_open = np.zeros(self.n_envs, dtype=bool)  # whether the episode goes on
        self._creditable: list[list[int]] = [[] for _ in range(self.n_envs)]

    def size(self) -> int:
        """:return: number of steps that can be sampled"""
        return int(np.count_nonzero(self.table.columns["valid"])) if self.table.is_allocated else 0

    def steps(self, name: str) -> npt.NDArray[Any]:
        """
        Return a column of all steps, those of the expert first.

        :param name: "action", "expert_action", "explored", "succeeded", "reward" or "done"
        :return: one entry a step
        """
        column: npt.NDArray[Any] = self.table.columns[name][self.table.columns["valid"]]
        return column

    def _allocate(self) -> None:
        size, available = self.table.nbytes / GIGABYTE, psutil.virtual_memory().available / GIGABYTE
        logger.info("Replay buffer: %d rows, %.2f GB (%.2f GB available)", self.buffer_size, size, available)
        if size > available:
            logger.warning("The full replay buffer does not fit into memory: %.2f > %.2f GB", size, available)
        self.table.allocate()

    def add_episode(
        self,
        observations: Observations,
        actions: npt.NDArray[Any],
        rewards: npt.NDArray[Any],
        terminations: npt.NDArray[Any],
        expert_actions: npt.NDArray[Any] | None = None,
    ) -> None:
        """
        Add an episode of the expert, before the first online step.

        :param observations: for each key an array of n + 1 observations
        :param actions: n executed actions in the policy's units [-1, 1], shape (n, action dimensions)
        :param rewards: n rewards
        :param terminations: n booleans, True where the episode terminated (not where it was truncated)
        :param expert_actions: n actions that the expert intended, if they differ from the executed ones
        :raises ValueError: if the lengths differ, the buffer is too small, or there are online steps
        """
        if self._next_obs is not None:
            raise ValueError("expert episodes must be added before the first online step")
        intended = actions if expert_actions is None else expert_actions
        self._check_episode(observations, actions, rewards, terminations, intended)
        if not self.table.is_allocated:
            self._allocate()
        rows = self.table.pin(len(actions) + 1)
        self.table.write_observations(rows, observations)
        self.table.write_steps(
            rows[:-1],
            action=np.reshape(actions, (len(actions), self.action_dim)),
            expert_action=np.reshape(intended, (len(actions), self.action_dim)),
            explored=False,
            succeeded=True,
            reward=rewards,
            done=terminations,
        )
        self.expert_size += len(actions)
        self.sampler.update(added=rows[:-1], removed=rows[:0])

    def _check_episode(self, observations: Observations, actions: Any, *columns: Any) -> None:
        n_steps = len(actions)
        if missing := self.table.codings.keys() - observations.keys():
            raise ValueError(
                f"observations must have the keys {sorted(self.table.codings)}, {missing} missing"
            )
        lengths = {f"observations[{key!r}]": len(observations[key]) - 1 for key in self.table.codings}
        names = ("rewards", "terminations", "expert_actions")
        lengths |= {name: len(column) for name, column in zip(names, columns, strict=True)}
        if n_steps == 0 or any(length != n_steps for length in lengths.values()):
            raise ValueError(
                f"an episode must have the same number of steps everywhere, got {n_steps}, {lengths}"
            )
        needed = self.table.n_pinned + n_steps + 1 + MIN_RING * self.n_envs
        if needed > self.buffer_size:
            raise ValueError(
                f"buffer_size must be at least {needed} for the demonstrations, got {self.buffer_size}"
            )

    def add(
        self,
        obs: AnyObservations,
        next_obs: AnyObservations,
        action: npt.NDArray[Any],
        reward: npt.NDArray[np.float32],
        done: npt.NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add one step of every environment.

        :param obs: observations, first axis of length ``n_envs``
        :param next_obs: next observations; the last ones of episodes that ended
        :param action: actions in the policy's units
        :param reward: rewards, shape (n_envs,)
        :param done: whether the episode ended, shape (n_envs,)
        :param infos: ``"TimeLimit.truncated"`` is True if the episode was truncated, ``"is_success"`` if it
            succeeded;
            :data:`EXPERT_ACTION` is the expert's action, :data:`EXPLORED` marks an exploratory action
        """
        if not self.table.is_allocated:
            self._allocate()
        obs, next_obs = self._as_dict(obs), self._as_dict(next_obs)
        done, table = np.asarray(done, dtype=bool), self.table
        starts = ~self._continues(obs)
        # The head of an interrupted episode holds its last observation.
        table.heads = np.where(starts & self._is_open, table.next(table.heads), table.heads)
        rows, next_rows = table.heads, table.next(table.heads)
        touched = np.unique(np.concatenate([rows, next_rows]))
        was_valid = touched[table.columns["valid"][touched]]
        if starts.any():
            table.write_observations(rows[starts], {key: obs[key][starts] for key in table.codings})
        table.write_observations(next_rows, next_obs)
        timeout = np.array([info.get("TimeLimit.truncated", False) for info in infos], dtype=bool)
        explored = np.array([info.get(EXPLORED, False) for info in infos], dtype=bool)
        table.write_steps(
            rows,
            action=np.asarray(action).reshape(self.n_envs, self.action_dim),
            expert_action=self._expert_actions(infos),
            explored=explored,
            succeeded=False,
            reward=reward,
            done=done & ~(timeout & self.handle_timeout_termination),
        )
        self._credit(rows, starts | explored, done, infos)
        table.heads = np.where(done, table.next(next_rows), next_rows)
        self._next_obs = {key: np.array(next_obs[key]) for key in table.codings}
        self._is_open = ~done
        self.sampler.update(added=rows, removed=was_valid)

    def _continues(self, obs: Observations) -> npt.NDArray[np.bool_]:
        """Return for each environment whether the observation is the one after its last step, (n_envs,)."""
        continues = self._is_open.copy()
        for key, latest in (self._next_obs or {}).items():
            # An environment can be reset in the middle of an episode, as learn() does.
            continues &= (obs[key] == latest).reshape(self.n_envs, -1).all(axis=1)
        return continues

    def _expert_actions(self, infos: list[dict[str, Any]]) -> npt.NDArray[Any]:
        """Return the expert's actions, (n_envs, action dimensions), NaN where unknown."""
        unknown = np.full(self.action_dim, np.nan)
        return np.stack([np.ravel(info.get(EXPERT_ACTION, unknown)) for info in infos])

    def _credit(
        self,
        rows: Rows,
        restarts: npt.NDArray[np.bool_],
        done: npt.NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> None:
        """Mark the steps of a successful episode from its last exploratory action on as succeeded."""
        for env, row in enumerate(rows.tolist()):
            steps = self._creditable[env] = [row] if restarts[env] else [*self._creditable[env], row]
            if done[env]:
                self.table.columns["succeeded"][steps] = bool(infos[env].get(SUCCESS, False))

    def _as_dict(self, obs: AnyObservations) -> Observations:
        return obs if isinstance(obs, dict) else {KEY: obs}

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> ExpertReplayBufferSamples:
        """
        Sample steps.

        :param batch_size: number of steps
        :param env: normalization to apply to observations and rewards
        :return: the sample
        :raises ValueError: if the buffer is empty
        """
        if not self.size():
            raise ValueError("the replay buffer must have at least one step, got 0")
        rows, weights = self.sampler.sample(batch_size, self.rng)
        return self._get_samples(rows, env, weights)

    def update_priorities(self, rows: Rows, td_errors: th.Tensor) -> None:
        """
        Pass the errors of an update to the sampler.

        :param rows: ``indices`` of a sample, shape (batch,)
        :param td_errors: absolute temporal-difference errors, shape (batch, 1)
        """
        self.sampler.update_priorities(rows, td_errors.detach().cpu().numpy().ravel().astype(np.float64))

    def _get_samples(  # type: ignore[override]
        self,
        batch_inds: Rows,
        env: VecNormalize | None = None,
        weights: npt.NDArray[np.float32] | None = None,
    ) -> ExpertReplayBufferSamples:
        columns, batch_size = self.table.columns, len(batch_inds)
        last_rows, rewards, discounts = self._n_step_returns(batch_inds, env)
        both = np.concatenate([batch_inds, self.table.next(last_rows)])
        observations, next_observations = self._observations(both, env, batch_size)
        weights = np.ones(batch_size, dtype=np.float32) if weights is None else weights
        return ExpertReplayBufferSamples(
            observations=observations,
            actions=self.to_torch(columns["action"][batch_inds], copy=False),
            next_observations=next_observations,
            dones=self._column(columns["done"][last_rows]),
            rewards=self._column(rewards),
            discounts=None if discounts is None else self._column(discounts),
            is_expert=self._column(batch_inds < self.table.n_pinned),
            weights=self._column(weights),
            indices=batch_inds,
            expert_actions=self.to_torch(columns["expert_action"][batch_inds], copy=False),
            succeeded=self._column(columns["succeeded"][batch_inds]),
        )

    def _observations(
        self, rows: Rows, env: VecNormalize | None, batch_size: int
    ) -> tuple[TensorDict | th.Tensor, TensorDict | th.Tensor]:
        """Return the observations of the first ``batch_size`` rows and of the others."""
        arrays = self.table.read_observations(rows)
        values = self._normalize_obs(arrays if self._is_dict else arrays[KEY], env)
        if not isinstance(values, dict):
            tensor = self.to_torch(values, copy=False)
            return tensor[:batch_size], tensor[batch_size:]
        tensors = {key: self.to_torch(value, copy=False) for key, value in values.items()}
        first = {key: tensor[:batch_size] for key, tensor in tensors.items()}
        return first, {key: tensor[batch_size:] for key, tensor in tensors.items()}

    def _column(self, values: npt.NDArray[Any]) -> th.Tensor:
        return self.to_torch(values.reshape(-1, 1), copy=False)

    def _n_step_returns(
        self, rows: Rows, env: VecNormalize | None
    ) -> tuple[Rows, npt.NDArray[np.float32], npt.NDArray[np.float32] | None]:
        """
        Return sums of discounted rewards over up to ``n_steps`` steps.

        :param rows: first rows, shape (batch,)
        :param env: normalization to apply to the rewards
        :return: last rows, sums, discounts of the values after them; each of shape (batch,)
        """
        columns = self.table.columns
        rewards = self._normalize_reward(columns["reward"][rows], env)
        if self.gamma is None:
            return rows, rewards, None
        discounts = np.full(len(rows), self.gamma, dtype=np.float32)
        for _ in range(self.n_steps - 1):
            next_rows = self.table.next(rows)
            goes_on = columns["valid"][next_rows] & ~columns["explored"][next_rows]
            rows = np.where(goes_on, next_rows, rows)
            reward = self._normalize_reward(columns["reward"][rows], env)
            rewards = rewards + np.where(goes_on, discounts * reward, np.float32(0))
            discounts = np.where(goes_on, discounts * np.float32(self.gamma), discounts)
        return rows, rewards, discounts


def check_compatible(loaded: ReplayBuffer | None, own: ExpertReplayBuffer) -> ExpertReplayBuffer:
    """
    Check that a loaded buffer fits an algorithm.

    :param loaded: loaded buffer
    :param own: buffer that the algorithm created
    :return: the loaded buffer
    :raises ValueError: if class, spaces or the number of environments differ
    """
    if not isinstance(loaded, ExpertReplayBuffer):
        raise ValueError(f"the replay buffer must be an ExpertReplayBuffer, got {type(loaded).__name__}")
    for name in ("observation_space", "action_space", "n_envs"):
        if getattr(loaded, name) != getattr(own, name):
            raise ValueError(
                f"the replay buffer's {name} must be {getattr(own, name)}, got {getattr(loaded, name)}"
            )
    return loaded
