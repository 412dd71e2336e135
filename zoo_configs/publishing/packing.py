"""Conversion of a run to the folder of a published agent: model file, test, card and page."""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bulletarm_gym.check.machine import describe_processor
from zoo_configs.agents import Agent, load_model
from zoo_configs.algorithms import ALGORITHMS, algorithm_classes
from zoo_configs.cards import FAILED, PAGE_FILE, SUCCEEDED, Card
from zoo_configs.drawing.curves import SUCCESS, load_curve
from zoo_configs.errors import CommandError
from zoo_configs.evaluating import EvalOptions, Outcome, check_unwrapped, evaluate_agent
from zoo_configs.files import whole_file
from zoo_configs.provenance import arithmetic, commit
from zoo_configs.publishing.compact import save_compact
from zoo_configs.training.certificate import certificate_of
from zoo_configs.training.runs import Run, day, env_folder_name, origin_of

WRAPPERS = ("normalize", "frame_stack", "vec_env_wrapper", "env_wrapper")
REINFORCEMENT_LEARNING = "reinforcement-learning"
TAGS = ("deep-reinforcement-learning", REINFORCEMENT_LEARNING, "stable-baselines3", "robotics", "bulletarm")
PAGE = """---
{metadata}---

# **{name}** agent on **{card.env}**

This is a trained model of a **{name}** agent ({label}) on **{card.env}**, for
[Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3) and BulletArm Gym.

Success rate **{card.success:.2f}** over {card.episodes} episodes on scenes that it was not trained on,
with its deterministic policy (Wilson's 95 % interval {card.interval[0]:.2f} to {card.interval[1]:.2f}).

## Usage

```python
{snippet}```

Or run `bulletarm-zoo enjoy --published FOLDER` with this folder.

The file contains the networks (weights: {card.weights}) without the states of the optimizers.
The loaded agent acts and can be trained further.

## Training

```
{card.command}
```

| | |
|---|---|
| model | the {card.model} of the run, {card.timesteps} time steps |
| seed | {card.seed} |
| trained | {card.date}, commit {card.commit}, {card.machine}{minutes} |
| evaluated | {evaluated}, scenes of `--seed {card.test_seed}` |
| versions | {versions} |

## Hyperparameters

```yaml
{hyperparams}```
"""
SNIPPET = """import bulletarm_gym
import gymnasium
{imports}from {module} import {name}

model = {name}.load({path})
env_kwargs = {env_kwargs}
env = gymnasium.make({env}, **env_kwargs)
observation, info = env.reset(seed=0)
over = False
while not over:
    action, _ = model.predict(observation, deterministic=True)
    observation, reward, terminated, truncated, info = env.step(action)
    over = terminated or truncated
print(info["is_success"])
"""


def check_publishable(run: Run) -> None:
    """Raise ``CommandError`` if a model file is not the complete agent, or its success is unknown."""
    check_unwrapped(run, WRAPPERS, "which a model file does not contain")
    if run.evaluations_file.is_file() and load_curve(run.evaluations_file).measure != SUCCESS:
        raise CommandError(f"{run.experiment.env_id} does not report is_success, which a card needs")


def pack(agent: Agent, folder: Path, options: EvalOptions, device: str, repo_id: str | None) -> Card:
    """
    Write model file, card and page of the agent of a run, for a repository or for a folder; return the card.

    Weights are stored in half precision, unless the success rate of the stored agent on the same scenes is
    below the 95 % interval of the agent's own.
    """
    assert agent.run is not None
    run = agent.run
    name = f"{run.experiment.algo}-{env_folder_name(agent.env_id)}.zip"  # huggingface_sb3's ModelName

    def store(half: bool) -> tuple[str, Outcome]:
        weights = save_compact(agent.model, folder / name, half)
        stored = load_model(folder / name, run.experiment.algo, device)
        return weights, evaluate_agent(replace(agent, model=stored), options)

    weights, outcome = store(half=True)
    if outcome.success_rate < evaluate_agent(agent, options).interval[0]:
        print("half precision lowers the success rate: the weights are stored in float32")
        weights, outcome = store(half=False)
    card = _card(agent, run, options, outcome, folder / name, weights)
    card.write()
    with whole_file(folder / PAGE_FILE) as partial:
        partial.write_text(render_readme(card, repo_id), encoding="utf-8")
    return card


