"""Videos of agents and experts: rendered episodes next to the observations."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from tqdm import trange

from sb3_extensions.spatial_dqn.policies import SpatialPolicy
from zoo_configs.agents import Agent
from zoo_configs.drawing.video import FRAMES_PER_SECOND, Frame, ValueMap, compose_frame, observed_images
from zoo_configs.environments import SeedStream, known_env_id, make_env, stream_seed, tried_env
from zoo_configs.errors import CommandError, refused
from zoo_configs.evaluating import check_fits, check_unwrapped
from zoo_configs.training.objects import wrapped

RENDER_MODE = "rgb_array"
FINAL_SECONDS = 1.0  # duration of the last frame of an episode
WRAPPERS = ("normalize", "frame_stack", "vec_env_wrapper")  # hyperparameters that change observations


class Actor(NamedTuple):
    """
    Policy and environment to record.

    :param env: Environment with ``render_mode="rgb_array"``
    :param act: Function from observation and state of a recurrent policy to action and next state
    :param folder: Default folder of the video
    :param evaluate_pixels: Function from observation to the values of its pixels; None for other policies
    """

    name: str
    env: gym.Env[Any, Any]
    act: Callable[[Any, Any], tuple[Any, Any]]
    folder: Path = Path()
    evaluate_pixels: Callable[[Any], ValueMap] | None = None

    @property
    def task(self) -> str:
        """Name of the environment without namespace and version."""
        assert self.env.spec is not None
        return self.env.spec.name


def _make(env_id: str, env_kwargs: Mapping[str, Any], is_expert: bool = False) -> gym.Env[Any, Any]:
    """Make an environment that renders, and check that it has an expert if needed."""
    if (mode := env_kwargs.get("render_mode", RENDER_MODE)) != RENDER_MODE:
        raise CommandError(f"render_mode must be {RENDER_MODE!r}, got {mode!r}")
    kwargs = {**env_kwargs, "render_mode": RENDER_MODE}
    with tried_env(env_id, kwargs) as env, refused(f"{env_id} cannot be rendered"):
        if is_expert and not hasattr(env.unwrapped, "expert_action"):
            raise CommandError(f"{env_id} has no expert")
        env.render()
        slow = {"fast_mode": False} if _is_open_loop(env) else {}  # simulates motions, which can be recorded
    return make_env(env_id, {**slow, **kwargs})


def expert_actor(env_id: str, env_kwargs: Mapping[str, Any]) -> Actor:
    """Return the expert of an environment; raise ``CommandError`` if it has none."""
    env = _make(known_env_id(env_id), env_kwargs, is_expert=True)
    expert = env.unwrapped.expert_action  # type: ignore[attr-defined]
    return Actor("expert", env, lambda *_: (expert(), None))


def agent_actor(agent: Agent, env_kwargs: Mapping[str, Any]) -> Actor:
    """Return an agent in its environment; raise ``CommandError`` if the environment does not fit it."""
    check_unwrapped(agent.run, WRAPPERS, "which record does not support")
    env = _make(agent.env_id, {**agent.env_kwargs, **env_kwargs})
    env = wrapped(env, agent.hyperparams.get("env_wrapper"))
    check_fits(env, agent)

    def act(observation: Any, state: Any) -> tuple[Any, Any]:
        return agent.model.predict(observation, state, deterministic=True)

    folder = Path() if agent.run is None else agent.run.folder
    return Actor(agent.label, env, act, folder, _pixel_values(agent.model.policy))


def _pixel_values(policy: Any) -> Callable[[Any], ValueMap] | None:
    """Return the values that a policy over the pixels of a heightmap computes, None for other policies."""
    if not isinstance(policy, SpatialPolicy):
        return None
    yaws = policy.codec.grids.get("theta")

    def evaluate(observation: Any) -> ValueMap:
        values, (row, column, *others) = policy.value_map(observation)
        return ValueMap(values, (row, column), None if yaws is None else float(yaws[others[0]]))

    return evaluate


def record(actor: Actor, episodes: int, seed: int, progress: bool = False) -> Iterator[Frame]:
    """Play episodes in an actor's environment, which stays open, and yield their frames."""
    first_seed, successes = stream_seed(seed, SeedStream.TEST), 0
    for episode in trange(episodes, unit="episode", disable=not progress):
        title = f"episode {episode + 1} of {episodes}"
        *frames, (last, success) = _record_episode(actor, first_seed + episode, title)
        yield from (frame for frame, _ in frames)
        yield from [last] * max(1, round(FINAL_SECONDS * FRAMES_PER_SECOND))
        successes += success
    print(f"{successes} of {episodes} episodes succeeded")


def _record_episode(actor: Actor, seed: int, title: str) -> Iterator[tuple[Frame, bool]]:
    """Yield the frames of an episode, each with the success at that time."""
    env, over, state = actor.env, False, None
    seen, info = env.reset(seed=seed)
    for step in itertools.count():
        success = bool(info.get("is_success", False))
        outcome = "success" if success else "failure" if over else f"step {step}"
        caption = f"{actor.task}, {actor.name}, {title}: {outcome}"
        images = list(observed_images(seen, env))
        values = actor.evaluate_pixels(seen) if actor.evaluate_pixels else None
        scene: Any = env.render()
        yield compose_frame(scene, images, caption, success, values), success
        if over:
            return
        unwrapped: Any = env.unwrapped
        motion = unwrapped.viewer.record_images(env.render) if _is_open_loop(env) else nullcontext(())
        with motion as rendered:  # images of the motion during an open-loop action
            action, state = actor.act(seen, state)
            seen, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        for image in rendered:
            yield compose_frame(image, images, caption, success, values), success


def _is_open_loop(env: gym.Env[Any, Any]) -> bool:
    return getattr(getattr(env.unwrapped, "config", None), "control", None) == "open_loop"
