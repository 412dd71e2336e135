"""Parameters of environments: defaults, those of the paper's benchmarks, checks, errors with their reason."""

import json
import pickle
import re
from collections import UserDict, UserList
from contextlib import nullcontext

import gymnasium
import numpy as np
import pytest
from rollouts import PICKING, make_env

import bulletarm_gym
from bulletarm_gym.benchmarks import BENCHMARKS
from bulletarm_gym.config import PARAMETERS, Context, EnvConfig, ParameterError, TaskDefaults
from bulletarm_gym.geometry import PlacementError
from bulletarm_gym.randomization import Randomization
from bulletarm_gym.registry import PAPER, load

TASK = TaskDefaults(num_objects=2, max_steps=50, object_scale=0.8, allowed_objects=(2, 3))
WRIST = UserDict(name="wrist", sensor="rgb", size=UserList([20, 16]))
WORKSPACE = [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]]


def config(**parameters):
    return EnvConfig.of(Context("close_loop", TASK), parameters)


def open_loop(surface="flat", **parameters):
    return EnvConfig.of(Context("open_loop", TASK, surface), parameters)


def test_defaults_are_the_papers():
    made = config()
    assert made.workspace == WORKSPACE and made.home_height == 0.2
    assert (made.robot, made.action_sequence, made.max_steps, made.obs_size) == ("kuka", "pxyzr", 50, 128)
    assert made.object_scale_range == [0.8, 0.8] and made.num_objects == 2
    assert made.fast_mode and made.random_orientation and made.workspace_check == "point"
    assert config(**made.parameters()) == made
    assert set(made.parameters()) == set(PARAMETERS) - {"half_rotation", "in_hand_size"}
    for surface, sequence, size in (("flat", "pxyr", 24), ("ramp", "pxyzrrr", 24), ("bump", "pxyzrrr", 40)):
        made = open_loop(surface)
        assert made.workspace == [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]] and made.home_height == 0.4
        assert (made.action_sequence, made.in_hand_size, made.obs_size) == (sequence, size, 128)
        assert made.half_rotation and made.random_orientation and not made.close_loop_tray
        assert open_loop(surface, **made.parameters()) == made


OPEN_LOOP_WRONG = {
    "action_sequence": ["pxyzr", "pxyrr", "xyz", "px", "pxyzrrrr", "", None],
    "half_rotation": [1, "yes", None],
    "in_hand_size": [0, 7, 300, 24.0, True],
    "close_loop_tray": [False],
    "view": ["orthographic"],
    "observation": ["state"],
}


def test_unknown_parameter_is_a_value_and_a_type_error():
    """Libraries catch the type; Gymnasium constructs the error again."""
    for name, hint in (
        ("obs_sise", "'obs_size'"),
        ("frameskip", "robot, action_sequence, "),
        ("half_rotation", "open-loop"),
    ):
        with pytest.raises(ParameterError, match=f"^{name} must .*{hint}") as error:
            config(**{name: 1})
        copy = pickle.loads(pickle.dumps(error.value))
        assert type(copy) is type(error.value) and str(copy) == str(error.value)
        for make in (gymnasium.make, make_env):
            with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'") as raised:
                make(PICKING, **{name: 1})
            assert isinstance(raised.value, ValueError) and PICKING in str(raised.value)


WRONG = {
    "robot": [1, None],
    "randomization": [1, "heavy", ["light"], {"weight": 1.0}, {1: 1.0}],
    "action_sequence": ["pxy", "pxyzrr", "", "PXYZR", 5, None, ["p", "x", "y", "z", "r"]],
    "workspace": [
        None,
        WORKSPACE[:2],
        [[0.3, 0.6], [-0.15, 0.2], [0.01, 0.25]],
        [[0.3, 0.33], [-0.01, 0.02], [0.01, 0.25]],
        [[0.3, 0.6], [-0.15, 0.15], [0.25, 0.01]],
        [[0.3, float("inf")], [-0.15, float("inf")], [0.01, 0.25]],
        np.zeros((3, 2)),
    ],
    "object_scale_range": [0, -1.0, [1.0, 0.5], [1.0], [0.5, 3.0], "big", None, True, [float("nan"), 1.0]],
    "max_steps": [0, -1, 2.5, "50", None, True],
    "num_objects": [1, 4, 2.0, "2", None, True],
    "home_height": [0, -0.1, "high", None, True, [0.2], float("nan"), float("inf")],
    "lift_height": [0, -0.1, "high", None, True, 0.1, float("nan"), float("inf")],
    "obs_size": [0, 15, 1025, 64.0, "64", (64, 64), True],
    "fast_mode": [1, 0, "yes", None],
    "random_orientation": [1, "no", None],
    "workspace_check": ["box", None, 3],
    "close_loop_tray": [1, "yes", None],
    "object_set": [3, "no/such/folder", [], ["cube", 3]],
    "view": ["side", None],
    "observation": ["vec", None, {"heightmap": 1}, [3], []],
    "physics_mode": ["quick", None, 1],
    "reward": ["nomodule", "a:b:c", ":f", "m:", 3, len],
    "render_mode": ["rgb", "ansi", 1, True],
    "render_size": [8, 5000, 480.0, "large", [480], [480, 360, 3], [480, 0], None, True],
    "render_camera": ["top", [1.0], {"eye": [1.0, 0.0, 1.0]}, {"position": [1.0, 0.0]}, {"fov": True}],
}


