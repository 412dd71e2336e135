"""States as JSON: exact, and nothing in them runs."""

import json
import math
from typing import Any

import numpy as np
import pytest
from rollouts import advance, transcript

from bulletarm_gym.demonstrations import plain
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -3,
        2**80,
        0.1 + 0.2,
        math.inf,
        "text",
        b"\x00\xff",
        (),
        (1, (2.5, "a")),
        [1, [2]],
        {"a": (1,), 2: b"x"},
        Pose((0.1, 0.2, 0.3)),
        (Pose.planar(1.0, 2.0, 3.0, 0.4), [None]),
    ],
    ids=repr,
)
def test_values_come_back_as_they_were(value: Any) -> None:
    back = plain.loads(plain.dumps(value))
    assert back == value and type(back) is type(value)


def test_numpy_scalars_become_numbers() -> None:
    assert plain.loads(plain.dumps((np.float64(0.1), np.int64(3), np.bool_(True)))) == (0.1, 3, True)


@pytest.mark.parametrize(
    "value", [object(), {1, 2}, np.zeros(3), lambda: 0], ids=["object", "set", "array", "f"]
)
def test_what_is_not_plain_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="neither plain"):
        plain.dumps((value,))


@pytest.mark.parametrize("path", ["os:system", "subprocess:Popen", "builtins:eval"])
def test_only_data_is_made(path: str) -> None:
    with pytest.raises(ValueError, match="neither a dataclass nor a named tuple"):
        plain.loads(json.dumps({path: ["true"]}))


def test_states_of_every_id_go_on_exactly(env: ManipulationEnv) -> None:
    state = advance(env, 0, 0)
    text = plain.dumps(state)
    assert plain.loads(text) == state
    first = transcript(env, 1)
    env.set_state(plain.loads(text))
    assert transcript(env, 1) == first
