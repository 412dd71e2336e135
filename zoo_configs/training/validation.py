"""Checks of an experiment before anything is built: names of arguments, policies and files."""

import contextlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym

from sb3_extensions.common.components import ENTROPY
from sb3_extensions.common.env_metadata import constructor_arguments
from sb3_extensions.replay.sampling import make_sampler
from zoo_configs.algorithms import algorithm_classes, class_from_path
from zoo_configs.environments import load_expert_data
from zoo_configs.errors import CommandError, check_names, refused, unknown_name
from zoo_configs.experiments.config import ExperimentConfig, leaves
from zoo_configs.files import format_yaml
from zoo_configs.training.objects import NOISES, SCHEDULE, TRAINER_KEYS, described_callables, parsed

RESERVED_KEYS = {"_init_setup_model", "device", "env", "seed", "tensorboard_log", "verbose"}
"""Constructor arguments that the trainer passes to every algorithm."""
DESCRIBED = ("callback", "env_wrapper", "vec_env_wrapper")
"""Hyperparameters that describe classes and their arguments."""


def _number(low: float, high: float = math.inf, whole: bool = False) -> tuple[str, Callable[[Any], bool]]:
    """Return description and check of finite numbers within bounds."""
    kinds = (int,) if whole else (int, float)
    limits = f"of at least {low}" if high == math.inf else f"from {low} to {high}"

    def is_valid(value: Any) -> bool:
        is_number = isinstance(value, kinds) and not isinstance(value, bool)
        return is_number and math.isfinite(value) and low <= value <= high

    return f"a {'whole ' if whole else ''}number {limits}", is_valid


RATE, COUNT = _number(0), _number(1, whole=True)
ARGUMENTS = ("a mapping of arguments", lambda value: isinstance(value, Mapping | str | None))


def _is_rate(value: Any) -> bool:
    if isinstance(value, str) and (schedule := SCHEDULE.fullmatch(value)):
        with contextlib.suppress(ValueError):
            value = float(schedule[2])
    return RATE[1](value)


def _is_period(value: Any) -> bool:
    number, unit = value if isinstance(value, list | tuple) and len(value) == 2 else (value, "step")
    return COUNT[1](number) and unit in ("step", "episode")


RANGES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "action_noise": ("None (set noise_type and noise_std instead)", lambda value: value is None),
    "expert_data": ("None or the path of a file", lambda value: isinstance(value, str | None)),
    "env_kwargs": ("a mapping of parameters", lambda value: isinstance(value, Mapping)),
    "gradient_steps": _number(-1, whole=True),
    **dict.fromkeys(("clip_range", "learning_rate"), (f"{RATE[0]}, or lin_NUMBER", _is_rate)),
    **dict.fromkeys(("expert_episodes", "learning_starts", "pretrain_steps"), _number(0, whole=True)),
    "n_timesteps": _number(1),
    "noise_std": _number(0),
    "normalize": ("a boolean or a mapping", lambda value: isinstance(value, bool | Mapping | str | None)),
    "noise_type": (f"None or one of {', '.join(NOISES)}", [None, *NOISES].__contains__),
    "policy": ("a name", lambda value: isinstance(value, str)),
    "train_freq": (f"{COUNT[0]}, or [number, 'step' or 'episode']", _is_period),
    **dict.fromkeys(("batch_size", "buffer_size", "frame_stack", "n_envs", "n_epochs", "n_steps"), COUNT),
    "target_update_interval": COUNT,
    **ENTROPY,
    **dict.fromkeys(("gamma", "tau"), _number(0, 1)),
    **dict.fromkeys(("monitor_kwargs", "policy_kwargs", "replay_buffer_kwargs"), ARGUMENTS),
}
"""Description and check of valid values, by hyperparameter."""


def check_experiment(experiment: ExperimentConfig) -> None:
    """Raise ``CommandError`` for an unknown name, with the nearest valid one, or an invalid value."""
    algorithms = algorithm_classes()
    check_names("algorithm", [experiment.algo], algorithms)
    for name, (constraint, is_valid) in RANGES.items():
        if name in experiment.hyperparams and not is_valid(experiment.hyperparams[name]):
            raise CommandError(f"{name} must be {constraint}, got {experiment.hyperparams[name]!r}")
    algorithm = algorithms[experiment.algo]
    valid = valid_hyperparams(algorithm)
    check_names(f"hyperparameter of {experiment.algo}", experiment.hyperparams, valid)
    for name, value in leaves(experiment.hyperparams):
        if isinstance(value, float) and math.isnan(value):
            raise CommandError(f"{name} must be a number, got {value}")
    if ("noise_std" in experiment.hyperparams) != ("noise_type" in experiment.hyperparams):
        raise CommandError("noise_type and noise_std must be set together")
    for key in ("n_timesteps", "policy"):
        if key not in experiment.hyperparams:
            raise CommandError(f"hyperparameter {key!r} is missing for {experiment.env_id}")
    policy = policy_class(algorithm, experiment.hyperparams["policy"])
    _check_policy_kwargs(policy, experiment.hyperparams.get("policy_kwargs"))
    _check_replay_buffer(algorithm, experiment.hyperparams)
    for key, value in experiment.hyperparams.items():
        with refused(f"{key} must be valid, got {value!r}"):
            format_yaml(value)  # as in the files of the run
            parsed({key: value})
            described_callables(value if key in DESCRIBED else None)
    with refused(f"{experiment.algo} cannot be built"):
        _check_arguments(algorithm, experiment.hyperparams)


