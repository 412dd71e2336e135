"""From a run to a folder: a small file of the agent, evaluated, its card and its page."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bulletarm_gym.check.machine import describe_processor
from zoo_configs.agents import Agent, load_published
from zoo_configs.benchmarking.results import wilson_interval
from zoo_configs.drawing.curves import SUCCESS, load_curve
from zoo_configs.environments import check_alike
from zoo_configs.errors import CommandError
from zoo_configs.evaluating import Outcome, build_test_env, evaluate
from zoo_configs.files import whole_file
from zoo_configs.measuring.machine import describe_arithmetic, versions
from zoo_configs.measuring.provenance import commit
from zoo_configs.publishing.card import FAILED, SUCCEEDED, Card
from zoo_configs.publishing.compact import save_compact
from zoo_configs.publishing.published import Published
from zoo_configs.publishing.readme import README_FILE, render_readme
from zoo_configs.training.origin import day, origin_of
from zoo_configs.training.runs import Run, env_folder_name

WRAPPING = ("normalize", "frame_stack", "vec_env_wrapper", "env_wrapper")


def check_publishable(run: Run) -> None:
    """
    Ask whether an agent can act without what stood around it in training.

    :param run: Its run
    :raises CommandError: if not, or nothing says whether an episode succeeded
    """
    if wrapped := [name for name in WRAPPING if run.cell.hyperparams.get(name)]:
        raise CommandError(f"{run.folder} acts through {wrapped[0]}, which a file of the agent does not hold")
    if run.evaluations_file.is_file() and load_curve(run.evaluations_file).measure != SUCCESS:
        raise CommandError(f"{run.cell.env_id} does not report is_success: a card says how often it succeeds")


def pack(agent: Agent, folder: Path, args: argparse.Namespace, repo_id: str | None = None) -> Card:
    """
    Write the folder of an agent: its file, evaluated as it was written, card and page. Weights are halved,
    unless the agent then succeeds less often on the same scenes than the interval of its own success allows.

    :param agent: The agent of a run
    :param folder: The folder, which is there
    :param args: Flags: device; seed and number of the scenes, parameters of the environment that are to
        differ; whether to keep full precision, which model was taken, commit of the training
    :param repo_id: Repository that it is for
    :return: The card
    :raises CommandError: if it cannot be evaluated
    """
    assert agent.run is not None
    path = (
        folder / f"{agent.run.cell.algo}-{env_folder_name(agent.env_id)}.zip"
    )  # huggingface_sb3's ModelName
    card = _describe(agent, agent.run, path.name, args)
    weights = save_compact(agent.model, path, half=not args.full_precision)
    outcome = _evaluate_file(agent, Published(folder, card), args)
    if not args.full_precision and outcome.rate < _lowest(evaluate_agent(agent, args)):
        print("float16 changes what it does: the weights stay float32")
        weights = save_compact(agent.model, path, half=False)
        outcome = _evaluate_file(agent, Published(folder, card), args)
    card = replace(card, weights=weights, **_measured(outcome))
    card.write(folder)
    with whole_file(folder / README_FILE) as partial:
        partial.write_text(render_readme(card, repo_id), encoding="utf-8")
    return card


def _lowest(outcome: Outcome) -> float:
    return wilson_interval(sum(outcome.successes), outcome.episodes)[0]


def _evaluate_file(agent: Agent, written: Published, args: argparse.Namespace) -> Outcome:
    return evaluate_agent(replace(agent, model=load_published(written, args.device)), args)


def evaluate_agent(agent: Agent, args: argparse.Namespace) -> Outcome:
    """
    Evaluate an agent, all episodes or none.

    :param agent: The agent
    :param args: Flags, see :func:`pack`
    :return: What came of it
    :raises CommandError: if its environment cannot be made
    :raises KeyboardInterrupt: after Ctrl-C
    """
    with closing(build_test_env(agent, args)) as env:
        check_alike(env, agent.model, "the agent cannot act here")
        outcome = evaluate(agent.model, env, args)
    if outcome.episodes < args.episodes:
        raise KeyboardInterrupt
    return outcome


def _describe(agent: Agent, run: Run, file: str, args: argparse.Namespace) -> Card:
    """The card as far as the run says it."""
    return Card(
        env=agent.env_id,
        env_kwargs={**agent.env_kwargs, **args.env_kwargs},
        algo=run.cell.algo,
        baseline=run.cell.baseline,
        preset=run.cell.preset,
        benchmark=run.cell.benchmark,
        seed=run.seed,
        model="best" if agent.path == run.best_model else "last",
        timesteps=agent.model.num_timesteps,
        file=file,
        weights="",
        success=0.0,
        episodes=0,
        interval=(0.0, 1.0),
        mean_return=0.0,
        std_return=0.0,
        test_seed=args.seed,
        outcomes="",
        evaluations=_evaluations(run),
        measured={},
        hyperparams=run.cell.hyperparams,
        gym_packages=run.gym_packages,
        **origin_of(run, args.commit)._asdict(),
    )


def _evaluations(run: Run) -> Mapping[str, Any]:
    if not run.evaluations_file.is_file():
        return {}
    curve = load_curve(run.evaluations_file)
    return {
        "episodes": curve.episodes,
        "timesteps": curve.timesteps.tolist(),
        "success": [round(float(success), 4) for success in curve.success],
    }


def arithmetic() -> dict[str, Any]:
    """
    Where an evaluation repeats bit for bit.

    :return: ``arithmetic`` and ``versions`` of this machine, as cards have them
    """
    return {"arithmetic": describe_arithmetic(), "versions": versions()}


def _measured(outcome: Outcome) -> dict[str, Any]:
    here = {"commit": commit(), "machine": describe_processor(), **arithmetic()}
    low, high = wilson_interval(sum(outcome.successes), outcome.episodes)
    return {
        "success": round(outcome.rate, 4),
        "episodes": outcome.episodes,
        "interval": (round(low, 4), round(high, 4)),
        "mean_return": round(float(np.mean(outcome.returns)), 4),
        "std_return": round(float(np.std(outcome.returns)), 4),
        "outcomes": "".join(SUCCEEDED if success else FAILED for success in outcome.successes),
        "measured": {"date": day(time.time()), **here},
    }
