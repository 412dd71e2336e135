"""Framework for efficient robotic manipulation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_extensions.common.augmentation import AugmentationSpec
from sb3_extensions.demonstrations.collecting import EpisodeData
from sb3_extensions.demonstrations.off_policy import check_not_negative
from sb3_extensions.ferm.policies import MultiInputPolicy
from sb3_extensions.sacfd import SACfD


class FERM(SACfD):
    """
    Framework for efficient robotic manipulation (FERM).

    SACfD on random views of the images, whose encoder also learns to tell which two views are of the same
    observation: before everything else from the demonstrations, then in every update from its sample. The
    queries come from the critic's features extractor, the keys from the target critic's, which follows it
    with ``encoder_tau``. With ``bc_weight=0`` it is FERM SAC.

    Paper: https://arxiv.org/abs/2012.07975; the defaults are those of BulletArm,
    https://arxiv.org/abs/2205.14292, appendix "Benchmark Details", and its authors' code.

    All parameters that are not listed are those of :class:`~sb3_extensions.sacfd.SACfD`.

    :param policy: The policy model to use (``"MultiInputPolicy"`` or a subclass of it)
    :param env: The environment to learn from (if registered in Gym, can be str); its observations are a Dict
    :param augmentation: random views of the images, as in :class:`~sb3_extensions.sacfd.SACfD`; not None
    :param contrastive_steps: number of updates of the encoder by the contrastive loss alone, on the
        demonstrations, before the first step in the environment; none where there are no demonstrations
    :param encoder_tau: the soft update coefficient of the target critic's features extractor; ``tau`` is that
        of its heads
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises ValueError: if an argument is out of its range, ``augmentation`` is None, or ``policy`` another
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MultiInputPolicy}
    policy: MultiInputPolicy

    def __init__(
        self,
        policy: str | type[SACPolicy],
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
        n_steps: int = 10,
        ent_coef: str | float = 0.005,
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        bc_weight: float = 10.0,
        bc_limit: float = 0.95,
        self_imitation: float | None = 0.1,
        q_weight: float = 1.0,
        expert_q_weight: float | None = None,
        backup_entropy: bool = False,
        value_range: tuple[float, float] | None = None,
        actor_tau: float | None = None,
        exploration: float = 0.1,
        greedy_fraction: float = 0.0,
        expert_episodes: int = 100,
        expert_noise: float = 0.0,
        expert_data: Iterable[EpisodeData] | None = None,
        dagger: bool = False,
        augmentation: AugmentationSpec = "rad",
        contrastive_steps: int = 1600,
        encoder_tau: float = 0.05,
        pretrain_steps: int = 0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
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
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            bc_weight=bc_weight,
            bc_limit=bc_limit,
            self_imitation=self_imitation,
            q_weight=q_weight,
            expert_q_weight=expert_q_weight,
            backup_entropy=backup_entropy,
            value_range=value_range,
            actor_tau=actor_tau,
            exploration=exploration,
            greedy_fraction=greedy_fraction,
            expert_episodes=expert_episodes,
            expert_noise=expert_noise,
            expert_data=expert_data,
            dagger=dagger,
            augmentation=augmentation,
            pretrain_steps=pretrain_steps,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        if not issubclass(self.policy_class, MultiInputPolicy):
            raise ValueError(f"policy must be FERM's MultiInputPolicy, got {self.policy_class.__name__}")
        if self.augmentation is None:
            raise ValueError("augmentation=None: FERM compares random views, give 'rad' or 'drq'")
        check_not_negative(contrastive_steps=contrastive_steps)
        if not 0 < encoder_tau <= 1:
            raise ValueError(f"encoder_tau must be greater than 0 and at most 1, got {encoder_tau}")
        self.contrastive_steps = contrastive_steps
        self.encoder_tau = encoder_tau

        if _init_setup_model:
            self._setup_model()

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.contrast = self.policy.contrast

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Sample the replay buffer and do the updates
        (gradient descent and update target networks)

        :param gradient_steps: number of updates
        :param batch_size: number of transitions for each
        """
        self._update_learning_rate(self.contrast.optimizer)
        super().train(gradient_steps, batch_size)

    @property
    def _pretraining_total(self) -> int:
        return self.contrastive_steps + super()._pretraining_total

    def _pretrain_once(self) -> None:
        """First the encoder by the contrastive loss alone, then everything."""
        assert self.replay_buffer is not None
        if self.n_pretrained >= self.contrastive_steps:
            super()._pretrain_once()
            return
        sample = self.replay_buffer.sample(self.batch_size, env=self._vec_normalize_env)
        for name, value in self._update_encoder(sample.observations).items():
            self.logger.record(f"train/{name}", value.item())
        self._update_target_encoder()

    def _update_encoder(self, observations: PyTorchObs) -> dict[str, th.Tensor]:
        """One step on the contrastive loss of two views of each observation."""
        assert self.augmentation is not None
        anchors = self.augmentation.view(observations, self.augmentation_generator)
        positives = self.augmentation.view(observations, self.augmentation_generator)
        # As the extractor gives them, without the critic's normalisation
        queries = self.policy.extract_features(anchors, self.critic.features_extractor)
        with th.no_grad():
            keys = self.policy.extract_features(positives, self.critic_target.features_extractor)
        loss = self.contrast(queries, keys)
        self.contrast.optimizer.zero_grad()
        loss.backward()
        self.contrast.optimizer.step()
        return {"contrastive_loss": loss.detach()}

    def _update_target_critic(self) -> None:
        self._update_target_encoder()
        heads, target_heads = (nn.ModuleList(net.q_networks) for net in (self.critic, self.critic_target))
        polyak_update(heads.parameters(), target_heads.parameters(), self.tau)

    def _update_target_encoder(self) -> None:
        extractor, target = self.critic.features_extractor, self.critic_target.features_extractor
        polyak_update(extractor.parameters(), target.parameters(), self.encoder_tau)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "contrast.optimizer"], variables
