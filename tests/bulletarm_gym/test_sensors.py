"""Observations as lists of built-in sensors and of sensors of users."""

import pickle
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from rollouts import advance, digest, make_env, transcript

import bulletarm_gym
from bulletarm_gym.config import PRESETS, ParameterError
from bulletarm_gym.demonstrations import collect
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations import SENSORS as CLASSES
from bulletarm_gym.observations import Sensor
from bulletarm_gym.registry import SENSORS

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
CAMERAS = [{"name": "rgb", "size": 32}, {"name": "point_cloud", "points": 200}]
ALL = ["heightmap", "color", "segmentation", *CAMERAS, "joint_state", "holding"]


def test_registry_names_every_sensor() -> None:
    assert tuple(SENSORS.builtin) == tuple(CLASSES)


@pytest.mark.parametrize(("env_id", "control"), [(PICKING, "close_loop"), (STACKING, "open_loop")])
def test_presets_are_lists(make: Make, env_id: str, control: str) -> None:
    for preset, sensors in PRESETS[control].items():
        named, listed = (make(env_id, observation=choice) for choice in (preset, sensors))
        assert named.observation_space == listed.observation_space
        assert transcript(named, 2, seed=1) == transcript(listed, 2, seed=1)


def test_lists_are_json_and_keep_their_order(make: Make) -> None:
    env = make(PICKING, observation=("holding", {"name": "state"}, "heightmap"))
    assert list(env.reset(seed=0)[0]) == ["holding", "state", "heightmap"]
    assert env.spec is not None and env.spec.kwargs["observation"] == [
        "holding",
        {"name": "state"},
        "heightmap",
    ]
    copy = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert copy.observation_space == env.observation_space
    copy.close()


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_spaces_and_states_of_all_sensors(make: Make, env_id: str) -> None:
    env, other = (make(env_id, instance, observation=ALL) for instance in range(2))
    check_env(env, skip_render_check=True)
    shapes = {name: space.shape for name, space in env.observation_space.items()}
    assert shapes == {
        "heightmap": (1, 128, 128), "color": (3, 128, 128), "segmentation": (1, 128, 128),
        "rgb": (3, 32, 32), "point_cloud": (200, 3), "joint_state": (8,), "holding": (1,),
    }  # fmt: skip
    other.set_state(advance(env, 3, 2))
    assert digest(other.observe()) == digest(env.observe())
    assert transcript(env, 2) == transcript(other, 2)


def test_actions_do_not_depend_on_what_is_observed(make: Make) -> None:
    """Their heights follow from the heightmap, whether or not the agent observes it."""
    env, plain = make(STACKING, observation=["holding"]), make(STACKING)
    for each in (env, plain):
        each.reset(seed=2)
    assert env.get_state().sensors == {}
    for _ in range(4):
        action = plain.expert_action()
        assert digest(*env.step(action)[1:]) == digest(*plain.step(action)[1:])
        assert env.get_state().world == plain.get_state().world


def test_state_fits_environments_that_observe_less(make: Make) -> None:
    env, less = make(STACKING), make(STACKING, observation=["heightmap", "holding"])
    env.reset(seed=0)
    env.step(env.expert_action())
    less.set_state(env.get_state())
    assert np.array_equal(less.observe()["heightmap"], env.observe()["heightmap"])
    with pytest.raises(ValueError, match="in_hand"):
        env.set_state(less.get_state())


def test_actions_use_the_scene_as_it_is(make: Make) -> None:
    """A user may have moved something since the last observation."""
    env = make(STACKING)
    env.reset(seed=0)
    first, *others = env.scene
    first.place(Pose.planar(0.45, 0.0, 0.015))
    for number, item in enumerate(others):
        item.place(Pose.planar(0.3, -0.15 + 0.1 * number, 0.015))
    observation, *_ = env.step([-1.0, 0.0, 0.0, -1.0])
    assert observation["holding"] == 1.0 and observation["in_hand"].max() > 0.02


