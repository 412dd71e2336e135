"""One rounding of images for the replay buffer and for what acts on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_extensions.encoders.observation import StackedImage
from sb3_extensions.replay.buffer import ExpertReplayBuffer


def follow_extractor(buffer_kwargs: Mapping[str, Any], policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """
    Let the buffer store images as the policy or its features extractor rounds them, where it is not told
    otherwise.

    :param buffer_kwargs: arguments of a replay buffer
    :param policy_kwargs: arguments of a policy
    :return: arguments of the replay buffer
    """
    extractor_kwargs = policy_kwargs.get("features_extractor_kwargs") or {}
    quantise = policy_kwargs.get("quantise", extractor_kwargs.get("quantise"))
    return {"image_dtype": quantise, **buffer_kwargs} if quantise else dict(buffer_kwargs)


def check_rounding(buffer: ExpertReplayBuffer, policy: BasePolicy) -> None:
    """
    Check that an agent sees images as it is trained on them.

    :param buffer: what stores them
    :param policy: what sees them; networks other than ours are left to their user
    :raises ValueError: if they are rounded in two ways
    """
    stored = buffer.image_dtype
    for stack in _stacks(policy):
        if stack.has_float_images and stack.quantise != stored:
            raise ValueError(
                f"the replay buffer stores images with image_dtype={stored!r}, but the policy "
                f"rounds them with quantise={stack.quantise!r}: give both the same"
            )


def check_normalisation(env: VecNormalize | None, policy: BasePolicy) -> None:
    """
    Check that images reach an agent within the bounds that it rounds them in.

    :param env: what normalises observations, if anything
    :param policy: what sees them; networks other than ours are left to their user
    :raises ValueError: if it normalises images
    """
    if env is None or not env.norm_obs:
        return
    for stack in _stacks(policy):
        images = stack.image_keys if env.norm_obs_keys is None else stack.image_keys & {*env.norm_obs_keys}
        if images and stack.quantise:
            raise ValueError(
                f"VecNormalize must not normalise the images {sorted(images)}, which the policy rounds: give "
                "it norm_obs_keys without them, or norm_obs=False"
            )


def _stacks(policy: BasePolicy) -> Iterator[StackedImage]:
    return (module for module in policy.modules() if isinstance(module, StackedImage))
