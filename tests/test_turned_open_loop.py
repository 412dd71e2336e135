"""Spatial Q networks and their samples on scenes of the simulator, turned and mirrored."""

import math
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import bulletarm_gym  # noqa: F401  registers the environments
from bulletarm_gym.geometry import Pose
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.spatial_dqn import EquivariantASRPolicy, EquivariantFCNPolicy, RotFCNPolicy
from sb3_extensions.spatial_dqn.augmentation import RigidMotion
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.policies import SpatialPolicy

SIZE, SIDE, YAWS = 48, 12, 4
EXACT = 1e-4  # of the spread of what is compared
EQUIVARIANT = {"fields": [4, 4, 6], "in_hand_channels": [4, 4, 6, 6]}
NETWORKS: dict[str, tuple[type[SpatialPolicy], dict[str, Any]]] = {
    "ASR": (
        EquivariantASRPolicy,
        {**EQUIVARIANT, "hidden": [16, 16], "patch_fields": [4, 4, 6, 4], "pool_encoding": True}
        | {"patch_channels": [4, 4, 6, 6], "patch_hidden": [16, 8]},
    ),
    "FCN": (EquivariantFCNPolicy, {**EQUIVARIANT, "hidden": 16}),
    "Rot FCN": (RotFCNPolicy, {"channels": [4, 6, 8], "in_hand_channels": [4, 4, 6]}),
}
Observation = dict[str, th.Tensor]


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    made = gym.make("BulletArm/OpenLoopHouseBuilding2-v0", obs_size=SIZE, in_hand_size=SIDE).unwrapped
    made.reset(seed=5)
    yield made
    made.close()


def make_policy(env: Any, kind: str, sequence: str = "pxyr") -> SpatialPolicy:
    """Random networks for what the environment shows, in-hand images of as many channels as in 6D too."""
    policy, network_kwargs = NETWORKS[kind]
    parts = dict(env.observation_space.spaces)
    if sequence != "pxyr":
        parts["in_hand"] = spaces.Box(0.0, 0.4, (3, SIDE, SIDE), np.float32)
    actions = spaces.Box(-1.0, 1.0, (len(sequence),), np.float32)
    kwargs = {"codec_kwargs": {"num_rotations": YAWS}, "standardise": (0.0, 0.02), "quantise": None}
    th.manual_seed(0)
    return policy(
        spaces.Dict(parts),
        actions,
        lambda _: 0.0,
        action_sequence=sequence,
        network_kwargs=network_kwargs,
        **kwargs,  # type: ignore[arg-type]
    )


def moved(pose: Pose, middle: tuple[float, float], angle: float, mirror: bool) -> Pose:
    """Turned about the vertical through a point, then left and right exchanged."""
    x, y = pose.x - middle[0], pose.y - middle[1]
    x, y = math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y
    yaw = pose.yaw + angle
    y, yaw = (-y, -yaw) if mirror else (y, yaw)
    return Pose.planar(middle[0] + x, middle[1] + y, pose.z, yaw)


def look_twice(env: Any, angle: float, mirror: bool = False) -> tuple[Observation, Observation]:
    """What is seen of a scene, and of the moved one: once by an empty gripper, once by one that holds."""
    env.reset(seed=5)
    seen = [env.observe()["heightmap"]]
    for item in list(env.scene):
        item.place(moved(item.pose, env.config.centre, angle, mirror))
    seen.append(env.observe()["heightmap"])
    hand = 0.05 * th.rand(1, 3, SIDE, SIDE, generator=th.Generator().manual_seed(0)).expand(2, 3, SIDE, SIDE)
    before, after = (
        {
            "heightmap": th.as_tensor(image).expand(2, 1, SIZE, SIZE),
            "in_hand": hand[:, :1],
            "holding": th.tensor([[0.0], [1.0]]),
        }
        for image in seen
    )
    assert before["heightmap"].max() > 0.02
    return before, after


