"""The same seed gives the same episode, bit for bit, wherever and after whatever it is run."""

import functools
import json
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from rollouts import TYPICAL, digest, make_env, step_on, transcript

import bulletarm_gym
from bulletarm_gym.env import ManipulationEnv

Make = Callable[..., ManipulationEnv]
Expected = Callable[..., list[str]]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
KEEPS_ITS_SCENE = "ObjectGrasping"
"""Unseeded resets of these ids go on with the clutter that an episode left."""
PARAMETERS = (
    {},
    {"fast_mode": False},
    {"physics_mode": "slow"},
    {"object_scale_range": [0.7, 0.9]},
    {"action_sequence": "zpxy", "random_orientation": False, "obs_size": 64},
)
CASES = [(env_id, {}) for env_id in bulletarm_gym.ENV_IDS]
CASES += [(env_id, parameters) for parameters in PARAMETERS[1:] for env_id in TYPICAL]
"""Every id, and an id of each kind under every other set of parameters."""


def name_of(case: tuple[str, dict]) -> str:
    return f"{case[0].split('/')[1]}-{case[1]}"


@pytest.fixture(scope="session")
def expected(make: Make) -> Expected:
    """Make the rollouts of seed 0, each once, that several tests compare others with."""

    @functools.cache
    def rollout(case: str) -> list[str]:
        env_id, parameters = json.loads(case)
        return transcript(make(env_id, **parameters), seed=0)

    return lambda env_id, **parameters: rollout(json.dumps([env_id, parameters]))


def begins(whole: list[str], part: list[str]) -> None:
    """Assert that a rollout is how a longer one begins."""
    assert len(part) > 1 and part == whole[: len(part)]


def first_heightmap(env: ManipulationEnv, seed: int | None = None) -> np.ndarray:
    return env.reset(seed=seed)[0]["heightmap"]


@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_two_instances_agree(make: Make, expected: Expected, case: tuple[str, dict]) -> None:
    env_id, parameters = case
    assert transcript(make(env_id, 1, **parameters), seed=0) == expected(env_id, **parameters)


def test_rollouts_grasp_and_succeed(picking: ManipulationEnv) -> None:
    """The rollouts compared here are worth it: the mixture of actions brings grasps and successes about."""
    seen = []
    transcript(picking, seed=0, before_step=lambda env: seen.append(env.scene.held is not None))
    assert any(seen) and not all(seen)
    successes = []
    transcript(picking, seed=0, before_step=lambda env: successes.append(env.get_state().steps == 0))
    assert sum(successes) >= 2, "no second episode began"


def test_same_instance_after_other_episodes(env: ManipulationEnv, expected: Expected) -> None:
    before = expected(env.spec.id)
    transcript(env, 12, seed=99, action_seed=5)
    assert transcript(env, seed=0) == before


def test_unseeded_resets_follow_from_the_seed(make: Make, env_id: str) -> None:
    def sequence(env: ManipulationEnv) -> list[str]:
        return [digest(*env.reset(seed=5)), *(digest(*env.reset()) for _ in range(4))]

    first, second = make(env_id), make(env_id, 1)
    expected = sequence(first)
    transcript(second, 8, seed=8)
    assert sequence(second) == expected
    if KEEPS_ITS_SCENE not in env_id:
        assert len(set(expected)) == len(expected)


def test_steps_do_not_move_the_resets_that_follow(env: ManipulationEnv) -> None:
    options = {"new_scene": True}
    env.reset(seed=5)
    without = digest(*env.reset(options=options))
    env.reset(seed=5)
    for _ in range(2):
        step_on(env, env.expert_action())
    assert digest(*env.reset(options=options)) == without


def test_another_process_agrees(expected: Expected, in_another_process: Callable) -> None:
    requests = {name_of(case): (*case, None) for case in CASES}
    answers = in_another_process(requests)
    for name, (env_id, parameters, _) in requests.items():
        assert answers[name] == expected(env_id, **parameters), name


def test_global_randomness_is_neither_read_nor_moved(env: ManipulationEnv, expected: Expected) -> None:
    elsewhere = expected(env.spec.id)
    np.random.seed(1 + bulletarm_gym.ENV_IDS.index(env.spec.id))  # a state that no other test leaves
    before = np.random.get_state()
    begins(elsewhere, transcript(env, 12, seed=0))
    after = np.random.get_state()
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))


def test_seeds_differ(env: ManipulationEnv) -> None:
    views = {first_heightmap(env, seed).tobytes() for seed in range(8)}
    assert len(views) == 8


def test_consecutive_resets_differ(env: ManipulationEnv) -> None:
    env.reset(seed=0)
    views = {env.reset(options={"new_scene": True})[0]["heightmap"].tobytes() for _ in range(8)}
    assert len(views) == 8


def test_unseeded_instances_differ(typical_id: str) -> None:
    first, second = make_env(typical_id), make_env(typical_id)
    assert not np.array_equal(first_heightmap(first), first_heightmap(second))
    first.close()
    second.close()


def test_interleaved_instances_do_not_disturb_each_other(make: Make, expected: Expected, env_id: str) -> None:
    first, second = make(env_id), make(env_id, 1)
    other = make(PICKING, 2)
    alone = expected(env_id)
    second.reset(seed=50)
    other.reset(seed=51)

    def disturb(env: ManipulationEnv) -> None:
        for neighbour in (second, other):
            *_, terminated, truncated, _ = neighbour.step(neighbour.expert_action())
            if terminated or truncated:
                neighbour.reset()

    begins(alone, transcript(first, 12, seed=0, before_step=disturb))


@pytest.mark.parametrize("parameters", PARAMETERS[:2], ids=str)
def test_looking_changes_nothing(make: Make, typical_id: str, parameters: dict) -> None:
    plain = make(typical_id, **parameters)
    watched = make(typical_id, 3, render_mode="rgb_array", **parameters)
    rng = np.random.default_rng(0)

    def look(env: ManipulationEnv) -> None:
        looks = (env.get_state, env.expert_action, lambda: env.observe())
        for number in rng.integers(len(looks), size=3):
            looks[number]()
        if rng.random() < 0.2:
            env.render()

    assert transcript(watched, 12, seed=2, before_step=look) == transcript(plain, 12, seed=2)


def test_render_mode_changes_nothing(make: Make, typical_id: str) -> None:
    for mode in ("rgb_array", "depth_array"):
        env = make(typical_id, render_mode=mode)
        assert transcript(env, 10, seed=2) == transcript(make(typical_id), 10, seed=2)


def test_action_type_does_not_matter(typical_env: ManipulationEnv) -> None:
    action = [0.5, -0.25, 0.125, -1.0, 0.75, 0.25, -0.5][: typical_env.action_space.shape[0]]
    results = []
    for form in (action, tuple(action), np.array(action, np.float32), np.array(action, np.float64)):
        typical_env.reset(seed=1)
        results.append(digest(*typical_env.step(form)))
    assert len(set(results)) == 1


def test_step_leaves_the_action_alone(typical_env: ManipulationEnv) -> None:
    typical_env.reset(seed=1)
    action = np.full(typical_env.action_space.shape, 3.0, np.float32)
    typical_env.step(action)
    assert (action == 3.0).all()


def test_wrapped_environment_agrees(typical_id: str, make: Make) -> None:
    wrapped = gymnasium.make(f"bulletarm_gym:{typical_id}")
    expected, _ = make(typical_id).reset(seed=21)
    observed, _ = wrapped.reset(seed=21)
    assert digest(observed) == digest(expected)
    wrapped.close()
