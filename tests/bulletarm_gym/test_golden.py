"""Recorded rollouts: a change of the environments' results requires a new version of the ids.

Bits depend on the machine and on library versions, so digests are compared only where they were recorded. The
first steps of the expert are compared everywhere: most of their values are equal within a tolerance.
Record new environments with ``python tests/bulletarm_gym/test_golden.py``. Present records are kept.
"""

import json
import platform
from contextlib import closing
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding
import numpy as np
import pytest
from rollouts import make_env, transcript

import bulletarm_gym

DIGESTS = Path(__file__).with_name("golden.json")
VALUES = Path(__file__).with_name("golden_values.json")
SEEDS = range(3)
STEPS = 4
"""Number of steps of the expert whose values are recorded."""
TOLERANCE, RELATIVE = 0.01, 0.001
"""Largest difference of mean observations (m) and actions between processors, also relative to the value."""
MAY_DIFFER = {"CloseLoop": 0.05, "OpenLoop": 0.2}
"""Fraction of the values that may differ more, because contacts amplify the last bits of a processor."""
CLUTTER_MAY_DIFFER = 0.4
"""The same for single picks from clutter, where the expert may choose another object."""
LIBRARIES = ("numpy", "numba", "pybullet", "gymnasium")


def here():
    """Return what the bits depend on."""
    return {
        "machine": platform.machine(),
        "processor": llvmlite.binding.get_host_cpu_name(),
        "libc": "-".join(platform.libc_ver()),
        **{library: version(library) for library in LIBRARIES},
    }


def digests_of(env_id):
    with closing(make_env(env_id)) as env:
        return [transcript(env, 20, seed=seed, action_seed=seed) for seed in SEEDS]


def values_of(env_id):
    """Return mean observations, action and reward of the first steps of the expert."""
    rows = []
    with closing(make_env(env_id)) as env:
        env.reset(seed=0)
        for _ in range(STEPS):
            action = env.expert_action()
            observation, reward, terminated, truncated, _ = env.step(action)
            means = [float(array.mean()) for _, array in sorted(observation.items())]
            rows.append([round(number, 3) for number in (*means, *action.tolist(), reward)])
            if terminated or truncated:
                break
    return rows


def recordings():
    """Return the digests of each machine on which some were recorded."""
    return list(json.loads(DIGESTS.read_text())) if DIGESTS.exists() else []


def test_digests_are_those_recorded_on_this_machine(env_id):
    known = next((one["rollouts"] for one in recordings() if one["recorded_on"] == here()), {})
    if env_id not in known and any(env_id in one["rollouts"] for one in recordings()):
        pytest.skip(f"recorded on {[one['recorded_on'] for one in recordings()]}, this is {here()}")
    assert digests_of(env_id) == known[env_id], (
        f"{env_id} has other results than recorded. Change its version (-v1), or before a release the record"
    )


def test_values_are_those_recorded_on_any_machine(env_id):
    expected, found = np.array(json.loads(VALUES.read_text())[env_id]), np.array(values_of(env_id))
    assert found.shape == expected.shape
    differs = ~np.isclose(found, expected, rtol=RELATIVE, atol=TOLERANCE)
    limit = next(limit for kind, limit in MAY_DIFFER.items() if f"/{kind}" in env_id)
    is_clutter = env_id == "BulletArm/OpenLoopObjectGrasping-v0"
    assert differs.mean() <= (CLUTTER_MAY_DIFFER if is_clutter else limit), (found, expected)


def record():
    """Record the environments that have no digests on this machine, or no values."""
    content = recordings()
    mine = next((one for one in content if one["recorded_on"] == here()), None)
    if mine is None:
        mine = {"recorded_on": here(), "rollouts": {}}
        content.append(mine)
    values = json.loads(VALUES.read_text()) if VALUES.exists() else {}
    for env_id in bulletarm_gym.ENV_IDS:
        if env_id not in mine["rollouts"]:
            mine["rollouts"][env_id] = digests_of(env_id)
        if env_id not in values:
            values[env_id] = values_of(env_id)
    DIGESTS.write_text(json.dumps(content, indent=1) + "\n")
    VALUES.write_text(json.dumps(values) + "\n")


if __name__ == "__main__":
    record()
