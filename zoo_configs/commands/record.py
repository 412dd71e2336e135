"""``bulletarm-zoo record``: films a trained agent, or the expert."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym

from zoo_configs.arguments import (
    Parser,
    add_progress,
    add_published,
    add_run_arguments,
    hides_progress,
    positive_int,
    seed,
)
from zoo_configs.environments import check_alike, known_env_id, make_env, register_environments, try_env
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable
from zoo_configs.training.seeds import SeedStream, stream_seed

if TYPE_CHECKING:
    from zoo_configs.agents import Agent
    from zoo_configs.drawing.video import Frame, ValueMap

DESCRIPTION = """Film episodes of a trained agent, with --published of one that comes with the package, or
with --expert of the expert of --env: the rendered scene beside the images that the agent sees and, where it
values every pixel, those values with its choice."""
FORMATS = ("gif", "mp4")
FRAMES_PER_SECOND = 5.0
RENDER_MODE = "rgb_array"
FINAL_HOLD = 1.0  # s that the last frame of an episode stays


class Actor(NamedTuple):
    """
    Who is filmed.

    :param name: For the caption
    :param env: The environment, rendering to arrays
    :param act: From an observation to an action
    :param folder: Where the film goes by default
    :param judge: What it thinks of the places in an observation; None for who does not
    """

    name: str
    env: gym.Env[Any, Any]
    act: Callable[[Any], Any]
    folder: Path
    judge: Callable[[Any], ValueMap] | None = None


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no such agent or expert
    """
    args = _parse(argv)
    register_environments(args.gym_packages)
    actor = _expert(args) if args.expert else _agent(args)
    path = args.output or actor.folder / f"{_task(actor.env)}-{actor.name}.{args.format}"
    check_writable(path, "--output")
    frames: list[Frame] = []
    try:
        for frame in film(actor, args.episodes, args.seed, args.fps, args.progress):
            frames.append(frame)
    finally:  # after Ctrl-C, too, with what there is
        actor.env.close()
        _write(frames, path, args.fps)


def _write(frames: list[Frame], path: Path, fps: float) -> None:
    from zoo_configs.drawing.video import write_video

    if frames:
        write_video(frames, path, fps)
        print(f"Written:\n  {path}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo record", description=DESCRIPTION)
    add_run_arguments(parser)
    add_published(parser)
    add = parser.add_argument
    add("--expert", action="store_true", help="film the expert of --env")
    add("-n", "--episodes", type=positive_int, default=5, help="how many episodes (default: 5)")
    add("--seed", type=seed, default=0, help="seed of the scenes (default: 0, the first of enjoy)")
    add("--format", choices=FORMATS, help="kind of film (default: gif, or what --output says)")
    add("-o", "--output", type=Path, help="file to write (default: in the run folder)")
    add(
        "--fps",
        type=float,
        default=FRAMES_PER_SECOND,
        help=f"steps per second (default {FRAMES_PER_SECOND:g})",
    )
    add_progress(parser)
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix[1:] not in FORMATS:
        parser.error(f"--output must end in .gif or .mp4, got {args.output}")
    if args.output is not None and args.format not in (None, args.output.suffix[1:]):
        parser.error(f"--output {args.output} is no {args.format}")
    if not 0 < args.fps < math.inf:
        parser.error(f"--fps must be positive, got {args.fps}")
    args.format = args.format or "gif"
    return args


def _expert(args: argparse.Namespace) -> Actor:
    if args.env is None:
        raise CommandError("--expert needs --env")
    if args.run is not None or args.published is not None:
        raise CommandError("--expert films the expert, not an agent: leave RUN_FOLDER and --published out")
    env_id = known_env_id(args.env)
    env = make_env(env_id, args.env_kwargs, RENDER_MODE)
    if not hasattr(env.unwrapped, "expert_action"):
        raise CommandError(f"{args.env} has no expert")
    try_env(env_id, args.env_kwargs, RENDER_MODE)
    expert = env.unwrapped.expert_action
    return Actor("expert", env, lambda _: expert(), Path())