def test_wrong_values_of_every_parameter_are_refused():
    assert {*WRONG, *OPEN_LOOP_WRONG} == set(PARAMETERS)
    for make, wrong in ((config, WRONG), (open_loop, OPEN_LOOP_WRONG)):
        for name, value in [(name, value) for name, values in wrong.items() for value in values]:
            with pytest.raises(ParameterError, match=rf"^{name} must .*, got ") as error:
                make(**{name: value})
            if make is open_loop:
                assert ("closed-loop" in str(error.value)) == (name in ("close_loop_tray", "view"))


def square(low, high, *z):
    """Return a workspace between two x, with y around 0."""
    half = (high - low) / 2.0
    return [[low, high], [-half, half], list(z)]


LOW = square(0.3, 0.6, 0.01, 0.11)
COMBINATIONS = [
    ("CloseLoopBlockPicking", {"num_objects": 3}, "num_objects"),
    ("CloseLoopBlockPulling", {"num_objects": 1}, "num_objects"),
    ("OpenLoopCovidTest", {"object_scale_range": 0.86}, "object_scale_range"),
    ("CloseLoopBlockStacking", {"object_scale_range": 1.5, "num_objects": 4}, "num_objects"),
    ("CloseLoopBlockPicking", {"object_scale_range": 2.0, "robot": "ur5_robotiq"}, "object_scale_range"),
    ("CloseLoopBlockPicking", {"object_scale_range": 1.46, "robot": "ur5"}, None),
    ("CloseLoopBlockPushing", {"object_scale_range": 2.0, "robot": "ur5"}, None),
    ("CloseLoopBlockPicking", {"workspace": square(0.3, 0.6, 0.01, 0.15)}, "workspace"),
    ("CloseLoopBlockPicking", {"workspace": square(0.3, 0.6, 0.01, 0.16)}, None),
    ("OpenLoopBlockStacking", {"workspace": square(0.3, 0.6, 0.0, 0.0155)}, "workspace"),
    ("OpenLoopBlockStacking", {"workspace": square(0.6, 0.9, 0.0, 1.0)}, "workspace"),
    ("CloseLoopBlockPicking", {"home_height": 0.26}, "home_height"),
    ("OpenLoopBlockStacking", {"home_height": 0.02}, "home_height"),
    ("CloseLoopBlockPicking", {"lift_height": 0.25}, "lift_height"),
    ("CloseLoopBlockPulling", {"lift_height": 0.1}, "lift_height"),
    ("CloseLoopBlockPicking", {"lift_height": 0.12, "workspace": LOW}, "lift_height"),
    ("CloseLoopCornerPicking", {"close_loop_tray": True}, "close_loop_tray"),
    ("CloseLoopObjectGrasping", {"close_loop_tray": False}, "close_loop_tray"),
    ("CloseLoopBlockPulling", {"close_loop_tray": True, "robot": "panda"}, "close_loop_tray"),
    ("CloseLoopBlockPulling", {"workspace": [[0.36, 0.6], [-0.09, 0.15], [0.01, 0.25]]}, None),
    ("CloseLoopBlockStacking", {"num_objects": 4, "object_scale_range": [0.8, 1.1]}, None),
    ("CloseLoopBlockInBowl", {"object_scale_range": 1.2}, None),
    ("OpenLoopCovidTest", {"workspace": [[0.35, 0.6], [-0.1, 0.15], [0.0, 1.0]]}, "workspace"),
    ("OpenLoopObjectGrasping", {"workspace": square(0.4, 0.5, 0, 1), "num_objects": 4}, "num_objects"),
    ("OpenLoopRampBlockStacking", {"object_scale_range": [0.6, 1.0]}, None),
]


