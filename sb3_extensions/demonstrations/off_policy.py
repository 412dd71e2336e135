"""Base class of off-policy algorithms that learn from demonstrations."""

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.components import check_fraction, check_integer
from sb3_extensions.common.env_metadata import action_sequence, has_absolute_yaw, with_action_metadata
from sb3_extensions.common.observations import as_parts
from sb3_extensions.demonstrations.collection import ActionTransform, make_progress_bar
from sb3_extensions.demonstrations.episodes import EpisodeData
from sb3_extensions.demonstrations.expert_envs import collect_from_copies
from sb3_extensions.demonstrations.validation import ExpertData, load_episodes, validate_episodes
from sb3_extensions.encoders.observation import StackedImage
from sb3_extensions.replay.augmentation import Augmentation
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.rotation import make_augmentation

AUGMENTATION_KEY, EXPERT_KEY, EXPLORATION_KEY = 0xA6, 0xE9, 0xE8
"""Keys of the independent random streams of an algorithm."""
PRETRAINING_LOG_INTERVAL = 100
"""Gradient steps of the pretraining between two entries of the log."""

Logs = defaultdict[str, list[th.Tensor]]
"""Values of the gradient steps of one call of ``train()``, by name."""
SelfOffPolicy = TypeVar("SelfOffPolicy", bound="OffPolicyFromDemonstrations")


