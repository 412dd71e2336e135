"""Learners accept images of both types and numbers from sensors, and several tasks at once."""

import gymnasium
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.utils import obs_as_tensor

from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantExtractor
from sb3_extensions.sacfd import SACfD

TASKS = [f"BulletArm/CloseLoop{task}-v0" for task in ("BlockReaching", "BlockPicking", "BlockPushing")]
COLOURS = ["heightmap", "color", "holding"]
IMAGES = [*COLOURS, "segmentation", {"name": "rgb", "size": 24}]
CNN = {"features_extractor_kwargs": {"channels": (4, 4, 4, 4, 8)}}
EQUIVARIANT = {"features_extractor_kwargs": {"n": 4, "channels": (2, 2, 2, 2, 4)}}


def make(observation):
    return gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", observation=observation, obs_size=48)


def as_seen(space, observation):
    """A batch of one as networks get it."""
    return preprocess_obs(
        obs_as_tensor({name: part[None] for name, part in observation.items()}, "cpu"), space
    )


@pytest.fixture(scope="module")
def seen():
    env = make(IMAGES)
    observation, _ = env.reset(seed=1)
    yield env.observation_space, observation
    env.close()


@pytest.mark.parametrize("extractor", [CnnExtractor, EquivariantExtractor])
def test_extractors_see_every_part(extractor, seen):
    space, observation = seen
    images = [name for name, part in space.spaces.items() if is_image_space(part)]
    assert set(images) == {"color", "segmentation", "rgb"}
    network = extractor(space)
    features = network(as_seen(space, observation))
    assert features.shape == (1, network.features_dim)
    for name, values in observation.items():
        changed = np.roll(values, 3, axis=-1) if values.ndim > 1 else 1 - values
        other = {**observation, name: changed}
        assert not th.equal(network(as_seen(space, other)), features), name


@pytest.mark.parametrize(
    ("policy", "observation", "policy_kwargs", "augmentation"),
    [
        ("MultiInputPolicy", [*IMAGES, "state"], CNN, "drq"),
        ("EquivariantPolicy", COLOURS, EQUIVARIANT, {"rad": {"size": 32}}),
    ],
)
def test_sacfd_learns_from_colours_and_keeps_them_exactly(policy, observation, policy_kwargs, augmentation):
    env = make(observation)
    kwargs = {"expert_episodes": 2, "batch_size": 8, "buffer_size": 100, "seed": 0}
    model = SACfD(policy, env, policy_kwargs=policy_kwargs, augmentation=augmentation, **kwargs)
    assert model.learn(4)._n_updates == 4
    table, (seen, _) = model.replay_buffer.table, env.reset(seed=5)
    row = table.heads[:1]
    table.write_observations(row, {name: values[None] for name, values in seen.items()})
    for name, values in table.read_observations(row).items():
        error = 0.2 / 255 if name == "heightmap" else 0
        np.testing.assert_allclose(values[0], seen[name], atol=error)
        assert values.dtype == seen[name].dtype
    assert model.predict(seen)[0].shape == env.action_space.shape
    env.close()
