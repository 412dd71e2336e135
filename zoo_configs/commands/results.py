"""``bulletarm-zoo results``: evaluates runs and keeps a table of what they reached."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_packages, add_progress, device, positive_int, seed
from zoo_configs.files import check_writable

if TYPE_CHECKING:
    from zoo_configs.publishing.measured import Row
    from zoo_configs.training.runs import Run

DESCRIPTION = """Evaluate the best and the last model of runs on scenes unseen in training, and write a row
for each run into a table (CSV): what it reached, how it was trained, its command, commit, date and machine. A
row of the same training is replaced. --page puts tables of it into a Markdown page, between the comments
<!-- results: PRESET TASKS --> and <!-- end of results -->; without runs that is all."""


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if a run has no model, or a file cannot be read or written
    """
    args = _parse(argv)
    from zoo_configs.environments import register_environments
    from zoo_configs.publishing.measured import merge, read_rows, write_rows
    from zoo_configs.training.runs import load_run

    register_environments(args.gym_packages)
    check_writable(args.output, "--output")
    rows = read_rows(args.output)
    if args.page is not None:
        _render(args.page, rows)  # tells what is wrong with it before the work
    for run in [load_run(folder) for folder in args.run]:
        rows = merge(rows, _measure(run, args))
        write_rows(args.output, rows)
    written = [args.output] if args.run else []
    if args.page is not None:
        _render(args.page, rows)
        written.append(args.page)
    print("\n".join(["Written:", *(f"  {path}" for path in written)]))


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo results", description=DESCRIPTION)
    add = parser.add_argument
    add("run", nargs="*", type=Path, metavar="RUN_FOLDER", help="run folders")
    add("-o", "--output", type=Path, required=True, help="the table, .csv; rows are added to what is there")
    add("--page", type=Path, help="Markdown page that shows tables of it")
    add("-n", "--episodes", type=positive_int, default=100, help="how many episodes (default: 100)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--commit", default="", help="commit that the runs were trained with (default: what they say)")
    add("--device", type=device, default="auto", help="PyTorch device (default: auto)")
    add_packages(parser)
    add_progress(parser)
    args = parser.parse_args(argv)
    if not args.run and args.page is None:
        parser.error("name run folders to evaluate, or a --page to write")
    args.n_envs, args.render, args.stochastic, args.env_kwargs = (
        1,
        False,
        False,
        {},
    )  # as evaluations take them
    return args


def _render(page: Path, rows: Sequence[Row]) -> None:
    from zoo_configs.files import whole_file
    from zoo_configs.publishing.measured import render_page

    text = page.read_text(encoding="utf-8")
    rendered = render_page(text, rows)
    if rendered != text:
        with whole_file(page) as partial:
            partial.write_text(rendered, encoding="utf-8")


def _measure(run: Run, args: argparse.Namespace) -> Row:
    from zoo_configs.agents import agent_of
    from zoo_configs.environments import known_env_id, register_environments
    from zoo_configs.publishing.packing import check_publishable, evaluate_agent

    register_environments(run.gym_packages)
    known_env_id(run.cell.env_id)
    check_publishable(run)
    reached = {}
    for name in ("best", "last"):
        agent = agent_of(run, name == "best", args.device)
        outcome = evaluate_agent(agent, args)
        how = f"success_rate={outcome.rate:.2f} episodes={outcome.episodes}"
        print(f"{agent.label} on {agent.env_id}, {name}: {how}")
        reached[name] = f"{outcome.rate:.4g}"
    return _row(run, args, **reached)


def _row(run: Run, args: argparse.Namespace, best: str, last: str) -> Row:
    from zoo_configs.drawing.curves import load_curve
    from zoo_configs.publishing.measured import Row
    from zoo_configs.publishing.origin import origin_of

    origin, hyperparams = origin_of(run, args.commit), run.cell.hyperparams
    command = shlex.split(origin.command)
    success = load_curve(run.evaluations_file).success if run.evaluations_file.is_file() else ()
    half = success[len(success) // 2 :]
    return Row(
        env=run.cell.env_id,
        options=" ".join(command[command.index("-params") + 1 :]) if "-params" in command else "",
        baseline=run.cell.label,
        preset=run.cell.preset or "",
        seed=str(run.seed),
        demonstrations=str(hyperparams.get("expert_episodes", 0)),
        noise=str(hyperparams.get("expert_noise", "")),
        dagger="yes" if hyperparams.get("dagger") else "",
        updates=str(hyperparams.get("pretrain_steps", 0)),
        steps=str(int(hyperparams["n_timesteps"])),
        best=best,
        last=last,
        episodes=str(args.episodes),
        least=f"{min(half):.4g}" if len(half) else "",
        greatest=f"{max(half):.4g}" if len(half) else "",
        minutes="" if origin.minutes is None else str(origin.minutes),
        machine=origin.machine,
        commit=origin.commit,
        date=origin.date,
        command=origin.command,
    )
