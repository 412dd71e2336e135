"""Seeds and states give the same steps in any instance, process and copy. States are stored as plain JSON.

The recorded rollouts of ``test_golden.py`` cover all ids.
"""

import copy
import json
import math
import multiprocessing
import pickle
import sys
from collections import OrderedDict
from dataclasses import dataclass, field, make_dataclass, replace

import numpy as np
import pytest
from rollouts import (
    CLOSE_STACKING,
    GRASPING,
    PICKING,
    STACKING,
    TYPICAL,
    advance,
    answer,
    digest,
    make_env,
    transcript,
)

from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import KUKA
from bulletarm_gym.simulation.shapes import Box, Piece, wavefront
from bulletarm_gym.tasks.picking import BlockPicking

PULLING = "BulletArm/CloseLoopBlockPulling-v0"
SEED = 3
OTHER = {"fast_mode": False, "object_scale_range": [0.7, 0.9]}
REAL = {"randomization": "real", "obs_size": 32}
CAMERAS = ["heightmap", "point_cloud", *({"name": name, "size": 32} for name in ("rgb", "depth"))]
SHAPED = {"observation": ["holding"], "reward": "progress"}
CASES = [
    *((PICKING, 0, {}), (PICKING, 6, {}), (PICKING, 6, OTHER), (PULLING, 5, {})),
    *((env_id, 1, {}) for env_id in TYPICAL if env_id != PICKING),
    *((env_id, 1, REAL) for env_id in TYPICAL),
    (PICKING, 1, {**REAL, "view": "point_cloud", "observation": CAMERAS}),
    *((env_id, 1, SHAPED) for env_id in (PICKING, CLOSE_STACKING, TYPICAL[0])),
    (CLOSE_STACKING, 1, {"num_objects": 3}, {"num_objects": 2}),
    (TYPICAL[2], 1, {"object_scale_range": [0.5, 0.6]}, {"num_objects": 2, "object_scale_range": 0.5}),
]
"""Ids, numbers of the expert's steps, mid-grasp and mid-push among them, parameters, options of the reset."""


def test_another_process_agrees(make, monkeypatch):
    """Mid-grasp and mid-push, with sampled physics, and from a seed."""
    requests = {}
    for env_id, moment, parameters in [*CASES[2:5], (PICKING, 4, REAL)]:
        state = advance(make(env_id, **parameters), SEED, moment)
        requests[f"{env_id} {parameters}"] = (env_id, parameters, state)
    assert any(state.robot.held is not None for *_, state in requests.values())
    own = {"action_sequence": "zpxy", "random_orientation": False, "physics_mode": "slow"}
    requests["seed"] = (PICKING, own, None)
    monkeypatch.setenv("PYTHONHASHSEED", "7")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(answer, (requests,)) == answer(requests)


def test_other_episodes_instances_and_global_randomness_change_nothing(make, typical_id):
    env, second, other = make(typical_id), make(typical_id, 1), make(PICKING, 2)
    alone = transcript(env, 8, seed=0)
    transcript(env, 6, seed=99, action_seed=5)
    second.reset(seed=50)
    other.reset(seed=51)
    np.random.seed(1)
    before = pickle.dumps(np.random.get_state())

    def disturb(_):
        for neighbour in (second, other):
            transcript(neighbour, 1)

    assert transcript(env, 8, seed=0, before_step=disturb) == alone
    assert pickle.dumps(np.random.get_state()) == before


def test_unseeded_resets_follow_from_the_seed_alone(make, typical_id):
    rows = [[], []]
    for instance, row in enumerate(rows):
        env = make(typical_id, instance, seed=5)
        for _ in range(3):
            if instance == 1:
                env.step(env.expert_action())
            row.append(digest(*env.reset(options={"new_scene": True})))
    assert rows[0] == rows[1] and len(set(rows[0])) == 3


