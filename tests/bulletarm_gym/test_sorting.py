"""Block sorting: what counts as sorted, and that colours tell what heights do not."""

from collections.abc import Callable

import numpy as np
import pytest

from bulletarm_gym.config import ParameterError
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.simulation.shapes import BLUE, RED

Make = Callable[..., ManipulationEnv]
IDS = ["BulletArm/CloseLoopBlockSorting-v0", "BulletArm/OpenLoopBlockSorting-v0"]
both = pytest.mark.parametrize("env_id", IDS)


def lay_out(env: ManipulationEnv, swapped: bool) -> None:
    """Cubes in bowls, two side by side, in those of their colours or in the others."""
    env.reset(seed=0)
    x, y = env.config.centre
    sites = {"red": (x, y - 0.08), "blue": (x, y + 0.08)}
    for name, site in sites.items():
        env.scene[f"{name} bowl"].place(Pose.planar(*site, 0.028))
    for name in sites:
        site = sites[{"red": "blue", "blue": "red"}[name] if swapped else name]
        for number, aside in enumerate((-0.0157, 0.0157)):
            env.scene[f"{name} cube {number}"].place(Pose.planar(site[0] + aside, site[1], 0.021))


@both
@pytest.mark.parametrize("swapped", [False, True])
def test_every_cube_must_be_in_the_bowl_of_its_colour(make: Make, env_id: str, swapped: bool) -> None:
    env = make(env_id)
    lay_out(env, swapped)
    assert env.task.is_valid(env.scene)
    assert env.task.evaluate(env.scene)["success"] is not swapped


def test_one_cube_beside_its_bowl_is_not_sorted(make: Make) -> None:
    env = make(IDS[0])
    lay_out(env, swapped=False)
    env.scene["red cube 0"].place(Pose.planar(env.config.centre[0] + 0.1, 0.0, 0.015))
    assert not env.task.evaluate(env.scene)["is_sorted"]


def test_a_fallen_bowl_ends_the_episode(make: Make) -> None:
    env = make(IDS[0])
    lay_out(env, swapped=False)
    pose = env.scene["red bowl"].pose
    env.scene["red bowl"].place(Pose(pose.position, (1.0, 0.0, 0.0, 0.0)))
    assert not env.task.is_valid(env.scene)


@both
def test_colours_are_seen_by_default(make: Make, env_id: str) -> None:
    observation, _ = make(env_id).reset(seed=0)
    assert observation["color"].shape == (3, 128, 128)
    for colour in (RED, BLUE):
        code = np.array([round(255 * part) for part in colour[:3]])[:, None, None]
        assert (observation["color"] == code).all(axis=0).sum() > 100


@both
def test_colours_alone_tell_the_two_kinds_apart(make: Make, env_id: str) -> None:
    """The mirrored roles give the same heights and other colours."""
    env = make(env_id)
    seen = []
    for swapped in (False, True):
        lay_out(env, swapped)
        seen.append(env.observe())
    assert np.array_equal(seen[0]["heightmap"], seen[1]["heightmap"])
    assert not np.array_equal(seen[0]["color"], seen[1]["color"])


@both
@pytest.mark.parametrize("parameters", [{"num_objects": 4}, {"action_sequence": None}], ids=str)
def test_expert_sorts(make: Make, env_id: str, parameters: dict) -> None:
    if "action_sequence" in parameters:
        sequence = "pxyz" if "Close" in env_id else "pxy"
        parameters = {"action_sequence": sequence, "random_orientation": False}
    env = make(env_id, **parameters)
    for seed in range(3):
        env.reset(seed=seed)
        ended = False
        while not ended:
            *_, terminated, truncated, info = env.step(env.expert_action())
            ended = terminated or truncated
        assert info["is_success"], seed


def test_it_needs_level_ground(make: Make) -> None:
    with pytest.raises(ParameterError, match="bowls slide on a slope"):
        make(IDS[1], surface="ramp")