def assert_same(found: th.Tensor, expected: th.Tensor) -> None:
    for sample in range(len(expected)):
        spread = expected[sample].std()
        assert spread > 0
        assert ((found[sample] - expected[sample]).abs().max() / spread).item() < EXACT


def maps(policy: SpatialPolicy, observation: Observation) -> th.Tensor:
    with th.no_grad():
        return policy.q_net.pixel_maps(policy.q_net.scene_view(observation))[0]


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_maps_turn_with_the_scene(env: Any, quarters: int, mirror: bool) -> None:
    before, after = look_twice(env, quarters * math.pi / 2, mirror)
    policy = make_policy(env, "ASR")
    expected = th.rot90(maps(policy, before), quarters, (2, 3))
    assert_same(maps(policy, after), expected.flip(3) if mirror else expected)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_yaws_shift_when_the_scene_turns(env: Any, quarters: int) -> None:
    before, after = look_twice(env, quarters * math.pi / 2)
    policy = make_policy(env, "FCN")
    expected = th.rot90(maps(policy, before), quarters, (2, 3)).roll(quarters * YAWS // 2, dims=1)
    assert_same(maps(policy, after), expected)


def test_rotated_networks_see_the_turned_scene(env: Any) -> None:
    before, after = look_twice(env, math.pi / 2)
    policy = make_policy(env, "Rot FCN")
    expected = th.rot90(maps(policy, before)[:, : YAWS // 2], 1, (2, 3))
    assert_same(maps(policy, after)[:, YAWS // 2 :], expected)


def test_all_levels_turn_with_the_scene(env: Any) -> None:
    """Yaws shift; heights and tilts stay, where the gripper need not be turned by half a turn."""
    before, after = look_twice(env, math.pi / 2)
    hand = before["in_hand"].expand(2, 3, SIDE, SIDE)
    before, after = ({**seen, "in_hand": hand} for seen in (before, after))
    policy = make_policy(env, "ASR", "pxyzrrr")
    highest = before["heightmap"].flatten(1).argmax(dim=1)
    indices = th.stack([highest // SIZE, highest % SIZE, *th.tensor([[1, 0], [3, 1], [5, 2], [1, 4]])], dim=1)
    turned = indices.clone()
    turned[:, 0], turned[:, 1] = SIZE - 1 - indices[:, 1], indices[:, 0]
    turned[:, 2] += YAWS // 2
    with th.no_grad():
        first, second = policy.q_net.values(before, indices), policy.q_net.values(after, turned)
    assert_same(second[1], first[1].roll(YAWS // 2, dims=1))
    for here, there in zip(first[2:], second[2:], strict=True):
        assert_same(there, here)


def samples_of(before: Observation, after: Observation) -> Any:
    return ExpertReplayBufferSamples(before, None, after, *[None] * 8)  # type: ignore[arg-type]


@pytest.mark.parametrize("turns", [1, 2, 3, 5, 7])
def test_augmented_samples_are_what_a_turned_scene_shows(env: Any, turns: int) -> None:
    before, after = look_twice(env, turns * math.pi / YAWS)
    motion = RigidMotion(SpatialActionCodec(SIZE, "pxyr", num_rotations=YAWS), "heightmap")
    errors = []
    for drawn in range(2 * YAWS):
        motion._sample_motions = lambda *args, n=drawn: (th.full((2,), n), th.zeros(2, 2))  # type: ignore[method-assign]
        found, _ = motion.move(samples_of(before, before), th.zeros(2, 3, dtype=th.int64), th.Generator())
        assert isinstance(found.observations, dict) and isinstance(found.next_observations, dict)
        image = found.observations["heightmap"]
        assert th.equal(image, found.next_observations["heightmap"])
        errors.append((image - after["heightmap"]).abs().mean().item())
    least, next_to_it = sorted(errors)[:2]
    assert errors.index(least) == turns and least < 0.4 * next_to_it
    assert (least == 0.0) == (turns % (YAWS // 2) == 0)
