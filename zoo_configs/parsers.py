"""Parsers of the commands of ``bulletarm-zoo``. They import neither PyTorch nor the engine."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from zoo_configs.arguments import (
    MAX_SEED,
    Parser,
    add_agent_flags,
    add_env_kwargs,
    add_packages,
    add_progress,
    add_run_filters,
    folder_name,
    positive_int,
    positive_number,
    seed,
    whole_number,
)
from zoo_configs.experiments.flags import PRESETS, add_experiment_flags
from zoo_configs.training.options import add_options

DEMO_SUFFIXES = (".h5", ".hdf5")
PLOT_SUFFIXES = (".png", ".pdf", ".svg")
VIDEO_FORMATS = ("gif", "mp4")
GPUS_A_RUN = 0.25
"""GPUs of a run on a cluster with GPUs."""


def _parser(function: Callable[..., Any], example: str = "") -> Parser:
    """Return the parser of the command that a function parses; its docstring describes the command."""
    program = f"bulletarm-zoo {function.__name__.removeprefix('parse_')}"
    epilog = f"{program} {example}" if example else None
    return Parser(program, description=function.__doc__, epilog=epilog, allow_abbrev=False)


def parse_train(argv: Sequence[str]) -> argparse.Namespace:
    """
    Train an agent.

    --baseline, --preset and --env name an experiment, whose hyperparameters are written to the run folder.
    The options of the training replace the preset's.
    """
    parser = _parser(
        parse_train, "--baseline equi_sacfd --env BulletArm/CloseLoopBlockPicking-v0 --preset quick"
    )
    add_experiment_flags(parser)
    add = parser.add_argument
    add("--resume", type=Path, metavar="RUN_FOLDER", help="resume a run from its last checkpoint")
    add("--dry-run", action="store_true", help="print the configuration and the source of each value")
    add("--seed", type=whole_number(-1, MAX_SEED), help="seed of the run (default, and -1: sampled)")
    add("--device", help="PyTorch device (default: auto; with --resume that of the run)")
    add("-f", "--log-folder", type=Path, help="folder for run folders (default: logs)")
    add("--allow-mismatched-demos", action="store_true", help="accept expert_data from another environment")
    add_packages(parser)
    add_progress(parser)
    add_options(parser)
    return parser.parse_args(argv)


def parse_tune(argv: Sequence[str]) -> argparse.Namespace:
    """
    Search hyperparameters.

    The experiment is named as for train, and its values are the first trial. Processes with the same command,
    on machines that share the log folder, work on one study. A trial whose process dies is continued by
    another process. The same command continues a study.
    """
    parser = _parser(parse_tune, "--baseline sacfd --env BulletArm/CloseLoopBlockReaching-v0 --n-trials 20")
    add_experiment_flags(parser)
    add = parser.add_argument
    add("--seed", type=seed, default=0, help="seed of all trials and the sampler (default: 0)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of studies/ (default: logs)")
    add("--space", type=Path, help="YAML with the search space (default: that of the algorithm)")
    add("--n-trials", type=positive_int, default=100, help="trials of all processes (default: 100)")
    add("--n-startup-trials", type=whole_number(0), default=10, help="trials at random (default: 10)")
    add("--n-evaluations", type=positive_int, default=8, help="evaluations of a trial (default: 8)")
    add("--pruner", choices=("median", "none"), default="median", help="default: median")
    add("--storage", help="URL of a database, or a journal file (default: a journal in the study's folder)")
    add("--study-name", type=folder_name, help="default: the baseline and the task")
    add_packages(parser)
    add_progress(parser)
    add_options(parser)
    args = parser.parse_args(argv)
    if hasattr(args, "eval_freq"):
        parser.error("--eval-freq follows from the time steps of a trial. Use --n-evaluations.")
    return args


def parse_enjoy(argv: Sequence[str]) -> argparse.Namespace:
    """
    Evaluate a trained agent with its deterministic policy: the agent of a run, a model that save() wrote, or,
    with --published, an agent of the package. The last line is, for example, "success_rate=0.98 episodes=50",
    or "mean_return=-150.20 episodes=50" if the environment reports no success.
    """
    parser = _parser(parse_enjoy)
    add_agent_flags(parser)
    add = parser.add_argument
    add("-n", "--episodes", type=positive_int, default=50, help="number of episodes (default: 50)")
    add("--n-envs", type=positive_int, default=1, help="number of environments in processes (default: 1)")
    return parser.parse_args(argv)


def parse_verify(argv: Sequence[str]) -> argparse.Namespace:
    """
    Train the first updates of a run or of a published agent again, and compare checksums of its observations,
    replay buffer and parameters with those that were recorded in the training. They are equal with the same
    code, processor type and versions. The exit code is 2 if they differ.
    """
    parser = _parser(parse_verify)
    add = parser.add_mutually_exclusive_group(required=True).add_argument
    add("path", nargs="?", type=Path, metavar="RUN_FOLDER", help="run folder, as train prints it")
    add("--published", metavar="TASK", help="verify the agent of the package, or a folder written by push")
    add = parser.add_argument
    add("--baseline", help="with --published: baseline of the agent")
    add("--updates", type=whole_number(0), default=200, help="maximum number of updates (default: 200)")
    add_progress(parser)
    args = parser.parse_args(argv)
    if args.baseline is not None and args.published is None:
        parser.error("--baseline needs --published")
    return args


def parse_record(argv: Sequence[str]) -> argparse.Namespace:
    """
    Record a video of a trained agent, of an agent of the package (--published), or of the expert of --env
    (--expert). It shows the rendered scene next to the observed images and, for a policy over pixels, the
    value of each pixel and the selected one.
    """
    parser = _parser(parse_record)
    add_agent_flags(parser)
    add = parser.add_argument
    add("--expert", action="store_true", help="record the expert of --env")
    add("-n", "--episodes", type=positive_int, default=5, help="number of episodes (default: 5)")
    add("--format", choices=VIDEO_FORMATS, default="gif", help="format without --output (default: gif)")
    add("-o", "--output", type=Path, help=".gif or .mp4 file to write (default: in the run folder)")
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix[1:] not in VIDEO_FORMATS:
        parser.error(f"--output must end in .gif or .mp4, got {args.output}")
    if args.expert and (args.env is None or args.path is not None or args.published is not None):
        parser.error("--expert records the expert of --env: pass --env, and neither a path nor --published")
    of_agents = {"--baseline": args.baseline, "--algo": args.algo, "--preset": args.preset}
    unused = [flag for flag, value in (of_agents | {"--load-last": not args.load_best}).items() if value]
    if args.expert and unused:
        parser.error(f"{', '.join(unused)} cannot be combined with --expert")
    return args


def parse_push(argv: Sequence[str]) -> argparse.Namespace:
    """
    Upload a trained agent to the Hugging Face hub, or write it to a folder (--folder): a small model file,
    tested as it was written, and a card. The token is that of `hf auth login` or HF_TOKEN.
    """
    parser = _parser(parse_push)
    add_agent_flags(parser, is_run=True)
    add = parser.add_mutually_exclusive_group(required=True).add_argument
    add("-orga", "--organization", help="organization or user of the repository on the hub")
    add("--folder", type=Path, help="write this folder instead; an existing agent is replaced")
    add = parser.add_argument
    add("-name", "--repo-name", help="name of the repository (default: BASELINE-ENV)")
    add("-n", "--episodes", type=positive_int, default=100, help="number of test episodes (default: 100)")
    args = parser.parse_args(argv)
    if args.folder is not None and args.repo_name is not None:
        parser.error("--repo-name needs --organization")
    return args


def parse_benchmark(argv: Sequence[str]) -> argparse.Namespace:
    """
    Train all experiments of a benchmark with all seeds, in processes of this machine or on a Ray cluster.

    The same command resumes a benchmark: runs that are done are kept, interrupted runs resume from their last
    checkpoint.
    """
    parser = _parser(
        parse_benchmark, "close_loop_4d --env 'CloseLoopBlock*' --baseline sacfd equi_sacfd -j 2"
    )
    add, names = parser.add_argument, "close_loop_4d, close_loop_3d, open_loop_2d, open_loop_3d, open_loop_6d"
    add("name", metavar="NAME", help=f"{names} or a YAML file")
    add("-f", "--log-folder", type=Path, help="folder of all runs (default: benchmarks/NAME)")
    add("--dry-run", action="store_true", help="list experiments, memory and disk, and train nothing")
    add("--retry-failed", action="store_true", help="restart failed runs")
    add_packages(parser)
    add_progress(parser)
    add = parser.add_argument_group("experiments").add_argument
    add("--env", nargs="+", help="tasks or shell patterns (default: all of the benchmark)")
    add("--baseline", nargs="+", help="baselines or shell patterns (default: all of the benchmark)")
    add("--preset", help=f"{PRESETS} (default: paper with a GPU, else cpu)")
    add("--seeds", "--seed", nargs="+", type=seed, help="seeds (default: 0 1 2 3, as in the paper)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add = parser.add_argument_group("resources").add_argument
    gpus = f"with --ray: GPUs of a run (default: {GPUS_A_RUN} if the cluster has GPUs)"
    address: dict[str, Any] = {"nargs": "?", "const": "auto", "metavar": "ADDRESS"}
    add("-j", "--jobs", type=positive_int, help="simultaneous runs (default: cores divided by --cpus)")
    add("--cpus", type=positive_number, default=1.0, help="cores and threads of a run (default: 1)")
    add("--gpus", type=positive_number, help=gpus)
    add("--memory", type=positive_number, help="with --ray: gigabytes of a run (default: see --dry-run)")
    add("--ray", **address, help="train on a Ray cluster (default: auto)")
    args = parser.parse_args(argv)
    if args.ray is None and (args.gpus is not None or args.memory is not None):
        parser.error("--gpus and --memory need --ray. Use -j for the number of runs on this machine")
    if args.ray is not None and args.jobs is not None:
        parser.error("-j cannot be combined with --ray. Use --cpus, --gpus and --memory")
    return args


def parse_plot(argv: Sequence[str]) -> argparse.Namespace:
    """
    Draw the evaluations of all runs in a log folder: a panel for each environment and a curve for each
    experiment, with the mean over the seeds and its standard error. Runs of an experiment differ only in
    their seeds. Experiments with the same baseline are labelled with the variant of the benchmark or with the
    settings that differ. Print tables of the experiments and of the baselines over all tasks, and write them
    next to the figure.
    """
    parser = _parser(parse_plot)
    add, kinds = parser.add_argument, ", ".join(PLOT_SUFFIXES)
    add("--env", nargs="+", help="environment ids (default: all)")
    add("--baseline", nargs="+", help="baselines (default: all)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
    add("-o", "--output", type=Path, help=f"{kinds} file to write (default: a .png in the log folder)")
    add("--training", action="store_true", help="draw critic values and policy entropy instead")
    add_run_filters(parser)
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix not in PLOT_SUFFIXES:
        parser.error(f"--output must end in {kinds}, got {args.output}")
    return args


def parse_demos(argv: Sequence[str]) -> argparse.Namespace:
    """
    Collect successful episodes of an expert into one HDF5 file, which is written at the end.

    To train with it: bulletarm-zoo train ... -params expert_data:FILE.
    """
    parser = _parser(parse_demos)
    add = parser.add_argument
    add("--env", required=True, help="environment id, see bulletarm-zoo list")
    add("-n", "--episodes", type=positive_int, default=100, help="successful episodes (default: 100)")
    add("--planner", default="waypoint", help="waypoint (default) or deconstruction")
    add("--seed", type=seed, default=0, help="seed of the collection (default: 0)")
    add("-o", "--output", type=Path, help="file to write (default: ENV-PLANNER.h5 in the log folder)")
    add("-f", "--log-folder", type=Path, default=Path(), help="folder of the file (default: this one)")
    add("--device", default="auto", help="PyTorch device; it is only checked, as experts do not use PyTorch")
    add_env_kwargs(parser)
    add_packages(parser)
    add_progress(parser)
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix not in DEMO_SUFFIXES:
        parser.error(f"--output must end in {' or '.join(DEMO_SUFFIXES)}, got {args.output}")
    return args


def parse_list(argv: Sequence[str]) -> argparse.Namespace:
    """
    List environments.

    --env lists the spaces and parameters of one environment, --baselines the baselines and presets of train,
    --published the published agents, and --log-folder the evaluated runs of a folder.
    """
    parser = _parser(parse_list)
    add = parser.add_argument
    add(
        "--env",
        help="id of an environment, to list its parameters and defaults, or with --log-folder its runs",
    )
    kinds = parser.add_mutually_exclusive_group().add_argument
    kinds("--baselines", action="store_true", help="list baselines and presets")
    kinds("--published", action="store_true", help="list the published agents")
    kinds("-f", "--log-folder", type=Path, help="folder of all runs, to list its runs")
    add_run_filters(parser)
    add_packages(parser)
    args = parser.parse_args(argv)
    if args.log_folder is None and (args.seed is not None or args.device is not None):
        parser.error("--seed and --device need --log-folder")
    if args.env is not None and (args.baselines or args.published):
        parser.error("--env cannot be combined with --baselines or --published")
    return args