def test_joint_state_gives_the_tool_pose(make: Make) -> None:
    env = make(PICKING, observation=["joint_state"])
    env.reset(seed=0)
    observation, *_ = env.step([1.0, 0.5, 0.5, -0.5, 0.5])
    *joints, opening = observation["joint_state"]
    pose = env.scene.robot.model.chain.forward(np.array(joints, float))
    assert pose.position == pytest.approx(env.scene.robot.pose.position, abs=1e-5)
    assert opening == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("env_id", "observation", "words"),
    [
        (PICKING, ["holding", "heigthmap"], "'heightmap'"),
        (PICKING, ["my_sensors:Force"], "'my_sensors:Force'"),
        (PICKING, [], "a list of some of"),
        (PICKING, "heightmap", "a list of some of"),
        (PICKING, ["holding", "holding"], "distinct names"),
        (PICKING, [3], "names and dicts"),
        (PICKING, [{"sensor": "holding"}], "names and dicts"),
        (PICKING, ["holding", {"name": "a b", "sensor": "state"}], "identifier"),
        (PICKING, [{"name": "holding", "size": 3}], "size"),
        (PICKING, [{"name": "holding", "size": {3}}], "JSON values"),
        (PICKING, [{"name": "mine", "sensor": "json:dumps"}], "subclass of Sensor"),
        (PICKING, [{"name": "mine", "sensor": "no_such_module:Sensor"}], "cannot be imported"),
        (PICKING, [{"name": "rgb", "sensor": "state"}], "distinct names"),
        (
            PICKING,
            [{"name": "rgb", "position": [1.0, 2.0]}],
            "position must be [x, y, z] in metres, got [1.0, 2.0]",
        ),
        (
            PICKING,
            [{"name": "rgb", "position": [0, 0, 1], "target": [0, 0, 1]}],
            "another point than position",
        ),
        (PICKING, [{"name": "rgb", "size": 8}], "got 8"),
        (PICKING, [{"name": "rgb", "fov": 180}], "fov must be a number of degrees from 1 to 170, got 180"),
        (PICKING, [{"name": "rgb", "fow": 60}], "fow"),
        (PICKING, [{"name": "point_cloud", "points": 0}], "points must be an integer of at least 1"),
        (PICKING, ["rgb", {"name": "render", "sensor": "rgb"}], "two cameras would be called 'render'"),
        (PICKING, ["in_hand"], "'in_hand' of open_loop"),
        (STACKING, ["heightmap", "state"], "'state' of close_loop"),
        (STACKING, "state", "'image', or a list of some of"),
    ],
    ids=str,
)
def test_observation_must_be_valid(env_id: str, observation: Any, words: str) -> None:
    with pytest.raises(ParameterError, match=r"^observation") as error:
        make_env(env_id, observation=observation)
    assert words in str(error.value)


@pytest.mark.parametrize("name", ["color", "segmentation"])
def test_labels_need_the_orthographic_view(name: str) -> None:
    with pytest.raises(ParameterError, match=r"view must be .*, got 'point_cloud'"):
        make_env(PICKING, view="point_cloud", observation=["heightmap", name])


# Sensors of users

SOURCE = '''
import numpy as np
from gymnasium import spaces

from bulletarm_gym.observations import Sensor


class Count(Sensor):
    """Number of actions, and by how much the last one raised the fingertips."""

    def __init__(self, scene, start=0):
        super().__init__(scene)
        self.start = start

    space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def read(self, view):
        count, height = self.memory or (self.start, view.frame.origin.z)
        return np.array([count, view.frame.origin.z - height], np.float32)

    def follow(self, before, pick):
        count, _ = self.memory or (self.start, 0.0)
        self.memory = (count + 1, before.frame.origin.z)


class Unfinished(Sensor):
    """Reads nothing."""


class Wrong(Sensor):
    space = spaces.Box(0.0, 1.0, (2,), np.float32)
    def read(self, view):
        return self.returned

class Shape(Wrong):
    returned = np.zeros(3, np.float32)

class Type(Wrong):
    returned = np.zeros(2)

class List(Wrong):
    returned = [0.0, 0.0]

class Discrete(Wrong):
    space = spaces.Discrete(2)

class Late(Wrong):
    def read(self, view):
        return view.labels[0, :2].astype(np.float32)
    def follow(self, before, pick):
        vars(before).pop("labels")
        before.labels
'''
DOWN = [1.0, 0.0, 0.0, -0.5, 0.0]


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("sensors")
    (folder / "my_counting.py").write_text(SOURCE)
    sys.path.insert(0, str(folder))
    yield __import__("my_counting")
    sys.path.remove(str(folder))
    del sys.modules["my_counting"]
    SENSORS.paths.pop("count", None)


