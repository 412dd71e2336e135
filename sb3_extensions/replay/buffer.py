"""Replay buffer with expert steps: one table of steps, a sampler, n-step returns."""

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.common.components import check_integer
from sb3_extensions.common.observations import KEY, as_parts, space_parts
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.replay.sampling import make_sampler
from sb3_extensions.replay.step_table import MIN_RING, Layout, Observations, Rows, StepTable

GIGABYTE = 1e9
EXPERT_ACTION = "sb3_extensions.expert_action"
"""Key in the info of a step: the expert's action in the state before the step, in the policy's units."""

AnyObservations = npt.NDArray[Any] | Observations


class ExpertReplayBuffer(ReplayBuffer):
    """
    Replay buffer that stores each observation once and keeps expert steps.

    The episodes of an expert come first (:meth:`add_episode`) and are never overwritten. Floating-point
    images are stored as integers, see :class:`~sb3_extensions.replay.quantisation.Quantiser`. The buffer can
    also replace ``ReplayBuffer`` and ``DictReplayBuffer`` in SAC, TQC and CrossQ. It warns if its full size
    exceeds the available memory.

    See Stable-Baselines3's ``ReplayBuffer`` for the parameters that are not documented here.

    :param buffer_size: number of rows for the steps of all environments; an episode of n steps occupies n + 1
    :param observation_space: Box space, or Dict space of Box spaces
    :param optimize_memory_usage: must be False, observations are always stored once
    :param handle_timeout_termination: bootstrap from the last observation of a truncated episode, also of an
        expert episode
    :param n_steps: maximum number of rewards in a return before the bootstrap
    :param gamma: discount factor per step, required if ``n_steps > 1``
    :param image_dtype: ``"uint8"`` or ``"uint16"``, type of the stored images; None to store them unchanged
    :param sampler: sampler of the steps: ``"uniform"``, ``"shares"``, ``"prioritized"``, one of them with its
        arguments, or an object, see :mod:`sb3_extensions.replay.sampling`
    :param seed: seed of the sampling, None to sample it from NumPy's global generator
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
        image_dtype: str | None = "uint8",
        sampler: Any = None,
        seed: int | None = None,
    ) -> None:
        # ReplayBuffer's own constructor would allocate its arrays.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False, got True")
        self._check_size(MIN_RING * n_envs, f"{n_envs} environments")
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.image_dtype = image_dtype
        self.set_discount(gamma, n_steps)
        columns: Layout = {
            "action": ((self.action_dim,), np.dtype(self._maybe_cast_dtype(action_space.dtype))),
            "expert_action": ((self.action_dim,), np.float32),  # NaN if unknown
            "reward": ((), np.float32),
            "done": ((), np.float32),
        }
        self.table = StepTable(buffer_size, n_envs, space_parts(observation_space), columns, image_dtype)
        size, available = self.table.nbytes / GIGABYTE, psutil.virtual_memory().available / GIGABYTE
        if size > available:
            warnings.warn(f"The replay buffer needs {size:.2f} GB, {available:.2f} GB are free", stacklevel=2)
        self.sampler = make_sampler(sampler)
        self.reset()
        self.seed(int(np.random.randint(2**31)) if seed is None else seed)

    def _check_size(self, needed: int, content: str) -> None:
        if self.buffer_size < needed:
            raise ValueError(f"buffer_size must be at least {needed} for {content}, got {self.buffer_size}")

    def set_discount(self, gamma: float | None, n_steps: int) -> None:
        """Set the discount factor per step and the maximum number of rewards in a return."""
        check_integer(1, n_steps=n_steps)
        if n_steps > 1 and gamma is None:
            raise ValueError(f"gamma must be a number with n_steps={n_steps}, got None")
        self.gamma, self.n_steps = gamma, n_steps

    def seed(self, seed: int) -> None:
        """Seed the sampling."""
        self.rng = np.random.default_rng(seed)

    def reset(self) -> None:
        """Remove all steps."""
        super().reset()
        self.expert_size = 0
        self.table.clear()
        self.sampler.setup(self.table)
        self._next_obs: Observations | None = None  # observations after the last step of each environment
        self._is_open = np.zeros(self.n_envs, dtype=bool)  # whether an episode has not ended

    def size(self) -> int:
        """:return: number of steps that can be sampled"""
        return int(np.count_nonzero(self.table.columns["valid"]))

    def steps(self, name: str) -> npt.NDArray[Any]:
        """Return a column of the table, such as "action" or "reward", of all steps, expert steps first."""
        column: npt.NDArray[Any] = self.table.columns[name][self.table.columns["valid"]]
        return column

    def add_episode(
        self,
        observations: AnyObservations,
        actions: npt.NDArray[Any],
        rewards: npt.NDArray[Any],
        terminations: npt.NDArray[Any],
        expert_actions: npt.NDArray[Any] | None = None,
    ) -> None:
        """
        Add an episode of the expert, before the first online step.

        :param observations: n + 1 observations; for a Dict space an array for each key
        :param actions: n executed actions in the policy's units [-1, 1], shape (n, action dimensions)
        :param rewards: n rewards
        :param terminations: n booleans, True where the episode terminated; all False if it was truncated
        :param expert_actions: n actions that the expert intended, if they differ from the executed ones
        :raises ValueError: if the buffer is too small, or there are online steps
        """
        if self._next_obs is not None:
            raise ValueError("expert episodes must be added before the first online step")
        n_rows = len(actions) + 1
        self._check_size(self.table.n_pinned + n_rows + MIN_RING * self.n_envs, "the demonstrations")
        intended = actions if expert_actions is None else expert_actions
        done = np.array(terminations, dtype=bool)
        done[-1] |= not self.handle_timeout_termination
        rows = self.table.pin(n_rows)
        self.table.write_observations(rows, as_parts(observations))
        self.table.write_steps(
            rows[:-1],
            action=np.reshape(actions, (-1, self.action_dim)),
            expert_action=np.reshape(intended, (-1, self.action_dim)),
            reward=rewards,
            done=done,
        )
        self.expert_size += len(actions)
        self.sampler.update(added=rows[:-1], removed=rows[:0])

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

        See Stable-Baselines3's ``ReplayBuffer`` for the other parameters.

        :param infos: ``"TimeLimit.truncated"`` is True if the episode was truncated. :data:`EXPERT_ACTION` is
            the expert's action
        """
        obs, next_obs = as_parts(obs), as_parts(next_obs)
        done, table = np.asarray(done, dtype=bool), self.table
        starts = ~self._continues(obs)
        # The head of an interrupted episode holds its last observation.
        table.heads = np.where(starts & self._is_open, table.next(table.heads), table.heads)
        rows, next_rows = table.heads, table.next(table.heads)
        written = np.unique(np.concatenate([rows, next_rows]))
        removed = written[table.columns["valid"][written]]
        table.write_observations(rows[starts], {key: values[starts] for key, values in obs.items()})
        table.write_observations(next_rows, next_obs)
        timeout = np.array([info.get("TimeLimit.truncated", False) for info in infos], dtype=bool)
        unknown = np.full(self.action_dim, np.nan)
        table.write_steps(
            rows,
            action=np.asarray(action).reshape(self.n_envs, self.action_dim),
            expert_action=np.stack([np.ravel(info.get(EXPERT_ACTION, unknown)) for info in infos]),
            reward=reward,
            done=done & ~(timeout & self.handle_timeout_termination),
        )
        table.heads = np.where(done, table.next(next_rows), next_rows)
        self._next_obs = {key: np.array(values) for key, values in next_obs.items()}
        self._is_open = ~done
        self.sampler.update(added=rows, removed=removed)

    def _continues(self, obs: Observations) -> npt.NDArray[np.bool_]:
        """Return for each environment whether the observation is the one after its last step, (n_envs,)."""
        continues = self._is_open.copy()
        for key, latest in (self._next_obs or {}).items():
            # learn() can reset an environment in the middle of an episode.
            continues &= (obs[key] == latest).reshape(self.n_envs, -1).all(axis=1)
        return continues

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> ExpertReplayBufferSamples:
        """
        Sample steps, see Stable-Baselines3's ``ReplayBuffer`` for the parameters.

        :raises ValueError: if the buffer is empty
        """
        if not self.size():
            raise ValueError("the replay buffer must have at least one step, got 0")
        rows, weights = self.sampler.sample(batch_size, self.rng)
        return self._get_samples(rows, env, weights)

    def update_priorities(self, rows: Rows, td_errors: th.Tensor) -> None:
        """Pass the absolute temporal-difference errors (batch, 1) of sampled rows (batch,) to the sampler."""
        self.sampler.update_priorities(rows, td_errors.detach().cpu().numpy().ravel().astype(np.float64))

    def _get_samples(  # type: ignore[override]
        self,
        batch_inds: Rows,
        env: VecNormalize | None = None,
        weights: npt.NDArray[np.float32] | None = None,
    ) -> ExpertReplayBufferSamples:
        columns = self.table.columns
        last_rows, rewards, discounts = self._n_step_returns(batch_inds, env)
        weights = np.ones(len(batch_inds), dtype=np.float32) if weights is None else weights
        return ExpertReplayBufferSamples(
            observations=self._observations(batch_inds, env),
            actions=self.to_torch(columns["action"][batch_inds], copy=False),
            next_observations=self._observations(self.table.next(last_rows), env),
            dones=self._column(columns["done"][last_rows]),
            rewards=self._column(rewards),
            discounts=None if discounts is None else self._column(discounts),
            is_expert=self._column(batch_inds < self.table.n_pinned),
            weights=self._column(weights),
            indices=batch_inds,
            expert_actions=self.to_torch(columns["expert_action"][batch_inds], copy=False),
        )

    def _observations(self, rows: Rows, env: VecNormalize | None) -> TensorDict | th.Tensor:
        arrays = self.table.read_observations(rows)
        is_dict = isinstance(self.observation_space, spaces.Dict)
        values = self._normalize_obs(arrays if is_dict else arrays[KEY], env)
        tensors = {key: self.to_torch(value, copy=False) for key, value in as_parts(values).items()}
        return tensors if is_dict else tensors[KEY]

    def _column(self, values: npt.NDArray[Any]) -> th.Tensor:
        return self.to_torch(values.reshape(-1, 1), copy=False)

    def _n_step_returns(
        self, rows: Rows, env: VecNormalize | None
    ) -> tuple[Rows, npt.NDArray[np.float32], npt.NDArray[np.float32] | None]:
        """Return last rows of returns, sums of rewards, and discounts of the values after them."""
        columns = self.table.columns
        rewards = self._normalize_reward(columns["reward"][rows], env)
        if self.gamma is None:
            return rows, rewards, None
        discounts = np.full(len(rows), self.gamma, dtype=np.float32)
        for _ in range(self.n_steps - 1):
            next_rows = self.table.next(rows)
            continues = columns["valid"][next_rows]
            rows = np.where(continues, next_rows, rows)
            reward = self._normalize_reward(columns["reward"][rows], env)
            rewards = rewards + np.where(continues, discounts * reward, np.float32(0))
            discounts = np.where(continues, discounts * np.float32(self.gamma), discounts)
        return rows, rewards, discounts