def _check_arguments(algorithm: type[Any], hyperparams: Mapping[str, Any]) -> None:
    """Pass the hyperparameters to the constructor, which checks them, without an environment."""
    kwargs = {key: value for key, value in parsed(hyperparams).items() if key not in TRAINER_KEYS}
    kwargs |= {} if kwargs.get("expert_data") is None else {"expert_data": ()}  # see check_expert_data()
    algorithm(env=None, device="cpu", _init_setup_model=False, **kwargs)


def valid_hyperparams(algorithm: type[Any]) -> set[str]:
    """Return the names of the hyperparameters that an experiment with an algorithm can have."""
    return {"policy", *TRAINER_KEYS, *constructor_arguments(algorithm)} - RESERVED_KEYS


def check_expert_data(experiment: ExperimentConfig, env: gym.Env[Any, Any]) -> None:
    """Raise ``CommandError`` if a file of demonstrations is damaged or has another task or parameters."""
    path = experiment.hyperparams.get("expert_data")
    episodes = load_expert_data(experiment.hyperparams).get("expert_data")
    core: Any = env.unwrapped
    if not isinstance(path, str) or episodes is None or not hasattr(core, "recipe"):
        return
    wanted = {"env": experiment.env_id, **core.recipe, **core.config.parameters()}
    with refused(f"expert_data: {path} cannot be read"):
        about = episodes.about
        found = {"env": about["env_id"], **about["recipe"], **about["configuration"]}
    compared = [name for name in wanted if not name.startswith("render_")]
    if other := [name for name in compared if found.get(name) != wanted[name]]:
        theirs, ours = ({name: values.get(name) for name in other} for values in (found, wanted))
        raise CommandError(
            f"expert_data: {path} has {theirs}, this run {ours}. Use --allow-mismatched-demos to accept it."
        )


def policy_class(algorithm: type[Any], policy: str) -> type[Any]:
    """Return the class of a policy, named by an alias or an import path."""
    aliases: dict[str, type[Any]] = algorithm.policy_aliases
    if policy in aliases:
        return aliases[policy]
    if "." not in policy:
        raise unknown_name(f"policy of {algorithm.__name__}", policy, aliases)
    return _imported("policy", policy)


def _check_policy_kwargs(policy: Any, policy_kwargs: Any) -> None:
    """Check the names of arguments, unless they are a Python expression."""
    if not isinstance(policy_kwargs, Mapping):
        return
    check_names(f"policy_kwargs of {policy.__name__}", policy_kwargs, constructor_arguments(policy))
    parameter = constructor_arguments(policy).get("features_extractor_class")
    default = getattr(policy, "default_extractor", object if parameter is None else parameter.default)
    extractor = policy_kwargs.get("features_extractor_class", default)
    if isinstance(extractor, str):
        extractor = _imported("features extractor", extractor)
    given = policy_kwargs.get("features_extractor_kwargs", {})
    if not isinstance(extractor, type):
        raise CommandError(f"features_extractor_class must be the import path of a class, got {extractor!r}")
    if not isinstance(given, Mapping):
        raise CommandError(f"features_extractor_kwargs must be a mapping of arguments, got {given!r}")
    check_names(f"features_extractor_kwargs of {extractor.__name__}", given, constructor_arguments(extractor))


def _check_replay_buffer(algorithm: type[Any], hyperparams: Mapping[str, Any]) -> None:
    """Check the names of arguments of a named buffer, or of the algorithm's own."""
    with refused("the replay buffer cannot be imported"):
        values = parsed({key: item for key, item in hyperparams.items() if key.startswith("replay_buffer")})
    buffer = values.get("replay_buffer_class") or getattr(algorithm, "default_replay_buffer_class", None)
    kwargs = values.get("replay_buffer_kwargs", {})
    if isinstance(buffer, type) and isinstance(kwargs, Mapping):
        valid = constructor_arguments(buffer).keys() - set(getattr(algorithm, "own_buffer_arguments", ()))
        check_names(f"replay_buffer_kwargs of {buffer.__name__}", kwargs, valid)
        with refused("replay_buffer_kwargs"):
            make_sampler(kwargs.get("sampler"))


def _imported(kind: str, path: str) -> type[Any]:
    with refused(f"{kind} {path!r} cannot be imported", (AttributeError, ImportError, ValueError)):
        return class_from_path(path)
