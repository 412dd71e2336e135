"""``bulletarm-zoo check``: puts environments, a user's own above all, through what ours must pass."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3.common.env_checker import check_env as check_sb3
from tqdm import trange

from zoo_configs.arguments import (
    Parser,
    add_env_kwargs,
    add_packages,
    add_progress,
    fraction,
    hides_progress,
    positive_int,
    seed,
)
from zoo_configs.cells.rules import family_of, task_name
from zoo_configs.drawing.video import compose_frame, write_picture
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments
from zoo_configs.errors import CommandError, reason_and_place
from zoo_configs.files import check_writable
from zoo_configs.measuring.data_files import EXPERTS, DataFile, number
from zoo_configs.measuring.provenance import env_kwargs_words, key_values, provenance

if TYPE_CHECKING:
    from sb3_extensions.demonstrations.action_transforms import ActionTransform

DESCRIPTION = """Check environments: Gymnasium's and Stable-Baselines3's own checks, equal episodes from equal
seeds, equal steps from equal states in two environments, and how often the expert succeeds. Draws the start
and the end of the expert's first episode."""
GRIDDED = "open_loop"  # family of the tasks with a grid
RENDER_MODE = "rgb_array"
SUCCESS_DIGITS, STEPS_DIGITS = 4, 3
UNBOUNDED = r".*A Box observation space m(in|ax)imum value is -?infinity"
ROLLOUT = 25  # steps compared between two environments


class Experience(NamedTuple):
    """
    What the expert did.

    :param successes: Episodes it solved
    :param lengths: Their numbers of steps, the solved ones
    :param frames: Pictures of the first episode's start and end
    """

    successes: int
    lengths: list[int]
    frames: list[np.ndarray[Any, np.dtype[np.uint8]]]

    @property
    def mean_length(self) -> float:
        """Steps of a solved episode, NaN where there is none."""
        return float(np.mean(self.lengths)) if self.lengths else float("nan")


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if a check fails
    """
    args = _parse(argv)
    register_environments(args.gym_packages)
    ids = [known_env_id(env_id) for env_id in args.env] or our_env_ids()
    if args.snap and (others := [env_id for env_id in ids if family_of(env_id).name != GRIDDED]):
        raise CommandError(f"--snap: only open-loop actions are places on a grid, not those of {others[0]}")
    for env_id in ids:
        make_env(env_id, args.env_kwargs, RENDER_MODE).close()
        check_writable(_picture(env_id, args.log_folder), "--log-folder")
    if args.data is not None:
        DataFile(args.data, EXPERTS).check("--data")
    failed = [env_id for env_id in ids if not _passes(env_id, args)]
    if failed:
        raise CommandError(f"failed: {', '.join(failed)}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo check", description=DESCRIPTION)
    add = parser.add_argument
    add("env", nargs="*", metavar="ENV", help="environment ids (default: all of ours)")
    add("-n", "--episodes", type=positive_int, default=20, help="episodes of the expert (default: 20)")
    add("--seed", type=seed, default=0, help="seed of the first episode (default: 0)")
    add("--min-success", type=fraction, default=0.95, help="least success rate of the expert (default: 0.95)")
    add_env_kwargs(parser)
    add("--snap", action="store_true", help="let the expert act on the grid of spatial Q-learning")
    add_packages(parser)
    add(
        "--data", type=Path, metavar="FILE", help="CSV to put the expert's figures into, a row an environment"
    )
    add("-f", "--log-folder", type=Path, default=Path("logs/check"), help="where pictures go")
    add_progress(parser)
    return parser.parse_args(argv)


def _picture(env_id: str, log_folder: Path) -> Path:
    return log_folder / f"{env_id.rpartition('/')[2]}.png"


def _passes(env_id: str, args: argparse.Namespace) -> bool:
    def make() -> gym.Env[Any, Any]:
        return make_env(env_id, args.env_kwargs, RENDER_MODE)

    print(env_id)
    checks = {
        "Gymnasium's check_env": lambda: _without_warnings(
            lambda: check_gymnasium(make().unwrapped, skip_render_check=True)
        ),
        "Stable-Baselines3's check_env": lambda: check_sb3(make().unwrapped, warn=False),
        "equal episodes from equal seeds": lambda: _check_determinism(make(), make(), args.seed),
        "equal steps from equal states": lambda: _check_states(make().unwrapped, make().unwrapped, args.seed),
    }
    passed = all([_report(name, check) for name, check in checks.items()])
    try:
        experience = _watch_expert(make(), args)
    except Exception as error:  # as above
        print(f"  expert: FAILED, {reason_and_place(error)}")
        return False
    rate, length = experience.successes / args.episodes, experience.mean_length
    print(f"  expert: success_rate={rate:.3f} episodes={args.episodes} mean_length={length:.2f}")
    if args.data is not None:
        DataFile(args.data, EXPERTS).add(_record(env_id, experience, args))
    # What is drawn shows that rendering works; Gymnasium would ask for a window, too.
    path = _picture(env_id, args.log_folder)
    write_picture(np.concatenate(experience.frames), path)
    print(f"Written:\n  {path}")
    return passed and rate >= args.min_success


def _record(env_id: str, experience: Experience, args: argparse.Namespace) -> dict[str, str]:
    """What is kept of the expert's episodes."""
    words = ["bulletarm-zoo", "check", env_id, "-n", str(args.episodes), "--seed", str(args.seed)]
    words += [*env_kwargs_words(args.env_kwargs), *(["--snap"] if args.snap else [])]
    others = {name: value for name, value in args.env_kwargs.items() if name != "robot"}
    return {
        "env": task_name(env_id),
        "robot": _robot(env_id, args.env_kwargs),
        "env_kwargs": " ".join(key_values(others)),
        "snap": "yes" if args.snap else "",
        "episodes": str(args.episodes),
        "first_seed": str(args.seed),
        "success": number(experience.successes / args.episodes, SUCCESS_DIGITS),
        "mean_steps": number(experience.mean_length, STEPS_DIGITS),
        **provenance(words),
    }