def test_rendering_and_queries_change_nothing(make, typical_id):
    def look(env):
        for query in (env.get_state, env.expert_action, env.observe, env.render):
            query()

    expected = transcript(make(typical_id), 8, seed=2)
    watched = make(typical_id, render_mode="rgb_array", render_size=64)
    assert transcript(watched, 8, seed=2, before_step=look) == expected


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(str(part).rsplit("/")[-1] for part in case))
def test_state_is_exact(make, case):
    env_id, moment, parameters, *options = case
    env, other = (make(env_id, instance, **parameters) for instance in range(2))
    state = advance(env, SEED, moment, *options)
    frozen = pickle.dumps(state)
    expected = transcript(env, 6)
    env.set_state(state)
    assert transcript(env, 6) == expected, "in the same instance"
    for copied in (pickle.loads(frozen), json_state.loads(json_state.dumps(state))):
        other.set_state(copied)
        assert other.get_state() == state
        assert transcript(other, 6) == expected, "in another instance"
    for each in (env, other):
        each.set_state(state)
    assert digest(*env.reset()) == digest(*other.reset()), "the next episode"
    assert pickle.dumps(state) == frozen


def test_state_of_a_moving_object_is_exact(picking, make):
    picking.reset(seed=0)
    item, twist = picking.scene["cube"], ((0.1, 0.0, 0.0), (0.0, 2.0, 1.0))
    picking.scene.world.place(item.body, item.pose._replace(position=(0.45, 0.0, 0.12)), twist)
    state = picking.get_state()
    assert state.world.twists[item.body.index] == twist
    expected, other = transcript(picking), make(PICKING, 1)
    other.set_state(state)
    assert transcript(other) == expected


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_keep_state_generators_and_seed(copied):
    env = make_env(PICKING, obs_size=16)
    spaces = (env.action_space, env.observation_space)
    for number, space in enumerate(spaces):
        space.seed(5 + number)
    advance(env, SEED, 1)
    other = copied(env)
    assert other.np_random_seed == env.np_random_seed and other.config == env.config
    copies = (other.action_space, other.observation_space)
    assert [digest(space.sample()) for space in copies] == [digest(space.sample()) for space in spaces]
    assert transcript(other, 6) == transcript(env, 6)
    assert digest(*other.reset()) == digest(*env.reset())


def test_seed_of_a_reset_to_a_state_determines_later_episodes(picking):
    later = []
    for state in (advance(picking, SEED, 1), advance(picking, 5, 2)):
        picking.reset(seed=11, options={"state": state})
        assert picking.np_random_seed == 11
        later.append(digest(*picking.reset()))
    assert later[0] == later[1]
    picking.set_state(state)
    assert picking.np_random_seed == -1  # Gymnasium's value for an unknown seed


def test_state_of_another_environment_is_rejected(make):
    for name, env_id, parameters in (
        ("robot", PICKING, {"robot": "panda"}),
        ("workspace", PICKING, {"workspace": [[0.32, 0.6], [-0.14, 0.14], [0.01, 0.25]]}),
        ("task", "BulletArm/CloseLoopBlockReaching-v0", {}),
        ("surface", PICKING, {"surface": "ramp"}),
        ("arm", PICKING, {"robot": replace(KUKA, gripper=replace(KUKA.gripper, force=40.0))}),
        ("num_objects", STACKING, {"num_objects": 3}),
        ("in_hand", STACKING, {"action_sequence": "pxyzrrr"}),
    ):
        env = make(PICKING if "CloseLoop" in env_id else env_id, obs_size=32)
        other = make_env(env_id, obs_size=32, **parameters)
        before = advance(env, SEED, 1)
        with pytest.raises(ValueError, match=rf"^state must be .*\b{name}=.*, got one with .*\b{name}="):
            env.set_state(advance(other, SEED, 1))
        assert env.get_state() == before


