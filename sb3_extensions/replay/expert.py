"""Replay that begins with the transitions of an expert."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_extensions.replay.buffer import NO_ROW, FrameReplayBuffer, Observations
from sb3_extensions.replay.frames import Ids


class ExpertReplayBuffer(FrameReplayBuffer):
    """
    :class:`FrameReplayBuffer` whose first rows are those of an expert: flagged, and never overwritten.

    :param args: arguments of :class:`FrameReplayBuffer`; ``buffer_size`` counts the expert rows
    :param expert_fraction: share of expert transitions in every sample, rounded to whole transitions, as soon
        as there are ``balanced_from`` on either side. None draws uniformly from all rows
    :param balanced_from: number of transitions that the expert and the agent must have each before samples
        are divided by ``expert_fraction``; until then all rows are drawn alike. With 1 the agent's first
        transition fills its share alone; with half a batch it does not come up again and again
    :param success_fraction: share of the agent's transitions with a ``return`` greater than 0, from which it
        succeeded without another exploratory action; the rest is drawn from all of the agent's. While there
        are few, so many only that one comes up as often as one of the expert's: the first successes are lucky
        ones. None: no share
    :param kwargs: keyword arguments of :class:`FrameReplayBuffer`
    :raises ValueError: if an argument is out of its range
    """

    def __init__(
        self,
        *args: Any,
        expert_fraction: float | None = None,
        success_fraction: float | None = None,
        balanced_from: int = 1,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        for name, value in (("expert_fraction", expert_fraction), ("success_fraction", success_fraction)):
            if value is not None and not 0 <= value <= 1:
                raise ValueError(f"{name} must be None or between 0 and 1, got {value}")
        if success_fraction is not None and (expert_fraction or 0.0) + success_fraction > 1:
            raise ValueError(
                f"expert_fraction={expert_fraction} and success_fraction={success_fraction} are more than 1"
            )
        if success_fraction is not None and expert_fraction is None:
            raise ValueError(f"success_fraction={success_fraction} needs an expert_fraction")
        if balanced_from < 1:
            raise ValueError(f"balanced_from must be at least 1, got {balanced_from}")
        if balanced_from > 1 and expert_fraction is None:
            raise ValueError(f"balanced_from={balanced_from} needs an expert_fraction")
        self.expert_fraction = expert_fraction
        self.success_fraction = success_fraction
        self.balanced_from = balanced_from
        self.progress_remaining = 1.0  # of the training, falling to 0: kept up to date by the algorithm

    @property
    def expert_size(self) -> int:
        """Number of expert transitions."""
        return self.rows.pinned

    def add_episode(
        self,
        observations: Observations,
        actions: npt.NDArray[Any],
        rewards: npt.NDArray[Any],
        terminations: npt.NDArray[Any],
        expert_actions: npt.NDArray[Any] | None = None,
    ) -> None:
        """
        Add an episode of the expert; only before the first online transition.

        :param observations: for each key an array of n + 1 observations
        :param actions: n actions in the units of the policy, [-1, 1], shape (n, action dimensions)
        :param rewards: n rewards
        :param terminations: n booleans, True where the episode terminated (not where it only ran out of time)
        :param expert_actions: the n actions that the expert wanted, where others were carried out
        :raises ValueError: if the lengths do not fit, the expert rows would fill the buffer, or there are
            online transitions already
        """
        if self.rows.end > self.expert_size:
            raise ValueError("expert episodes must be added before the first online transition")
        if missing := self.frames.keys - observations.keys():
            raise ValueError(f"the episode's observations lack {sorted(missing)}")
        n_steps = len(actions)
        lengths = {f"observations[{key!r}]": len(observations[key]) - 1 for key in self.frames.keys}
        lengths |= {"rewards": len(rewards), "terminations": len(terminations)}
        if expert_actions is not None:
            lengths["expert_actions"] = len(expert_actions)
        wrong = {name: length for name, length in lengths.items() if length != n_steps}
        if wrong or n_steps == 0:
            raise ValueError(f"an episode of {n_steps} actions has another number of steps in {wrong}")
        self._check_room(n_steps)
        if not self.table:
            self._allocate()
        actions = np.asarray(actions).reshape(n_steps, self.action_dim)
        wanted = actions if expert_actions is None else expert_actions
        frames = self.frames.pin(observations)
        rows = self.rows.pin(n_steps)
        self._write_rows(
            rows,
            frame=frames[:-1],
            next_frame=frames[1:],
            oldest_frame=0,
            next_row=np.append(rows[1:], NO_ROW),
            action=actions,
            expert_action=np.asarray(wanted).reshape(n_steps, self.action_dim),
            explored=False,
            reward=rewards,
            done=terminations,
            **{"return": np.nan},
        )
        self._write_returns(rows)

    def _check_room(self, n_steps: int) -> None:
        """Frames and rows of an episode are pinned both or not at all."""
        rings = {
            "a larger buffer_size": (self.rows, n_steps),
            "more frames_per_transition, or a larger buffer_size": (self.frames.ring, n_steps + 1),
        }
        for cure, (ring, count) in rings.items():
            if not ring.has_room(count):
                raise ValueError(
                    "the demonstrations do not fit into the replay buffer: it has room for "
                    f"buffer_size={self.buffer_size} transitions, own ones among them, there are "
                    f"{self.expert_size + n_steps} of the expert, and more may come: give it {cure}"
                )

    def update_priorities(self, slots: Ids, td_errors: th.Tensor) -> None:
        """
        Take the errors that an update has found; here no draw depends on them.

        :param slots: ``indices`` of a sample, shape (batch,)
        :param td_errors: temporal-difference errors of its transitions, shape (batch, 1)
        """

    def _draw(self, batch_size: int) -> tuple[Ids, npt.NDArray[np.float32]]:
        online_size = self.size() - self.expert_size
        if self.expert_fraction is None or min(online_size, self.expert_size) < self.balanced_from:
            return super()._draw(batch_size)
        n_expert = round(batch_size * self.expert_fraction)
        won = self._draw_successes(round(batch_size * (self.success_fraction or 0.0)), n_expert)
        n_online = batch_size - n_expert - len(won)
        ranks = np.concatenate(
            [
                self.rng.integers(self.expert_size, size=n_expert),
                self.expert_size + self.rng.integers(online_size, size=n_online),
            ]
        )
        return np.append(self.rows.ids(ranks), won), np.ones(batch_size, dtype=np.float32)

    def _draw_successes(self, most: int, n_expert: int) -> Ids:
        """Ids of the agent's transitions with a return, beside so many of the expert's."""
        if not most:
            return np.empty(0, dtype=np.int64)
        returns = self.table["return"][self.expert_size : self.rows.used_slots]
        won = self.rows.ids_in(self.expert_size + np.flatnonzero(returns > 0))
        won = won[won >= self.rows.first]
        alike = n_expert * len(won) / self.expert_size
        # Rounded up or down by chance: on the mean neither more nor less
        count = min(most, int(alike + self.rng.random()))
        return self.rng.choice(won, size=count) if count else won[:0]


def check_alike(given: ReplayBuffer | None, own: ExpertReplayBuffer) -> ExpertReplayBuffer:
    """
    Check that a buffer can take the place of another.

    :param given: the buffer
    :param own: what it is to replace
    :return: the buffer
    :raises ValueError: if it stores other things
    """
    if not isinstance(given, ExpertReplayBuffer):
        raise ValueError(f"the replay buffer must be an ExpertReplayBuffer, got {type(given).__name__}")
    for name in ("observation_space", "action_space", "n_envs"):
        if getattr(given, name) != getattr(own, name):
            raise ValueError(
                f"the replay buffer's {name} must be {getattr(own, name)}, got {getattr(given, name)}"
            )
    return given
