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


def recorded() -> dict[str, Any]:
    if not GOLDEN.exists():
        pytest.skip("nothing is recorded yet")
    content: dict[str, Any] = json.loads(GOLDEN.read_text())
    if content["recorded_on"] != here():
        pytest.skip(f"recorded on {content['recorded_on']}, this is {here()}")
    return content


def test_rollouts_are_those_recorded(env_id: str) -> None:
    content = recorded()["rollouts"]
    assert env_id in content, "record the new environment, see the head of this file"
    assert rollouts_of(env_id) == content[env_id], (
        f"{env_id} behaves otherwise than recorded: if that is meant, its version must change (-v1), "
        "or before a release the recording; see the head of this file"
    )


def renew() -> None:
    """Record the rollouts of environments that have none yet, whole or not at all.

    On another machine, or with other versions, all of them.
    """
    content = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    if content.get("recorded_on") != here():
        content = {"recorded_on": here(), "rollouts": {}}
    known = content["rollouts"]
    known |= {env_id: rollouts_of(env_id) for env_id in bulletarm_gym.ENV_IDS if env_id not in known}
    temporary = GOLDEN.with_suffix(".part")
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    os.replace(temporary, GOLDEN)


if __name__ == "__main__":
    renew()
    print(GOLDEN)
