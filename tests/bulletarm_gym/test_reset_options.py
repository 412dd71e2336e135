"""Options of a reset: narrowed sizes, numbers and randomisation; those that are rejected."""

import re

import gymnasium
import numpy as np
import pytest
from rollouts import GRASPING, PICKING, finish
from stable_baselines3.common.env_util import make_vec_env

from bulletarm_gym.demonstrations import RecordDemonstrations, load, replay
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.objects import bowl
from bulletarm_gym.objects.containers import BOWL_DIAMETER
from bulletarm_gym.scene import scaled
from bulletarm_gym.tasks.picking import BlockInBowl
from bulletarm_gym.wrappers import ResetOptions

PALLETIZING = "BulletArm/OpenLoopBoxPalletizing-v0"
SIZES = {"object_scale_range": [0.6, 1.0], "obs_size": 32}
FEWER = [
    ("BulletArm/OpenLoopHouseBuilding1-v0", {"object_scale_range": [0.5, 0.6]}, 2),
    ("BulletArm/CloseLoopBlockStacking-v0", {"num_objects": 3}, 2),
    ("BulletArm/OpenLoopBottleArrangement-v0", {}, 1),
    (PALLETIZING, {}, 6),
    ("BulletArm/CloseLoopBlockSorting-v0", {}, 4),
    (GRASPING, {}, 2),
]
"""Ids, parameters and smaller numbers of objects."""


def side(env):
    """Return the scale of the cube."""
    return round(env.scene["cube"].spec.extents[0] / 0.05, 3)


def test_scales_are_narrowed_for_one_episode(make):
    env = make(PICKING, **SIZES, seed=0)
    narrow = {side(env) for _ in range(15) if env.reset(options={"object_scale_range": [0.7, 0.74]})}
    assert narrow == {0.7, 0.72, 0.74}
    env.reset(options={"object_scale_range": 0.9})
    assert side(env) == 0.9
    wide = {side(env) for _ in range(15) if env.reset()}
    assert min(wide) < 0.7 and max(wide) > 0.9


@pytest.mark.parametrize("case", FEWER, ids=lambda case: case[0].split("/")[1])
def test_expert_solves_episodes_with_fewer_objects(make, case):
    env_id, parameters, count = case
    env = make(env_id, obs_size=32, **parameters, seed=0)
    total, solved = len(list(env.scene)), False
    for seed in range(3):
        observation, _ = env.reset(seed=seed, options={"num_objects": count})
        assert observation in env.observation_space
        if env_id != PALLETIZING:  # which adds the boxes one by one
            assert len(list(env.scene)) == total - env.config.num_objects + count
        solved |= finish(env)[0]
    assert solved
    env.reset(seed=0)
    assert len(list(env.scene)) == total


def test_clutter_is_kept_while_the_number_is_the_same(make):
    env = make(GRASPING, obs_size=32, seed=0)
    options = {"num_objects": 2}
    env.reset(options=options)
    chosen = [obj.slot.name for obj in env.scene]
    env.reset(options=options)
    assert [obj.slot.name for obj in env.scene] == chosen
    env.reset(options={**options, "new_scene": True})
    assert len(chosen) == 2 and [obj.slot.name for obj in env.scene] != chosen
    env.reset()
    assert len(list(env.scene)) == 5


