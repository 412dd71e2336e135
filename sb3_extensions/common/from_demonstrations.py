"""Learning from demonstrations, for SAC and what is built on it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from tqdm import tqdm

from sb3_extensions.common.augmentation import AugmentationSpec, make_augmentation
from sb3_extensions.common.expert import EpisodeData, collect_episodes, make_expert_env
from sb3_extensions.common.expert_replay import ExpertReplayBuffer
from sb3_extensions.common.replay import EXPERT_ACTION
from sb3_extensions.common.seeds import SeedKey, derive_seed
from sb3_extensions.common.soft_actor_critic import SoftActorCritic

SelfFromDemonstrations = TypeVar("SelfFromDemonstrations", bound="FromDemonstrations")


class FromDemonstrations(SoftActorCritic):
    """
    Makes an algorithm learn from demonstrations.

    The replay buffer begins with the episodes of an expert, and the actor is also drawn to the expert's
    actions: its loss has the additional term ``bc_weight * MSE(sampled action, expert action)``, the mean
    over the expert transitions of the batch and all action dimensions, in the policy's units [-1, 1]; with
    ``dagger`` also over the agent's own.

    The demonstrations are collected at the first ``learn()`` in an environment of their own, made from the
    spec of the training environment; these steps do not count as timesteps.

    :param policy: The policy model to use (one of the aliases, or a class)
    :param env: The environment to learn from (if registered in Gym, can be str); its observations are a Dict
    :param learning_rate: learning rate for adam optimizer,
        the same learning rate will be used for all networks (Q-Values, Actor and entropy coefficient)
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: number of transitions in the replay buffer, demonstrations included
    :param learning_starts: how many steps of the model to collect transitions for before learning starts;
        they are taken at random
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency
        and unit like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment during the rollout.
    :param action_noise: the action noise type (None by default), this can help
        for hard exploration problem. Cf common.noise for the different action noise type.
    :param replay_buffer_class: Replay buffer class, ``ExpertReplayBuffer`` (the default) or a subclass
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation;
        ``n_steps`` and ``gamma`` of this class are passed on besides
    :param n_steps: number of rewards that are summed up before the bootstrap
    :param ent_coef: Entropy regularization coefficient. (Equivalent to
        inverse of reward scale in the original SAC paper.)  Controlling exploration/exploitation trade-off.
        Set it to 'auto' to learn it automatically (and 'auto_0.1' for using 0.1 as initial value)
    :param target_update_interval: update the target network every ``target_network_update_freq``
        gradient steps.
    :param target_entropy: target entropy when learning ``ent_coef`` (``ent_coef = 'auto'``);
        'auto' is minus the number of action dimensions
    :param bc_weight: weight of the behaviour cloning term in the actor's loss
    :param expert_episodes: number of successful episodes of the expert to begin with, unless ``expert_data``
        is given
    :param expert_noise: standard deviation of a normal disturbance of the expert's actions, in the policy's
        units [-1, 1]: its episodes then show how to make good what an agent does inexactly, see
        :func:`~sb3_extensions.common.expert.collect_episodes`
    :param expert_data: episodes to begin with instead, with Minari's attributes
        (see :class:`~sb3_extensions.common.expert.EpisodeData`), in the environment's units; not saved
    :param dagger: ask the environment's expert before every step of the training as well: it does not act,
        but what it would have done is imitated in the agent's own states too. For tasks in which an agent
        goes astray where no demonstration has been; not part of the paper.
        DAgger: https://arxiv.org/abs/1011.0686
    :param augmentation: random views of the images: None, a :class:`~sb3_extensions.common.augmentation.RAD`
        or :class:`~sb3_extensions.common.augmentation.DrQ`, or in YAML ``"drq"``, ``{"rad": {"size": 128}}``
    :param pretrain_steps: number of gradient steps before the first step in the environment
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to
        average the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used),
        2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if ``bc_weight``, ``expert_episodes``, ``expert_noise`` or ``pretrain_steps`` is
        negative, if there is pretraining without demonstrations, if ``dagger`` has no weight or
        the environment no ``expert_action()`` for it, or if ``replay_buffer_class`` is no
        ``ExpertReplayBuffer``
    """

    action_space: spaces.Box
    _expert_actions: npt.NDArray[Any]  # what the expert would do in the last observations, with dagger

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 64,
        tau: float = 0.01,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        n_steps: int = 1,
        ent_coef: str | float = "auto_0.01",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        bc_weight: float = 1.0,
        expert_episodes: int = 100,
        expert_noise: float = 0.0,
        expert_data: Iterable[EpisodeData] | None = None,
        dagger: bool = False,
        augmentation: AugmentationSpec = None,
        pretrain_steps: int = 0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        replay_buffer_class = replay_buffer_class or ExpertReplayBuffer
        if not issubclass(replay_buffer_class, ExpertReplayBuffer):
            raise ValueError(f"replay_buffer_class must be an ExpertReplayBuffer, got {replay_buffer_class}")
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        _check_not_negative(
            bc_weight=bc_weight,
            expert_episodes=expert_episodes,
            expert_noise=expert_noise,
            pretrain_steps=pretrain_steps,
        )
        if pretrain_steps and expert_data is None and not expert_episodes:
            raise ValueError(
                f"pretrain_steps must be 0 without demonstrations (expert_episodes=0), got {pretrain_steps}"
            )
        if dagger and bc_weight == 0:
            raise ValueError("dagger=True needs a bc_weight greater than 0, got 0")
        # The base class ignores n_steps and gamma when a buffer class is given, see GH #2274
        self.replay_buffer_kwargs = {"n_steps": n_steps, "gamma": gamma, **self.replay_buffer_kwargs}
        self.bc_weight = bc_weight
        self.expert_episodes = expert_episodes
        self.expert_noise = expert_noise
        self.expert_data = expert_data
        self.dagger = dagger
        self._check_expert()
        self.augmentation = make_augmentation(augmentation)
        self.augmentation_generator = th.Generator().manual_seed(th.initial_seed())
        self.pretrain_steps = pretrain_steps

        if _init_setup_model:
            self._setup_model()

    def _check_expert(self) -> None:
        if self.dagger and self.env is not None and not self.env.has_attr("expert_action"):
            raise ValueError("dagger=True needs an environment with expert_action(), this one has none")

    def _setup_model(self) -> None:
        if self.augmentation is not None:
            self.augmentation.check(self.observation_space)
            self.policy_kwargs = self.augmentation.with_crop(self.policy_kwargs)
        super()._setup_model()
        # Nothing learns through the target. Its forward pass turns gradients on again inside no_grad, see
        # ContinuousCritic.forward, and its encoder would keep everything for a backward pass
        self.critic_target.requires_grad_(False)
        self.target_entropy = float(self.target_entropy)  # TQC's is of NumPy
        # The base class seeds before it makes the buffer
        self._seed_samplers(self.seed)

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Set the seed of the pseudo-random generators
        (python, numpy, pytorch, gym, action_space, replay buffer, augmentation)

        :param seed:
        """
        super().set_random_seed(seed)
        self._seed_samplers(seed)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        if self.replay_buffer is not None:
            self.replay_buffer.progress_remaining = self._current_progress_remaining

    def _seed_samplers(self, seed: int | None) -> None:
        if seed is not None:
            self.augmentation_generator.manual_seed(derive_seed(seed, SeedKey.AUGMENTATION))
            if self.replay_buffer is not None:
                self.replay_buffer.seed(seed)

    def learn(
        self: SelfFromDemonstrations,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfFromDemonstrations:
        """
        Return a trained model; the first call adds the demonstrations and pretrains.

        :param total_timesteps: The total number of samples (env steps) to train on, without demonstrations
        :param callback: callback(s) called at every step with state of the algorithm.
        :param log_interval: the number of episodes before logging
        :param tb_log_name: the name of the run for TensorBoard logging; that of the class if ``None``
        :param reset_num_timesteps: whether or not to reset the current timestep number (used in logging)
        :param progress_bar: Display a progress bar using tqdm and rich.
        :return: the trained model
        """
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.replay_buffer is not None
        self._check_expert()  # of an environment that was set since
        if not self.replay_buffer.size():
            self._add_demonstrations()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self._n_updates == 0:
            for _ in tqdm(range(self.pretrain_steps), desc="pretraining", disable=not self.pretrain_steps):
                self.train(1, self.batch_size)
        return total_timesteps, callback

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        if self.dagger:
            # Before the step: the expert says what to do in the state that the environment is in
            assert self.env is not None
            self._expert_actions = self._as_policy_actions(np.stack(self.env.env_method("expert_action")))
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
        if self.dagger:
            infos = [
                {**info, EXPERT_ACTION: action}
                for info, action in zip(infos, self._expert_actions, strict=True)
            ]
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _as_policy_actions(self, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
        # The environments clip, so a clipped action is the one that is carried out
        return self.policy.scale_action(np.clip(actions, self.action_space.low, self.action_space.high))

    def _add_demonstrations(self) -> None:
        """Fill the expert rows of the replay buffer, from ``expert_data`` or by collecting episodes."""
        if self.expert_data is not None:
            self._add_episodes(self.expert_data)
        elif self.expert_episodes > 0:
            assert self.env is not None, "You must set the environment before calling learn()"
            seed = None if self.seed is None else derive_seed(self.seed, SeedKey.EXPERT)
            with contextlib.closing(make_expert_env(self.env)) as expert_env:
                self._add_episodes(
                    collect_episodes(expert_env, self.expert_episodes, seed, noise=self.expert_noise)
                )

    def _add_episodes(self, episodes: Iterable[EpisodeData]) -> None:
        assert self.replay_buffer is not None
        for episode in episodes:
            self.replay_buffer.add_episode(
                episode.observations,
                self._as_policy_actions(episode.actions),
                episode.rewards,
                episode.terminations,
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "expert_data", "augmentation_generator", "_expert_actions"]


def _check_not_negative(**given: float) -> None:
    for name, value in given.items():
        if value < 0:
            raise ValueError(f"{name} must not be negative, got {value}")
