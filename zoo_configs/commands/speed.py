"""``bulletarm-zoo speed``: steps a second with the expert, and what they are spent on."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bulletarm_gym.check.machine import describe_machine
from zoo_configs.arguments import (
    Parser,
    add_env_kwargs,
    add_packages,
    add_progress,
    device,
    hides_progress,
    positive_int,
    seed,
)
from zoo_configs.environments import known_env_id, our_env_ids, register_environments, try_env
from zoo_configs.measuring.data_files import OVERHEAD, SPEED, UPDATES, DataFile, Layout
from zoo_configs.measuring.speed_records import (
    overhead_record,
    throughput_record,
    update_record,
)
from zoo_configs.measuring.throughput import (
    ReferenceRate,
    Throughput,
    load_reference,
    measure_env,
)

if TYPE_CHECKING:
    from zoo_configs.cells.cell import Cell
    from zoo_configs.measuring.update_speed import UpdateSpeed

DESCRIPTION = """Measure steps a second with the expert in one process, split into physics (the engine's
steps), rendering (heightmaps) and the rest, and once without the expert. The yardstick is plain PyBullet, on
this machine at this hour. With --baseline instead: the time of one gradient update, split into its parts, the
greatest memory of its process, and how the equivariant convolutions compare with plain ones of the same
width, forward and backward, in turn. With --overhead in addition: what train adds to a bare
model.learn(), of five pairs in turn."""
DEFAULT_LEARNING_ENV = "BulletArm/CloseLoopBlockPicking-v0"
SHIPPED_REFERENCE = "data/reference_rates.csv"
COLUMNS = (
    "environment",
    "yardstick us",
    "steps/s",
    "ms/step",
    "physics",
    "rendering",
    "rest",
    "without expert",
    "without simulation",
    "reset ms",
    "expert",
)
COMPARISON_COLUMNS = ("reference steps/s", "ratio")


class Row(NamedTuple):
    """
    One environment of the table.

    :param ours: What was measured
    :param reference: What it is compared with, if anything
    """

    ours: Throughput
    reference: ReferenceRate | None

    @property
    def ratio(self) -> float | None:
        """How many times as fast as the reference, scaled by the yardsticks."""
        if self.reference is None:
            return None
        return self.ours.steps_per_second / self.reference.scaled_to(self.ours.yardstick)


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: for an unknown id, or a file that is no reference
    """
    args = _parse(argv)
    register_environments(args.gym_packages)
    data = _data_file(args)
    if data is not None:
        data.check("--data")
    if args.baseline:
        _measure_updates(args, data)
        return
    env_ids = [known_env_id(env_id) for env_id in args.env] or our_env_ids()
    for env_id in env_ids:
        try_env(env_id, args.env_kwargs)
    reference = load_reference(args.reference) if args.reference else {}
    print(describe_machine())
    rows: list[Row] = []
    try:
        for ours in _measure(env_ids, args):
            rows.append(Row(ours, reference.get(ours.env_id)))
            if data is not None:
                data.add(throughput_record(*rows[-1], args.env_kwargs, _throughput_flags(args)))
    finally:  # after Ctrl-C, too, with what there is
        _print(rows, args.markdown)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo speed", description=DESCRIPTION)
    add = parser.add_argument
    add("--env", nargs="+", default=[], help="environment ids (default: all of ours)")
    add("--seconds", type=float, default=5.0, help="how long to measure each (default: 5)")
    add("--seed", type=seed, default=0, help="seed of the first episode (default: 0)")
    help_text = "CSV to compare with (default where no file is named: the earlier implementation's rates)"
    add("--reference", type=Path, nargs="?", const=_shipped_reference(), metavar="FILE", help=help_text)
    add("--baseline", nargs="+", default=[], help="measure updates of these baselines, on the first --env")
    add("--preset", default="cpu", help="... with this preset (default: cpu)")
    add(
        "--overhead",
        type=positive_int,
        metavar="N",
        help="... or what train adds to trainings of N time steps",
    )
    add("--device", type=device, default="auto", help="... on this PyTorch device (default: auto)")
    add("--num-threads", type=positive_int, help="... with so many threads (default: PyTorch's choice)")
    add(
        "--data",
        type=Path,
        metavar="FILE",
        help="CSV to put the figures into, a row an environment or baseline",
    )
    add("--markdown", action="store_true", help="print a table for a Markdown page")
    add_env_kwargs(parser)
    add_packages(parser)
    add_progress(parser)
    args = parser.parse_args(argv)
    if not 0 < args.seconds < math.inf:
        parser.error(f"--seconds must be positive, got {args.seconds}")
    if args.overhead and not args.baseline:
        parser.error("--overhead goes with --baseline, which names what is trained")
    return args


def _data_file(args: argparse.Namespace) -> DataFile | None:
    return None if args.data is None else DataFile(args.data, _layout(args))


def _layout(args: argparse.Namespace) -> Layout:
    if args.baseline:
        return OVERHEAD if args.overhead else UPDATES
    return SPEED


def _throughput_flags(args: argparse.Namespace) -> list[str]:
    """What repeats a measurement besides its environment."""
    file = [] if args.reference in (None, _shipped_reference()) else [args.reference.name]
    reference = ["--reference", *file] if args.reference else []
    return ["--seconds", f"{args.seconds:g}", "--seed", str(args.seed), *reference]