def _robot(env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """Name of the arm, nothing where an environment says none."""
    with closing(make_env(env_id, env_kwargs)) as env:
        return str(getattr(getattr(env.unwrapped, "config", None), "robot", ""))


def _report(name: str, check: Callable[[], None]) -> bool:
    try:
        check()
    except Exception as error:  # whatever a user's code raises is what the check found
        print(f"  {name}: FAILED, {reason_and_place(error)}")
        return False
    print(f"  {name}: passed")
    return True


def _without_warnings(check: Callable[[], None]) -> None:
    """Numbers without bounds are no fault: poses and points have none."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=UNBOUNDED)
        check()


def _check_determinism(first: gym.Env[Any, Any], second: gym.Env[Any, Any], seed: int) -> None:
    for episode in range(2):
        assert data_equivalence(
            first.reset(seed=seed + episode), second.reset(seed=seed + episode), exact=True
        ), f"reset(seed={seed + episode}) differs between two environments"
        for step in range(ROLLOUT):
            action = _expert(first)()
            assert np.array_equal(action, _expert(second)()), f"the expert differs in step {step}"
            results = first.step(action), second.step(action)
            assert data_equivalence(*results, exact=True), f"step {step} differs between two environments"
            if results[0][2] or results[0][3]:
                break


def _check_states(played: Any, fresh: Any, seed: int) -> None:
    """
    Continue from each state of two episodes in an environment in which no episode has begun, too.

    :param played: Environment whose task arranges the episodes
    :param fresh: Environment of the same id, which knows of them what the states contain
    """
    for episode in range(2):
        played.reset(seed=seed + episode)
        for step in range(ROLLOUT):
            fresh.set_state(played.get_state())
            action = played.expert_action()
            assert np.array_equal(action, fresh.expert_action()), f"the expert differs {_restored(step)}"
            results = played.step(action), fresh.step(action)
            if moved := _moved_apart(played, fresh):
                raise AssertionError(f"the pose of {moved!r} differs {_restored(step)}")
            assert data_equivalence(*results, exact=True), f"what step() returns differs {_restored(step)}"
            if results[0][2] or results[0][3]:
                break


def _restored(step: int) -> str:
    return (
        f"after set_state() with the state before step {step} in another environment: the task changes"
        " something that the state lacks. Use the methods of SceneObject and Task.memory instead"
    )


def _moved_apart(first: Any, second: Any) -> str | None:
    """Name of a body whose poses differ between two environments."""
    poses = zip(first.scene.world.poses, second.scene.world.poses, first.scene.world.bodies, strict=True)
    return next((str(body.spec.name) for one, other, body in poses if one != other), None)


def _watch_expert(env: gym.Env[Any, Any], args: argparse.Namespace) -> Experience:
    transform = _grid_snapping(env) if args.snap else lambda action, _: action
    rng = np.random.default_rng(args.seed)
    successes, lengths, frames = 0, [], []
    for episode in trange(args.episodes, unit="episode", disable=hides_progress(args.progress)):
        observation, info = env.reset(seed=args.seed + episode)
        if episode == 0:
            frames.append(_frame(env, observation, "start"))
        steps, over = 0, False
        while not over:
            observation, _, terminated, truncated, info = env.step(transform(_expert(env)(), rng))
            steps, over = steps + 1, terminated or truncated
        if info["is_success"]:
            successes += 1
            lengths.append(steps)
        if episode == 0:
            frames.append(_frame(env, observation, "success" if info["is_success"] else "failure"))
    env.close()
    return Experience(successes, lengths, frames)


def _grid_snapping(env: gym.Env[Any, Any]) -> ActionTransform:
    """Return the transformation of the expert's actions to the grid over the heightmap."""
    from sb3_extensions.demonstrations.action_transforms import GridSnapping
    from sb3_extensions.encoders.observation import SceneView
    from sb3_extensions.spatial_dqn.codec import DEFAULT_SEQUENCE, SpatialActionCodec

    config: Any = getattr(env.unwrapped, "config", None)
    sequence = getattr(config, "action_sequence", DEFAULT_SEQUENCE)
    try:
        size = SceneView(env.observation_space).size
        return GridSnapping(env.action_space, SpatialActionCodec(size, sequence))
    except ValueError as error:
        raise CommandError(f"--snap: {error}") from error


def _expert(env: gym.Env[Any, Any]) -> Callable[[], Any]:
    expert: Callable[[], Any] = env.get_wrapper_attr("expert_action")
    return expert


def _frame(env: gym.Env[Any, Any], observation: Any, title: str) -> np.ndarray[Any, np.dtype[np.uint8]]:
    picture: Any = env.render()
    return compose_frame(picture, observation, env.observation_space, title, title == "success")
