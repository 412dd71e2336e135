"""``bulletarm-zoo benchmark``: trains all experiments of a benchmark on one machine or on a cluster."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_packages, add_progress, check_device, positive_int, seed
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.experiments.flags import PRESETS
from zoo_configs.files import made_folder, print_written

if TYPE_CHECKING:
    from zoo_configs.benchmarking.run import Overview, Runner, Size
    from zoo_configs.training.runs import Run

DESCRIPTION = """Train all experiments of a benchmark with all seeds, in processes of this machine or on a Ray
cluster. The same command resumes a benchmark: runs that are done are kept, interrupted runs resume from their
last checkpoint."""
EPILOG = "bulletarm-zoo benchmark close_loop_4d --env 'CloseLoopBlock*' --baseline sacfd equi_sacfd -j 2"
GPUS_A_RUN = 0.25


def main(argv: Sequence[str]) -> None:
    """Run the command; raise ``CommandError`` before anything is written, or at the end if runs failed."""
    args = _parse(argv)
    if args.ray is not None and not args.dry_run:
        from zoo_configs.benchmarking.cluster import check_address

        check_address(args.ray)
    from zoo_configs.benchmarking.plan import build_jobs, read_plan
    from zoo_configs.benchmarking.run import check_jobs, size_of, train_jobs

    passed = {"tasks": args.env, "baselines": args.baseline, "preset": args.preset, "seeds": args.seeds}
    changes = {name: value for name, value in passed.items() if value is not None}
    plan = replace(read_plan(args.name), **changes)
    folder = (args.log_folder or Path("benchmarks") / Path(args.name).stem).absolute()
    jobs = build_jobs(plan, folder, args.gym_packages, args.device, max(1, int(args.cpus)))
    if args.ray is None:
        check_device(args.device)
    check_jobs(jobs, folder)
    sizes = {name: size_of(job) for name, job in {job.folder.parent: job for job in reversed(jobs)}.items()}
    if args.dry_run:
        _print_sizes(jobs, sizes)
        return
    with made_folder(folder), _runner(jobs, sizes, folder, args) as runner:
        _report(train_jobs(jobs, folder, runner, args.retry_failed, args.progress))


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo benchmark", description=DESCRIPTION, epilog=EPILOG)
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
    add("-j", "--jobs", type=positive_int, help="simultaneous runs (default: cores divided by --cpus)")
    add("--cpus", type=positive_number, default=1.0, help="cores and threads of a run (default: 1)")
    add("--gpus", type=positive_number, help=gpus)
    add("--memory", type=positive_number, help="with --ray: gigabytes of a run (default: see --dry-run)")
    add(
        "--ray",
        nargs="?",
        const="auto",
        metavar="ADDRESS",
        help="train on a Ray cluster (default: auto)",
    )
    args = parser.parse_args(argv)
    if args.ray is None and (args.gpus is not None or args.memory is not None):
        parser.error("--gpus and --memory need --ray. Use -j for the number of runs on this machine")
    if args.ray is not None and args.jobs is not None:
        parser.error("-j cannot be combined with --ray. Use --cpus, --gpus and --memory")
    return args


def positive_number(text: str) -> float:
    """Parse a finite number greater than 0."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be greater than 0, got {text!r}")
    return value


def _print_sizes(jobs: Sequence[Run], sizes: Mapping[Path, Size]) -> None:
    rows = []
    for name, size in sorted(sizes.items()):
        seeds = " ".join(str(job.seed) for job in jobs if job.folder.parent == name)
        rows.append(["/".join(name.parts[-2:]), seeds, f"{size.memory:.1f}", f"{size.disk:.2f}"])
    print_table(["experiment", "seeds", "GB of memory", "GB of disk"], rows)
    disk = sum(sizes[job.folder.parent].disk for job in jobs)
    print(f"{len(rows)} experiments, {len(jobs)} runs, {disk:.2f} GB of disk")


@contextmanager
def _runner(
    jobs: Sequence[Run], sizes: Mapping[Path, Size], folder: Path, args: argparse.Namespace
) -> Iterator[Runner]:
    """Prepare the machine or the cluster, and provide the function that trains runs."""
    if args.ray is None:
        from zoo_configs.benchmarking.process import run_here

        n_jobs = int(args.jobs or max(1, (os.cpu_count() or 1) // max(1, int(args.cpus))))
        yield lambda waiting, look: run_here(waiting, n_jobs, look)
        return
    from zoo_configs.benchmarking.cluster import check_resources, connected, run_on_ray

    with connected(args.ray, folder, args.gym_packages) as token:
        resources = {job.folder: _resources(args, sizes[job.folder.parent]) for job in jobs}
        check_resources(resources)
        yield lambda waiting, look: run_on_ray(waiting, resources, token, look)


def _resources(args: argparse.Namespace, size: Size) -> dict[str, float]:
    from zoo_configs.benchmarking.cluster import machines
    from zoo_configs.benchmarking.run import GIGABYTE

    has_gpus = args.device != "cpu" and any("GPU" in node["Resources"] for node in machines())
    gpus = args.gpus if args.gpus is not None else GPUS_A_RUN if has_gpus else 0.0
    memory = int((args.memory or size.memory) * GIGABYTE)
    return {"num_cpus": args.cpus, "num_gpus": gpus, "memory": memory}


def _report(overview: Overview) -> None:
    """Print the status at the end."""
    from zoo_configs.training.state import State

    print(overview.counts())
    print_written(overview.folder)
    failed, number = overview.of(State.FAILED), len(overview.entries)
    if failed:
        first = f"{failed[0]}: {overview.entries[failed[0]].detail}"
        raise CommandError(f"{len(failed)} of {number} runs failed. Use --retry-failed to restart; {first}")
    if left := number - len(overview.of(State.DONE)):
        raise CommandError(f"{left} of {number} runs are locked by other processes")