@pytest.fixture
def counting(module: Any) -> Iterator[Any]:
    bulletarm_gym.register_sensor("count", module.Count)
    made = gymnasium.make(PICKING, observation=[{"name": "count", "start": 5}, "holding"], obs_size=16)
    yield made.unwrapped
    made.close()


def test_own_sensor_reads_and_remembers(counting: Any) -> None:
    for _ in range(2):
        assert counting.reset(seed=0)[0]["count"].tolist() == [5.0, 0.0]
        for number in (6, 7):
            observation, *_ = counting.step(DOWN)
            np.testing.assert_allclose(observation["count"], [number, -0.025], atol=1e-4)
    state = counting.get_state()
    copy = pickle.loads(pickle.dumps(counting))
    counting.step(DOWN)
    counting.set_state(state)
    for each in (counting, copy):
        assert digest(each.observe()) == digest(observation)
    copy.close()


def test_spec_has_the_path_of_an_own_sensor(counting: Any) -> None:
    entry = {"name": "count", "start": 5, "sensor": "my_counting:Count"}
    assert counting.spec.kwargs["observation"] == [entry, "holding"]
    SENSORS.paths.pop("count")
    copy = gymnasium.make(counting.spec)
    assert copy.observation_space == counting.observation_space
    copy.close()


def test_demonstrations_keep_own_sensors(counting: Any) -> None:
    recorded = collect(PICKING, 1, env_kwargs={"observation": ["count", "color"]}, seed=0)
    (episode,) = recorded
    assert episode.observations["count"][:, 0].tolist() == list(range(len(episode) + 1))
    again = recorded.make_env()
    observation, _ = again.reset(seed=episode.seed)
    assert np.array_equal(observation["color"], episode.observations["color"][0])
    again.close()


@pytest.mark.parametrize(
    ("name", "sensor", "words"),
    [
        ("color", "my_counting:Count", "^name must be unused, got 'color'"),
        ("count", "my_counting:Unfinished", "^name must be unused, got 'count'"),
        ("two words", "my_counting:Count", "^name must be an identifier"),
        ("other", lambda scene: None, "lambda"),
        ("other", type("Local", (Sensor,), {"__qualname__": "f.<locals>.Local"}), "local to a function"),
        ("other", "my_counting:Missing", "cannot be imported"),
    ],
)
def test_registered_sensors_need_a_new_name_and_a_path(
    counting: Any, name: str, sensor: Any, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        bulletarm_gym.register_sensor(name, sensor)


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        ("my_counting:Unfinished", "mine: .*abstract"),
        ("my_counting:spaces", "must be .*'my_counting:spaces'"),
        ("my_counting:Shape", r"mine: .*float32 of the shape \(2,\), got ndarray float32 \(3,\)"),
        ("my_counting:Type", r"mine: .*float32 .* got ndarray float64 \(2,\)"),
        ("my_counting:List", "mine: .*float32 .* got list"),
        ("my_counting:Discrete", "mine: space must be a Box, got Discrete"),
    ],
)
def test_own_sensors_are_checked(module: Any, sensor: str, reason: str) -> None:
    with pytest.raises(ValueError, match=f"^observation:? {reason}"):
        gymnasium.make(PICKING, observation=[{"name": "mine", "sensor": sensor}], obs_size=16).reset(seed=0)


def test_labels_of_an_earlier_scene_are_not_available(module: Any) -> None:
    env = gymnasium.make(PICKING, observation=[{"name": "mine", "sensor": "my_counting:Late"}], obs_size=16)
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="labels must be read before the scene changes"):
        env.step(np.array(DOWN, np.float32))
    env.close()
