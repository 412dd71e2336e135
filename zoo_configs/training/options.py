"""How a cell is trained: what ``rl_zoo3.train`` takes as flags, as values and as flags of our own parser."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zoo_configs.arguments import KeyValues, Parser, whole_number
from zoo_configs.errors import CommandError, unknown_name

if TYPE_CHECKING:
    from zoo_configs.cells.cell import Cell

# Of rl_zoo3's search for hyperparameters.
TUNING = (
    "-optimize",
    "--optimize-hyperparameters",
    "--max-total-trials",
    "--n-evaluations",
    "--n-jobs",
    "--n-startup-trials",
    "--n-trials",
    "--no-optim-plots",
    "--optimization-log-path",
    "--pruner",
    "--sampler",
    "--storage",
    "--study-name",
    "--trial-id",
)
VEC_ENVS = ("dummy", "subproc")
# Packages that rl_zoo3 does not require, by the option that does.
PACKAGES = {"tensorboard_log": ("tensorboard",), "track": ("wandb", "tensorboard")}


@dataclass(frozen=True)
class TrainingOptions:
    """
    How a cell is trained. Names, meanings and defaults are those of the flags of ``rl_zoo3.train``.

    :param n_timesteps: Length of the training in time steps over all environments; -1 takes the cell's
    :param eval_freq: Time steps between two evaluations; 0 or less for none
    :param eval_episodes: Episodes of an evaluation
    :param n_eval_envs: Environments of an evaluation
    :param save_freq: Time steps between two checkpoints; 0 or less for none
    :param save_replay_buffer: Whether to save the replay buffer beside the last model
    :param vec_env: ``"dummy"`` steps the environments in turn, ``"subproc"`` each in a process of its own
    :param num_threads: Threads of PyTorch, -1 leaves them as they are
    :param log_interval: Episodes between two logs, -1 takes the algorithm's, -2 for none
    :param trained_agent: A model file from which to begin
    :param truncate_last_trajectory: Whether a loaded replay buffer ends with its last episode
    :param eval_env_kwargs: Parameters of the evaluation's environments that differ from those of training
    :param tensorboard_log: Folder for TensorBoard
    :param track: Whether to log to Weights & Biases
    :param wandb_project_name: Its project
    :param wandb_entity: Its entity
    :param wandb_group: Its group
    :param wandb_tags: Its tags
    :param uuid: Whether the run folder's name ends in an identifier of its own
    :param verbose: 0 prints nothing of what is built and logged, 1 does
    :raises CommandError: for a value that an option does not take, or a package that it needs
    """

    n_timesteps: int = -1
    eval_freq: int = 25000
    eval_episodes: int = 5
    n_eval_envs: int = 1
    save_freq: int = -1
    save_replay_buffer: bool = False
    vec_env: str = "dummy"
    num_threads: int = -1
    log_interval: int = -1
    trained_agent: str = ""
    truncate_last_trajectory: bool = True
    eval_env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    tensorboard_log: str = ""
    track: bool = False
    wandb_project_name: str = "sb3"
    wandb_entity: str | None = None
    wandb_group: str | None = None
    wandb_tags: tuple[str, ...] = ()
    uuid: bool = False
    verbose: int = 1

    def __post_init__(self) -> None:
        for name in ("n_timesteps", "num_threads"):
            _check_count(name, getattr(self, name), but=-1)
        for name in ("eval_episodes", "n_eval_envs"):
            _check_count(name, getattr(self, name))
        if self.vec_env not in VEC_ENVS:
            raise unknown_name(_flag("vec_env"), self.vec_env, VEC_ENVS)
        for name, packages in PACKAGES.items():
            if getattr(self, name) and (missing := [item for item in packages if find_spec(item) is None]):
                needed = f"needs what is not installed: pip install {' '.join(missing)}"
                raise CommandError(f"{_flag(name)} {needed}")
        if self.trained_agent:
            check_trained_agent(Path(self.trained_agent))

    @classmethod
    def of(cls, cell: Cell, given: Mapping[str, Any] | None = None) -> TrainingOptions:
        """
        The options of a cell.

        :param cell: The cell, whose flags are its defaults
        :param given: Options that win over them
        :return: The options
        :raises CommandError: for an option that does not exist, or a value that it does not take
        """
        values = {**cell.flags, **(given or {})}
        for name in values:
            if name not in (names := [item.name for item in fields(cls)]):
                raise unknown_name("option of training", name, names)
        return replace(cls(), **values)

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> TrainingOptions:
        """
        The options that :meth:`plain` has written.

        :param values: What it wrote
        :return: The options
        """
        return cls(**{**values, "wandb_tags": tuple(values["wandb_tags"])})

    def plain(self) -> dict[str, Any]:
        """All values as YAML can hold them."""
        values = asdict(self)
        return {**values, "wandb_tags": list(self.wandb_tags), "eval_env_kwargs": dict(self.eval_env_kwargs)}


def _check_count(name: str, value: int, but: int | None = None) -> None:
    if value != but and (not isinstance(value, int) or value < 1):
        raise CommandError(f"{_flag(name)} takes a whole number of at least 1, got {value!r}")


def check_trained_agent(path: Path) -> None:
    """
    Check the model that training is to go on from.

    :param path: As given to ``-i``
    :raises CommandError: if there is no such model
    """
    if path.suffix != ".zip" or not path.is_file():
        raise CommandError(f"--trained-agent takes the .zip file of a model, got {path}")


def add_options(parser: argparse.ArgumentParser, tuning: bool = True) -> None:
    """
    Add the flags of ``rl_zoo3.train``. Those that are not given leave no trace in what is parsed; those of
    its search for hyperparameters are refused.

    :param parser: Parser of a command
    :param tuning: Whether to add those that are refused
    """
    group = parser.add_argument_group("flags of rl_zoo3.train", argument_default=argparse.SUPPRESS)
    add, number = group.add_argument, whole_number
    add("-n", "--n-timesteps", type=number(1), help="time steps of training (default: the cell's)")
    add("--eval-freq", type=int, help="time steps between two evaluations, none if not positive")
    add("--eval-episodes", type=number(1), help="episodes of an evaluation")
    add("--n-eval-envs", type=number(1), help="environments of an evaluation")
    add("--save-freq", type=int, help="time steps between two checkpoints, none if not positive")
    add("--save-replay-buffer", action="store_true", help="save the replay buffer beside the last model")
    add(
        "--vec-env", choices=VEC_ENVS, help="environments in one process, in one each, or divided among cores"
    )
    add("--num-threads", type=number(-1), help="threads of PyTorch (default, and -1: as it chooses)")
    add("--log-interval", type=int, help="episodes between two logs (-2: none)")
    add("-i", "--trained-agent", help="model file from which to begin")
    add("--truncate-last-trajectory", type=_truth, help="whether a loaded replay buffer ends its episode")
    add(
        "--eval-env-kwargs",
        nargs="+",
        action=KeyValues,
        metavar="KEY:VALUE",
        help="evaluation's environments",
    )
    add("-tb", "--tensorboard-log", help="folder for TensorBoard")
    add("--track", action="store_true", help="log to Weights & Biases")
    add("--wandb-project-name", help="its project")
    add("--wandb-entity", help="its entity")
    add("--wandb-group", help="its group")
    add("-tags", "--wandb-tags", nargs="+", help="its tags")
    add("-uuid", "--uuid", action="store_true", help="an identifier of its own in the run folder's name")
    add(
        "--verbose",
        type=number(0),
        help="0 names the run folder only, 1 tells what is done (default)",
    )
    for flag in TUNING if tuning else ():
        add(flag, nargs="*", dest="tuning", action=_Refuse, help=argparse.SUPPRESS)


class _Refuse(argparse.Action):
    def __call__(self, *args: Any) -> None:
        raise CommandError(f"train does not tune: {args[-1]} belongs to bulletarm-zoo tune")


def _truth(text: str) -> bool:
    if text not in ("True", "False"):
        raise argparse.ArgumentTypeError(f"takes True or False, got {text!r}")
    return text == "True"


def given_options(args: argparse.Namespace) -> dict[str, Any]:
    """
    The options among parsed flags.

    :param args: What a parser with :func:`add_options` has parsed
    :return: Those that are given
    """
    names = [item.name for item in fields(TrainingOptions)]
    return {name: value for name, value in vars(args).items() if name in names}


def parser_of_options(prog: str) -> argparse.ArgumentParser:
    """
    A parser of these flags alone.

    :param prog: Name of the program, for its help
    :return: The parser
    """
    parser = Parser(prog, add_help=False, allow_abbrev=False)
    add_options(parser)
    return parser


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
