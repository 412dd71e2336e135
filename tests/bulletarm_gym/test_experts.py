"""Experts solve their tasks, come back from failures, and look without touching."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import advance, digest, is_open_loop, is_sloping, mixed_action

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.approach import avoid_limits
from bulletarm_gym.geometry import Pose

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
SEEDS = range(5)
LENGTHS = {"CloseLoopBlockReaching": 3.0, "CloseLoopBlockPicking": 7.0, "CloseLoopBlockPulling": 7.0}
"""Mean number of an expert's steps, for tasks whose plan leaves little to chance."""


def finish(env: ManipulationEnv) -> tuple[bool, int]:
    """Let the expert act to the end; return whether it succeeded and its number of steps."""
    for count in range(1, env.config.max_steps + 1):
        *_, terminated, truncated, info = env.step(env.expert_action())
        if terminated or truncated:
            return info["is_success"], count
    raise AssertionError("the episode has no end")


def seeds(env: ManipulationEnv, most: int) -> range:
    """Return seeds, fewer where the default time limit gives long episodes."""
    if is_open_loop(env.spec.id):
        return range(min(most, 100 // type(env.task).defaults.max_steps))
    return range(max(1, min(most, 300 // env.config.max_steps)))


def solve(env: ManipulationEnv, seed: int) -> tuple[bool, int]:
    env.reset(seed=seed)
    return finish(env)


def solve_seeds(env: ManipulationEnv, most: int) -> list[tuple[bool, int]]:
    """Whether it solves the first seeds, and its steps; of those and three more one may fail.

    Experts fail in up to one of 25 scenes, not in the same ones on all processors.
    """
    results = [solve(env, seed) for seed in seeds(env, most)]
    if not all(success for success, _ in results):
        results += [solve(env, seed) for seed in range(100, 103)]
    assert sum(not success for success, _ in results) <= 1, results
    return results


def test_expert_solves_every_seed(env: ManipulationEnv) -> None:
    results = solve_seeds(env, 5)
    name = env.spec.id.split("/")[1].removesuffix("-v0")
    if name in LENGTHS:
        mean = np.mean([count for success, count in results if success])
        assert mean == pytest.approx(LENGTHS[name], rel=0.2)


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
def test_expert_solves_under_other_parameters(make: Make, paper_id: str, parameters: dict[str, Any]) -> None:
    env = make(paper_id, **parameters)
    solve_seeds(env, 1)


def test_expert_solves_in_a_smaller_workspace_elsewhere(make: Make) -> None:
    env = make(PICKING, workspace=[[0.36, 0.6], [-0.09, 0.15], [0.01, 0.25]])
    results = [solve(env, seed) for seed in SEEDS]
    assert all(success for success, _ in results), results


def test_fixed_orientation_turns_by_quarters_at_most(make: Make, env_id: str) -> None:
    env = make(env_id, action_sequence="pxyz", random_orientation=False)
    env.reset(seed=0)
    yaws = np.array([item.pose.yaw for item in env.scene if item.spec.mass > 0.0])
    if "Grasping" not in env_id and not is_sloping(env_id):
        np.testing.assert_allclose(np.sin(2.0 * yaws), 0.0, atol=0.04)


def test_expert_recovers_from_random_actions(make: Make, env_id: str) -> None:
    longer = max(60, make(env_id).config.max_steps + 20)
    env = make(env_id, max_steps=longer)
    if env.task.single_step:
        pytest.skip("nothing to recover from")
    solved = []
    for seed in SEEDS if 60 < longer <= 150 else seeds(env, 5):
        _act_at_random(env, seed)
        solved.append(finish(env)[0])
    assert sum(solved) >= 0.8 * len(solved), solved


def _act_at_random(env: ManipulationEnv, seed: int) -> None:
    """Ten random actions that do not end the episode."""
    for action_seed in range(20):
        rng = np.random.default_rng((seed, action_seed))
        env.reset(seed=seed)
        actions = (rng.uniform(-1, 1, env.action_space.shape) for _ in range(10))
        if not any(any(env.step(action)[2:4]) for action in actions):
            return
    raise AssertionError("random actions end every episode")


def test_expert_action_is_pure(env: ManipulationEnv) -> None:
    rng = np.random.default_rng(0)
    env.reset(seed=1)
    for _ in range(12):
        state, observation = env.get_state(), digest(env.observe())
        first, second = env.expert_action(), env.expert_action()
        assert first.dtype == np.float32 and first in env.action_space
        np.testing.assert_array_equal(first, second)
        assert env.get_state() == state and digest(env.observe()) == observation
        *_, terminated, truncated, _ = env.step(mixed_action(env, rng))
        if terminated or truncated:
            env.reset()


def test_expert_follows_the_state(make: Make, env_id: str) -> None:
    env, other = make(env_id), make(env_id, 1)
    state = advance(env, 1, 2)
    other.reset(seed=9)
    other.set_state(state)
    np.testing.assert_array_equal(env.expert_action(), other.expert_action())


@pytest.mark.parametrize("height", [0.06, 0.125])
def test_expert_keeps_clear_of_the_last_joint_limit_at_every_height(make: Make, height: float) -> None:
    """Near that limit one of these heights is reached in a straight motion, the other is not."""
    env = make("BulletArm/CloseLoopBinPacking-v0", robot="panda")
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.3532, 0.1133, 0.125, -0.293))
    goal = avoid_limits(env.scene, Pose.planar(0.3531, 0.1137, height, 2.849))
    assert goal.yaw == pytest.approx(2.849 - np.pi)