def _agent(args: argparse.Namespace) -> Actor:
    from zoo_configs.agents import agent_from_arguments

    agent = agent_from_arguments(args)
    actor = acting(agent, args.env_kwargs)
    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    return actor


def acting(agent: Agent, env_kwargs: Mapping[str, Any] | None = None) -> Actor:
    """
    An agent in its environment.

    :param agent: The agent
    :param env_kwargs: Parameters that are to differ from those it was trained with
    :return: Who is filmed
    :raises CommandError: if the environment cannot be made so, or the agent cannot act there
    """
    from zoo_configs.training.objects import wrapper

    agent.check_plain("which cannot be filmed")
    kwargs = {**agent.env_kwargs, "render_mode": RENDER_MODE, **(env_kwargs or {})}
    try_env(agent.env_id, kwargs, RENDER_MODE)
    env = make_env(agent.env_id, kwargs, RENDER_MODE)
    wrap = wrapper(None if agent.run is None else agent.run.cell.hyperparams.get("env_wrapper"))
    env = wrap(env) if wrap is not None else env
    check_alike(env, agent.model, "the agent cannot act here")
    model = agent.model
    return Actor(
        agent.label,
        env,
        lambda seen: model.predict(seen, deterministic=True)[0],
        agent.folder,
        _judge(model.policy),
    )


def _judge(policy: Any) -> Callable[[Any], ValueMap] | None:
    """What a policy over the places of a heightmap thinks of them."""
    from sb3_extensions.spatial_dqn.policies import SpatialPolicy
    from zoo_configs.drawing.video import ValueMap

    if not isinstance(policy, SpatialPolicy):
        return None
    yaws = policy.codec.grids.get("theta")

    def judge(seen: Any) -> ValueMap:
        values, (row, column, *others) = policy.value_map(seen)
        return ValueMap(values, (row, column), None if yaws is None else float(yaws[others[0]]))

    return judge


def film(
    actor: Actor, episodes: int, seed: int, fps: float = FRAMES_PER_SECOND, progress: bool | None = None
) -> Iterator[Frame]:
    """
    Film episodes under a progress bar.

    :param actor: Who acts; the environment stays open
    :param episodes: How many
    :param seed: Of the scenes, as ``--seed``
    :param fps: Steps per second
    :param progress: As from :func:`zoo_configs.arguments.add_progress`
    :return: The frames
    """
    from tqdm import trange

    first_seed, successes = stream_seed(seed, SeedStream.TEST), 0
    for episode in trange(episodes, unit="episode", disable=hides_progress(progress)):
        *frames, last = _film_episode(actor, first_seed + episode, f"episode {episode + 1} of {episodes}")
        yield from (frame for frame, _ in frames)
        yield from [last[0]] * max(1, round(FINAL_HOLD * fps))
        successes += last[1]
    print(f"{successes} of {episodes} episodes succeeded")


def _film_episode(actor: Actor, seed: int, title: str) -> Iterator[tuple[Frame, bool]]:
    """Frames of an episode, each with whether the task is solved in it."""
    from zoo_configs.drawing.video import compose_frame

    name = f"{_task(actor.env)}, {actor.name}, {title}"
    seen, info = actor.env.reset(seed=seed)
    step, over = 0, False
    while True:
        success = bool(info.get("is_success", False))
        outcome = "success" if success else "failure" if over else f"step {step}"
        picture: Any = actor.env.render()
        space, value_map = actor.env.observation_space, actor.judge(seen) if actor.judge else None
        yield compose_frame(picture, seen, space, f"{name}: {outcome}", success, value_map), success
        if over:
            return
        seen, _, terminated, truncated, info = actor.env.step(actor.act(seen))
        step, over = step + 1, terminated or truncated


def _task(env: gym.Env[Any, Any]) -> str:
    """``CloseLoopBlockPicking`` for ``BulletArm/CloseLoopBlockPicking-v0``."""
    assert env.spec is not None
    return env.spec.name
