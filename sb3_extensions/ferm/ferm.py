"""Framework for efficient robotic manipulation."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_extensions.common.components import check_integer
from sb3_extensions.ferm.policies import MultiInputPolicy
from sb3_extensions.replay.rotation import AugmentationSpec
from sb3_extensions.sacfd import SACfD


class FERM(SACfD):
    """
    Framework for efficient robotic manipulation (FERM): SACfD with a contrastive loss of random crops.

    The encoder learns to identify two crops of the same observation, first on the demonstrations alone, then
    in every update. With ``bc_weight=0`` it is FERM SAC.

    Paper: https://arxiv.org/abs/2012.07975; defaults: BulletArm,
    https://arxiv.org/abs/2205.14292, appendix "Benchmark Details", and its authors' code.

    :param policy: The policy model to use (``"MultiInputPolicy"`` or a subclass of it)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param augmentation: see :class:`~sb3_extensions.sacfd.SACfD`; must include RAD or DrQ
    :param contrastive_steps: number of updates of the encoder by the contrastive loss alone, on the
        demonstrations, before the first step in the environment
    :param encoder_tau: the soft update coefficient of the target critic's features extractor. ``tau`` is the
        coefficient of its heads
    :param kwargs: keyword arguments of :class:`~sb3_extensions.sacfd.SACfD`
    :raises ValueError: if an argument is out of its range, ``augmentation`` has no crops, or ``policy`` is
        not FERM's
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MultiInputPolicy}
    policy: MultiInputPolicy

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        augmentation: AugmentationSpec = "rad",
        contrastive_steps: int = 1600,
        encoder_tau: float = 0.05,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, augmentation=augmentation, _init_setup_model=False, **kwargs)
        if not issubclass(self.policy_class, MultiInputPolicy):
            raise ValueError(f"policy must be FERM's MultiInputPolicy, got {self.policy_class.__name__}")
        check_integer(0, contrastive_steps=contrastive_steps)
        if not 0 < encoder_tau <= 1:
            raise ValueError(f"encoder_tau must be greater than 0 and at most 1, got {encoder_tau}")
        self.contrastive_steps = contrastive_steps
        self.encoder_tau = encoder_tau

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.augmentation is None or self.augmentation.window is None:
            raise ValueError(f"augmentation must have 'rad' or 'drq', got {self.augmentation}")

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.contrast = self.policy.contrast

    @property
    def _pretraining_total(self) -> int:
        return self.contrastive_steps + super()._pretraining_total

    def _pretrain_once(self) -> None:
        assert self.replay_buffer is not None
        if self.n_pretrained >= self.contrastive_steps:
            super()._pretrain_once()
            return
        sample = self.replay_buffer.sample(self.batch_size, env=self._vec_normalize_env)
        for name, value in self._update_encoder(sample.observations).items():
            self.logger.record(f"train/{name}", value.item())
        self._update_target_encoder()

    def _imitate(self) -> None:
        super()._imitate()  # trains the encoder, too
        self._update_target_encoder()

    def _update_encoder(self, observations: PyTorchObs) -> dict[str, th.Tensor]:
        """Do one gradient step on the contrastive loss of two views of each observation."""
        assert self.augmentation is not None and self.augmentation.window is not None
        window = self.augmentation.window
        anchors = window.view(observations, self.augmentation_generator)
        positives = window.view(observations, self.augmentation_generator)
        # Features of the extractor, without the critic's normalisation
        queries = self.policy.extract_features(anchors, self.critic.features_extractor)
        with th.no_grad():
            keys = self.policy.extract_features(positives, self.critic_target.features_extractor)
        loss = self.contrast(queries, keys)
        self._update_learning_rate(self.contrast.optimizer)
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
