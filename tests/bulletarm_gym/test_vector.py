"""Vector environments of Gymnasium and Stable-Baselines3: equal to single ones, members begin at states."""

import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from rollouts import TYPICAL, advance
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from bulletarm_gym.vector import CommonSpaces, make_multi_task_vec, reset_to_states

ENV_ID = "BulletArm/CloseLoopBlockPicking-v0"


def test_experts_of_stable_baselines3_members_solve_the_task():
    for make, env_id in ((DummyVecEnv, TYPICAL[0]), (partial(SubprocVecEnv, start_method="fork"), ENV_ID)):
        vec_env = make([partial(gymnasium.make, f"bulletarm_gym:{env_id}", obs_size=32)] * 2)
        vec_env.seed(0)
        vec_env.reset()
        solved = np.zeros(2, bool)
        for _ in range(25):
            _, _, dones, infos = vec_env.step(np.stack(vec_env.env_method("expert_action")))
            solved |= dones & np.array([info["is_success"] for info in infos])
        vec_env.close()
        assert solved.all()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_members_begin_at_states(make, mode):
    """The last state is within an episode."""
    env = make(ENV_ID, obs_size=32)
    states = [advance(env, 40 + seed, steps) for seed, steps in enumerate((0, 0, 1))]
    expected = [env.reset(options={"state": state})[0]["heightmap"] for state in states]
    vector = gymnasium.make_vec(ENV_ID, 3, mode, obs_size=32)
    vector.reset(seed=0)
    for _ in range(2):
        observations, infos = reset_to_states(vector, states)
        np.testing.assert_array_equal(observations["heightmap"], expected)
        assert infos["is_valid"].tolist() == [True] * 3
        assert list(vector.call("get_state")) == states
        ended = False
        # Afterwards Gymnasium resets some members at the next step, unless they begin at states.
        while not ended:
            *_, terminations, truncations, _ = vector.step(np.stack(vector.call("expert_action")))
            ended = bool((terminations | truncations).any())
    reset_to_states(vector, states)
    vector.step(np.zeros((3, 5), np.float32))
    assert [state.steps for state in vector.call("get_state")] == [state.steps + 1 for state in states]
    with pytest.raises(ValueError, match=r"^states must be 3 states, one per member, got 2"):
        reset_to_states(vector, states[:2])
    vector.close()
    apart = gymnasium.make_vec(ENV_ID, 3, "async", vector_kwargs={"shared_memory": False}, obs_size=32)
    with pytest.raises(ValueError, match=r"^envs must have shared_memory=True, got shared_memory=False$"):
        reset_to_states(apart, states)
    apart.close()


CLOSE = [f"BulletArm/CloseLoop{name}-v0" for name in ("BlockPicking", "BlockStacking", "BlockSorting")]
OPEN = ["BulletArm/OpenLoopBlockStacking-v0", "BulletArm/OpenLoopRampBlockStacking-v0"]


@pytest.mark.parametrize(
    ("ids", "kwargs", "sequence"),
    [(CLOSE, {}, "pxyzr"), (OPEN, {"in_hand_size": 24, "observation": ["heightmap", "holding"]}, "pxyzrrr")],
    ids=["close loop", "open loop"],
)
def test_experts_solve_several_tasks_in_common_spaces(ids, kwargs, sequence):
    vector = make_multi_task_vec(ids, obs_size=32, **kwargs)
    space = vector.single_observation_space
    assert vector.call("action_sequence") == (sequence,) * len(ids)
    assert vector.single_action_space.shape == (len(sequence),)
    observations, _ = vector.reset(seed=0)
    np.testing.assert_array_equal(observations["task_id"], np.eye(len(ids)))
    solved = np.zeros(len(ids), bool)
    for _ in range(60):
        actions = np.stack(vector.call("expert_action"))
        observations, rewards, *_ = vector.step(actions)
        assert actions in vector.action_space and observations in vector.observation_space
        solved |= rewards == 1.0
    vector.close()
    assert solved.all()
    if ids is CLOSE:
        assert space["color"].shape == (3, 32, 32) and observations["color"][2].any()
        assert not observations["color"][:2].any()


