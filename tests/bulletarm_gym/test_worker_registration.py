"""Worker processes find registered components by name."""

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

import bulletarm_gym
from bulletarm_gym import registry

PARTS = """
import dataclasses

import numpy as np
from gymnasium import spaces

from bulletarm_gym.objects import BodySpec, Box, Piece
from bulletarm_gym.control import CloseLoop
from bulletarm_gym.robots import KUKA
from bulletarm_gym.observations import Sensor
from bulletarm_gym.surfaces import FlatSurface
from bulletarm_gym.tasks.picking import BlockPicking

def arm():
    return dataclasses.replace(KUKA, name="arm")

class Zero(Sensor):
    space = spaces.Box(0.0, 1.0, (1,), np.float32)

    def read(self, view):
        return np.zeros(1, np.float32)

class Raised(FlatSurface):
    slide = 0.0

class Backwards(CloseLoop):
    sequences = ("rzyxp",)

class Picking(BlockPicking):
    pass

def tile(name, scale):
    return BodySpec(name, (Piece(Box((0.08 * scale, 0.03 * scale, 0.04 * scale))),), mass=0.3)
"""
PREFIX = "bulletarm_gym:BulletArm/"


@pytest.fixture
def registered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Everything that can be registered; the task's id."""
    (tmp_path / "my_parts.py").write_text(PARTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    bulletarm_gym.register_robot("mine", "my_parts:arm")
    bulletarm_gym.register_object("tile", "my_parts:tile")
    bulletarm_gym.register_sensor("zero", "my_parts:Zero")
    bulletarm_gym.register_surface("raised", "my_parts:Raised")
    bulletarm_gym.register_control("backwards", "my_parts:Backwards")
    yield bulletarm_gym.register_task("Mine", "my_parts:Picking", "backwards", "raised")
    sys.modules.pop("my_parts", None)
    for one in (registry.ROBOTS, registry.OBJECTS, registry.SENSORS, registry.SURFACES, registry.CONTROLS):
        for name in [name for name, path in one.paths.items() if path.startswith("my_parts:")]:
            del one.paths[name]


PARAMETERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("CloseLoopBlockPicking-v0", {"robot": "mine", "observation": ["heightmap", "zero"]}),
    ("CloseLoopBlockPicking-v0", {"surface": "raised", "control": "backwards"}),
    ("CloseLoopObjectGrasping-v0", {"object_set": ["tile"], "num_objects": 1, "object_scale_range": 0.5}),
    ("BackwardsRaisedMine-v0", {}),
)


@pytest.mark.usefixtures("registered", "own_registrations")
def test_spawned_workers_find_what_is_registered() -> None:
    makers = [
        partial(gymnasium.make, f"{PREFIX}{env_id}", obs_size=16, **more) for env_id, more in PARAMETERS
    ]
    for make in makers:
        vector = AsyncVectorEnv([make], context="spawn")
        observations, _ = vector.reset(seed=0)
        with make() as env:
            expected, _ = env.reset(seed=0)
        np.testing.assert_array_equal(observations["heightmap"][0], expected["heightmap"])
        vector.close()


@pytest.mark.usefixtures("own_registrations")
def test_those_of_sb3_too(registered: str) -> None:
    env = make_vec_env(
        f"bulletarm_gym:{registered}",
        1,
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "spawn"},
        env_kwargs={"robot": "mine", "obs_size": 16},
    )
    env.reset()
    assert env.get_attr("action_sequence") == ["rzyxp"]
    env.close()


def test_what_somebody_else_has_put_there_is_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("not JSON", "[1]"):
        monkeypatch.setenv(registry.VARIABLE, text)
        assert registry.published("robot") == {}
