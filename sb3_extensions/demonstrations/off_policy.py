"""What off-policy algorithms that learn from demonstrations have in common, whatever they learn."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_extensions.common.augmentation import Augmentation, make_augmentation
from sb3_extensions.common.following import check_rotation, follow_ranges, follow_sequence
from sb3_extensions.common.rounding import check_normalisation, check_rounding, follow_extractor
from sb3_extensions.common.seeds import SeedKey, derive_seed
from sb3_extensions.demonstrations.collecting import EpisodeData
from sb3_extensions.demonstrations.dagger import Adviser
from sb3_extensions.demonstrations.source import DemonstrationSource
from sb3_extensions.replay.expert import ExpertReplayBuffer, check_alike

# Gradient steps of the pretraining between two lines of the log.
PRETRAINING_LOG_INTERVAL = 100

SelfOffPolicy = TypeVar("SelfOffPolicy", bound="OffPolicyFromDemonstrations")


class OffPolicyFromDemonstrations(OffPolicyAlgorithm):
    """
    Begins with the episodes of an expert in the replay buffer, and with gradient steps on them.

    Both belong to the training: callbacks are at work (before every gradient step of the pretraining
    ``on_rollout_start()`` is called), the log counts up to 0, a checkpoint taken in between goes on there.

    A subclass stands before an algorithm of Stable-Baselines3, or is one itself. Its constructor sets the
    attributes below, and calls :meth:`_check_demonstrations` before ``_setup_model()``.

    - ``expert_episodes``, ``expert_noise``, ``expert_data``: see
      :class:`~sb3_extensions.demonstrations.source.DemonstrationSource`
    - ``dagger``: whether to ask the environment's expert before every step, see
      :class:`~sb3_extensions.demonstrations.dagger.Adviser`
    - ``pretrain_steps``: number of gradient steps before the first step in the environment
    - ``augmentation``: random views of the images, or None
    """

    replay_buffer: ExpertReplayBuffer | None
    expert_episodes: int
    expert_noise: float
    expert_data: Iterable[EpisodeData] | None
    dagger: bool
    pretrain_steps: int
    augmentation: Augmentation | None
    augmentation_generator: th.Generator
    _progress_bar: bool | None = None  # that of the latest learn()
    n_pretrained: int = 0
    """Gradient steps of the pretraining that are done."""
    _had_expert_data: bool = False  # also where it was not saved

    default_replay_buffer_class: ClassVar[type[ExpertReplayBuffer]] = ExpertReplayBuffer
    own_buffer_arguments: ClassVar[tuple[str, ...]] = ("gamma", "n_steps")
    """What the algorithm itself gives to its replay buffer."""

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
                raise ValueError(f"{name} is an argument of the algorithm, not one of replay_buffer_kwargs")

    def _demonstrations(self, **kwargs: Any) -> DemonstrationSource:
        return DemonstrationSource(self.expert_episodes, self.expert_noise, self.expert_data, **kwargs)

    def _setup_model(self) -> None:
        if self.dagger:
            Adviser.check(self.env)
        self.augmentation = make_augmentation(self.augmentation)  # load() sets it as it is given
        if self.augmentation is not None:
            self.augmentation.check(self.observation_space)
            self.policy_kwargs = self.augmentation.with_crop(self.policy_kwargs)
        self.replay_buffer_kwargs = follow_extractor(self.replay_buffer_kwargs, self.policy_kwargs)
        self._follow_env()
        # The base class does not pass n_steps and gamma on to a given class, and warns, see GH #2274
        n_steps, self.n_steps = self.n_steps, 1
        super()._setup_model()
        self.n_steps = n_steps
        self._check_train_freq()
        self._follow_discount()
        assert self.replay_buffer is not None
        check_rounding(self.replay_buffer, self.policy)
        self._adviser = Adviser(self._as_policy_actions)
        self._had_expert_data |= self.expert_data is not None
        # The base class seeds before it makes the buffer
        self._seed_samplers(self.seed)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(f"policy must be one of {', '.join(self.policy_aliases)}, got {policy_name!r}")
        return self.policy_aliases[policy_name]

    def _check_train_freq(self) -> None:
        """Stable-Baselines3 refuses this with the first step in the environment, after the pretraining."""
        assert isinstance(self.train_freq, TrainFreq)
        if self.train_freq.unit == TrainFrequencyUnit.EPISODE and self.n_envs > 1:
            raise ValueError(
                f"train_freq must be a number of steps with {self.n_envs} environments, got "
                f"({self.train_freq.frequency}, 'episode')"
            )

    def _follow_env(self) -> None:
        """Policy and replay buffer take from the environment what its numbers are, unless they are told."""
        assert self.replay_buffer_class is not None
        env, space = self.env, self.action_space
        check_rotation(self.policy_class, env)
        policy_kwargs = follow_sequence(self.policy_class, self.policy_kwargs, env, space)
        self.policy_kwargs = follow_ranges(self.policy_class, policy_kwargs, env)
        buffer_class, buffer_kwargs = self.replay_buffer_class, self.replay_buffer_kwargs
        self.replay_buffer_kwargs = follow_sequence(buffer_class, buffer_kwargs, env, space)

    def _follow_discount(self) -> None:
        """The replay buffer sums up what the algorithm says, also where that was changed or loaded."""
        assert self.replay_buffer is not None
        self.replay_buffer.set_discount(self.gamma, self.n_steps)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seed of the pseudo-random generators
        (python, numpy, pytorch, gym, action_space, replay buffer, augmentation)

        :param seed:
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
            self.replay_buffer.progress_remaining = self._current_progress_remaining

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
        Return a trained model; the first call begins with demonstrations and pretraining.

        :param total_timesteps: The total number of samples (env steps) to train on, without demonstrations
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: the number of episodes before logging
        :param tb_log_name: the name of the run for TensorBoard logging; that of the class if ``None``
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich, and one each for demonstrations and
            pretraining; None displays these two only, and only on a terminal.
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
        # An environment or a discount may have been set since
        if self.dagger:
            Adviser.check(self.env)
        self._follow_discount()
        assert self.replay_buffer is not None
        if self._had_expert_data and self.expert_data is None and not self.replay_buffer.size():
            raise ValueError(
                "expert_data must be set anew, or the replay buffer loaded: the model was made with "
                "demonstrations, which are not saved with it"
            )
        check_normalisation(self.get_vec_normalize_env(), self.policy)
        return super()._setup_learn(*args, **kwargs)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """
        Collect experiences and store them; the first time, after demonstrations and pretraining.

        :param env: The training environment
        :param callback: Callback that will be called at each step
            (and at the beginning and end of the rollout)
        :param train_freq: How much experience to collect
        :param replay_buffer: Where to store it
        :param action_noise: Action noise that will be used for exploration
        :param learning_starts: Number of steps before learning for the warm-up phase.
        :param log_interval: Log data every ``log_interval`` episodes
        :return: what was collected
        """
        assert isinstance(replay_buffer, ExpertReplayBuffer)
        if not replay_buffer.size():
            self._collect_demonstrations(replay_buffer, env)
        if self.pretraining_left:
            self._pretrain(callback)
        return super().collect_rollouts(
            env, callback, train_freq, replay_buffer, action_noise, learning_starts, log_interval
        )

    def _collect_demonstrations(self, replay_buffer: ExpertReplayBuffer, env: VecEnv) -> None:
        seed = None if self.seed is None else derive_seed(self.seed, SeedKey.EXPERT)
        source = self._demonstrations(progress_bar=self._progress_bar)
        self.n_pretrained = 0  # a model loaded for another environment begins again
        try:
            source.fill(replay_buffer, env, seed, self._as_policy_actions)
        except BaseException:  # some of them would be taken for all by the next learn()
            replay_buffer.reset()
            raise

    def _pretrain(self, callback: BaseCallback) -> None:
        total = self._pretraining_total
        silent = None if self._progress_bar is None else not self._progress_bar  # None: but on a terminal
        with tqdm(total=total, initial=self.n_pretrained, desc="pretraining", disable=silent) as progress:
            while self.pretraining_left:
                callback.on_rollout_start()
                self._pretrain_once()
                self.n_pretrained += 1
                progress.update()
                if self.n_pretrained % PRETRAINING_LOG_INTERVAL == 0:
                    self.logger.dump(step=-self.pretraining_left)

    def _pretrain_once(self) -> None:
        """One gradient step before the first step in the environment."""
        self.train(gradient_steps=1, batch_size=self.batch_size)

    @property
    def _pretraining_total(self) -> int:
        return self.pretrain_steps

    @property
    def pretraining_left(self) -> int:
        """Gradient steps until the first step in the environment; 0 without demonstrations or after it."""
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
        :raises ValueError: if it is not one that the algorithm would have made; its own stays then
        """
        own = self.replay_buffer
        assert own is not None
        super().load_replay_buffer(path, truncate_last_traj)  # type: ignore[arg-type]
        try:
            check_rounding(check_alike(self.replay_buffer, own), self.policy)
        except ValueError:
            self.replay_buffer = own
            raise

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        if self.dagger:
            assert self.env is not None
            self._adviser.ask(self.env)
        return super()._sample_action(learning_starts, action_noise, n_envs)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: npt.NDArray[Any],
        new_obs: npt.NDArray[Any] | dict[str, npt.NDArray[Any]],
        reward: npt.NDArray[Any],
        dones: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        told = self._annotated(infos)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, told)

    def _annotated(self, infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """What the replay buffer is told of a step besides what the environments say."""
        return self._adviser.advise(infos) if self.dagger else infos

    def _as_policy_actions(self, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
        # The environments clip, so a clipped action is the one that is carried out
        space = self.action_space
        return self.policy.scale_action(np.clip(actions, space.low, space.high))  # type: ignore[attr-defined]

    def _excluded_save_params(self) -> list[str]:
        own = ["expert_data", "augmentation_generator", "_adviser", "_progress_bar"]
        return [*super()._excluded_save_params(), *own]


def check_share(**given: float) -> None:
    """
    Check arguments.

    :param given: values by their names
    :raises ValueError: if one is not in [0, 1]
    """
    for name, value in given.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be between 0 and 1, got {value}")


def check_not_negative(**given: float | None) -> None:
    """
    Check arguments.

    :param given: values by their names, None where there is none
    :raises ValueError: if one is negative
    """
    for name, value in given.items():
        if value is not None and value < 0:
            raise ValueError(f"{name} must not be negative, got {value}")
