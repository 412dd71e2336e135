"""Policy of FERM: one convolutional encoder for critic and actor, trained by a contrastive loss."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.nn import functional as F

from sb3_extensions.encoders.cnn import CnnEncoder
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.sacfd import policies as sacfd
from sb3_extensions.sacfd.actor_critic import NetArch


class ContrastiveEncoder(CnnEncoder):
    """Convolutional encoder with BulletArm's channels of FERM, see the base class for the parameters."""

    LAST = (256, 256, 1024)


class ContrastiveExtractor(CnnExtractor):
    """
    Convolutional encoder, a linear layer and layer normalisation.

    :param observation_space: see :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param features_dim: number of features
    :param kwargs: further parameters of :class:`~sb3_extensions.encoders.extractors.CnnExtractor`
    """

    encoder_class = ContrastiveEncoder

    def __init__(self, observation_space: gym.Space[Any], features_dim: int = 50, **kwargs: Any) -> None:
        super().__init__(observation_space, **kwargs)
        linear = nn.Linear(self.features_dim, features_dim)
        nn.init.xavier_uniform_(linear.weight)
        nn.init.zeros_(linear.bias)
        self.projection = nn.Sequential(linear, nn.LayerNorm(features_dim))
        self._features_dim = features_dim
        self.trains_encoder = True

    def borrow_encoder(self, owner: ContrastiveExtractor) -> None:
        """Use the convolutions of another extractor without training them."""
        self.encoder, self.small_images = owner.encoder, owner.small_images
        self.trains_encoder = False

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """:return: (batch, features_dim)"""
        with th.set_grad_enabled(th.is_grad_enabled() and self.trains_encoder):
            image_features = super().forward(observations)
        features: th.Tensor = self.projection(image_features)
        return features


class BilinearContrast(nn.Module):
    """
    Contrastive loss with the similarity ``query^T W key`` of two views, where W is learned.

    InfoNCE: https://arxiv.org/abs/1807.03748; bilinear: CURL, https://arxiv.org/abs/2004.04136

    :param features_dim: length of a query and of a key
    """

    optimizer: th.optim.Optimizer

    def __init__(self, features_dim: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(nn.init.xavier_uniform_(th.empty(features_dim, features_dim)))

    def forward(self, queries: th.Tensor, keys: th.Tensor) -> th.Tensor:
        """
        Return the mean cross-entropy of the classification of each query's key among all keys.

        :param queries: features of one view of each observation, (batch, features_dim)
        :param keys: features of the other views, (batch, features_dim)
        """
        return F.cross_entropy(queries @ self.weight @ keys.T, th.arange(len(keys), device=keys.device))


class MultiInputPolicy(sacfd.MultiInputPolicy):
    """
    Policy class (with both actor and critic) for FERM.

    Actor and critic use the convolutions of the critic, which the actor's loss does not train. Each has its
    own linear layer and normalisation. The contrastive loss trains the critic's features extractor with a
    separate optimizer; its keys come from the target critic. By default actor and critic have two hidden
    layers of 1,024 units. See :class:`~sb3_extensions.sacfd.policies.SACfDPolicy` for the parameters.

    :raises ValueError: with ``share_features_extractor``, or without a :class:`ContrastiveExtractor`
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = ContrastiveExtractor
    default_net_arch: ClassVar[NetArch] = [1024, 1024]

    def _build(self, lr_schedule: Schedule) -> None:
        if self.share_features_extractor:
            raise ValueError("share_features_extractor must be False for FERM, got True")
        super()._build(lr_schedule)
        borrower, owner = self.actor.features_extractor, self.critic.features_extractor
        if not isinstance(borrower, ContrastiveExtractor) or not isinstance(owner, ContrastiveExtractor):
            raise ValueError(f"features_extractor_class must be a ContrastiveExtractor, got {type(owner)}")
        borrower.borrow_encoder(owner)
        self.build_average()
        borrowed = set(owner.parameters()) & set(borrower.parameters())
        self.contrast = BilinearContrast(owner.features_dim)
        for module, parameters in (
            (self.actor, [p for p in self.actor.parameters() if p not in borrowed]),
            (self.contrast, [*owner.parameters(), *self.contrast.parameters()]),
        ):
            module.optimizer = self.optimizer_class(
                parameters,
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **self.optimizer_kwargs,
            )
