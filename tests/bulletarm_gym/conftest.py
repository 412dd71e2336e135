"""Fixtures of the environments' tests: ids, instances that last the whole session, another process."""

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
KEPT = 12
"""Number of shared environments that stay open; one needs some 40 MB."""
sys.path.insert(0, str(HERE))  # for the module of rollouts, which also runs as a script
sys.path.insert(1, str(HERE.parents[1] / "examples"))  # for small_arm

import rollouts  # noqa: E402

import bulletarm_gym  # noqa: E402
from bulletarm_gym.env import ManipulationEnv  # noqa: E402


@pytest.fixture(scope="session", params=bulletarm_gym.ENV_IDS, ids=lambda env_id: env_id.split("/")[1])
def env_id(request: pytest.FixtureRequest) -> str:
    """Every registered id in turn."""
    return str(request.param)


@pytest.fixture(scope="session", params=bulletarm_gym.PAPER_IDS, ids=lambda env_id: env_id.split("/")[1])
def paper_id(request: pytest.FixtureRequest) -> str:
    """Every id of the paper."""
    return str(request.param)


@pytest.fixture(scope="session", params=rollouts.TYPICAL, ids=lambda env_id: env_id.split("/")[1])
def typical_id(request: pytest.FixtureRequest) -> str:
    """An id of each kind."""
    return str(request.param)


@pytest.fixture(scope="session")
def make() -> Iterator[Callable[..., ManipulationEnv]]:
    """Make environments that tests share, up to :data:`KEPT` at once; ``instance`` tells equal ones apart."""
    made: dict[str, ManipulationEnv] = {}

    def get(env_id: str, instance: int = 0, **parameters: Any) -> ManipulationEnv:
        key = json.dumps([env_id, instance, parameters], sort_keys=True)
        env = made.pop(key, None)
        made[key] = env = env or rollouts.make_env(env_id, **parameters)
        if len(made) > KEPT:
            made.pop(next(iter(made))).close()
        return env

    yield get
    for env in made.values():
        env.close()


@pytest.fixture
def env(make: Callable[..., ManipulationEnv], env_id: str) -> ManipulationEnv:
    """The shared instance of each id with its default parameters."""
    return make(env_id)


@pytest.fixture
def typical_env(make: Callable[..., ManipulationEnv], typical_id: str) -> ManipulationEnv:
    """The shared instance of an id of each kind."""
    return make(typical_id)


@pytest.fixture
def picking(make: Callable[..., ManipulationEnv]) -> ManipulationEnv:
    """The shared instance of the picking task."""
    return make("BulletArm/CloseLoopBlockPicking-v0")


@pytest.fixture(scope="session")
def in_another_process() -> Callable[[dict[str, Any]], dict[str, list[str]]]:
    """Return the rollouts of another process, see the module of rollouts."""

    def ask(requests: dict[str, Any]) -> dict[str, list[str]]:
        command = [sys.executable, str(HERE / "rollouts.py")]
        path = os.pathsep.join([str(HERE.parent.parent), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": path, "PYTHONHASHSEED": "7"}
        child = subprocess.run(
            command, input=pickle.dumps(requests), capture_output=True, check=False, env=environment
        )
        assert child.returncode == 0, child.stderr.decode()
        answers: dict[str, list[str]] = json.loads(child.stdout[child.stdout.index(b"{") :])
        return answers

    return ask
