"""Experts act in the action space of the outermost wrapper, or the error names the wrapper in between."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import (
    ClipAction,
    DiscretizeAction,
    RecordEpisodeStatistics,
    RescaleAction,
    StickyAction,
    TransformAction,
)

ENV_ID = "BulletArm/CloseLoopBlockPicking-v0"


class Doubled(gymnasium.ActionWrapper):  # type: ignore[type-arg]
    """A user's wrapper with an inverse."""

    def action(self, action: Any) -> Any:
        return 2.0 * action

    def revert_action(self, action: Any) -> Any:
        return action / 2.0


class Shorter(gymnasium.Wrapper):  # type: ignore[type-arg]
    """A user's wrapper with another action space and no inverse."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))

    def step(self, action: Any) -> Any:
        return self.env.step(np.append(action, 0.0))


rescale = partial(RescaleAction, min_action=np.float32(-3.0), max_action=np.float32(1.0))
INVERTIBLE: dict[str, list[Any]] = {
    "none": [],
    "watching": [RecordEpisodeStatistics],
    "rescaled": [rescale],
    "rescaled twice": [rescale, RecordEpisodeStatistics, partial(rescale, max_action=np.float32(5.0))],
    "clipped": [ClipAction],
    "own": [Doubled, rescale],
}
OTHERS: dict[str, Any] = {
    "TransformAction": partial(TransformAction, func=np.negative, action_space=None),
    "StickyAction": partial(StickyAction, repeat_action_probability=0.5),
    "DiscretizeAction": partial(DiscretizeAction, bins=3),
    "Shorter": Shorter,
}


def make(*wrappers: Any) -> gymnasium.Env[Any, Any]:
    env: Any = gymnasium.make(ENV_ID, obs_size=16)
    for wrapper in wrappers:
        env = wrapper(env)
    return env  # type: ignore[no-any-return]


@pytest.mark.parametrize("name", INVERTIBLE)
def test_expert_acts_in_the_outermost_action_space(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(*INVERTIBLE[name])
    core: Any = env.unwrapped
    expert = env.get_wrapper_attr("expert_action")
    env.reset(seed=3)
    carried: list[Any] = []
    step = core.step
    monkeypatch.setattr(core, "step", lambda action: carried.append(action) or step(action))
    for _ in range(20):
        wanted = core.expert_action()
        *_, terminated, truncated, info = env.step(expert())
        np.testing.assert_allclose(carried[-1], wanted, atol=1e-6)
        if terminated or truncated:
            break
    assert info["is_success"]
    env.close()


@pytest.mark.parametrize("name", OTHERS)
def test_expert_names_the_wrapper_without_an_inverse(name: str) -> None:
    env = rescale(make()) if name == "DiscretizeAction" else make()
    env = OTHERS[name](env)
    with pytest.raises(ValueError, match=rf"^expert_action must be queried below .*, got {name}\."):
        RecordEpisodeStatistics(env).get_wrapper_attr("expert_action")
    assert env.has_wrapper_attr("expert_action")
    env.close()


def test_expert_below_a_wrapper_is_that_of_the_inner_environment() -> None:
    inner = make()
    outer = OTHERS["TransformAction"](inner)
    outer.reset(seed=1)
    core: Any = inner.unwrapped
    np.testing.assert_array_equal(inner.get_wrapper_attr("expert_action")(), core.expert_action())
    inner.close()
