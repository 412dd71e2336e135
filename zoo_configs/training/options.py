"""Options of a training: flags of rl_zoo3's ``train`` as a dataclass and as flags of our commands."""

import argparse
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from zoo_configs.arguments import whole_number
from zoo_configs.errors import CommandError, check_names
from zoo_configs.experiments.config import ExperimentConfig

PACKAGES = {"tensorboard_log": ("tensorboard",), "track": ("wandb", "tensorboard")}
"""Optional packages, by the option that needs them."""


def _option(default: Any, help: str, *short: str, **kwargs: Any) -> Any:
    """Return a field of the dataclass; ``kwargs`` are further arguments of ``add_argument``."""
    return field(default=default, metadata={"help": help, "short": short, "kwargs": kwargs})


@dataclass(frozen=True)
class TrainingOptions:
    """
    Options of a training. Each is a flag of ``bulletarm-zoo train`` with rl_zoo3's name, meaning and default:
    ``eval_freq`` is ``--eval-freq``. ``bulletarm-zoo train --help`` describes them.

    :raises CommandError: for an invalid value
    """

    n_timesteps: int = _option(
        -1, "time steps of training (default: the preset's)", "-n", type=whole_number(1)
    )
    eval_freq: int = _option(25000, "time steps between two evaluations, 0 for none", type=int)
    eval_episodes: int = _option(5, "episodes of an evaluation", type=whole_number(1))
    n_eval_envs: int = _option(1, "environments of an evaluation", type=whole_number(1))
    save_freq: int = _option(
        -1, "time steps between two checkpoints, 0 for none (default: a tenth of the training)", type=int
    )
    vec_env: str = _option(
        "dummy", "all environments in one process, or one process each", choices=("dummy", "subproc")
    )
    num_threads: int = _option(
        -1, "threads of PyTorch (default: PyTorch's own number)", type=whole_number(1, 1024)
    )
    trained_agent: str = _option("", "model file to start from", "-i")
    tensorboard_log: str = _option("", "folder for TensorBoard", "-tb")
    track: bool = _option(False, "log to Weights & Biases (set its project by WANDB_PROJECT)")
    verbose: int = _option(1, "0 prints only the run folder, 1 also tables (default)", type=whole_number(0))

    def __post_init__(self) -> None:
        for item in fields(self):
            _check(item, getattr(self, item.name))

    @classmethod
    def of(cls, experiment: ExperimentConfig, given: Mapping[str, Any] | None = None) -> "TrainingOptions":
        """
        Return the options of an experiment's preset, which ``given`` options replace.

        :raises CommandError: for an invalid value, or if the model file or an optional package is missing
        """
        values = {**experiment.flags, **(given or {})}
        check_names("option of the training", values, [item.name for item in fields(cls)])
        options = cls(**values)
        options.check_packages()
        file = Path(options.trained_agent)
        if options.trained_agent and (file.suffix != ".zip" or not file.is_file()):
            raise CommandError(f"--trained-agent must be an existing .zip file, got {file}")
        return options

    def check_packages(self) -> None:
        """Raise ``CommandError`` if an optional package is not installed."""
        for name, packages in PACKAGES.items():
            if getattr(self, name) and (missing := [item for item in packages if find_spec(item) is None]):
                raise CommandError(f"{flag(name)} needs a package: pip install {' '.join(missing)}")


def _check(item: Field[Any], value: Any) -> None:
    """Check a value as the command line does."""
    kwargs = item.metadata["kwargs"]
    if value == item.default:
        return
    if type(value).__name__ != (kind := type(item.default).__name__):
        raise CommandError(f"{flag(item.name)} must be of the type {kind}, got {value!r}")
    check_names(flag(item.name), [value], kwargs.get("choices", [value]))
    try:
        kwargs.get("type", str)(str(value))
    except (ValueError, argparse.ArgumentTypeError) as error:
        raise CommandError(f"{flag(item.name)}: {error}") from error


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a training. A flag that is not passed adds no attribute to the parsed arguments."""
    group = parser.add_argument_group("options of the training", argument_default=argparse.SUPPRESS)
    for item in fields(TrainingOptions):
        kwargs = item.metadata["kwargs"] or ({"action": "store_true"} if item.default is False else {})
        group.add_argument(*item.metadata["short"], flag(item.name), help=item.metadata["help"], **kwargs)


def given_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options among the arguments of a parser with :func:`add_options`, by name."""
    names = [item.name for item in fields(TrainingOptions)]
    return {name: value for name, value in vars(args).items() if name in names}


def flag(name: str) -> str:
    """Return the flag of an argument."""
    return "-params" if name == "hyperparams" else f"--{name.replace('_', '-')}"
