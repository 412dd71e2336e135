"""Observations are composed from sensors by name."""

import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from rollouts import digest, is_open_loop, make_env, transcript

from bulletarm_gym.config import PRESETS, ParameterError
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations import SENSORS as CLASSES
from bulletarm_gym.registry import SENSORS

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"


def test_every_name_has_a_sensor() -> None:
    assert tuple(SENSORS.builtin) == tuple(CLASSES)


@pytest.mark.parametrize("preset", ["image", "state"])
def test_presets_are_lists_by_another_name(make: Make, typical_id: str, preset: str) -> None:
    control = "open_loop" if is_open_loop(typical_id) else "close_loop"
    if preset not in PRESETS[control]:
        pytest.skip("the preset belongs to the other control")
    named, listed = (
        make(typical_id, observation=preset),
        make(typical_id, observation=PRESETS[control][preset]),
    )
    assert named.observation_space == listed.observation_space
    assert transcript(named, 6, seed=1) == transcript(listed, 6, seed=1)


def test_a_list_is_json_and_keeps_its_order(make: Make) -> None:
    env = make(PICKING, observation=("holding", {"name": "state"}, "heightmap"))
    assert list(env.reset(seed=0)[0]) == ["holding", "state", "heightmap"]
    assert env.spec.kwargs["observation"] == ["holding", {"name": "state"}, "heightmap"]
    copy = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())).unwrapped
    assert copy.observation_space == env.observation_space
    copy.close()


def test_what_is_not_asked_for_is_not_there(make: Make) -> None:
    env = make(STACKING, observation=["heightmap"])
    observation, _ = env.reset(seed=0)
    assert list(observation) == ["heightmap"] and env.get_state().sensors == {}
    env.step(env.expert_action())
    assert env.scene.held is not None


def test_actions_do_not_depend_on_what_is_observed(make: Make) -> None:
    """Their heights follow from the heightmap, whether or not the agent sees it."""
    env, plain = make(STACKING, observation=["holding"]), make(STACKING)
    for each in (env, plain):
        each.reset(seed=2)
    for _ in range(4):
        action = plain.expert_action()
        assert digest(*env.step(action)[1:]) == digest(*plain.step(action)[1:])
        assert env.get_state().world == plain.get_state().world


def test_a_state_serves_environments_that_observe_less(make: Make) -> None:
    env, less = make(STACKING), make(STACKING, observation=["heightmap", "holding"])
    env.reset(seed=0)
    env.step(env.expert_action())
    less.set_state(pickle.loads(pickle.dumps(env.get_state())))
    assert np.array_equal(less.observe()["heightmap"], env.observe()["heightmap"])
    with pytest.raises(ValueError, match="in_hand"):
        env.set_state(less.get_state())


def test_actions_see_the_scene_as_it_is(make: Make) -> None:
    """A user may have moved something since the last observation."""
    env = make(STACKING)
    env.reset(seed=0)
    first, *others = env.scene
    first.place(first.pose.__class__.planar(0.45, 0.0, 0.015))
    for number, item in enumerate(others):
        item.place(item.pose.__class__.planar(0.3, -0.15 + 0.1 * number, 0.015))
    observation, *_ = env.step([-1.0, 0.0, 0.0, -1.0])
    assert observation["holding"] == 1.0 and observation["in_hand"].max() > 0.02


WRONG: dict[str, Any] = {
    "heigthmap": "'heightmap'",
    "odometry": "'heightmap', ",
    "my_sensors:Force": "'my_sensors:Force'",
}


@pytest.mark.parametrize("name", WRONG)
def test_unknown_names(make: Make, name: str) -> None:
    with pytest.raises(ParameterError, match=r"^observation must be .*, got ") as error:
        make(PICKING, observation=["holding", name])
    assert WRONG[name] in str(error.value)


@pytest.mark.parametrize(
    ("env_id", "observation", "words"),
    [
        (PICKING, [], "a list of some of"),
        (PICKING, "heightmap", "a list of some of"),
        (PICKING, ["holding", "holding"], "distinct names"),
        (PICKING, [3], "names and dicts"),
        (PICKING, [{"sensor": "holding"}], "names and dicts"),
        (PICKING, ["holding", {"name": "a b", "sensor": "state"}], "identifier"),
        (PICKING, [{"name": "holding", "size": 3}], "no parameters, not size"),
        (PICKING, [{"name": "holding", "size": {3}}], "JSON values"),
        (PICKING, [{"name": "mine", "sensor": "json:dumps"}], "subclass of Sensor"),
        (PICKING, [{"name": "mine", "sensor": "no_such_module:Sensor"}], "cannot be imported"),
        (PICKING, [{"name": "rgb", "sensor": "state"}], "distinct names"),
        (
            PICKING,
            [{"name": "rgb", "position": [1.0, 2.0]}],
            "rgb: position must be [x, y, z] in metres, got [1.0, 2.0]",
        ),
        (
            PICKING,
            [{"name": "rgb", "position": [0, 0, 1], "target": [0, 0, 1]}],
            "another point than position",
        ),
        (
            PICKING,
            [{"name": "rgb", "size": 8}],
            "got 8",
        ),
        (PICKING, [{"name": "rgb", "fov": 180}], "fov must be a number of degrees from 1 to 170, got 180"),
        (PICKING, [{"name": "rgb", "fow": 60}], "position, target, size, fov, mount, not fow"),
        (
            PICKING,
            [{"name": "point_cloud", "points": 0}],
            "points must be an integer of at least 1 and at most 65536, got 0",
        ),
        (PICKING, ["rgb", {"name": "render", "sensor": "rgb"}], "two cameras would be called 'render'"),
        (PICKING, ["in_hand"], "'in_hand' belongs to open-loop environments"),
        (STACKING, ["heightmap", "state"], "'state' belongs to close-loop environments"),
        (STACKING, "state", "'image', or a list of some of"),
    ],
    ids=str,
)
def test_refusals_name_the_reason(env_id: str, observation: Any, words: str) -> None:
    with pytest.raises(ParameterError, match=r"^observation") as error:
        make_env(env_id, observation=observation)
    assert words in str(error.value)