def _device_flags(args: argparse.Namespace) -> list[str]:
    threads = ["--num-threads", str(args.num_threads)] if args.num_threads else []
    return ["--device", args.device, *threads]


def _shipped_reference() -> Path:
    return Path(str(resources.files("zoo_configs") / SHIPPED_REFERENCE))


def _measure_updates(args: argparse.Namespace, data: DataFile | None) -> None:
    import torch as th

    from zoo_configs.cells.cell import resolve
    from zoo_configs.drawing.tables import print_table
    from zoo_configs.measuring.update_speed import PARTS, REST

    if args.num_threads:
        th.set_num_threads(args.num_threads)
    env_id = known_env_id(args.env[0]) if args.env else DEFAULT_LEARNING_ENV
    overrides = {"env_kwargs": args.env_kwargs}
    cells = [resolve(baseline, args.preset, env_id, overrides) for baseline in args.baseline]
    for cell in cells:
        try_env(env_id, cell.hyperparams["env_kwargs"])
    print(f"{describe_machine()}, {th.get_num_threads()} threads; {env_id}, preset {args.preset}")
    if args.overhead:
        _measure_overheads(cells, args, data)
        return
    rows = []
    for cell in cells:
        speed = _measure_alone(cell, args)
        if data is not None:
            flags = ["--seconds", f"{args.seconds:g}", *_device_flags(args)]
            data.add(update_record(cell, speed, args.env_kwargs, flags))
        shares = [f"{share:.0%}" for share in speed.shares.values()]
        ratio = "" if speed.convolution_ratio is None else f"{speed.convolution_ratio:.2f}"
        rows.append([cell.label, f"{speed.update_ms:.1f}", f"{speed.peak_gigabytes:.1f}", *shares, ratio])
    columns = ["baseline", "ms/update", "peak GB", *PARTS, REST, "equivariant/plain"]
    print_table(columns, rows, args.markdown)


def _measure_overheads(cells: Sequence[Cell], args: argparse.Namespace, data: DataFile | None) -> None:
    from zoo_configs.drawing.tables import print_table
    from zoo_configs.measuring.overhead import measure_overhead

    rows = []
    for cell in cells:
        one = replace(cell, hyperparams={**cell.hyperparams, "n_envs": 1})
        measured = measure_overhead(one, args.overhead, args.device)
        if data is not None:
            data.add(overhead_record(cell, args.overhead, measured, args.env_kwargs, _device_flags(args)))
        seconds = [f"{statistics.median(values):.1f}" for values in measured]
        shares = measured.shares
        span = f"{shares[0]:.1%} to {shares[-1]:.1%}"
        rows.append([cell.label, str(args.overhead), *seconds, f"{statistics.median(shares):.1%}", span])
    columns = [
        "baseline",
        "time steps",
        "model.learn() CPU s",
        "train CPU s",
        "overhead",
        "least to greatest",
    ]
    print_table(columns, rows, args.markdown)


def _measure_alone(cell: Cell, args: argparse.Namespace) -> UpdateSpeed:
    """In a process of its own: a process remembers its greatest memory."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        speed = pool.apply(_measure_in_process, (cell, args.seconds, args.device, args.num_threads))
        pool.close()  # and not killed while it tidies up
        pool.join()
    return speed


def _measure_in_process(cell: Cell, seconds: float, device: str, num_threads: int | None) -> UpdateSpeed:
    import torch as th

    from zoo_configs.measuring.update_speed import measure_update

    register_environments()
    if num_threads:
        th.set_num_threads(num_threads)
    return measure_update(cell, seconds, device)


def _measure(env_ids: Sequence[str], args: argparse.Namespace) -> Iterator[Throughput]:
    from tqdm import tqdm

    total, hidden = args.seconds * len(env_ids), hides_progress(args.progress)
    with tqdm(total=total, disable=hidden, bar_format="{desc}: {percentage:.0f}%|{bar}|") as bar:
        for env_id in env_ids:
            bar.set_description(env_id)
            yield measure_env(env_id, args.seconds, args.seed, bar.update, args.env_kwargs)


def _print(rows: Sequence[Row], markdown: bool) -> None:
    from zoo_configs.drawing.tables import print_table

    if not rows:
        return
    columns = list(COLUMNS)
    cells = [_cells(row.ours) for row in rows]
    if any(row.reference for row in rows):
        columns += COMPARISON_COLUMNS
        cells = [line + _comparison(row) for line, row in zip(cells, rows, strict=True)]
    print_table(columns, cells, markdown)
    ratios = [row.ratio for row in rows if row.ratio is not None]
    if ratios:
        mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
        print(f"ratio: geometric mean {mean:.1f}, least {min(ratios):.1f}")


def _cells(ours: Throughput) -> list[str]:
    times = (ours.step_ms, ours.physics_ms, ours.rendering_ms, ours.rest_ms, ours.without_expert_ms)
    return [
        ours.env_id,
        f"{ours.yardstick.step_us:.1f}",
        f"{ours.steps_per_second:.0f}",
        *(f"{time:.2f}" for time in times),
        f"{ours.unsimulated:.0%}",
        f"{ours.reset_ms:.1f}",
        f"{ours.success_rate:.2f} of {ours.episodes}",
    ]


def _comparison(row: Row) -> list[str]:
    if row.reference is None:
        return ["", ""]
    return [f"{row.reference.scaled_to(row.ours.yardstick):.1f}", f"{row.ratio:.1f}"]