def test_state_of_changed_object_files_is_rejected(tmp_path):
    parameters = {"object_set": str(tmp_path), "num_objects": 1, "obs_size": 16}

    def make_with(side):
        (tmp_path / "box.obj").write_text(wavefront([Piece(Box((0.04, side, 0.04)))]))
        return make_env(GRASPING, **parameters)

    before, same, changed = make_with(0.05), make_with(0.05), make_with(0.06)
    state = advance(before, SEED, 1)
    same.set_state(state)
    with pytest.raises(ValueError, match=r"with object_files='crc .*', got one with object_files="):
        changed.set_state(state)


def test_json_keeps_values_and_types():
    for value in (
        *(None, True, -3, 2**80, 0.1 + 0.2, math.inf, "text", b"\x00\xff", (), (1, (2.5, "a")), [1, [2]]),
        *({"a": (1,), 2: b"x"}, (Pose.planar(1.0, 2.0, 3.0, 0.4), [None])),
    ):
        back = json_state.loads(json_state.dumps(value))
        assert back == value and type(back) is type(value)
    values = (np.float64(0.1), np.int64(3), np.bool_(True))
    assert json_state.loads(json_state.dumps(values)) == (0.1, 3, True)
    for value in (object(), {1, 2}, np.zeros(3), OrderedDict()):
        with pytest.raises(ValueError, match=f"^state must .*, got a {type(value).__name__}"):
            json_state.dumps((value,))


def test_loads_rejects_other_types_and_texts_and_imports_nothing():
    before = set(sys.modules)
    for name in ("this:x", "os:system", "bulletarm_gym.geometry:Mesh", "str"):
        with pytest.raises(ValueError, match=rf"^state type must be one of .*Pose.*, got '{name}'"):
            json_state.loads(json.dumps({name: []}))
    assert set(sys.modules) == before
    for text in (
        "",
        "{}",
        '{"Pose": 1}',
        '{"Pose": [[0, 0, 0]]}',
        '{"Pose": [1, 2, 3]}',
        '{"dict": [1]}',
        '{"bytes": 1}',
    ):
        with pytest.raises(ValueError):
            json_state.loads(text)


@dataclass(frozen=True)
class Count:
    number: int
    places: tuple[Pose, ...]


class Counting(BlockPicking):
    memory_types = (Count,)

    def after_action(self, scene, rng):
        number, places = (self.memory.number, self.memory.places) if self.memory else (0, ())
        self.memory = Count(number + 1, (*places, scene.robot.pose))


def test_state_does_not_share_the_memory_of_the_task(picking):
    picking.reset(seed=0)
    picking.task.memory = [1]
    state = picking.get_state()
    picking.task.memory.append(2)
    picking.set_state(state)
    picking.task.memory.append(3)
    assert state.memory == [1] and picking.task.memory == [1, 3]


def test_json_keeps_declared_memory():
    env = ManipulationEnv(f"{Counting.__module__}:Counting", "close_loop", obs_size=16)
    state = advance(env, 0, 3)
    back = json_state.loads(json_state.dumps(state))
    assert back == state and type(back.memory) is Count and back.memory.number == 3
    first = digest(*env.step(env.expert_action()))
    env.set_state(back)
    assert digest(*env.step(env.expert_action())) == first
    env.task.memory = make_dataclass("Undeclared", ["number"])(1)
    with pytest.raises(ValueError, match=r"got a Undeclared: .*memory_types"):
        json_state.dumps(env.get_state())


DERIVED = make_dataclass("Derived", [("number", int, field(init=False, default=0))])


@pytest.mark.parametrize("types", [(int,), (DERIVED,), [Count], (type("Pose", (Count,), {}),)], ids=str)
def test_memory_types_must_be_records_with_distinct_names(types):
    with pytest.raises(ValueError, match=r"^memory_types must .*, got "):
        type("Own", (BlockPicking,), {"memory_types": types})


def test_reloaded_modules_replace_their_memory_types():
    for _ in range(2):
        kind = make_dataclass("Reloaded", ["number"], namespace={"__module__": "elsewhere"})
        type("Own", (BlockPicking,), {"memory_types": (kind,)})
        assert type(json_state.loads(json_state.dumps(kind(1)))) is kind
