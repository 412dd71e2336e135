"""Heights and workspaces for arms that are smaller than the paper's."""

from typing import Any

import pytest
from rollouts import make_env
from small_arm import PARAMETERS, SMALL

from bulletarm_gym.config import ParameterError, default_home_height

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PULLING = "BulletArm/CloseLoopBlockPulling-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
SIDES = [[0.3, 0.6], [-0.15, 0.15]]


@pytest.mark.parametrize(
    ("control", "z", "height"),
    [
        ("close_loop", [0.01, 0.25], 0.2),
        ("close_loop", [0.01, 0.16], 0.16),
        ("open_loop", [0.0, 1.0], 0.4),
        ("open_loop", [0.05, 0.5], 0.45),
    ],
)
def test_default_home_height_is_within_the_workspace(control: str, z: list[float], height: float) -> None:
    assert default_home_height(control, [*SIDES, z]) == pytest.approx(height)


@pytest.mark.parametrize(
    ("env_id", "parameters", "name"),
    [
        (PICKING, {"home_height": 0.26}, "home_height"),
        (PICKING, {"home_height": 0.04}, "home_height"),
        (STACKING, {"home_height": 0.02}, "home_height"),
        (STACKING, {"home_height": 2.0}, "home_height"),
        (PICKING, {"lift_height": 0.25}, "lift_height"),
        (PULLING, {"lift_height": 0.1}, "lift_height"),
        (PICKING, {"lift_height": 0.12, "workspace": [*SIDES, [0.01, 0.11]]}, "lift_height"),
    ],
    ids=str,
)
def test_heights_that_do_not_fit_are_named(env_id: str, parameters: dict[str, Any], name: str) -> None:
    with pytest.raises(ParameterError, match=f"^{name} must .*, got .*{parameters[name]}"):
        make_env(env_id, **parameters)


SMALLEST = {"workspace": [[0.4, 0.44], [-0.02, 0.02], [0.005, 0.12]], "object_scale_range": 0.3}
"""The smallest workspace, and a cube of 1.5 cm."""


@pytest.mark.parametrize(
    ("task", "parameters"),
    [
        ("CloseLoopBlockPicking", {**SMALLEST, "home_height": 0.1, "lift_height": 0.08}),
        ("OpenLoopBlockStacking", {"robot": SMALL, **PARAMETERS, "num_objects": 2}),
    ],
    ids=["closed loop", "small arm"],
)
def test_expert_solves_tasks_in_a_small_workspace(task: str, parameters: dict[str, Any]) -> None:
    env, solved = make_env(f"BulletArm/{task}-v0", **parameters), 0
    for seed in range(5):
        env.reset(seed=seed)
        assert env.scene.robot.pose.z == pytest.approx(env.config.home_height, abs=1e-3)
        is_over = False
        while not is_over:
            *_, terminated, truncated, info = env.step(env.expert_action())
            is_over = terminated or truncated
        solved += info["is_success"]
    env.close()
    assert solved >= 4


def test_goal_of_a_push_shrinks_with_the_cube() -> None:
    sides = []
    for scale in (1.2, 1.0, 0.5):
        env = make_env("BulletArm/CloseLoopBlockPushing-v0", object_scale_range=scale)
        sides.append(env.scene["goal"].spec.extents[0])
        env.close()
    assert sides == pytest.approx([0.09, 0.09, 0.045])
