"""``bulletarm-zoo benchmark``: trains all experiments of a benchmark on one machine or on a cluster."""

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from zoo_configs.arguments import check_device
from zoo_configs.benchmarking.cluster import check_address, check_resources, connected, machines, run_on_ray
from zoo_configs.benchmarking.plan import build_jobs, read_plan
from zoo_configs.benchmarking.process import run_here
from zoo_configs.benchmarking.run import GIGABYTE, Overview, Runner, Size, check_jobs, size_of, train_jobs
from zoo_configs.drawing.tables import print_table
from zoo_configs.errors import CommandError
from zoo_configs.files import made_folder, print_written
from zoo_configs.parsers import GPUS_A_RUN
from zoo_configs.training.runs import Run
from zoo_configs.training.state import State


def main(args: argparse.Namespace) -> None:
    """Run the command; raise ``CommandError`` before anything is written, or at the end if runs failed."""
    if args.ray is not None and not args.dry_run:
        check_address(args.ray)
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
        n_jobs = int(args.jobs or max(1, (os.cpu_count() or 1) / args.cpus))
        yield lambda waiting, look: run_here(waiting, n_jobs, look)
        return
    with connected(args.ray, folder, jobs[0].gym_packages) as token:
        resources = {job.folder: _resources(args, sizes[job.folder.parent]) for job in jobs}
        check_resources(resources)
        yield lambda waiting, look: run_on_ray(waiting, resources, token, look)


def _resources(args: argparse.Namespace, size: Size) -> dict[str, float]:
    has_gpus = args.device != "cpu" and any("GPU" in node["Resources"] for node in machines())
    gpus = args.gpus if args.gpus is not None else GPUS_A_RUN if has_gpus else 0.0
    memory = int((args.memory or size.memory) * GIGABYTE)
    return {"num_cpus": args.cpus, "num_gpus": gpus, "memory": memory}


def _report(overview: Overview) -> None:
    """Print the status at the end."""
    print(overview.counts())
    print_written(overview.folder)
    failed, number = overview.of(State.FAILED), len(overview.entries)
    if failed:
        first = f"{failed[0]}: {overview.entries[failed[0]].detail}"
        raise CommandError(f"{len(failed)} of {number} runs failed. Use --retry-failed to restart; {first}")
    if left := number - len(overview.of(State.DONE)):
        raise CommandError(f"{left} of {number} runs are locked by other processes")