class OffPolicyFromDemonstrations(OffPolicyAlgorithm):
    """
    Base class of algorithms whose replay buffer starts with expert episodes, with pretraining on them.

    The first ``learn()`` collects the demonstrations and pretrains. ``on_rollout_start()`` of callbacks is
    called before every gradient step of the pretraining. A checkpoint of the pretraining continues in it.
    The statistics of ``VecNormalize`` include the observations of the demonstrations.

    A subclass is an algorithm or precedes an algorithm of Stable-Baselines3 in the bases. Its constructor
    sets the annotated attributes and calls :meth:`_check_demonstrations` before ``_setup_model()``.
    """

    replay_buffer: ExpertReplayBuffer | None
    expert_episodes: int
    expert_data: ExpertData | None
    pretrain_steps: int
    augmentation: Augmentation | None
    _progress_bar: bool | None = None
    """Argument of the latest ``learn()``."""
    n_pretrained: int = 0
    """Number of gradient steps of the pretraining so far."""
    _had_expert_data: bool = False
    """Whether ``expert_data``, which is not saved, was set."""

    default_replay_buffer_class: ClassVar[type[ExpertReplayBuffer]] = ExpertReplayBuffer
    own_buffer_arguments: ClassVar[set[str]] = {"gamma", "n_steps"}
    """Arguments of the replay buffer that are arguments of the algorithm."""

    def _check_demonstrations(self) -> None:
        load_episodes(self.expert_data)
        check_integer(0, expert_episodes=self.expert_episodes, pretrain_steps=self.pretrain_steps)
        check_integer(0, learning_starts=self.learning_starts)
        check_integer(1, batch_size=self.batch_size, buffer_size=self.buffer_size)
        check_integer(-1, gradient_steps=self.gradient_steps)
        check_fraction(gamma=self.gamma, tau=self.tau)
        if self.pretrain_steps and self.expert_data is None and not self.expert_episodes:
            raise ValueError(
                "pretrain_steps must be 0 without demonstrations (expert_episodes=0), "
                f"got {self.pretrain_steps}"
            )
        buffer_class = self.replay_buffer_class
        if not (isinstance(buffer_class, type) and issubclass(buffer_class, ExpertReplayBuffer)):
            raise ValueError(f"replay_buffer_class must be an ExpertReplayBuffer, got {buffer_class!r}")
        for name in self.replay_buffer_kwargs.keys() & self.own_buffer_arguments:
            raise ValueError(f"{name} must be an argument of the algorithm, not of replay_buffer_kwargs")

    def _action_transform(self) -> ActionTransform | None:
        """Return the transformation of the expert's actions before they are executed, or None."""
        return None

    def _setup_model(self) -> None:
        kwargs = with_action_metadata(self.policy_class, self.policy_kwargs, self.env, self.action_space)
        self.policy_kwargs = kwargs
        self.augmentation = make_augmentation(self.augmentation, action_sequence(self.env, self.action_space))
        if self.augmentation is not None:
            self.augmentation.check(self.observation_space, has_absolute_yaw(self.env))
            self.policy_kwargs = self.augmentation.with_crop(self.policy_kwargs)
        passed_kwargs = self.replay_buffer_kwargs
        self.replay_buffer_kwargs = {**self._buffer_defaults(), **passed_kwargs}
        self.augmentation_generator = th.Generator().manual_seed(th.initial_seed())
        self.exploration_generator = th.Generator().manual_seed(th.initial_seed())
        # The base class does not pass n_steps and gamma to a custom buffer class and warns, see GH #2274.
        n_steps, self.n_steps = self.n_steps, 1
        super()._setup_model()
        self.n_steps = n_steps
        # Not saved, because the defaults of a loaded model follow its arguments.
        self.replay_buffer_kwargs = passed_kwargs
        self._check_setup()
        self._had_expert_data |= self.expert_data is not None
        # The base class sets the seed before it creates the buffer.
        self._seed_samplers(self.seed)

    def _buffer_defaults(self) -> dict[str, Any]:
        """Return arguments of the replay buffer that the user can replace."""
        # The paper's targets do not bootstrap from truncated episodes (the authors' code).
        defaults: dict[str, Any] = {"handle_timeout_termination": False}
        extractor_kwargs = self.policy_kwargs.get("features_extractor_kwargs") or {}
        for kwargs in (extractor_kwargs, self.policy_kwargs):
            if "quantise" in kwargs:
                defaults["image_dtype"] = kwargs["quantise"]
        return defaults

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(f"policy must be one of {', '.join(self.policy_aliases)}, got {policy_name!r}")
        return self.policy_aliases[policy_name]

    def _check_setup(self) -> None:
        """
        Set the buffer's discount, which can have changed, and check the arguments before any work.

        :raises ValueError: if ``train_freq`` does not fit the number of environments, a loaded buffer has
            another class, other spaces or another number of environments, buffer and policy round images
            differently, or the environment normalises images that the policy rounds
        """
        assert isinstance(self.train_freq, TrainFreq)
        frequency, unit = self.train_freq
        if frequency < 1 or (self.n_envs > 1 and unit == TrainFrequencyUnit.EPISODE):
            raise ValueError(
                "train_freq must be positive, and a number of steps with several environments, got "
                f"({frequency}, {unit.value!r}) with n_envs={self.n_envs}"
            )
        if not isinstance(self.replay_buffer, ExpertReplayBuffer):
            raise ValueError(f"replay_buffer must be an ExpertReplayBuffer, got {self.replay_buffer!r}")
        for name in ("observation_space", "action_space", "n_envs"):
            if (stored := getattr(self.replay_buffer, name)) != (own := getattr(self, name)):
                raise ValueError(f"{name} of the buffer must be {own}, got {stored}")
        self.replay_buffer.set_discount(self.gamma, self.n_steps)
        env, image_dtype = self.get_vec_normalize_env(), self.replay_buffer.image_dtype
        for stack in (module for module in self.policy.modules() if isinstance(module, StackedImage)):
            if stack.has_float_images and stack.quantise != image_dtype:
                raise ValueError(
                    f"quantise of the policy must be the buffer's image_dtype={image_dtype!r}, got "
                    f"quantise={stack.quantise!r}"
                )
            if env is None or not env.norm_obs or not stack.quantise:
                continue
            normalised = stack.scales if env.norm_obs_keys is None else env.norm_obs_keys
            if images := stack.scales.keys() & set(normalised):
                raise ValueError(
                    f"VecNormalize must not normalise the images {sorted(images)}, which the policy rounds. "
                    "Use norm_obs_keys without them, or norm_obs=False"
                )

    def set_random_seed(self, seed: int | None = None) -> None:
        """Set the seed of all pseudo-random generators, of replay buffer and augmentation too."""
        super().set_random_seed(seed)
        self._seed_samplers(seed)

    def _seed_samplers(self, seed: int | None) -> None:
        if seed is not None:
            self.augmentation_generator.manual_seed(_derive_seed(seed, AUGMENTATION_KEY))
            self.exploration_generator.manual_seed(_derive_seed(seed, EXPLORATION_KEY))
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

        See Stable-Baselines3's ``learn()`` for the other parameters.

        :param total_timesteps: The total number of samples (env steps) to train on, without demonstrations
        :param tb_log_name: the name of the run for TensorBoard logging; that of the class if ``None``
        :param progress_bar: Display a progress bar using tqdm and rich, and one each for demonstrations and
            pretraining. None displays the last two on a terminal, and no other.
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
        self._check_setup()
        assert self.replay_buffer is not None
        if self._had_expert_data and self.expert_data is None and not self.replay_buffer.size():
            raise ValueError(
                "expert_data must be set after load(), got None: a model does not store its "
                "demonstrations. Set model.expert_data, or load the replay buffer"
            )
        # The noise of a loaded model has its former number of environments.
        if isinstance(self.action_noise, VectorizedActionNoise):
            self.action_noise = self.action_noise.base_noise
        return super()._setup_learn(*args, **kwargs)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any
    ) -> RolloutReturn:
        """
        Collect experiences and store them. The first call begins with demonstrations and pretraining.

        See Stable-Baselines3's ``OffPolicyAlgorithm.collect_rollouts()`` for the parameters.
        """
        assert self.replay_buffer is not None
        if not self.replay_buffer.size():
            self._collect_demonstrations(self.replay_buffer, env)
        if self.pretraining_left:
            self._pretrain(callback)
        rollout = super().collect_rollouts(env, callback, *args, **kwargs)
        if not rollout.continue_training:
            # The step at which a callback stops is not stored, so the next learn() must reset.
            self._last_obs = None
        return rollout

    def _collect_demonstrations(self, replay_buffer: ExpertReplayBuffer, env: VecEnv) -> None:
        seed = None if self.seed is None else _derive_seed(self.seed, EXPERT_KEY)
        self.n_pretrained = 0  # A model that was loaded with another environment is pretrained again.
        data, episodes = load_episodes(self.expert_data), self.expert_episodes
        demonstrations: Iterable[EpisodeData] = (
            collect_from_copies(env, episodes, seed, self._progress_bar, self._action_transform())
            if data is None
            else validate_episodes(data, env)
        )
        try:
            self._add_demonstrations(replay_buffer, demonstrations)
        except BaseException:  # The next learn() must collect all of them again.
            replay_buffer.reset()
            raise

    def _add_demonstrations(self, buffer: ExpertReplayBuffer, demonstrations: Iterable[EpisodeData]) -> None:
        for episode in demonstrations:
            intended = getattr(episode, "expert_actions", None)
            buffer.add_episode(
                episode.observations,
                self.as_policy_actions(episode.actions),
                episode.rewards,
                episode.terminations,
                expert_actions=None if intended is None else self.as_policy_actions(intended),
            )
            self._update_statistics(episode.observations)
        if self.expert_data is not None and not buffer.expert_size:
            raise ValueError(
                "expert_data must have at least one episode, got none. Pass a list: an iterator is empty "
                "after its first use"
            )

    def _update_statistics(self, observations: Any) -> None:
        # Without them, the pretraining would use the statistics of the first observation alone.
        env = self.get_vec_normalize_env()
        if env is not None and env.norm_obs and env.training:
            statistics, parts = as_parts(env.obs_rms), as_parts(observations)
            for key, running in statistics.items():
                running.update(np.asarray(parts[key]))

    def _pretrain(self, callback: BaseCallback) -> None:
        # A loaded model has the progress, and so the learning rate, of the end of its former training.
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
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
        self.train(gradient_steps=1, batch_size=self.batch_size)

    def _log_updates(self, gradient_steps: int, logs: Logs) -> None:
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in logs.items():
            if len(numbers := th.cat([value.reshape(-1) for value in values])):
                self.logger.record(f"train/{name}", numbers.mean().item())

    @property
    def _pretraining_total(self) -> int:
        return self.pretrain_steps

    @property
    def pretraining_left(self) -> int:
        """Gradient steps before the first step in the environment, 0 after it or without demonstrations."""
        assert self.replay_buffer is not None
        has_only_demonstrations = 0 < self.replay_buffer.size() == self.replay_buffer.expert_size
        return max(self._pretraining_total - self.n_pretrained, 0) if has_only_demonstrations else 0

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
        own = ["expert_data", "augmentation_generator", "exploration_generator", "_progress_bar"]
        return [*super()._excluded_save_params(), *own]


def _derive_seed(seed: int, key: int) -> int:
    return int(np.random.SeedSequence([seed, key]).generate_state(1)[0])
