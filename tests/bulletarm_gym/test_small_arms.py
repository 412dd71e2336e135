"""Heights and workspaces for arms that are smaller than the paper's."""

from typing import Any

import pytest
from rollouts import make_env
from small_arm import PARAMETERS, SMALL

from bulletarm_gym.config import ParameterError, default_home_height

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PUSHING = "BulletArm/CloseLoopBlockPushing-v0"
PULLING = "BulletArm/CloseLoopBlockPulling-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
WORKSPACE = [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]]
OPEN_WORKSPACE = [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]]


def closed(z: list[float]) -> float:
    return default_home_height("close_loop", [*WORKSPACE[:2], z])


def opened(z: list[float]) -> float:
    return default_home_height("open_loop", [*OPEN_WORKSPACE[:2], z])


def test_default_home_height_is_within_the_workspace() -> None:
    assert closed(WORKSPACE[2]) == 0.2 and opened(OPEN_WORKSPACE[2]) == 0.4
    assert closed([0.01, 0.16]) == 0.16
    assert opened([0.05, 0.5]) == pytest.approx(0.45)


@pytest.mark.parametrize(
    ("env_id", "parameters", "name"),
    [
        (PICKING, {"home_height": 0.005}, "home_height"),
        (PICKING, {"home_height": 0.26}, "home_height"),
        (PICKING, {"home_height": 0.04}, "home_height"),
        (STACKING, {"home_height": 0.02}, "home_height"),
        (STACKING, {"home_height": 2.0}, "home_height"),
        (PICKING, {"lift_height": 0.25}, "lift_height"),
        (PULLING, {"lift_height": 0.1}, "lift_height"),
        (STACKING, {"lift_height": 0.15}, "lift_height"),
        (PICKING, {"lift_height": 0.12, "workspace": [*WORKSPACE[:2], [0.01, 0.11]]}, "lift_height"),
    ],
    ids=str,
)
def test_heights_that_do_not_fit_are_named(env_id: str, parameters: dict[str, Any], name: str) -> None:
    with pytest.raises(ParameterError, match=f"^{name} must .*, got .*{parameters[name]}"):
        make_env(env_id, **parameters)


@pytest.mark.parametrize("task", ["BlockReaching", "BlockPicking"])
def test_expert_solves_a_task_of_a_small_arm(task: str) -> None:
    """The workspace is as small as can be, the cube has 1.5 cm."""
    small = {"workspace": [[0.4, 0.44], [-0.02, 0.02], [0.005, 0.12]], "object_scale_range": 0.3}
    lift = {"lift_height": 0.08} if "Picking" in task else {}
    env = make_env(f"BulletArm/CloseLoop{task}-v0", home_height=0.1, **small, **lift)
    for seed in range(3):
        env.reset(seed=seed)
        assert env.scene.robot.pose.z == pytest.approx(0.1, abs=1e-3)
        info: dict[str, Any] = {"is_success": False}
        steps = 0
        while not info["is_success"] and steps < env.config.max_steps:
            *_, info = env.step(env.expert_action())
            steps += 1
        assert info["is_success"]
        assert not lift or 0.08 < env.scene.robot.pose.z <= 0.121
    env.close()


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("CloseLoopBlockReaching", {}),
        ("CloseLoopBlockPicking", {"lift_height": 0.08}),
        ("CloseLoopBlockPushing", {}),
        ("CloseLoopBlockStacking", {"num_objects": 2}),
        ("OpenLoopBlockStacking", {"num_objects": 2}),
    ],
)
def test_the_expert_solves_tasks_with_an_arm_of_five_joints(task: str, changes: dict[str, Any]) -> None:
    env = make_env(f"BulletArm/{task}-v0", robot=SMALL, **PARAMETERS, **changes)
    solved = 0
    for seed in range(10):
        env.reset(seed=seed)
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(env.expert_action())
            over = terminated or truncated
        solved += info["is_success"]
    env.close()
    assert solved >= 9


def test_the_goal_of_a_push_shrinks_with_the_cube() -> None:
    sides = []
    for scale in (1.2, 1.0, 0.5):
        env = make_env(PUSHING, object_scale_range=scale)
        sides.append(env.scene["goal"].spec.extents[0])
        env.close()
    assert sides == pytest.approx([0.09, 0.09, 0.045])


def test_open_loop_returns_to_the_home_height() -> None:
    workspace = [[0.35, 0.55], [-0.1, 0.1], [0.0, 0.3]]
    env = make_env(STACKING, home_height=0.25, workspace=workspace, num_objects=2, object_scale_range=0.5)
    env.reset(seed=0)
    rewards = []
    for _ in range(2):
        assert env.scene.robot.pose.z == pytest.approx(0.25, abs=1e-3)
        rewards.append(env.step(env.expert_action())[1])
    assert rewards == [0.0, 1.0] and env.scene.robot.pose.z == pytest.approx(0.25, abs=1e-3)
    env.close()