def test_members_of_several_tasks_begin_at_states():
    vector = make_multi_task_vec(CLOSE[:2], obs_size=32)
    vector.reset(seed=0)
    states = vector.call("get_state")
    vector.reset(seed=1)
    _, infos = reset_to_states(vector, states)
    assert vector.call("get_state") == states
    assert infos["_is_held"].tolist() == [True, False] and infos["_is_stacked"].tolist() == [False, True]
    vector.close()


def test_common_spaces_must_include_those_of_the_environment(picking):
    space = spaces.Dict({**picking.observation_space, "task_id": spaces.Box(0.0, 1.0, (2,), np.float32)})
    for sequence, task, message in (("pxyz", 0, "action_sequence must be"), ("pxyzr", -1, "task must be")):
        with pytest.raises(ValueError, match=f"^{message} .*, got "):
            CommonSpaces(picking, space, sequence, task)


def test_numbers_of_other_tasks_do_not_change_the_result():
    """The flat task has pxyr, the ramp pxyzrrr; vectors are padded at the end."""
    vector = make_multi_task_vec(OPEN, obs_size=32, observation=["heightmap", "holding"])
    flat = vector.envs[0]
    known, results = np.array([-1.0, 0.1, 0.2, 0.3], np.float32), []
    for others in (0.0, 0.5):
        flat.reset(seed=1)
        action = np.insert(known, [3, 4, 4], others)
        results.append(flat.step(action)[0])
    np.testing.assert_equal(*results)
    core = flat.unwrapped
    core.reset(seed=1)
    np.testing.assert_array_equal(core.step(known)[0]["heightmap"], results[0]["heightmap"])
    np.testing.assert_array_equal(flat.revert_action(known)[[0, 1, 2, 4]], known)
    with pytest.raises(ValueError, match=r"^action must have the shape \(7,\), got \(4,\)"):
        flat.step(known)


def test_members_of_several_tasks_run_in_processes():
    """Equal to those of one process; vectors are padded at the end."""
    results = []
    for kind in (SyncVectorEnv, AsyncVectorEnv):
        vector = make_multi_task_vec(CLOSE[:2], 2, vec_env_cls=kind, observation=["state"])
        found = [vector.reset(seed=5)[0]["state"]]
        found.append(vector.step(np.stack(vector.call("expert_action")))[0]["state"])
        results.append(found)
        vector.close()
    np.testing.assert_equal(*results)
    assert not found[0][:2, -3:].any() and found[0][2:, -3:].any()


def test_a_member_passes_the_checks_and_is_made_again_from_its_spec():
    (env, _) = make_multi_task_vec([CLOSE[0], CLOSE[2]], obs_size=36).envs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
        check_env_sb3(env)
    again = gymnasium.make(env.spec)
    assert again.observation_space == env.observation_space and again.action_space == env.action_space
    np.testing.assert_equal(again.reset(seed=2)[0], env.reset(seed=2)[0])


def test_ids_without_common_spaces_are_rejected():
    for ids, kwargs, message in (
        ([], {}, r"ids must be a list of at least one id, got \[\]"),
        (ENV_ID, {}, "ids must be a list of at least one id, got 'BulletArm"),
        ([CLOSE[0], OPEN[0]], {}, "ids must all have one kind of control, got close_loop, open_loop"),
        (OPEN, {}, r"ids must observe 'in_hand' with one type and shape, got .*\(1, 24, 24\)"),
        (CLOSE[:1], {"envs_per_task": 0}, "envs_per_task .*, got 0"),
        (CLOSE[:1], {"observation": [{"name": "task_id", "sensor": "holding"}]}, "names than 'task_id'"),
    ):
        with pytest.raises(ValueError, match=message):
            make_multi_task_vec(ids, **kwargs)
