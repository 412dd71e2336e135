"""Actions of the expert in the action space of the outermost wrapper."""

import sys
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
from gymnasium.wrappers import ClipAction, DiscretizeAction, RescaleAction
from gymnasium.wrappers.utils import rescale_box

Wrapper = gymnasium.Wrapper[Any, Any, Any, Any]
Inverse = Callable[[Any], Any]


def querying_wrappers(env: gymnasium.Env[Any, Any]) -> list[Wrapper]:
    """Return the wrappers whose ``get_wrapper_attr()`` called that of an environment, the innermost first.

    An environment of Gymnasium has no reference to its wrappers, so they are read from the call stack.
    """
    wrappers: list[Wrapper] = []
    inner: Any = env
    frame = sys._getframe(1)
    while frame is not None:
        caller = frame.f_locals.get("self")
        if isinstance(caller, gymnasium.Wrapper) and caller.env is inner:
            wrappers.append(caller)
            inner = caller
        elif caller is not inner:
            break
        frame = frame.f_back  # type: ignore[assignment]
    return wrappers


def wrapped_expert(expert: Callable[[], Any], wrappers: Sequence[Wrapper]) -> Callable[[], Any]:
    """Return an expert with actions in the action space of the outermost wrapper.

    :param wrappers: wrappers, the innermost first
    :raises ValueError: a wrapper changes actions in a way that cannot be inverted
    """
    inverses = [inverse for wrapper in wrappers if (inverse := _inverse(wrapper)) is not None]

    def act() -> Any:
        action = expert()
        for inverse in inverses:
            action = inverse(action)
        return action

    return act if inverses else expert


def _inverse(wrapper: Wrapper) -> Inverse | None:
    own: Inverse | None = getattr(wrapper, "revert_action", None)
    if own is not None and not isinstance(wrapper, DiscretizeAction):  # which returns the nearest bin
        return own
    if isinstance(wrapper, RescaleAction):
        outer: Any = wrapper.action_space
        inner: Any = wrapper.env.action_space
        _, forward, _ = rescale_box(inner, outer.low, outer.high)
        return lambda action: forward(action).clip(outer.low, outer.high)
    same_space = wrapper.action_space == wrapper.env.action_space
    if isinstance(wrapper, ClipAction) or (same_space and not isinstance(wrapper, gymnasium.ActionWrapper)):
        return None
    raise ValueError(
        "expert_action must be queried below wrappers whose change of actions has no known inverse, got "
        f"{type(wrapper).__name__}. Define revert_action(action) in the wrapper, or use env.unwrapped."
    )
