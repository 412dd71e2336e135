"""Replay of observations with images: a flat table of transitions over a store of frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.replay.frames import FrameStore, Ids, PinnedRing
from sb3_extensions.replay.memory import announce_size, warn_of_short_episodes
from sb3_extensions.replay.samples import FrameReplayBufferSamples

# An episode of n steps has n + 1 frames: this is room for a last frame every eleven transitions, and 100,000
# transitions at 128 x 128 pixels of one byte stay below 1.8 GB. How long episodes will be is not known when
# the memory is taken, and to take more later would copy gigabytes in the middle of a training.
FRAMES_PER_TRANSITION = 1.09
NO_ROW = -1  # in the column of successors: the episode ends here, or its next transition has not come yet

KEY = "observation"  # under which the only entry of an observation that is no Dict is stored
# Entry of an info: what the expert would have done in the state before the step, in the policy's units
EXPERT_ACTION = "sb3_extensions.expert_action"
# Entry of an info: whether the step's action was an exploratory one, no choice of the policy
EXPLORED = "sb3_extensions.explored"

Observations = dict[str, npt.NDArray[Any]]
AnyObservations = npt.NDArray[Any] | Observations


class FrameReplayBuffer(ReplayBuffer):
    """
    Replay buffer that stores every observation once.

    A transition refers to its two observations by number, and the next observation of a step is the
    observation of the step after it; only the last observation of an episode takes a place of its own. Images
    of floating-point numbers are stored as integers over the bounds of their space (error at most half a
    step, see :class:`~sb3_extensions.replay.quantisation.Quantiser`). It takes the place of ``ReplayBuffer``
    and ``DictReplayBuffer`` in SAC, TQC, CrossQ and others:
    ``SAC(..., replay_buffer_class=FrameReplayBuffer)``.

    The arrays are allocated, their size logged and compared with the free memory, at the first :meth:`add`.
    Where episodes are so short that the frames run out before the table is full, the oldest transitions are
    dropped early, and a warning says so once; give a larger ``frames_per_transition`` then. Episodes of n
    steps need (n + 1) / n: 2, always enough, where they are one decision each, as in open-loop object
    grasping; with the default such a buffer holds little more than half of ``buffer_size``.

    :param buffer_size: number of transitions, of all environments together
    :param observation_space: Box space, or Dict space of Box spaces
    :param action_space: action space
    :param device: PyTorch device of the samples
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: must be False: frames are always shared
    :param handle_timeout_termination: bootstrap from the last observation of an episode that ran out of time
    :param n_steps: number of rewards summed up before the bootstrap, fewer where an episode or the data end,
        or an exploratory action follows: its luck is no merit of the actions before it
    :param gamma: discount factor per step; needed where ``n_steps > 1``. None leaves it to the algorithm
    :param image_dtype: ``"uint8"`` or ``"uint16"``, for the quantised images
    :param frames_per_transition: number of frames to make room for, per transition; the default is for
        episodes of at least twelve steps
    :param seed: seed of the sampling. None takes one from NumPy's global generator, which the ``seed`` of a
        Stable-Baselines3 algorithm sets before it makes its buffer
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
        frames_per_transition: float = FRAMES_PER_TRANSITION,
        seed: int | None = None,
    ) -> None:
        # ReplayBuffer's own constructor would allocate its arrays
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.optimize_memory_usage = optimize_memory_usage
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False: this buffer always stores a frame once")
        if n_steps < 1:
            raise ValueError(f"n_steps must be at least 1, got {n_steps}")
        if n_steps > 1 and gamma is None:
            raise ValueError(f"n_steps={n_steps} needs gamma, the discount factor of the algorithm")
        if buffer_size < 2 * n_envs:
            raise ValueError(
                f"buffer_size must be at least {2 * n_envs}, two steps of n_envs={n_envs}, got {buffer_size}"
            )
        if frames_per_transition < 1:
            raise ValueError(f"frames_per_transition must be at least 1, got {frames_per_transition}")
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma
        # A step links its rows to those of the step before: the two must never share a row or a frame.
        n_frames = int(buffer_size * frames_per_transition) + 2 * n_envs
        self._is_dict = isinstance(observation_space, spaces.Dict)
        keyed = observation_space if isinstance(observation_space, spaces.Dict) else {KEY: observation_space}
        self.frames = FrameStore(dict(keyed.items()), n_frames, 3 * n_envs, image_dtype)
        self.rows = PinnedRing(buffer_size, 2 * n_envs)
        self.table: dict[str, npt.NDArray[Any]] = {}
        # Of the latest add(): next observations, their frames, and rows (NO_ROW where the episode ended)
        self._latest: Observations | None = None
        self._latest_frames = np.zeros(n_envs, dtype=np.int64)
        self._latest_rows = np.full(n_envs, NO_ROW, dtype=np.int64)
        self._first_rows = np.full(n_envs, NO_ROW, dtype=np.int64)  # of the episodes under way
        self._has_warned = False
        self.seed(int(np.random.randint(2**31)) if seed is None else seed)

    def seed(self, seed: int) -> None:
        """
        Seed the sampling.

        :param seed: seed
        """
        self.rng = np.random.default_rng(seed)

    def size(self) -> int:
        """:return: number of transitions that can be sampled"""
        return len(self.rows)

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self.rows = PinnedRing(self.rows.capacity, self.rows.min_ring)
        self.frames.clear()
        self._latest = None
        self._latest_rows.fill(NO_ROW)

    def _columns(self) -> dict[str, tuple[tuple[int, ...], npt.DTypeLike]]:
        """Shape of an entry and type of each column of the table."""
        return {
            "frame": ((), np.int64),  # id of the observation
            "next_frame": ((), np.int64),
            "oldest_frame": ((), np.int64),  # oldest frame of all rows added together with this one
            "next_row": ((), np.int64),  # id of the next transition of the episode, or NO_ROW
            "action": ((self.action_dim,), np.dtype(self._maybe_cast_dtype(self.action_space.dtype))),
            "expert_action": ((self.action_dim,), np.float32),  # NaN where no expert was asked
            "explored": ((), np.bool_),
            "reward": ((), np.float32),
            "done": ((), np.float32),
            "return": ((), np.float32),  # see FrameReplayBufferSamples, NaN while the episode goes on
        }

    @property
    def nbytes(self) -> int:
        """Size of the full buffer in bytes, allocated or not."""
        columns = self._columns().values()
        row = sum(int(np.prod(shape)) * np.dtype(dtype).itemsize for shape, dtype in columns)
        return self.frames.nbytes + row * self.rows.capacity

    def _allocate(self) -> None:
        """Allocate everything, once; announce the size."""
        announce_size(self.rows.capacity, self.frames.ring.capacity, self.nbytes)
        self.frames.allocate()
        for name, (shape, dtype) in self._columns().items():
            self.table[name] = np.zeros((self.rows.capacity, *shape), dtype=dtype)

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
        Add one transition of every environment.

        :param obs: observations, first axis of length ``n_envs``
        :param next_obs: observations that followed; the last ones of their episodes where these have ended
        :param action: actions as the policy gave them
        :param reward: rewards, shape (n_envs,)
        :param done: whether the episode ended, shape (n_envs,)
        :param infos: ``"TimeLimit.truncated"`` says that it ended only for want of time;
            :data:`EXPERT_ACTION` is what an expert would have done instead, as the policy gives it,
            :data:`EXPLORED` whether the action was an exploratory one
        """
        if not self.table:
            self._allocate()
        obs, next_obs = self._as_dict(obs), self._as_dict(next_obs)
        done = np.asarray(done, dtype=bool)
        continues = self._continues(obs)
        frames = np.where(continues, self._latest_frames, 0)
        if not continues.all():
            frames[~continues] = self.frames.append({key: obs[key][~continues] for key in self.frames.keys})
        next_frames = self.frames.append(next_obs)
        timeout = np.array([info.get("TimeLimit.truncated", False) for info in infos], dtype=bool)
        rows = self._write_rows(
            self.rows.append(self.n_envs),
            frame=frames,
            next_frame=next_frames,
            oldest_frame=min(frames.min(), next_frames.min()),
            next_row=NO_ROW,
            action=np.asarray(action).reshape(self.n_envs, self.action_dim),
            expert_action=self._read_expert_actions(infos),
            explored=[info.get(EXPLORED, False) for info in infos],
            reward=reward,
            done=done & ~(timeout & self.handle_timeout_termination),
            **{"return": np.nan},
        )
        self.table["next_row"][self.rows.slots(self._latest_rows[continues])] = rows[continues]
        self._latest = {key: np.array(next_obs[key]) for key in self.frames.keys}
        self._latest_frames = next_frames
        self._latest_rows = np.where(done, NO_ROW, rows)
        self._first_rows = np.where(continues, self._first_rows, rows)
        for env in np.flatnonzero(done):
            self._write_returns(np.arange(self._first_rows[env], self.rows.end, self.n_envs))
        self._drop_rows_without_frames()
        self.pos = self.rows.end % self.buffer_size
        self.full = len(self.rows) == self.buffer_size

    def _write_returns(self, rows: Ids) -> None:
        """Discounted rewards to an episode's end or next exploratory action, for its rows that are kept."""
        if self.gamma is None:
            return
        slots = self.rows.slots(rows[(rows >= self.rows.first) | (rows < self.rows.pinned)])[::-1]
        rewards, explored = self.table["reward"][slots], self.table["explored"][slots]
        after, returns = 0.0, []
        for reward, was_explored in zip(rewards.tolist(), explored.tolist(), strict=True):
            returns.append(reward + self.gamma * after)
            after = 0.0 if was_explored else returns[-1]
        self.table["return"][slots] = returns

    def set_discount(self, gamma: float, n_steps: int) -> None:
        """
        Change what :meth:`sample` sums up.

        :param gamma: discount factor per step
        :param n_steps: number of rewards summed up before the bootstrap
        :raises ValueError: if ``n_steps`` is not positive
        """
        if n_steps < 1:
            raise ValueError(f"n_steps must be at least 1, got {n_steps}")
        self.n_steps, before, self.gamma = n_steps, self.gamma, gamma
        if self.table and gamma != before:
            self._recompute_returns()

    def _recompute_returns(self) -> None:
        assert self.gamma is not None
        successors, rewards, explored, returns = (
            self.table[name] for name in ("next_row", "reward", "explored", "return")
        )
        for slot in self.rows.slots(self.rows.ids(np.arange(self.size())))[::-1]:  # youngest first
            next_slot = self.rows.slots(successors[slot])
            ends = successors[slot] == NO_ROW or explored[next_slot]
            if not np.isnan(returns[slot]):
                returns[slot] = rewards[slot] + self.gamma * (0.0 if ends else returns[next_slot])

    def _read_expert_actions(self, infos: list[dict[str, Any]]) -> npt.NDArray[Any]:
        """What an expert would have done, (n, action dimensions); NaN where none was asked."""
        unknown = np.full(self.action_dim, np.nan)
        return np.stack([np.ravel(info.get(EXPERT_ACTION, unknown)) for info in infos])

    def _as_dict(self, obs: AnyObservations) -> Observations:
        return obs if isinstance(obs, dict) else {KEY: obs}

    def _continues(self, obs: Observations) -> npt.NDArray[np.bool_]:
        """Whether the observations of the first n environments are what their latest steps led to, (n,)."""
        n_envs = len(next(iter(obs.values())))
        continues: npt.NDArray[np.bool_] = self._latest_rows[:n_envs] != NO_ROW
        for key, latest in (self._latest or {}).items():
            # An environment may have been reset in the middle of an episode: compare, do not trust the order.
            continues &= (obs[key] == latest[:n_envs]).reshape(n_envs, -1).all(axis=1)
        return continues

    def _write_rows(self, rows: Ids, **columns: Any) -> Ids:
        slots = self.rows.slots(rows)
        for name, values in columns.items():
            self.table[name][slots] = values
        return rows

    def _drop_rows_without_frames(self) -> None:
        rows, oldest_frame, first = self.rows, self.table["oldest_frame"], self.rows.first
        while oldest_frame[rows.slots(np.asarray(rows.first))] < self.frames.ring.first:
            rows.first += 1
        if rows.first > first and not self._has_warned:
            self._has_warned = True
            warn_of_short_episodes(len(rows), rows.capacity, self.frames.ring.end / rows.end)

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> FrameReplayBufferSamples:
        """
        Draw transitions.

        :param batch_size: number of transitions
        :param env: normalization to apply to observations and rewards
        :return: the sample
        :raises ValueError: if the buffer is empty
        """
        if not self.size():
            raise ValueError("the replay buffer is empty: nothing to sample from")
        rows, weights = self._draw(batch_size)
        return self._get_samples(rows, env, weights)

    def _draw(self, batch_size: int) -> tuple[Ids, npt.NDArray[np.float32]]:
        """Ids of sampled rows and their importance weights, both of shape (batch_size,)."""
        rows = self.rows.ids(self.rng.integers(self.size(), size=batch_size))
        return rows, np.ones(batch_size, dtype=np.float32)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: Ids, env: VecNormalize | None = None, weights: npt.NDArray[np.float32] | None = None
    ) -> FrameReplayBufferSamples:
        batch_size, slots = len(batch_inds), self.rows.slots(batch_inds)
        last_slots, rewards, discounts = self._n_step_returns(batch_inds, env)
        # Both observations in one pass.
        frames = np.concatenate([self.table["frame"][slots], self.table["next_frame"][last_slots]])
        observations, next_observations = self._observations(frames, env, batch_size)
        weights = np.ones(batch_size, dtype=np.float32) if weights is None else weights
        return FrameReplayBufferSamples(
            observations=observations,
            actions=self.to_torch(self.table["action"][slots], copy=False),
            next_observations=next_observations,
            dones=self._column(self.table["done"][last_slots]),
            rewards=self._column(rewards),
            discounts=None if discounts is None else self._column(discounts),
            is_expert=self._column(batch_inds < self.rows.pinned),
            weights=self._column(weights),
            indices=slots,
            expert_actions=self.to_torch(self.table["expert_action"][slots], copy=False),
            returns=self._column(self._normalize_reward(self.table["return"][slots], env)),
        )

    def _observations(
        self, frames: Ids, env: VecNormalize | None, batch_size: int
    ) -> tuple[TensorDict | th.Tensor, TensorDict | th.Tensor]:
        """The first ``batch_size`` frames and the others, as the policy takes them."""
        arrays = self.frames.read(frames)
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
        self, rows: Ids, env: VecNormalize | None
    ) -> tuple[Ids, npt.NDArray[np.float32], npt.NDArray[np.float32] | None]:
        """
        Sums of discounted rewards over up to ``n_steps`` transitions of the same episode, none but the first
        of an exploratory action (as Watkins's Q(lambda) cuts its traces).

        :param rows: ids of the first transitions, shape (batch,)
        :param env: normalization to apply to the rewards
        :return: slots of the last transitions, sums, discounts of the value after them; each (batch,)
        """
        slots = self.rows.slots(rows)
        rewards = self._normalize_reward(self.table["reward"][slots], env)
        if self.gamma is None:
            return slots, rewards, None
        discounts = np.full(len(rows), self.gamma, dtype=np.float32)
        for _ in range(self.n_steps - 1):
            next_rows = self.table["next_row"][slots]
            next_slots = self.rows.slots(next_rows)
            goes_on = (next_rows != NO_ROW) & ~self.table["explored"][next_slots]
            slots = np.where(goes_on, next_slots, slots)
            reward = self._normalize_reward(self.table["reward"][slots], env)
            rewards = rewards + np.where(goes_on, discounts * reward, np.float32(0))
            discounts = np.where(goes_on, discounts * np.float32(self.gamma), discounts)
        return slots, rewards, discounts

    def __getstate__(self) -> dict[str, Any]:
        # Only rows that were ever filled go into a pickle.
        state = self.__dict__.copy()
        state["table"] = {name: column[: self.rows.used_slots] for name, column in self.table.items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        used = state.pop("table")
        self.__dict__.update(state, table={})
        for name, (shape, dtype) in self._columns().items() if used else ():
            self.table[name] = np.zeros((self.rows.capacity, *shape), dtype=dtype)
            if name in used:  # not in the pickle of an earlier version
                self.table[name][: len(used[name])] = used[name]
