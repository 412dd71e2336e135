"""Covid Test: what the user does, what ends an episode, where things lie."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.approach import PRECISE
from bulletarm_gym.geometry import Footprint, Pose
from bulletarm_gym.scene.sampling import footprint

Make = Callable[..., ManipulationEnv]

ENV_ID = "BulletArm/OpenLoopCovidTest-v0"
FIXED = {"action_sequence": "pxy", "random_orientation": False}


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    env = make(ENV_ID, max_steps=100)
    env.reset(seed=0)
    return env


def put(env: ManipulationEnv, name: str, place: str, x: float = 0.0, y: float = 0.0) -> None:
    env.scene[name].place(env.scene[place].pose.compose(Pose((x, y, 0.012))))


def idle(env: ManipulationEnv) -> tuple[bool, dict[str, bool]]:
    """Act without effect: a place while empty; return whether that ended the episode, and the info."""
    *_, terminated, _, info = env.step(np.ones(env.action_space.shape, np.float32))
    return terminated, info


def names(env: ManipulationEnv) -> set[str]:
    return {item.slot.name for item in env.scene if item.spec.mass > 0.0}


@pytest.mark.parametrize("parameters", [{}, FIXED], ids=str)
def test_places_are_apart_and_inside(make: Make, parameters: dict[str, Any]) -> None:
    env = make(ENV_ID, **parameters)
    for seed in range(40):
        _, info = env.reset(seed=seed)
        assert info["is_valid"] and info["is_at_rest"] and len(names(env)) == 6
        bases = [footprint(env.scene[name]) for name in ("new box", "test area", "used box")]
        assert all(base.is_inside(env.config.workspace) for base in bases)
        # In their own frame, where gaps are exact, they touch or nearly so.
        local = env.scene["test area"].pose.inverse()
        places = [env.scene[name] for name in ("new box", "test area", "used box")]
        shadows = [footprint(place, local.compose(place.pose)) for place in places]
        gaps = [one.gap(other) for number, one in enumerate(shadows) for other in shadows[:number]]
        assert min(gaps) > -1e-6 and sorted(gaps)[1] < 0.01
        task: Any = env.task
        assert all(len(task._inside(env.scene, kind, "new box")) == 3 for kind in ("swab", "tube"))


def test_a_pair_becomes_a_used_tube(env: ManipulationEnv) -> None:
    put(env, "swab 1", "test area", y=0.06)
    assert idle(env)[0] is False and "swab 1" in names(env)
    put(env, "tube 2", "test area", y=-0.06)
    assert idle(env)[0] is False
    assert names(env) == {"swab 0", "swab 2", "tube 0", "tube 1", "used tube 0"}
    task: Any = env.task
    assert len(task._inside(env.scene, "used tube", "test area")) == 1


def test_used_tubes_are_left_anywhere(make: Make) -> None:
    env = make(ENV_ID, max_steps=100)
    spots = []
    for seed in range(12):
        env.reset(seed=seed)
        put(env, "swab 0", "test area", y=0.06)
        put(env, "tube 0", "test area", y=-0.06)
        idle(env)
        frame = env.scene["test area"].pose.inverse().compose(env.scene["used tube 0"].pose)
        spots.append((frame.y, frame.yaw))
    assert np.ptp(spots, axis=0)[0] > 0.08 and np.ptp(spots, axis=0)[1] > 2.0


@pytest.mark.parametrize(
    "kinds", [("swab", "swab"), ("tube", "tube"), ("used tube", "tube"), ("used tube", "used tube")]
)
def test_two_alike_in_the_test_area_end_the_episode(env: ManipulationEnv, kinds: tuple[str, str]) -> None:
    for number, kind in enumerate(kinds):
        put(env, f"{kind} {number}", "test area", y=0.12 * number - 0.06)
    terminated, info = idle(env)
    assert terminated and not info["is_valid"] and not info["is_success"]


def test_three_used_tubes_in_their_box_are_the_goal(env: ManipulationEnv) -> None:
    for number in range(3):
        assert not env.task.evaluate(env.scene)["success"]
        put(env, f"used tube {number}", "used box", y=0.025 * (number - 1))
    assert env.task.evaluate(env.scene)["success"]


@pytest.mark.parametrize("parameters", [{}, FIXED], ids=str)
def test_expert_solves_in_the_papers_steps(make: Make, parameters: dict[str, Any]) -> None:
    env = make(ENV_ID, **parameters)
    env.reset(seed=4)
    for step in range(1, 19):
        *_, terminated, truncated, info = env.step(env.expert_action())
        assert info["is_success"] == (step == 18) == terminated and not truncated


def test_fingers_around_a_swab_keep_clear_of_the_tubes(make: Make) -> None:
    env = make("BulletArm/CloseLoopCovidTest-v0", robot="ur5_robotiq")
    gripper = env.scene.robot.model.gripper
    thickness, width, _ = gripper.finger
    for seed in range(20):
        env.reset(seed=seed)
        tubes = [footprint(env.scene[f"tube {number}"]) for number in range(3)]
        pick = next(iter(env.task.plan(env.scene, np.random.default_rng(0))))
        offset = (pick.gripper * gripper.stroke + thickness) / 2.0
        fingers = [pick.pose.compose(Pose((side * offset, 0.0, 0.0))) for side in (1.0, -1.0)]
        bases = [Footprint.rectangle((thickness, width), finger) for finger in fingers]
        assert min(base.gap(tube) for base in bases for tube in tubes) > 2.0 * PRECISE
