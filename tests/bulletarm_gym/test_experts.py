"""Experts solve their tasks, recover from failures, and change nothing when they are queried."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import digest, is_open_loop, mixed_action

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.approach import avoid_limits
from bulletarm_gym.geometry import Pose

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
LENGTHS = {"CloseLoopBlockReaching": 3.0, "CloseLoopBlockPicking": 7.0, "CloseLoopBlockPulling": 7.0}
"""Mean number of an expert's steps, for tasks with short plans."""


def finish(env: ManipulationEnv) -> tuple[bool, int]:
    """Act by the expert to the end; return whether it succeeded and its number of steps."""
    for count in range(1, env.config.max_steps + 1):
        *_, terminated, truncated, info = env.step(env.expert_action())
        if terminated or truncated:
            return info["is_success"], count
    raise AssertionError("the episode has no end")


def solve(env: ManipulationEnv, most: int = 1) -> float:
    """Solve the first seeds, fewer of long episodes; return the mean number of steps.

    Of these and three more one may fail: experts fail in up to one of 25 scenes.
    """
    steps = env.config.max_steps * (1.0 if is_open_loop(env.spec.id) else 0.3)
    results = []
    for seed in [*range(max(1, min(most, int(60 / steps)))), 100, 101, 102]:
        if seed < 100 or not all(success for success, _ in results):
            env.reset(seed=seed)
            results.append(finish(env))
    assert sum(not success for success, _ in results) <= 1, results
    return float(np.mean([count for success, count in results if success]))


@pytest.mark.parametrize("name", LENGTHS)
def test_expert_is_short(make: Make, name: str) -> None:
    assert solve(make(f"BulletArm/{name}-v0"), 4) == pytest.approx(LENGTHS[name], rel=0.3)


@pytest.mark.parametrize(
    "parameters",
    [
        {"action_sequence": "pxyz", "random_orientation": False},
        {"action_sequence": "rzyxp", "obs_size": 32},
        {"fast_mode": False},
        {"physics_mode": "slow"},
    ],
    ids=str,
)
def test_expert_solves_under_other_parameters(
    make: Make, typical_id: str, parameters: dict[str, Any]
) -> None:
    few = {"num_objects": 6} if "Palletizing" in typical_id else {}
    solve(make(typical_id, **parameters, **few))


def test_expert_solves_in_a_smaller_workspace_elsewhere(make: Make) -> None:
    solve(make(PICKING, workspace=[[0.36, 0.6], [-0.09, 0.15], [0.01, 0.25]]), 4)


def test_expert_recovers_from_random_actions(make: Make, typical_id: str) -> None:
    env = make(typical_id, max_steps=80)
    if env.task.single_step:
        pytest.skip("every action ends the episode")
    solved = []
    for seed in range(3):
        for action_seed in range(20):
            rng = np.random.default_rng((seed, action_seed))
            env.reset(seed=seed)
            actions = (rng.uniform(-1, 1, env.action_space.shape) for _ in range(10))
            if not any(any(env.step(action)[2:4]) for action in actions):
                break
        solved.append(finish(env)[0])
    assert sum(solved) >= 2


def test_expert_action_is_a_function_of_the_state(make: Make, typical_id: str) -> None:
    env, other = make(typical_id), make(typical_id, 1)
    rng = np.random.default_rng(0)
    env.reset(seed=1)
    other.reset(seed=9)
    for _ in range(8):
        state, observation = env.get_state(), digest(env.observe())
        first, second = env.expert_action(), env.expert_action()
        assert first.dtype == np.float32 and first in env.action_space
        np.testing.assert_array_equal(first, second)
        assert env.get_state() == state and digest(env.observe()) == observation
        other.set_state(state)
        np.testing.assert_array_equal(other.expert_action(), first)
        *_, terminated, truncated, _ = env.step(mixed_action(env, rng))
        if terminated or truncated:
            env.reset()


@pytest.mark.parametrize("height", [0.06, 0.125])
def test_expert_keeps_clear_of_the_last_joint_limit_at_every_height(make: Make, height: float) -> None:
    """Near that limit one of these heights is reached in a straight motion, the other is not."""
    env = make("BulletArm/CloseLoopBinPacking-v0", robot="panda")
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.3532, 0.1133, 0.125, -0.293))
    goal = avoid_limits(env.scene, Pose.planar(0.3531, 0.1137, height, 2.849))
    assert goal.yaw == pytest.approx(2.849 - np.pi)
