"""``bulletarm-zoo benchmark``: trains all cells of a benchmark, here or on a cluster."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import (
    MAX_SEED,
    Parser,
    add_packages,
    add_progress,
    check_device,
    positive_int,
    whole_number,
)
from zoo_configs.cells.flags import PRESETS
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.files import missing_folders, remove_empty

if TYPE_CHECKING:
    from zoo_configs.benchmarking.cluster import Share
    from zoo_configs.benchmarking.cost import Cost
    from zoo_configs.benchmarking.overview import Overview
    from zoo_configs.benchmarking.run import Runner
    from zoo_configs.benchmarking.sweep import Member, Plan, Sweep

DESCRIPTION = """Train all cells of a benchmark with all seeds, in processes of this machine or on a Ray
cluster. A second start goes on: what is done is left, what was interrupted goes on from its last
checkpoint."""
EPILOG = "bulletarm-zoo benchmark close_loop_4d --env 'CloseLoopBlock*' --baseline sacfd equi_sacfd -j 2"
THIS_CLUSTER = ""
GPU_SHARE = 0.25  # four runs on a GPU, unless --gpus says


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: for what cannot be trained, before anything is written; at the end, if runs failed
    :raises KeyboardInterrupt: after Ctrl-C, once all runs have stopped; they can go on
    """
    args = _parse(argv)
    from zoo_configs.benchmarking.run import check_cells, check_folder, run_sweep
    from zoo_configs.benchmarking.sweep import build_sweep, read_plan

    plan = _narrowed(read_plan(args.name), args)
    sweep = build_sweep(Path(args.name).stem, plan, args.gym_packages, args.device, max(1, int(args.cpus)))
    if args.ray is None:
        check_device(args.device)
    check_cells(sweep)
    costs = _costs(sweep, args)
    if args.dry_run:
        _print_costs(sweep, costs, args)
        return
    folder = args.log_folder or Path("benchmarks") / sweep.name
    check_folder(sweep, folder)
    made = missing_folders(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _runner(sweep, costs, folder, args) as runner:
            live = args.progress if args.progress is not None else sys.stderr.isatty()
            command = shlex.join(["bulletarm-zoo", "benchmark", *argv])
            overview = run_sweep(sweep, folder, runner, command, args.retry_failed, live)
    finally:
        remove_empty(made)
    _tell_end(overview)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo benchmark", description=DESCRIPTION, epilog=EPILOG)
    names = "open_loop_2d, open_loop_3d, open_loop_6d, close_loop_3d, close_loop_4d or a YAML"
    folder = "folder of all runs (default: benchmarks/NAME)"
    add = parser.add_argument
    add("name", metavar="NAME", help=names)
    add("-f", "--log-folder", type=Path, metavar="FOLDER", help=folder)
    add("--dry-run", action="store_true", help="list cells, hours and gigabytes, and train nothing")
    add("--retry-failed", action="store_true", help="begin runs again that have failed")
    _add_cells(parser)
    _add_shares(parser)
    add_packages(parser)
    add_progress(parser)
    args = parser.parse_args(argv)
    if args.ray is None and (args.gpus is not None or args.memory is not None):
        advice = "on this machine -j says how many runs there are at once"
        parser.error(f"--gpus and --memory belong to --ray: {advice}")
    if args.ray is not None and args.jobs is not None:
        advice = "with --ray the shares of a run (--cpus, --gpus, --memory) decide"
        parser.error(f"-j is for this machine: {advice}")
    return args


def _add_cells(parser: Parser) -> None:
    group = parser.add_argument_group("cells")
    add, a_seed = group.add_argument, whole_number(0, MAX_SEED)
    add("--env", nargs="+", help="tasks, or shell patterns, instead of the benchmark's")
    add("--baseline", nargs="+", help="baselines, or shell patterns, instead of the benchmark's")
    add("--preset", help=f"{PRESETS} (default: cpu)")
    seeds = "seeds (default: 0 1 2 3, as many as in the paper)"
    add("--seeds", "--seed", nargs="+", type=a_seed, help=seeds)
    add("--device", default="auto", help="PyTorch device (default: auto)")


def _add_shares(parser: Parser) -> None:
    group = parser.add_argument_group("what runs take")
    add = group.add_argument
    jobs = "runs at once on this machine (default: its cores over --cpus)"
    gpus = f"with --ray: GPUs of a run (default: {GPU_SHARE} where the cluster has some)"
    memory = "with --ray: gigabytes of a run (default: as --dry-run tells)"
    cluster = "train on a Ray cluster (default: this machine's)"
    add("-j", "--jobs", type=positive_int, help=jobs)
    add("--cpus", type=_positive, default=1.0, help="cores, and threads, of a run (default: 1)")
    add("--gpus", type=_positive, help=gpus)
    add("--memory", type=_positive, help=memory)
    add("--ray", nargs="?", const=THIS_CLUSTER, metavar="ADDRESS", help=cluster)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number greater than 0, got {text!r}")
    return value


def _narrowed(plan: Plan, args: argparse.Namespace) -> Plan:
    given = {"tasks": args.env, "baselines": args.baseline, "preset": args.preset, "seeds": args.seeds}
    return replace(plan, **{name: value for name, value in given.items() if value is not None})


def _costs(sweep: Sweep, args: argparse.Namespace) -> dict[str, Cost]:
    """What a run of each cell takes, by task and baseline."""
    from zoo_configs.benchmarking.cost import estimate

    device = "cpu" if args.device == "cpu" or (args.ray is None and not _has_gpu()) else "cuda"
    first = {_cell_name(member): member for member in reversed(sweep.members)}
    return {name: estimate(member.cell, member.options, device) for name, member in first.items()}


def _has_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def _cell_name(member: Member) -> str:
    return member.name.rpartition("/")[0]


def _print_costs(sweep: Sweep, costs: dict[str, Cost], args: argparse.Namespace) -> None:
    rows, total, disk, unknown = [], 0.0, 0.0, 0
    for name, cost in sorted(costs.items()):
        seeds = [member.seed for member in sweep.members if _cell_name(member) == name]
        hours = "?" if cost.hours is None else f"{cost.hours:.2f}"
        rows.append([name, " ".join(map(str, seeds)), hours, f"{cost.memory:.1f}", f"{cost.disk:.2f}"])
        total += (cost.hours or 0.0) * len(seeds)
        disk += cost.disk * len(seeds)
        unknown += cost.hours is None
    print_table(["cell", "seeds", "hours a run", "GB of memory", "GB of disk"], rows)
    print(f"{len(costs)} cells, {len(sweep.members)} runs, {disk:.2f} GB of disk")
    known = f"{total:.2f} hours of runs in all"
    at_once = f", {total / _jobs(args):.2f} with {_jobs(args)} at once" if args.ray is None else ""
    print(known + at_once + (f"; {unknown} cells have not been measured on such a device" if unknown else ""))
    print("Hours are of idle cores like those of docs/speed.md, by network and preset.")


def _jobs(args: argparse.Namespace) -> int:
    return int(args.jobs or max(1, (os.cpu_count() or 1) // max(1, int(args.cpus))))


@contextmanager
def _runner(
    sweep: Sweep, costs: Mapping[str, Cost], folder: Path, args: argparse.Namespace
) -> Iterator[Runner]:
    """What trains the runs, once all that it needs is there."""
    from zoo_configs.benchmarking.local import run_here

    if args.ray is None:
        yield lambda tasks, look: run_here(tasks, _jobs(args), look)
        return
    from zoo_configs.benchmarking.cluster import check_shares, connected, run_on_ray, shared_folder

    with connected(args.ray or None):
        shares = {member.name: _share(args, costs[_cell_name(member)]) for member in sweep.members}
        check_shares(shares)
        with shared_folder(folder.absolute(), sweep.gym_packages) as token:
            yield lambda tasks, look: run_on_ray(tasks, shares, token, look)


def _share(args: argparse.Namespace, cost: Cost) -> Share:
    from zoo_configs.benchmarking.cluster import Share, machines

    has_gpus = args.device != "cpu" and any("GPU" in node["Resources"] for node in machines())
    default = GPU_SHARE if has_gpus else 0.0
    return Share(args.cpus, default if args.gpus is None else args.gpus, args.memory or cost.memory)


def _tell_end(overview: Overview) -> None:
    """Say how it ended."""
    from zoo_configs.benchmarking.overview import Status

    print(f"{overview.counts()}\nWritten:\n  {overview.folder}")
    failed, number = overview.of(Status.FAILED), len(overview.entries)
    if failed:
        again = "to begin them again: --retry-failed"
        first = f"{failed[0].name}: {failed[0].error}"
        raise CommandError(f"{len(failed)} of {number} runs failed, {again}; {first}")
    if left := number - len(overview.of(Status.DONE)):
        raise CommandError(f"{left} of {number} runs are being trained by other processes")