def test_invalid_options_are_rejected(make):
    env = make(PICKING, **SIZES, seed=0)
    state = env.get_state()
    for options, message in (
        *(
            (options, rf"^options must be .*, got {re.escape(repr(options))}$")
            for options in ("foo", 3, ["start"], {"scenery": "alps"}, {"new_scene": 1}, {1: 2})
        ),
        *((options, '"start": "goal"') for options in ({"start": "gaol"}, {"start": True})),
        ({"start": "goal"}, "BlockPicking has no arrange_goal"),
        ({"object_scale_range": 0.8, "state": 3}, "options must have no others next to 'state'"),
        ({"state": [3]}, r"got a list\. Use bulletarm_gym\.vector\.reset_to_states\(\)"),
        ({"object_scale_range": [0.5, 0.7]}, r"object_scale_range must be .* from 0\.6 to 1, got \[0\.5"),
        ({"object_scale_range": "small"}, "object_scale_range must be a number or .*got 'small'"),
        ({"object_scale_range": 0.71}, r"object_scale_range must be .* 'cube', one of \[0\.6, .*got 0\.71"),
        ({"num_objects": 2}, "num_objects must be one of 1, got 2"),
        ({"randomization": {"object_mass": 1.1}}, r"object_mass must be .*, from 1 to 1, got \[1\.1, 1\.1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)
        assert env.get_state() == state


def test_state_after_the_end_and_other_options_are_rejected(make):
    env = ResetOptions(make(PICKING, **SIZES), {"num_objects": 1})
    env.reset(seed=0)
    finish(env)
    with pytest.raises(ValueError, match="state must be before the end of its episode"):
        env.reset(options={"state": env.unwrapped.get_state()})
    for call in (lambda: env.set_reset_options([]), lambda: env.reset(options=[])):
        with pytest.raises(ValueError, match=r"options must be .*got \[\]"):
            call()


def test_options_reach_the_members_of_sb3():
    envs = make_vec_env(PICKING, n_envs=2, env_kwargs={**SIZES, "max_steps": 1}, wrapper_class=ResetOptions)
    envs.set_options([{"object_scale_range": 0.7}, {"object_scale_range": 0.8}])
    envs.reset()
    cores = [env.unwrapped for env in envs.envs]
    assert [side(core) for core in cores] == [0.7, 0.8]
    envs.env_method("set_reset_options", {"object_scale_range": 0.62})
    for _ in range(2):
        envs.step(np.zeros((2, 5)))
        assert [side(core) for core in cores] == [0.62, 0.62], "after the automatic reset"
    state = cores[0].get_state()
    envs.set_options({"state": state})
    envs.reset()
    assert cores[1].get_state() == state


def test_options_do_not_change_with_the_callers_dict(make):
    options = {"object_scale_range": [0.7, 0.7]}
    env = ResetOptions(make(PICKING, **SIZES), options)
    options["object_scale_range"][0] = 5.0
    env.reset(seed=0)
    assert side(env.unwrapped) == 0.7


def test_options_reach_the_members_of_gymnasium():
    parameters = {**SIZES, "randomization": "light"}
    envs = gymnasium.make_vec(PICKING, 2, "sync", wrappers=[ResetOptions], **parameters)
    _, infos = envs.reset(seed=0, options={"object_scale_range": 0.7, "randomization": {"object_mass": 1.1}})
    assert infos["randomization/object_mass"].tolist() == [1.1, 1.1]
    assert [side(env.unwrapped) for env in envs.envs] == [0.7, 0.7]
    envs.call("set_reset_options", {"randomization": None})
    _, infos = envs.reset()
    assert infos["randomization/object_mass"].tolist() == [1.0, 1.0]


def test_narrowed_episodes_are_recorded_and_replay(tmp_path):
    path = tmp_path / "picking.h5"
    parameters = {**SIZES, "randomization": "real"}
    env = RecordDemonstrations(gymnasium.make(PICKING, **parameters), path)
    for seed in range(3):
        env.reset(seed=seed, options={"object_scale_range": 0.7, "randomization": {"object_mass": 0.6}})
        finish(env)
    recorded = load(path)
    other = recorded.make_env().unwrapped
    assert len(recorded) == 3 and other.config.randomization == "real"
    for number, episode in enumerate(recorded):
        assert dict(episode.state.sampled)["object_mass"] == 0.6
        assert len(list(replay(recorded, number, other))) == len(episode) + 1
        assert side(other) == 0.7


class CoupledInBowl(BlockInBowl):
    def bodies(self, config):
        block, _ = super().bodies(config)
        return [block, scaled(config, "bowl", bowl, like="cube")]


def test_coupled_objects_have_the_same_scale():
    env = ManipulationEnv("test_reset_options:CoupledInBowl", "close_loop", **SIZES)
    sizes = set()
    for seed in range(10):
        env.reset(seed=seed)
        sizes.add(side(env))
        assert env.scene["bowl"].spec.extents[0] == pytest.approx(BOWL_DIAMETER * side(env), rel=0.02)
    assert len(sizes) > 3
