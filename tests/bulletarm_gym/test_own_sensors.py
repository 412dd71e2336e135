"""Sensors of users: registered by name, found by path, their memory part of the state."""

import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import bulletarm_gym
from bulletarm_gym.demonstrations import collect
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations import Sensor
from bulletarm_gym.registry import SENSORS

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
SOURCE = '''
import numpy as np
from gymnasium import spaces

from bulletarm_gym.observations import Sensor


class Count(Sensor):
    """How many actions there were, and by how much the last one raised the fingertips."""

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
'''
Make = Callable[..., ManipulationEnv]


@pytest.fixture(scope="module", autouse=True)
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("sensors")
    (folder / "my_counting.py").write_text(SOURCE)
    sys.path.insert(0, str(folder))
    yield __import__("my_counting")
    sys.path.remove(str(folder))
    del sys.modules["my_counting"]
    SENSORS.paths.pop("count", None)


@pytest.fixture
def env(module: Any) -> Iterator[ManipulationEnv]:
    bulletarm_gym.register_sensor("count", module.Count)
    made = gymnasium.make(PICKING, observation=["count", "holding"])
    yield made.unwrapped
    made.close()


def test_it_reads_and_remembers(env: ManipulationEnv) -> None:
    assert env.reset(seed=0)[0]["count"].tolist() == [0.0, 0.0]
    for number in (1, 2):
        observation, *_ = env.step([1.0, 0.0, 0.0, -0.5, 0.0])
        np.testing.assert_allclose(observation["count"], [number, -0.025], atol=1e-4)
    assert env.reset(seed=0)[0]["count"].tolist() == [0.0, 0.0]


def test_its_memory_is_part_of_the_state(env: ManipulationEnv) -> None:
    env.reset(seed=0)
    env.step([1.0, 0.0, 0.0, -0.5, 0.0])
    state, seen = env.get_state(), env.observe()["count"]
    copy = pickle.loads(pickle.dumps(env))
    env.step([1.0, 0.0, 0.0, -0.5, 0.0])
    env.set_state(state)
    for each in (env, copy):
        assert np.array_equal(each.observe()["count"], seen)
    copy.close()


def test_the_spec_names_its_path(env: ManipulationEnv) -> None:
    entry = {"name": "count", "sensor": "my_counting:Count"}
    assert env.spec.kwargs["observation"] == [entry, "holding"]
    SENSORS.paths.pop("count")
    copy = gymnasium.make(env.spec)
    assert copy.observation_space == env.observation_space
    copy.close()


def test_parameters_reach_it(env: ManipulationEnv) -> None:
    other = gymnasium.make(PICKING, observation=[{"name": "count", "start": 5}])
    assert other.reset(seed=0)[0]["count"][0] == 5
    other.close()


def test_demonstrations_keep_what_it_read(env: ManipulationEnv) -> None:
    recorded = collect(PICKING, 1, env_kwargs={"observation": ["count", "color"]}, seed=0)
    (episode,) = recorded
    assert episode.observations["count"][:, 0].tolist() == list(range(len(episode) + 1))
    assert episode.observations["color"].dtype == np.uint8
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
        ("other", "my_counting:Missing", "cannot be imported"),
    ],
)
def test_names_and_classes_that_are_refused(env: ManipulationEnv, name: str, sensor: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        bulletarm_gym.register_sensor(name, sensor)


def test_a_class_local_to_a_function_is_refused() -> None:
    class Local(Sensor):
        pass

    with pytest.raises(ValueError, match="local to a function"):
        bulletarm_gym.register_sensor("local", Local)


@pytest.mark.parametrize("path", ["my_counting:Unfinished", "my_counting:spaces", Path.__module__ + ":Path"])
def test_what_is_no_whole_sensor_is_refused(path: str) -> None:
    with pytest.raises(ValueError, match=r"^observation must be "):
        gymnasium.make(PICKING, observation=[{"name": "mine", "sensor": path}])


WRONG = """
import numpy as np
from gymnasium import spaces
from bulletarm_gym.observations import Sensor

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
    returned = 0
"""


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("Shape", r"must return an array of float32 of the shape \(2,\), got float32 of the shape \(3,\)"),
        ("Type", r"must return an array of float32 .* got float64 of the shape \(2,\)"),
        ("List", "must return an array of float32 .* got list"),
        ("Discrete", "space must be a Box, got Discrete"),
    ],
)
def test_a_reading_outside_its_space_is_refused(
    name: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wrong_sensors.py").write_text(WRONG)
    monkeypatch.syspath_prepend(tmp_path)
    sensor = {"name": "mine", "sensor": f"wrong_sensors:{name}"}
    with pytest.raises(ValueError, match=f"^observation: mine: .*{reason}"):
        gymnasium.make(PICKING, observation=[sensor]).reset(seed=0)
