"""States are exact: what follows from one is the same in any instance, process and after any pickle."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from rollouts import advance, digest, idle, make_env, transcript

import bulletarm_gym
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import KUKA
from bulletarm_gym.simulation.shapes import Box, Piece, wavefront

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PULLING = "BulletArm/CloseLoopBlockPulling-v0"
SEED = 3
MOMENTS = {
    "CloseLoopBlockReaching": (0, 1, 2),
    "CloseLoopBlockPicking": (0, 3, 4, 5, 6),
    "CloseLoopCornerPicking": (0, 3, 4, 5, 6),
    "CloseLoopBlockPulling": (0, 3, 5, 4),
    "OpenLoopHouseBuilding1": (0, 1, 2, 5),
}
"""Numbers of expert's steps after which a state is taken; mid-grasp and mid-push among them.

The last of each is taken under other parameters, too, which may make the way shorter.
"""
CASES = [
    (env_id, moment, parameters)
    for env_id in bulletarm_gym.ENV_IDS
    for name, moments in MOMENTS.items()
    if name in env_id
    for moment in moments
    for parameters in ({}, {"fast_mode": False, "object_scale_range": [0.7, 0.9]})
    if not parameters or moment == moments[-1]
]


def name_of(case: Any) -> str:
    return "-".join(str(part).rsplit("/")[-1] for part in case)


@pytest.mark.parametrize("case", CASES, ids=name_of)
def test_state_is_exact(make: Make, case: tuple[str, int, dict[str, Any]]) -> None:
    env_id, moment, parameters = case
    env, other = (make(env_id, instance, **parameters) for instance in range(2))
    state = advance(env, SEED, moment)
    expected = transcript(env)
    transcript(env, 15, seed=77)
    env.set_state(state)
    assert transcript(env) == expected, "in the same instance"
    transcript(other, 10, seed=78)
    other.set_state(state)
    assert transcript(other) == expected, "in another instance, busy before"
    env.set_state(state)
    assert digest(*env.reset()) == digest(*_after(other, state).reset()), "the next episode"


def _after(env: ManipulationEnv, state: Any) -> ManipulationEnv:
    env.set_state(state)
    return env


def test_states_are_exact_in_another_process(make: Make, in_another_process: Callable) -> None:
    requests, expected = {}, {}
    for case in CASES:
        env_id, moment, parameters = case
        env = make(env_id, **parameters)
        requests[name_of(case)] = (env_id, parameters, advance(env, SEED, moment))
        expected[name_of(case)] = transcript(env)
    assert in_another_process(requests) == expected


def test_the_moments_cover_grasp_and_push(make: Make) -> None:
    picking, pulling = make(PICKING), make(PULLING)
    held = [
        advance(picking, SEED, moment).robot.held is not None for moment in MOMENTS["CloseLoopBlockPicking"]
    ]
    assert held[0] is False and held[-1] is True
    start, end = (
        advance(pulling, SEED, moment).world.poses for moment in (0, max(MOMENTS["CloseLoopBlockPulling"]))
    )
    assert start != end, "nothing was pushed"


def test_state_taken_while_something_moves_is_exact(picking: ManipulationEnv, make: Make) -> None:
    """A cube let go in the air with the time limit of settling cut short keeps its speed in the state."""
    picking.reset(seed=0)
    item = picking.scene["cube"]
    pose = item.pose._replace(position=(0.45, 0.0, 0.12))
    picking.scene.world.place(item.body, pose, ((0.1, 0.0, 0.0), (0.0, 2.0, 1.0)))
    state = picking.get_state()
    assert state.world.twists[item.body.index] == ((0.1, 0.0, 0.0), (0.0, 2.0, 1.0))
    expected = transcript(picking)
    other = _after(make(PICKING, 1), pickle.loads(pickle.dumps(state)))
    assert transcript(other) == expected


def test_setting_a_state_restores_what_can_be_seen(env: ManipulationEnv) -> None:
    env.reset(seed=1)
    observation, *_ = env.step(env.expert_action())
    state = env.get_state()
    action = env.expert_action()
    transcript(env, 10, seed=9)
    env.set_state(state)
    assert digest(env.observe()) == digest(observation)
    assert np.array_equal(env.expert_action(), action)
    assert env.get_state() == state


def test_state_is_independent_of_the_environment(env: ManipulationEnv) -> None:
    env.reset(seed=1)
    state = env.get_state()
    frozen = pickle.dumps(state)
    transcript(env, 10)
    assert pickle.dumps(state) == frozen
    env.set_state(state)
    transcript(env, 10)
    assert pickle.dumps(state) == frozen


def test_set_state_on_a_fresh_instance(env_id: str, make: Make) -> None:
    state = advance(make(env_id), SEED, 2)
    expected = transcript(make(env_id), 12)
    fresh = make_env(env_id)
    fresh.set_state(state)
    assert transcript(fresh, 12) == expected
    fresh.close()


def test_state_keeps_the_time_limit(make: Make, env_id: str) -> None:
    env, other = make(env_id, max_steps=3), make(env_id, 1, max_steps=3)
    if env.task.single_step:
        pytest.skip("ends before it")
    env.reset(seed=0)
    env.step(idle(env))
    env.step(idle(env))
    other.set_state(env.get_state())
    assert other.step(idle(env))[3] is True


@pytest.mark.parametrize("moment", [None, 0, 2])
def test_environment_can_be_pickled(typical_id: str, moment: int | None) -> None:
    env = make_env(typical_id, max_steps=20, obs_size=64)
    if moment is not None:
        advance(env, SEED, moment)
    copy = pickle.loads(pickle.dumps(env))
    assert copy.config == env.config
    assert copy.spec == env.spec
    if moment is None:
        with pytest.raises(gymnasium.error.ResetNeeded):
            copy.expert_action()
    seed = 5 if moment is None else None
    assert transcript(copy, 15, seed=seed) == transcript(env, 15, seed=seed)
    env.close()
    copy.close()


def test_wrapped_environment_can_be_pickled(typical_id: str) -> None:
    env = gymnasium.make(typical_id)
    env.reset(seed=3)
    copy = pickle.loads(pickle.dumps(env))
    action = env.unwrapped.expert_action()
    assert digest(*copy.step(action)) == digest(*env.step(action))
    env.close()
    copy.close()


def test_copies_live_on_their_own(typical_id: str) -> None:
    env = make_env(typical_id)
    env.reset(seed=0)
    copy = pickle.loads(pickle.dumps(env))
    env.close()
    assert transcript(copy, 5)
    copy.close()


def test_state_needs_an_episode(typical_id: str) -> None:
    env = make_env(typical_id)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.get_state()
    env.close()


# Resets to a state


def test_reset_begins_at_a_state(typical_id: str, make: Make) -> None:
    env, other = make(typical_id), make(typical_id, 1)
    state = advance(env, SEED, 1)
    expected = digest(env.observe())
    transcript(other, 5, seed=8)
    observation, info = other.reset(options={"state": state})
    assert digest(observation) == expected and info["is_valid"]
    assert other.get_state() == state
    assert transcript(other, 12) == transcript(env, 12)


def test_seed_of_a_reset_to_a_state_decides_later_episodes(picking: ManipulationEnv) -> None:
    state = advance(picking, SEED, 1)
    picking.reset(seed=11, options={"state": state})
    assert picking.np_random_seed == 11
    later = digest(*picking.reset())
    picking.reset(seed=11, options={"state": advance(picking, 5, 2)})
    assert digest(*picking.reset()) == later


def test_reset_rejects_other_states(picking: ManipulationEnv, make: Make) -> None:
    state = advance(picking, SEED, 0)
    other = make("BulletArm/CloseLoopBlockReaching-v0")
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"state": 3}, r"^state must be an EnvState from get_state\(\), got a int$"),
        ({"state": [state]}, r"got a list\. Use bulletarm_gym\.vector\.reset_to_states\(\)"),
        ({"state": advance(other, 0, 0)}, r"^state must be of an environment with task="),
        ({"state": state, "new_scene": True}, r"^options must have no others next to 'state'"),
    ]
    for options, message in wrong:
        with pytest.raises(ValueError, match=message):
            picking.reset(options=options)
        assert picking.get_state() == state
    short = make(PICKING, max_steps=1)
    short.reset(seed=0)
    short.step(idle(short))
    with pytest.raises(ValueError, match=r"^state must be before the end of its episode"):
        short.reset(options={"state": short.get_state()})


# Copies


@pytest.mark.parametrize("moment", [None, 1])
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_keep_generators_and_seed(copied: Callable[[Any], Any], moment: int | None) -> None:
    env = make_env(PICKING, obs_size=16)
    env.action_space.seed(5)
    env.observation_space.seed(6)
    env.action_space.sample()
    if moment is None:
        _ = env.np_random_seed
    else:
        advance(env, SEED, moment)
    other = copied(env)
    assert other.np_random_seed == env.np_random_seed
    assert np.array_equal(other.action_space.sample(), env.action_space.sample())
    assert digest(other.observation_space.sample()) == digest(env.observation_space.sample())
    assert digest(*other.reset()) == digest(*env.reset())
    env.close()
    other.close()


def test_set_state_leaves_no_seed_of_another_generator(picking: ManipulationEnv) -> None:
    state = advance(picking, SEED, 1)
    picking.reset(seed=4)
    picking.set_state(state)
    assert picking.np_random_seed == -1  # Gymnasium's value for an unknown seed


STACKING = "BulletArm/OpenLoopBlockStacking-v0"
OTHERS: list[tuple[str, str, dict[str, Any]]] = [
    ("robot", PICKING, {"robot": "panda"}),
    ("workspace", PICKING, {"workspace": [[0.32, 0.6], [-0.14, 0.14], [0.01, 0.25]]}),
    ("object_scale_range", PICKING, {"object_scale_range": 0.8}),
    ("task", "BulletArm/CloseLoopBlockReaching-v0", {}),
    ("surface", PICKING, {"surface": "ramp"}),
    ("close_loop_tray", PICKING, {"close_loop_tray": True}),
    ("num_objects", STACKING, {"num_objects": 3}),
    ("in_hand", STACKING, {"action_sequence": "pxyzrrr"}),
]


@pytest.mark.parametrize(("name", "env_id", "parameters"), OTHERS, ids=lambda value: str(value))
def test_state_of_another_environment_is_refused(
    make: Make, name: str, env_id: str, parameters: dict[str, Any]
) -> None:
    own_id = PICKING if "CloseLoop" in env_id else env_id
    env, other = make(own_id, obs_size=32), make_env(env_id, obs_size=32, **parameters)
    advance(env, SEED, 1)
    before = env.get_state()
    state = advance(other, SEED, 1)
    with pytest.raises(ValueError, match=rf"^state must be .*\b{name}=.*, got one with .*\b{name}="):
        env.set_state(state)
    assert env.get_state() == before
    other.close()


def test_set_state_rejects_other_values(picking: ManipulationEnv) -> None:
    picking.reset(seed=0)
    with pytest.raises(ValueError, match=r"^state must be an EnvState from get_state\(\), got a dict"):
        picking.set_state({})  # type: ignore[arg-type]


def test_state_of_an_environment_that_looks_otherwise_is_taken(picking: ManipulationEnv, make: Make) -> None:
    other = make(PICKING, obs_size=32, max_steps=9, action_sequence="pxyz", random_orientation=False)
    picking.reset(seed=0)
    other.set_state(picking.get_state())
    assert other.scene.world.poses == picking.scene.world.poses


def test_state_of_changed_object_files_is_refused(tmp_path: Path) -> None:
    """A file of demonstrations replays with the objects that it was recorded with, or not at all."""
    env_id, parameters = (
        "BulletArm/CloseLoopObjectGrasping-v0",
        {"object_set": str(tmp_path), "num_objects": 1},
    )

    def write(side: float) -> None:
        (tmp_path / "box.obj").write_text(wavefront([Piece(Box((0.04, side, 0.04)))]))

    write(0.05)
    before = make_env(env_id, **parameters)
    state = advance(before, SEED, 1)
    same = make_env(env_id, **parameters)
    same.set_state(state)
    write(0.06)
    changed = make_env(env_id, **parameters)
    with pytest.raises(
        ValueError, match=r"state must be .* with object_files='crc .*', got one with object_files="
    ):
        changed.set_state(state)
    for env in (before, same, changed):
        env.close()


def test_state_of_a_changed_arm_of_the_same_name_is_refused(picking: ManipulationEnv) -> None:
    longer = replace(KUKA, tool=KUKA.tool.compose(Pose((0.0, 0.0, -0.01))))
    stronger = replace(longer, gripper=replace(KUKA.gripper, force=40.0))
    one, same, other = (make_env(PICKING, robot=model) for model in (longer, replace(longer), stronger))
    state = advance(one, SEED, 1)
    same.set_state(state)
    picking.reset(seed=0)
    for env, found in ((other, "'crc .*'"), (picking, "None")):
        with pytest.raises(ValueError, match=rf"state must be .* with arm={found}, got one with arm='crc "):
            env.set_state(state)
