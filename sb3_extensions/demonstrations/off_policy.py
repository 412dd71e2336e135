"""Base class of off-policy algorithms that learn from demonstrations."""

from __future__ import annotations

import io
import os
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.components import check_not_negative
from sb3_extensions.common.env_metadata import action_sequence, with_action_metadata
from sb3_extensions.common.rounding import check_rounding, with_image_dtype
from sb3_extensions.common.seeds import SeedKey, derive_seed
from sb3_extensions.demonstrations.collection import make_progress_bar
from sb3_extensions.demonstrations.source import DemonstrationSource, ExpertData, load_episodes
from sb3_extensions.replay.augmentation import Augmentation
from sb3_extensions.replay.augmentations import make_augmentation
from sb3_extensions.replay.buffer import ExpertReplayBuffer, check_compatible

PRETRAINING_LOG_INTERVAL = 100
"""Gradient steps of the pretraining between two entries of the log."""

SelfOffPolicy = TypeVar("SelfOffPolicy", bound="OffPolicyFromDemonstrations")


class OffPolicyFromDemonstrations(OffPolicyAlgorithm):
    """
    Base class of algorithms whose replay buffer starts with expert episodes, with pretraining on them.

    The first ``learn()`` collects the demonstrations and pretrains. ``on_rollout_start()`` of callbacks is
    called before every gradient step of the pretraining. A checkpoint of the pretraining continues in it.

    A subclass is an algorithm or precedes an algorithm of Stable-Baselines3 in the bases. Its constructor
    sets the attributes below and calls :meth:`_check_demonstrations` before ``_setup_model()``.

    - ``expert_episodes``, ``expert_noise``: see
      :class:`~sb3_extensions.demonstrations.source.DemonstrationSource`
    - ``expert_data``: see :func:`~sb3_extensions.demonstrations.source.load_episodes`
    - ``pretrain_steps``: number of gradient steps before the first step in the environment
    - ``augmentation``: augmentation of the sampled steps, or None
    """

    replay_buffer: ExpertReplayBuffer | None
    expert_episodes: int
    expert_noise: float
    expert_data: ExpertData | None
    pretrain_steps: int
    augmentation: Augmentation | None
    augmentation_generator: th.Generator
    _progress_bar: bool | None = None
    """Argument of the latest ``learn()``."""
    n_pretrained: int = 0
    """Number of gradient steps of the pretraining so far."""
    _had_expert_data: bool = False
    """Whether ``expert_data``, which is not saved, was set."""

    default_replay_buffer_class: ClassVar[type[ExpertReplayBuffer]] = ExpertReplayBuffer
    own_buffer_arguments: ClassVar[tuple[str, ...]] = ("gamma", "n_steps")
    """Arguments of the replay buffer that are arguments of the algorithm."""

    def _check_demonstrations(self) -> None:
        source = self._demonstrations()
        check_not_negative(pretrain_steps=self.pretrain_steps)
        if self.pretrain_steps and source.is_empty:
            raise ValueError(
                "pretrain_steps must be 0 without demonstrations (expert_episodes=0), "
                f"got {self.pretrain_steps}"
            )
        buffer_class = self.replay_buffer_class
        if buffer_class is None or not issubclass(buffer_class, ExpertReplayBuffer):
            raise ValueError(f"replay_buffer_class must be an ExpertReplayBuffer, got {buffer_class}")
        for name in self.own_buffer_arguments:
            if name in self.replay_buffer_kwargs:
                raise ValueError(f"{name} must be an argument of the algorithm, not of replay_buffer_kwargs")

    def _demonstrations(self, **kwargs: Any) -> DemonstrationSource:
        data = load_episodes(self.expert_data)
        return DemonstrationSource(self.expert_episodes, self.expert_noise, data, **kwargs)

    def _setup_model(self) -> None:
        kwargs = with_action_metadata(self.policy_class, self.policy_kwargs, self.env, self.action_space)
        self.policy_kwargs = kwargs
        self.augmentation = make_augmentation(self.augmentation, action_sequence(self.env, self.action_space))
        if self.augmentation is not None:
            self.augmentation.check(self.observation_space)
            self.policy_kwargs = self.augmentation.with_crop(self.policy_kwargs)
        # The paper's targets do not bootstrap from truncated episodes (the authors' code).
        buffer_kwargs = {"handle_timeout_termination": False, **self.replay_buffer_kwargs}
        self.replay_buffer_kwargs = with_image_dtype(buffer_kwargs, self.policy_kwargs)
        # The base class does not pass n_steps and gamma to a custom buffer class and warns, see GH #2274.
        n_steps, self.n_steps = self.n_steps, 1
        super()._setup_model()
        self.n_steps = n_steps
        self._check_train_freq()
        self._set_discount()
        assert self.replay_buffer is not None
        check_rounding(self.replay_buffer, self.policy)
        self._had_expert_data |= self.expert_data is not None
        # The base class sets the seed before it creates the buffer.
        self._seed_samplers(self.seed)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(f"policy must be one of {', '.join(self.policy_aliases)}, got {policy_name!r}")
        return self.policy_aliases[policy_name]

    def _check_train_freq(self) -> None:
        """Raise an error before the demonstrations, not at the first step in the environment."""
        assert isinstance(self.train_freq, TrainFreq)
        if self.train_freq.unit == TrainFrequencyUnit.EPISODE and self.n_envs > 1:
            raise ValueError(
                f"train_freq must be a number of steps with {self.n_envs} environments, got "
                f"({self.train_freq.frequency}, 'episode')"
            )

    def _set_discount(self) -> None:
        """Set the buffer's discount to that of the algorithm, which a user or load() can have changed."""
        assert self.replay_buffer is not None
        self.replay_buffer.set_discount(self.gamma, self.n_steps)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seed of the pseudo-random generators
        (python, numpy, pytorch, gym, action_space, replay buffer, augmentation)

        :param seed: seed
        """
        super().set_random_seed(seed)
        self._seed_samplers(seed)

    def _seed_samplers(self, seed: int | None) -> None:
        if seed is not None:
            self.augmentation_generator.manual_seed(derive_seed(seed, SeedKey.AUGMENTATION))
            if self.replay_buffer is not None:
                self.replay_buffer.seed(seed)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        if self.replay_buffer is not None:
            self.replay_buffer.sampler.progress_remaining = self._current_progress_remaining

    def learn(
        self: SelfOffPolicy,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool | None = None,
    ) -> SelfOffPolicy:
        """
        Return a trained model. The first call starts with demonstrations and pretraining.

        :param total_timesteps: The total number of samples (env steps) to train on, without demonstrations
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: the number of episodes before logging
        :param tb_log_name: the name of the run for TensorBoard logging; that of the class if ``None``
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich, and one each for demonstrations and
            pretraining. None displays the last two on a terminal, and no other.
        :return: the trained model
        :raises ValueError: if a loaded model's ``expert_data`` is missing, or images are normalised
        """
        self._progress_bar = progress_bar
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=bool(progress_bar),
        )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self._set_discount()
        assert self.replay_buffer is not None
        if self._had_expert_data and self.expert_data is None and not self.replay_buffer.size():
            raise ValueError(
                "expert_data must be set after load(), got None: a model does not store its "
                "demonstrations. Set model.expert_data, or load the replay buffer"
            )
        check_rounding(self.replay_buffer, self.policy, self.get_vec_normalize_env())
        return super()._setup_learn(*args, **kwargs)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any
    ) -> RolloutReturn:
        """
        Collect experiences and store them. The first call begins with demonstrations and pretraining.

        :param env: The training environment
        :param callback: Callback that will be called at each step
            (and at the beginning and end of the rollout)
        :param args: arguments of ``OffPolicyAlgorithm.collect_rollouts()``
        :param kwargs: keyword arguments of ``OffPolicyAlgorithm.collect_rollouts()``
        :return: collected experience
        """
        assert self.replay_buffer is not None
        if not self.replay_buffer.size():
            self._collect_demonstrations(self.replay_buffer, env)
        if self.pretraining_left:
            self._pretrain(callback)
        return super().collect_rollouts(env, callback, *args, **kwargs)

    def _collect_demonstrations(self, replay_buffer: ExpertReplayBuffer, env: VecEnv) -> None:
        seed = None if self.seed is None else derive_seed(self.seed, SeedKey.EXPERT)
        source = self._demonstrations(progress_bar=self._progress_bar)
        self.n_pretrained = 0  # A model that was loaded with another environment is pretrained again.
        try:
            source.fill(replay_buffer, env, seed, self.as_policy_actions)
        except BaseException:  # The next learn() must collect all of them again.
            replay_buffer.reset()
            raise

    def _pretrain(self, callback: BaseCallback) -> None:
        total, done = self._pretraining_total, self.n_pretrained
        with make_progress_bar(total, "pretraining", self._progress_bar, done) as progress:
            while self.pretraining_left:
                callback.on_rollout_start()
                self._pretrain_once()
                self.n_pretrained += 1
                progress.update()
                if self.n_pretrained % PRETRAINING_LOG_INTERVAL == 0:
                    self.logger.dump(step=-self.pretraining_left)

    def _pretrain_once(self) -> None:
        """Do one gradient step of the pretraining."""
        self.train(gradient_steps=1, batch_size=self.batch_size)

    @property
    def _pretraining_total(self) -> int:
        return self.pretrain_steps

    @property
    def pretraining_left(self) -> int:
        """Gradient steps before the first step in the environment, 0 after it or without demonstrations."""
        assert self.replay_buffer is not None
        has_only_demonstrations = 0 < self.replay_buffer.size() == self.replay_buffer.expert_size
        return self._pretraining_total - self.n_pretrained if has_only_demonstrations else 0

    def load_replay_buffer(
        self, path: str | os.PathLike[str] | io.BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """
        Load a replay buffer from a pickle file.

        :param path: Path to the pickled replay buffer
        :param truncate_last_traj: without effect, see Stable-Baselines3's ``HerReplayBuffer``
        :raises ValueError: if it does not fit the algorithm. The algorithm then keeps its present buffer
        """
        own = self.replay_buffer
        assert own is not None
        super().load_replay_buffer(path, truncate_last_traj)  # type: ignore[arg-type]
        try:
            check_rounding(check_compatible(self.replay_buffer, own), self.policy)
        except ValueError:
            self.replay_buffer = own
            raise

    def as_policy_actions(self, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """
        Convert actions to the policy's units.

        :param actions: in the environment's units, shape (n, action dimensions)
        :return: in [-1, 1]
        """
        # The environments clip, so the clipped action is the executed one.
        space = self.action_space
        return self.policy.scale_action(np.clip(actions, space.low, space.high))  # type: ignore[attr-defined]

    def _excluded_save_params(self) -> list[str]:
        own = ["expert_data", "augmentation_generator", "_progress_bar"]
        return [*super()._excluded_save_params(), *own]
