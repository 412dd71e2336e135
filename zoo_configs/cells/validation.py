"""Checks hyperparameters against the signatures of what they will be given to, before anything is built."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from sb3_extensions.common.env_metadata import constructor_keys
from sb3_extensions.replay.augmentations import make_augmentation
from sb3_extensions.replay.sampling import make_sampler
from zoo_configs.algorithms import class_from_path, register_algorithms
from zoo_configs.cells.cell import Cell
from zoo_configs.cells.ranges import check_values
from zoo_configs.environments import load_expert_data
from zoo_configs.errors import CommandError, refused, unknown_name

# Keys that rl_zoo3's manager takes for itself; every other key goes to the algorithm.
MANAGER_KEYS = (
    "callback",
    "env_kwargs",
    "env_wrapper",
    "frame_stack",
    "monitor_kwargs",
    "n_envs",
    "n_timesteps",
    "noise_std",
    "noise_type",
    "normalize",
    "policy",
    "vec_env_wrapper",
)
# What the manager passes to every algorithm itself.
RESERVED_KEYS = ("_init_setup_model", "device", "env", "seed", "tensorboard_log", "verbose")


def check_cell(cell: Cell) -> None:
    """
    Check the names in a cell: its algorithm, hyperparameters, policy, and what they are given.

    :param cell: The cell
    :raises CommandError: for a name that does not exist; names the nearest one that does
    """
    algorithms = register_algorithms()
    if cell.algo not in algorithms:
        raise unknown_name("algorithm", cell.algo, algorithms)
    check_values(cell.hyperparams)
    algorithm = algorithms[cell.algo]
    valid = {*MANAGER_KEYS, *constructor_keys(algorithm)} - set(RESERVED_KEYS)
    _check_names(f"hyperparameter of {cell.algo}", cell.hyperparams, valid)
    for key in ("n_timesteps", "policy"):
        if key not in cell.hyperparams:
            raise CommandError(f"hyperparameter {key!r} is missing for {cell.env_id}")
    policy = policy_class(algorithm, cell.hyperparams["policy"])
    _check_policy_kwargs(policy, cell.hyperparams.get("policy_kwargs"))
    _check_replay_buffer(algorithm, cell.hyperparams)
    with refused("augmentation"):
        make_augmentation(cell.hyperparams.get("augmentation"))


def check_expert_data(cell: Cell, env: gym.Env[Any, Any], any_demonstrations: bool = False) -> None:
    """
    Look whether a file of demonstrations is of an environment like the one to train on.

    :param cell: Its hyperparameters may name a file as ``expert_data``
    :param env: The environment
    :param any_demonstrations: Whether it may be another task or have other parameters
    :raises CommandError: if there is no such file, or it is of another environment
    """
    path = cell.hyperparams.get("expert_data")
    episodes = load_expert_data(cell.hyperparams).get("expert_data")
    if not isinstance(path, str) or episodes is None:
        return
    with refused(f"expert_data: {path} cannot be read"):
        for episode in episodes:
            _check_shapes(path, episode, env)
    if not any_demonstrations:
        _check_origin(path, episodes.about, cell.env_id, env)


def _check_shapes(path: str, episode: Any, env: gym.Env[Any, Any]) -> None:
    first = {key: values[0] for key, values in episode.observations.items()}
    if first not in env.observation_space or episode.actions[0] not in env.action_space:
        shapes = {key: values.shape for key, values in first.items()}
        raise CommandError(
            f"expert_data: {path} has observations {shapes} and actions {episode.actions[0].shape}, "
            f"the environment has {env.observation_space} and {env.action_space}"
        )


def _check_origin(path: str, about: Mapping[str, Any], env_id: str, env: gym.Env[Any, Any]) -> None:
    """Compare the task, its action sequence and its parameters with those of the demonstrations."""
    config: Any = getattr(env.unwrapped, "config", None)
    wanted = {} if config is None else {"env": env_id, **config.parameters()}
    shown = {"env": about.get("env_id"), **about.get("configuration", {})}
    compared = [name for name in wanted if not name.startswith("render_")]
    other = [name for name in compared if shown.get(name) != wanted[name]]
    if config is None or not other:
        return
    theirs, ours = ({name: values.get(name) for name in other} for values in (shown, wanted))
    advice = "to take it nevertheless: --any-demonstrations"
    raise CommandError(f"expert_data: {path} is of {theirs}, this run of {ours}; {advice}")


def policy_class(algorithm: type[Any], policy: str) -> type[Any]:
    """
    The class behind a policy's name.

    :param algorithm: Class of the algorithm
    :param policy: One of its aliases, or a dotted path
    :return: Class of the policy
    :raises CommandError: if there is no such policy
    """
    aliases: dict[str, type[Any]] = algorithm.policy_aliases
    if policy in aliases:
        return aliases[policy]
    if "." not in policy:
        raise unknown_name(f"policy of {algorithm.__name__}", policy, aliases)
    return _imported("policy", policy)


def _check_policy_kwargs(policy: type[Any], policy_kwargs: Any) -> None:
    """Python code in a string is left to rl_zoo3, which evaluates it."""
    if not isinstance(policy_kwargs, Mapping):
        return
    _check_names(f"policy_kwargs of {policy.__name__}", policy_kwargs, constructor_keys(policy))
    default = getattr(policy, "default_extractor", _default(policy, "features_extractor_class"))
    extractor = policy_kwargs.get("features_extractor_class", default)
    if isinstance(extractor, str):
        extractor = _imported("features extractor", extractor)
    given = policy_kwargs.get("features_extractor_kwargs", {})
    if not isinstance(extractor, type):
        raise CommandError(f"features_extractor_class takes the dotted path of a class, got {extractor!r}")
    if not isinstance(given, Mapping):
        raise CommandError(f"features_extractor_kwargs takes a mapping of arguments, got {given!r}")
    _check_names(f"features_extractor_kwargs of {extractor.__name__}", given, constructor_keys(extractor))


def _check_replay_buffer(algorithm: type[Any], hyperparams: Mapping[str, Any]) -> None:
    """What a buffer is given is known where it is named, or where the algorithm has one of its own."""
    path, kwargs = hyperparams.get("replay_buffer_class"), hyperparams.get("replay_buffer_kwargs", {})
    buffer = getattr(algorithm, "default_replay_buffer_class", None)
    if isinstance(path, str):
        buffer = _imported("replay buffer", path)
    if buffer is not None and isinstance(kwargs, Mapping):
        valid = constructor_keys(buffer) - set(getattr(algorithm, "own_buffer_arguments", ()))
        _check_names(f"replay_buffer_kwargs of {buffer.__name__}", kwargs, valid)
        with refused("replay_buffer_kwargs"):
            make_sampler(kwargs.get("sampler"))


def _default(cls: type[Any], parameter: str) -> Any:
    for parent in cls.__mro__:
        parameters = inspect.signature(vars(parent).get("__init__", object)).parameters
        if parameter in parameters:
            return parameters[parameter].default
    return object


def _imported(kind: str, path: str) -> type[Any]:
    try:
        return class_from_path(path)
    except (ImportError, ValueError) as error:  # ValueError: no module in front of the name
        raise CommandError(f"{kind} {path!r} cannot be imported: {error}") from error


def _check_names(kind: str, given: Mapping[str, Any], valid: set[str]) -> None:
    for name in given:
        if name not in valid:
            raise unknown_name(kind, name, valid)
