"""Rollouts reduced to short digests, for exact comparison between instances, processes and versions."""

import dataclasses
import hashlib
import itertools
from contextlib import closing

import gymnasium
import numpy as np

import bulletarm_gym
from bulletarm_gym.env import ManipulationEnv

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
GRASPING = "BulletArm/CloseLoopObjectGrasping-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
CLOSE_STACKING = "BulletArm/CloseLoopBlockStacking-v0"
EXPERT_SHARE = 0.7
"""Share of expert actions among random ones, with which grasps, pushes and successes happen."""
TYPICAL = (
    "BulletArm/OpenLoopHouseBuilding2-v0",
    "BulletArm/OpenLoopCovidTest-v0",
    "BulletArm/OpenLoopRampBlockStacking-v0",
    "BulletArm/OpenLoopBumpBoxPalletizing-v0",
    PICKING,
    "BulletArm/CloseLoopObjectGrasping-v0",
)
"""An id of each kind."""


def make_env(env_id, **parameters):
    """Make an environment without wrappers.

    An action sequence of closed loop is replaced in open loop by one without z, or on slopes with three r's.
    """
    assert env_id in bulletarm_gym.ENV_IDS
    sequence = parameters.get("action_sequence")
    if sequence and is_open_loop(env_id) and sequence.count("r") < 3:
        is_sloping = "LoopRamp" in env_id or "LoopBump" in env_id
        flat, tilted = sequence.replace("z", ""), sequence.replace("r", "") + "rrr"
        parameters["action_sequence"] = tilted if is_sloping else flat
    env = gymnasium.make(env_id, **parameters).unwrapped
    assert isinstance(env, ManipulationEnv)
    return env


def is_open_loop(env_id):
    """Return True if the actions of an id are picks and places."""
    return "/OpenLoop" in env_id


def core_of(demonstrations):
    """Return the environment of demonstrations without wrappers, as a context."""
    return closing(demonstrations.make_env().unwrapped)


def idle(env):
    """Return an action that does nothing at the start of an episode."""
    return np.zeros(env.action_space.shape, np.float32)


def finish(env):
    """Act by the expert to the end of the episode; return whether it succeeded, and its number of steps."""
    expert = env.get_wrapper_attr("expert_action")
    for step in itertools.count(1):
        *_, terminated, truncated, info = env.step(expert())
        if terminated or truncated:
            return bool(info["is_success"]), step
    raise AssertionError


def digest(*parts):
    """Return a short hash of arrays, dicts and Python scalars; equal only if they are equal bit for bit."""
    sha = hashlib.sha256()
    for part in parts:
        for name, value in sorted(part.items()) if isinstance(part, dict) else [("", part)]:
            content = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            sha.update(f"{name} {type(value).__name__} ".encode() + content)
    return sha.hexdigest()[:16]


def transcript(env, steps=None, *, seed=None, action_seed=0, before_step=lambda env: None):
    """Act on an environment, with expert actions among random ones, and reset it after each episode.

    :param steps: number of steps, by default fewer in open loop
    :param seed: seed of a first reset; without one the rollout begins at the present state
    :param before_step: function that is called before every step
    :return: one digest for each step and reset, of the action and all results
    """
    rng = np.random.default_rng(action_seed)
    steps = steps or (12 if is_open_loop(env.spec.id) else 50)
    lines = [] if seed is None else [digest(*env.reset(seed=seed))]
    for _ in range(steps):
        before_step(env)
        anything = rng.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)  # partly outside the box
        action = env.expert_action() if rng.random() < EXPERT_SHARE else anything
        result = env.step(action)
        lines.append(digest(action, *result))
        if result[2] or result[3]:
            lines.append(digest(*env.reset()))
    return lines


def advance(env, seed, steps, options=None):
    """Return the state after some steps of the expert; the episode must not have ended.

    If each step is an episode, the next one has begun.
    """
    env.reset(seed=seed, options=options)
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(env.expert_action())
        if env.task.single_step:
            env.reset()
        else:
            assert not terminated and not truncated
    return env.get_state()


def step_on(env, action):
    """Step, also after the end of the episode."""
    env.set_state(dataclasses.replace(env.get_state(), steps=0, ended=False))
    return env.step(action)


def answer(requests):
    """Return the rollouts of ``{name: (env_id, parameters, state or None)}``, without a state of seed 0."""
    answers = {}
    for name, (env_id, parameters, state) in requests.items():
        env = make_env(env_id, **parameters)
        if state is not None:
            env.set_state(state)
        answers[name] = transcript(env, seed=0 if state is None else None)
        env.close()
    return answers