@pytest.mark.parametrize(("name", "parameters", "refused"), COMBINATIONS, ids=str)
def test_combination_is_accepted_or_the_parameter_is_named(name, parameters, refused):
    """At the latest by a reset that finds no space."""
    value = re.escape(str(parameters.get(refused)).strip("[]"))
    expected = pytest.raises((ParameterError, PlacementError), match=rf"{refused}.* must .*, got .*{value}")
    with nullcontext() if refused is None else expected:
        env = make_env(f"BulletArm/{name}-v0", obs_size=16, **parameters)
        for seed in range(5):
            env.reset(seed=seed)


def test_array_likes_are_kept_as_plain_values():
    """Libraries of configurations have their own classes of lists and dicts."""
    for name, given, kept in (
        ("workspace", np.array(WORKSPACE), WORKSPACE),
        ("object_scale_range", (0.6, 1), [0.6, 1.0]),
        ("object_scale_range", 1, [1.0, 1.0]),
        ("max_steps", np.int64(9), 9),
        ("fast_mode", np.bool_(False), False),
        ("render_size", np.array([64, 48]), [64, 48]),
        ("randomization", Randomization(object_mass=(0.5, 2.0)), {"object_mass": [0.5, 2.0]}),
        ("render_camera", {"position": np.ones(3)}, {"position": [1.0, 1.0, 1.0]}),
        ("observation", np.array(["state", "holding"]), ["state", "holding"]),
        ("observation", np.array("state"), "state"),
        ("observation", UserList([WRIST]), [{"name": "wrist", "sensor": "rgb", "size": [20, 16]}]),
    ):
        value = getattr(config(**{name: given}), name)
        assert value == kept and type(value) is type(kept)
        json.dumps(value)


def test_scales_are_a_grid_with_both_ends():
    assert config(object_scale_range=[0.6, 0.7]).scales == [0.6, 0.62, 0.64, 0.66, 0.68, 0.7]
    for low, high in ((0.6, 0.63), (0.6, 0.61), (0.5, 0.535)):
        scales = config(object_scale_range=[low, high]).scales
        assert scales[0] == low and scales[-1] == high
        assert scales == sorted(set(scales)), "each once, in order, none beyond the end"


def test_configurations_share_no_values():
    for workspace in ([list(row) for row in WORKSPACE], np.array(WORKSPACE)):
        made = config(workspace=workspace)
        made.workspace[0][0] = 9.0
        assert np.array_equal(workspace, WORKSPACE)
    config().workspace[0][0] = 9.0
    assert config().workspace == WORKSPACE


EPISODES = {"CovidTest": 500, "Ramp": 1000, "OpenLoop": 200, "CloseLoop": 100}
"""Number of expert episodes by the first word that is in an id."""
SEQUENCES = {
    "open_loop_2d": "pxy",
    "open_loop_3d": "pxyr",
    "open_loop_6d": "pxyzrrr",
    "close_loop_3d": "pxyz",
    "close_loop_4d": "pxyzr",
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_benchmarks_have_the_papers_numbers(name):
    benchmark = BENCHMARKS[name]
    rotates = "r" in SEQUENCES[name]
    assert (benchmark.action_sequence, benchmark.random_orientation) == (SEQUENCES[name], rotates)
    for row in benchmark.environments:
        assert row.expert_episodes == next(count for word, count in EPISODES.items() if word in row.env_id)
        size = 40 if "Bump" in row.env_id else 24 if "OpenLoop" in row.env_id else None
        assert benchmark.make_kwargs(row).get("in_hand_size") == size
        kwargs = PAPER[row.env_id]
        context = Context(kwargs["control"], load(kwargs["task"]).defaults, kwargs["surface"])
        config = EnvConfig.of(context, benchmark.make_kwargs(row), kwargs.get("defaults"))
        assert (config.num_objects, config.max_steps) == (row.num_objects, row.max_steps)
        assert row.optimal_steps <= row.max_steps


def test_every_environment_of_the_benchmarks_is_registered():
    listed = {env.env_id for benchmark in BENCHMARKS.values() for env in benchmark.environments}
    assert set(bulletarm_gym.PAPER_IDS) == listed and len(listed) == 31
