"""Checks that an environment fits the Gymnasium interface, is deterministic and has a working expert."""

import importlib
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
from gymnasium.utils.env_checker import check_env, data_equivalence
from PIL import Image

from bulletarm_gym.check.environments import play_episode
from bulletarm_gym.check.machine import Finding
from bulletarm_gym.env import ManipulationEnv

MIN_SUCCESS = 0.95
"""Minimum success rate of an expert."""
PIXELS = 320
"""Side length of an image of the scene."""
UNBOUNDED = r".*A Box observation space m(in|ax)imum value is -?infinity"
"""Warning of Gymnasium about sensors whose values have no limits, such as poses and points."""

Make = Callable[[], ManipulationEnv]


def check_environment(make: Make, episodes: int, seed: int) -> Iterator[Finding]:
    """Yield the findings on an environment and on some episodes of its expert."""
    checks: dict[str, Callable[[], str]] = {
        "Gymnasium's check_env": partial(_check_gymnasium, make),
        "Stable-Baselines3's check_env": partial(_check_sb3, make),
        "equal episodes from equal seeds": partial(_check_copies, make, seed, restores=False),
        "equal steps from equal states": partial(_check_copies, make, seed, restores=True),
        "expert": partial(_check_expert, make, episodes, seed),
    }
    for name, check in checks.items():
        try:
            yield Finding(name, check())
        except Exception as error:  # every error of a user's task is a finding
            yield Finding(name, _describe(error), fails=True)


def _describe(error: Exception) -> str:
    """Return the message of an error with its place in the code, if it is outside this module."""
    *_, place = traceback.extract_tb(error.__traceback__)
    if place.filename == __file__:
        return str(error)
    return f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"


def _check_gymnasium(make: Make) -> str:
    with closing(make()) as env, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=UNBOUNDED)
        check_env(env, skip_render_check=True)
    return "passed"


def _check_sb3(make: Make) -> str:
    try:
        checker = importlib.import_module("stable_baselines3.common.env_checker")  # not required
    except ImportError:
        return "Stable-Baselines3 is not installed"
    with closing(make()) as env:
        checker.check_env(env, warn=False)
    return "passed"


def _check_copies(make: Make, seed: int, restores: bool) -> str:
    """Compare episodes from equal seeds, or steps from states set in an environment without an episode."""
    where = "between two environments"
    if restores:
        where = (
            "after set_state() in another environment. "
            "Use SceneObject.set_properties(), Scene.set_surface_properties() and Task.memory for changes"
        )
    with closing(make()) as first, closing(make()) as second:
        for number in range(2):
            start = first.reset(seed=seed + number)
            if not restores:
                again = second.reset(seed=seed + number)
                assert data_equivalence(start, again, exact=True), f"reset(seed) differs {where}"
            for step in range(25):
                if restores:
                    second.set_state(first.get_state())
                if _step_both(first, second, f"differs in step {step} {where}"):
                    break
    return "passed"


def _step_both(first: ManipulationEnv, second: ManipulationEnv, where: str) -> bool:
    """Carry out an expert action in two environments, and return True if the episode is over."""
    action = first.expert_action()
    other_action = second.expert_action()
    assert data_equivalence(action, other_action, exact=True), f"the expert's action {where}"
    result, other = first.step(action), second.step(action)
    worlds = first.scene.world, second.scene.world
    for pose, other_pose, body in zip(worlds[0].poses, worlds[1].poses, worlds[0].bodies, strict=True):
        assert pose == other_pose, f"the pose of {body.spec.name!r} {where}"
    assert data_equivalence(result, other, exact=True), f"the return value of step() {where}"
    return result[2] or result[3]


def _check_expert(make: Make, episodes: int, seed: int) -> str:
    with closing(make()) as env:
        played = [play_episode(env, seed + episode) for episode in range(episodes)]
    lengths = [steps for steps, _, success in played if success]
    value = f"success in {len(lengths)} of {episodes} episodes (at least {MIN_SUCCESS:.0%})"
    assert len(lengths) >= MIN_SUCCESS * episodes, value
    return f"{value}, {np.mean(lengths):.2f} steps per success"


def draw_episode(make: Make, seed: int, path: Path) -> None:
    """Write an image of the start and the end of an episode of the expert."""
    with closing(make()) as env:
        env.reset(seed=seed)
        start = env.viewer.close_up(PIXELS)
        play_episode(env, seed)
        Image.fromarray(np.hstack([start, env.viewer.close_up(PIXELS)])).save(path)
