"""The same seed gives the same episode, bit for bit, in every instance and process.

The recorded rollouts of ``test_golden.py`` cover all ids.
"""

import functools
import json
from collections.abc import Callable

import numpy as np
import pytest
from rollouts import TYPICAL, digest, make_env, transcript

from bulletarm_gym.env import ManipulationEnv

Make = Callable[..., ManipulationEnv]
Expected = Callable[..., list[str]]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PARAMETERS = (
    {"fast_mode": False},
    {"physics_mode": "slow"},
    {"object_scale_range": [0.7, 0.9]},
    {"action_sequence": "zpxy", "random_orientation": False, "obs_size": 64},
)
CASES: list[tuple[str, dict]] = [(env_id, {}) for env_id in TYPICAL]
CASES += [(env_id, parameters) for parameters in PARAMETERS for env_id in (TYPICAL[0], PICKING)]


@pytest.fixture(scope="session")
def expected(make: Make) -> Expected:
    """Return the rollouts of seed 0, each computed once."""

    @functools.cache
    def rollout(case: str) -> list[str]:
        env_id, parameters = json.loads(case)
        return transcript(make(env_id, **parameters), seed=0)

    return lambda env_id, **parameters: rollout(json.dumps([env_id, parameters]))


def first_heightmap(env: ManipulationEnv, seed: int | None = None) -> bytes:
    return env.reset(seed=seed)[0]["heightmap"].tobytes()


def test_another_process_agrees(expected: Expected, in_another_process: Callable) -> None:
    requests = {f"{env_id} {parameters}": (env_id, parameters, None) for env_id, parameters in CASES}
    answers = in_another_process(requests)
    for name, (env_id, parameters, _) in requests.items():
        assert answers[name] == expected(env_id, **parameters), name


def test_other_episodes_instances_and_global_randomness_change_nothing(
    make: Make, expected: Expected, typical_id: str
) -> None:
    env, second, other = make(typical_id), make(typical_id, 1), make(PICKING, 2)
    alone = expected(typical_id)
    transcript(env, 6, seed=99, action_seed=5)
    second.reset(seed=50)
    other.reset(seed=51)
    np.random.seed(1)
    before = np.random.get_state()

    def disturb(env: ManipulationEnv) -> None:
        for neighbour in (second, other):
            *_, terminated, truncated, _ = neighbour.step(neighbour.expert_action())
            if terminated or truncated:
                neighbour.reset()

    part = transcript(env, 12, seed=0, before_step=disturb)
    assert len(part) > 1 and part == alone[: len(part)]
    after = np.random.get_state()
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))


def test_unseeded_resets_follow_from_the_seed_alone(make: Make, typical_id: str) -> None:
    def sequence(env: ManipulationEnv, acts: bool) -> list[str]:
        lines = [digest(*env.reset(seed=5))]
        for _ in range(3):
            if acts:
                env.step(env.expert_action())
            lines.append(digest(*env.reset(options={"new_scene": True})))
        return lines

    first = sequence(make(typical_id), acts=False)
    assert sequence(make(typical_id, 1), acts=True) == first and len(set(first)) == len(first)


def test_seeds_differ(make: Make, typical_id: str) -> None:
    env, *unseeded = make(typical_id), make_env(typical_id), make_env(typical_id)
    assert len({first_heightmap(env, seed) for seed in range(5)}) == 5
    first, second = map(first_heightmap, unseeded)
    assert first != second
    for each in unseeded:
        each.close()


def test_rendering_and_queries_change_nothing(make: Make, typical_id: str) -> None:
    rng = np.random.default_rng(0)

    def look(env: ManipulationEnv) -> None:
        queries = (env.get_state, env.expert_action, env.observe)
        for number in rng.integers(len(queries), size=3):
            queries[number]()
        if rng.random() < 0.2:
            env.render()

    expected = transcript(make(typical_id), 8, seed=2)
    for mode in ("rgb_array", "depth_array"):
        watched = make(typical_id, render_mode=mode)
        assert transcript(watched, 8, seed=2, before_step=look) == expected


def test_action_type_does_not_matter_and_the_action_is_not_changed(typical_env: ManipulationEnv) -> None:
    action = [0.5, -3.0, 0.125, -1.0, 0.75, 0.25, -0.5][: typical_env.action_space.shape[0]]
    array = np.array(action, np.float32)
    results = set()
    for form in (action, tuple(action), array, np.array(action, np.float64)):
        typical_env.reset(seed=1)
        results.add(digest(*typical_env.step(form)))
    assert len(results) == 1 and array.tolist() == action
