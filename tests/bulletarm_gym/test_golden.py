"""Recorded rollouts: what moves them is a change of the environments, and asks for a new version of the ids.

Bits depend on the machine and on library versions, so they are compared only where they were recorded.
Record new environments with ``python tests/bulletarm_gym/test_golden.py``; what is recorded stays.
"""

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite.binding
import pytest
from rollouts import make_env, transcript

import bulletarm_gym

GOLDEN = Path(__file__).with_name("golden.json")
SEEDS = range(3)
LIBRARIES = ("numpy", "numba", "pybullet", "gymnasium")


def here() -> dict[str, str]:
    """What the bits depend on."""
    return {
        "machine": platform.machine(),
        "processor": llvmlite.binding.get_host_cpu_name(),
        "libc": "-".join(platform.libc_ver()),
        **{library: version(library) for library in LIBRARIES},
    }


def rollouts_of(env_id: str) -> list[list[str]]:
    env = make_env(env_id)
    lines = [transcript(env, 20, seed=seed, action_seed=seed) for seed in SEEDS]
    env.close()
    return lines


def recordings() -> list[dict[str, Any]]:
    """One for each machine that some were made on."""
    return list(json.loads(GOLDEN.read_text())) if GOLDEN.exists() else []


def recorded() -> dict[str, Any]:
    found = [one for one in recordings() if one["recorded_on"] == here()]
    if not found:
        pytest.skip(f"recorded on {[one['recorded_on'] for one in recordings()]}, this is {here()}")
    return dict(found[0]["rollouts"])


def test_rollouts_are_those_recorded(env_id: str) -> None:
    known = recorded()
    if env_id not in known and any(env_id in one["rollouts"] for one in recordings()):
        pytest.skip("changed since, and recorded on another machine only")
    assert env_id in known, "record the new environment, see the head of this file"
    assert rollouts_of(env_id) == known[env_id], (
        f"{env_id} behaves otherwise than recorded: if that is meant, its version must change (-v1), "
        "or before a release the recording; see the head of this file"
    )


def renew() -> None:
    """Record the rollouts of environments that have none yet on this machine, whole or not at all."""
    content = recordings()
    mine = next((one for one in content if one["recorded_on"] == here()), None)
    if mine is None:
        mine = {"recorded_on": here(), "rollouts": {}}
        content.append(mine)
    known = mine["rollouts"]
    known |= {env_id: rollouts_of(env_id) for env_id in bulletarm_gym.ENV_IDS if env_id not in known}
    temporary = GOLDEN.with_suffix(".part")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    os.replace(temporary, GOLDEN)


if __name__ == "__main__":
    renew()
    print(GOLDEN)
