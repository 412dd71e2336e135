"""Checks that the replay buffer and the networks round images equally."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.encoders.observation import StackedImage
from sb3_extensions.replay.buffer import ExpertReplayBuffer


def with_image_dtype(buffer_kwargs: Mapping[str, Any], policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """
    Add the type to which the policy or its features extractor rounds images to the buffer's arguments.

    :param buffer_kwargs: arguments of a replay buffer; an ``image_dtype`` takes precedence
    :param policy_kwargs: arguments of a policy
    :return: arguments of the replay buffer
    """
    extractor_kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
    quantise = policy_kwargs.get("quantise", extractor_kwargs.get("quantise"))
    return {"image_dtype": quantise, **buffer_kwargs} if quantise else dict(buffer_kwargs)


def check_rounding(buffer: ExpertReplayBuffer, policy: BasePolicy, env: VecNormalize | None = None) -> None:
    """
    Check that a policy acts on images as the replay buffer stores them. Networks of users are not checked.

    :param buffer: replay buffer
    :param policy: policy
    :param env: vector environment that normalises observations, or None
    :raises ValueError: if buffer and policy round images differently, or the environment normalises images
        that the policy rounds
    """
    for stack in (module for module in policy.modules() if isinstance(module, StackedImage)):
        if stack.has_float_images and stack.quantise != buffer.image_dtype:
            raise ValueError(
                f"quantise of the policy must be the buffer's image_dtype={buffer.image_dtype!r}, got "
                f"quantise={stack.quantise!r}"
            )
        if env is None or not env.norm_obs or not stack.quantise:
            continue
        images = stack.image_keys.intersection(
            stack.image_keys if env.norm_obs_keys is None else env.norm_obs_keys
        )
        if images:
            raise ValueError(
                f"VecNormalize must not normalise the images {sorted(images)}, which the policy rounds. Use "
                "norm_obs_keys without them, or norm_obs=False"
            )
