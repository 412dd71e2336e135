"""Fixtures of the environments' tests: ids, and instances that last the whole session."""

import json
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
KEPT = 12
"""Number of shared environments that stay open; one needs some 40 MB."""
sys.path.insert(0, str(HERE))  # for the module of rollouts, which also runs as a script
sys.path.insert(1, str(HERE.parents[1] / "examples"))  # for small_arm

import rollouts  # noqa: E402

import bulletarm_gym  # noqa: E402
from bulletarm_gym.demonstrations import collect  # noqa: E402


@pytest.fixture(scope="session", params=bulletarm_gym.ENV_IDS, ids=lambda env_id: env_id.split("/")[1])
def env_id(request):
    """Every registered id in turn."""
    return str(request.param)


@pytest.fixture(scope="session", params=rollouts.TYPICAL, ids=lambda env_id: env_id.split("/")[1])
def typical_id(request):
    """An id of each kind."""
    return str(request.param)


@pytest.fixture(scope="session")
def make():
    """Make environments that tests share, up to :data:`KEPT` at once; ``instance`` tells equal ones apart.

    With a seed they are reset.
    """
    made = {}

    def get(env_id, instance=0, *, seed=None, **parameters):
        key = json.dumps([env_id, instance, parameters], sort_keys=True)
        env = made.pop(key, None)
        made[key] = env = env or rollouts.make_env(env_id, **parameters)
        if len(made) > KEPT:
            made.pop(next(iter(made))).close()
        if seed is not None:
            env.reset(seed=seed)
        return env

    yield get
    for env in made.values():
        env.close()


@pytest.fixture(scope="session")
def picked():
    """Two recorded episodes of the picking task with images."""
    return collect(rollouts.PICKING, 2, seed=3, env_kwargs={"obs_size": 32})


@pytest.fixture
def typical_env(make, typical_id):
    """The shared instance of an id of each kind."""
    return make(typical_id)


@pytest.fixture
def picking(make):
    """The shared instance of the picking task."""
    return make(rollouts.PICKING)