def _card(agent: Agent, run: Run, options: EvalOptions, outcome: Outcome, file: Path, weights: str) -> Card:
    low, high = outcome.interval
    here = {"commit": commit(), "machine": describe_processor(), **arithmetic()}
    return Card(
        env=agent.env_id,
        env_kwargs={**agent.env_kwargs, **options.env_kwargs},
        **{name: getattr(run.experiment, name) for name in ("algo", "baseline", "preset", "benchmark")},
        seed=run.seed,
        model="best" if agent.path == run.best_model else "last",
        timesteps=agent.model.num_timesteps,
        file=file.name,
        weights=weights,
        success=round(outcome.success_rate, 4),
        episodes=options.episodes,
        interval=(round(low, 4), round(high, 4)),
        mean_return=round(float(np.mean(outcome.returns)), 4),
        std_return=round(float(np.std(outcome.returns)), 4),
        test_seed=options.seed,
        outcomes="".join(SUCCEEDED if success else FAILED for success in outcome.successes),
        evaluations=_evaluations(run),
        measured={"date": day(time.time()), **here},
        hyperparams=run.experiment.hyperparams,
        gym_packages=run.gym_packages,
        certificate=certificate_of(run) if run.certificate.is_file() else {},
        folder=file.parent,
        **asdict(origin_of(run)),
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


def render_readme(card: Card, repo_id: str | None = None) -> str:
    """Return the page of an agent, for a repository on the hub or for a folder."""
    algorithm = algorithm_classes()[card.algo]
    labels = [card.label, *([f"preset {card.preset}"] if card.preset else [])]
    return PAGE.format(
        card=card,
        evaluated="{date}, commit {commit}, {machine}".format_map(card.measured),
        name=algorithm.__name__,
        label=", ".join(labels),
        metadata=yaml.safe_dump(_metadata(card, algorithm.__name__), sort_keys=False),
        snippet=_snippet(card, algorithm, repo_id),
        minutes="" if card.minutes is None else f", {card.minutes:.0f} minutes",
        versions=", ".join(f"{package} {version}" for package, version in card.versions.items()),
        hyperparams=yaml.safe_dump(dict(card.hyperparams), sort_keys=False),
    )


def _metadata(card: Card, name: str) -> dict[str, Any]:
    mean_reward = f"{card.mean_return:.2f} +/- {card.std_return:.2f}"
    metrics = {"mean_reward": mean_reward, "success_rate": card.success}
    over = {"config": f"{card.episodes} episodes", "verified": False}
    result = {
        "task": {"type": REINFORCEMENT_LEARNING, "name": REINFORCEMENT_LEARNING},
        "dataset": {"name": card.env, "type": card.env},
        "metrics": [
            {"type": metric, "value": value, "name": metric, **over} for metric, value in metrics.items()
        ],
    }
    index = [{"name": name, "results": [result]}]
    return {"library_name": "stable-baselines3", "tags": [card.env, *TAGS], "model-index": index}


def _snippet(card: Card, algorithm: type[Any], repo_id: str | None) -> str:
    """Return Python code that loads the agent and runs an episode."""
    imports, path = [f"import {package}\n" for package in card.gym_packages], json.dumps(card.file)
    if repo_id:
        imports.append("from huggingface_sb3 import load_from_hub\n")
        path = f"load_from_hub({json.dumps(repo_id)}, {path})"
    own = ALGORITHMS.get(card.algo, "").rpartition(".")[0]
    literals = {key: json.dumps(v) if isinstance(v, str) else repr(v) for key, v in card.env_kwargs.items()}
    values = [f"{json.dumps(key)}: {literal}" for key, literal in literals.items()]
    return SNIPPET.format(
        imports="".join(imports),
        module=own or algorithm.__module__.partition(".")[0],
        name=algorithm.__name__,
        path=path,
        env_kwargs=f"{{{', '.join(values)}}}",
        env=json.dumps(card.env),
    )
