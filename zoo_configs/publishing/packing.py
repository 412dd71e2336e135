"""Conversion of a run to the folder of a published agent: model file, test, card and page."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bulletarm_gym.check.machine import describe_processor
from zoo_configs.agents import Agent, load_model
from zoo_configs.drawing.curves import SUCCESS, load_curve
from zoo_configs.errors import CommandError
from zoo_configs.evaluating import EvalOptions, Outcome, check_unwrapped, evaluate_agent
from zoo_configs.files import whole_file
from zoo_configs.provenance import commit, describe_arithmetic, versions
from zoo_configs.publishing.compact import save_compact
from zoo_configs.publishing.published import FAILED, SUCCEEDED, Card
from zoo_configs.publishing.readme import README_FILE, render_readme
from zoo_configs.training.origin import day, origin_of
from zoo_configs.training.runs import Run, env_folder_name

WRAPPERS = ("normalize", "frame_stack", "vec_env_wrapper", "env_wrapper")


def check_publishable(run: Run) -> None:
    """Raise ``CommandError`` if a model file is not the complete agent, or its success is unknown."""
    check_unwrapped(run.experiment.hyperparams, WRAPPERS, "which a model file does not contain")
    if run.evaluations_file.is_file() and load_curve(run.evaluations_file).measure != SUCCESS:
        raise CommandError(f"{run.experiment.env_id} does not report is_success, which a card needs")


def pack(
    agent: Agent,
    folder: Path,
    options: EvalOptions,
    *,
    device: str = "auto",
    full_precision: bool = False,
    repo_id: str | None = None,
) -> Card:
    """
    Write the folder of an agent: model file, card and page.

    Weights are stored in half precision, unless the success rate of the stored agent on the same scenes is
    below the 95 % interval of the agent's own.

    :param agent: Agent of a run
    :param folder: Existing folder
    :param options: Options of the test
    :param device: PyTorch device
    :param full_precision: Whether to store weights in float32
    :param repo_id: Repository for which the page is written
    :return: The card
    :raises CommandError: if the agent cannot be tested
    """
    assert agent.run is not None
    path = (
        folder / f"{agent.run.experiment.algo}-{env_folder_name(agent.env_id)}.zip"
    )  # huggingface_sb3's ModelName

    def store(run: Run, half: bool) -> tuple[str, Outcome]:
        weights = save_compact(agent.model, path, half)
        return weights, evaluate_agent(
            replace(agent, model=load_model(path, run.experiment.algo, device)), options
        )

    weights, outcome = store(agent.run, not full_precision)
    if not full_precision and outcome.success_rate < evaluate_agent(agent, options).interval[0]:
        print("half precision lowers the success rate: the weights are stored in float32")
        weights, outcome = store(agent.run, False)
    card = _card(agent, agent.run, options, outcome, path.name, weights)
    card.write(folder)
    with whole_file(folder / README_FILE) as partial:
        partial.write_text(render_readme(card, repo_id), encoding="utf-8")
    return card


def _card(agent: Agent, run: Run, options: EvalOptions, outcome: Outcome, file: str, weights: str) -> Card:
    low, high = outcome.interval
    here = {"commit": commit(), "machine": describe_processor(), **arithmetic()}
    return Card(
        env=agent.env_id,
        env_kwargs={**agent.env_kwargs, **options.env_kwargs},
        algo=run.experiment.algo,
        baseline=run.experiment.baseline,
        preset=run.experiment.preset,
        benchmark=run.experiment.benchmark,
        seed=run.seed,
        model="best" if agent.path == run.best_model else "last",
        timesteps=agent.model.num_timesteps,
        file=file,
        weights=weights,
        success=round(outcome.success_rate, 4),
        episodes=outcome.episodes,
        interval=(round(low, 4), round(high, 4)),
        mean_return=round(float(np.mean(outcome.returns)), 4),
        std_return=round(float(np.std(outcome.returns)), 4),
        test_seed=options.seed,
        outcomes="".join(SUCCEEDED if success else FAILED for success in outcome.successes),
        evaluations=_evaluations(run),
        measured={"date": day(time.time()), **here},
        hyperparams=run.experiment.hyperparams,
        gym_packages=run.gym_packages,
        **origin_of(run)._asdict(),
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
    """Return what must be equal for a test to repeat exactly: ``arithmetic`` and ``versions`` of a card."""
    return {"arithmetic": describe_arithmetic(), "versions": versions()}
