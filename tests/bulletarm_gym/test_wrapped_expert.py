"""The expert acts in the action space of the outermost wrapper, or the error names a wrapper."""

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


rescale = partial(RescaleAction, min_action=np.float32(-3.0), max_action=np.float32(1.0))
negate = partial(TransformAction, func=np.negative, action_space=None)
INVERTIBLE: dict[str, list[Any]] = {
    "none": [RecordEpisodeStatistics],
    "rescaled twice": [rescale, RecordEpisodeStatistics, partial(rescale, max_action=np.float32(5.0))],
    "clipped": [ClipAction],
    "own": [Doubled, rescale],
}
OTHERS: dict[str, list[Any]] = {
    "TransformAction": [negate],
    "StickyAction": [partial(StickyAction, repeat_action_probability=0.5)],
    "DiscretizeAction": [rescale, partial(DiscretizeAction, bins=3)],
    "Shorter": [Shorter],
}


def make(*wrappers: Any) -> Any:
    env: Any = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", obs_size=16)
    for wrapper in wrappers:
        env = wrapper(env)
    return env


@pytest.mark.parametrize("name", INVERTIBLE)
def test_expert_acts_in_the_outermost_action_space(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(*INVERTIBLE[name])
    core = env.unwrapped
    expert, step, executed = env.get_wrapper_attr("expert_action"), core.step, []
    env.reset(seed=3)
    monkeypatch.setattr(core, "step", lambda action: executed.append(action) or step(action))
    over = False
    while not over:
        wanted, action = core.expert_action(), expert()
        *_, terminated, truncated, info = env.step(action)
        assert action in env.action_space
        np.testing.assert_allclose(executed[-1], wanted, atol=1e-6)
        over = terminated or truncated
    assert info["is_success"]
    env.close()


@pytest.mark.parametrize("name", OTHERS)
def test_expert_names_the_wrapper_without_an_inverse(name: str) -> None:
    env = make(*OTHERS[name])
    with pytest.raises(ValueError, match=rf"expert_action .*, got {name}\."):
        RecordEpisodeStatistics(env).get_wrapper_attr("expert_action")
    assert env.has_wrapper_attr("expert_action")
    env.close()


def test_expert_below_a_wrapper_is_that_of_the_inner_environment() -> None:
    inner = make()
    negate(inner).reset(seed=1)
    np.testing.assert_array_equal(inner.get_wrapper_attr("expert_action")(), inner.unwrapped.expert_action())
    inner.close()
