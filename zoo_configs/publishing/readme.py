"""The card of an agent as a page, laid out as huggingface_sb3 does."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import yaml

from zoo_configs.algorithms import ALGORITHMS, algorithm_classes
from zoo_configs.publishing.card import Card

if TYPE_CHECKING:
    from huggingface_hub import ModelCardData

README_FILE = "README.md"
REINFORCEMENT_LEARNING = "reinforcement-learning"
TAGS = ("deep-reinforcement-learning", REINFORCEMENT_LEARNING, "stable-baselines3", "robotics", "bulletarm")
PAGE = """---
{metadata}
---

# **{name}** agent on **{env}**

This is a trained model of a **{name}** agent ({label}) on **{env}**, for
[Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3) and BulletArm Gym.

Success **{success:.2f}** over {episodes} episodes on scenes that it was not trained on, with its
deterministic policy (Wilson's 95 % interval {low:.2f} to {high:.2f}).

## Usage

```python
{snippet}
```

or `bulletarm-zoo enjoy --published FOLDER` with this folder.

The file holds what acts (weights: {weights}). Critics, target networks and the state of optimizers are
left out and read as NaN: it is there to predict, not to be trained further.

## Training

```
{command}
```

| | |
|---|---|
| model | the {model} of the run, {timesteps} time steps |
| seed | {seed} |
| trained | {trained} |
| evaluated | {evaluated}, scenes of `--seed {test_seed}` |
| versions | {versions} |

## Hyperparameters

```yaml
{hyperparams}```
"""


def render_readme(card: Card, repo_id: str | None = None) -> str:
    """
    Write the page of an agent.

    :param card: Its card
    :param repo_id: Its repository on the hub; None for a folder
    :return: Markdown, with a head of metadata
    """
    name = algorithm_classes()[card.algo].__name__
    minutes = "" if card.minutes is None else f", {card.minutes:.0f} minutes"
    return PAGE.format(
        metadata=_metadata(card, name).to_yaml(),
        name=name,
        env=card.env,
        label=", ".join(part for part in (card.baseline, card.preset and f"preset {card.preset}") if part)
        or card.algo,
        success=card.success,
        episodes=card.episodes,
        low=card.interval[0],
        high=card.interval[1],
        snippet=_snippet(card, name, repo_id),
        weights=card.weights,
        command=card.command,
        model=card.model,
        timesteps=card.timesteps,
        seed=card.seed,
        trained=f"{card.date}, {_commit(card.commit)}{card.machine}{minutes}",
        evaluated=f"{card.measured['date']}, {_commit(card.measured['commit'])}{card.measured['machine']}",
        test_seed=card.test_seed,
        versions=", ".join(f"{package} {version}" for package, version in card.versions.items()),
        hyperparams=yaml.safe_dump(dict(card.hyperparams), sort_keys=False),
    )


def _commit(commit: str) -> str:
    return f"commit {commit}, " if commit else ""


def _metadata(card: Card, name: str) -> ModelCardData:
    from huggingface_hub import EvalResult, ModelCardData

    def result(metric: str, value: Any, configuration: str) -> EvalResult:
        """One number of the evaluation."""
        return EvalResult(
            task_type=REINFORCEMENT_LEARNING,
            task_name=REINFORCEMENT_LEARNING,
            dataset_type=card.env,
            dataset_name=card.env,
            metric_type=metric,
            metric_name=metric,
            metric_value=value,
            verified=False,
            metric_config=configuration,
        )

    over = f"{card.episodes} episodes"
    returns = f"{card.mean_return:.2f} +/- {card.std_return:.2f}"
    results = [result("mean_reward", returns, over), result("success_rate", card.success, over)]
    return ModelCardData(
        library_name="stable-baselines3", tags=[card.env, *TAGS], model_name=name, eval_results=results
    )


def _snippet(card: Card, name: str, repo_id: str | None) -> str:
    """How to load it and let it act for an episode."""
    module = ALGORITHMS[card.algo].rpartition(".")[0] if card.algo in ALGORITHMS else _package(card.algo)
    kwargs = ", ".join(f"{json.dumps(key)}: {_literal(value)}" for key, value in card.env_kwargs.items())
    path = json.dumps(card.file)
    own = [f"import {package}" for package in card.gym_packages]
    lines = ["import bulletarm_gym", "import gymnasium", *own]
    if repo_id:
        lines.append("from huggingface_sb3 import load_from_hub")
        path = f"load_from_hub({json.dumps(repo_id)}, {path})"
    lines += [
        f"from {module} import {name}",
        "",
        f"model = {name}.load({path})",
        f"env_kwargs = {{{kwargs}}}",
        f"env = gymnasium.make({json.dumps(card.env)}, **env_kwargs)",
        "observation, info = env.reset(seed=0)",
        "over = False",
        "while not over:",
        "    action, _ = model.predict(observation, deterministic=True)",
        "    observation, reward, terminated, truncated, info = env.step(action)",
        "    over = terminated or truncated",
        'print(info["is_success"])',
    ]
    return "\n".join(lines)


def _literal(value: Any) -> str:
    return json.dumps(value) if isinstance(value, str) else repr(value)


def _package(algo: str) -> str:
    """``stable_baselines3`` or ``sb3_contrib``, whose algorithms stand at the top."""
    return algorithm_classes()[algo].__module__.partition(".")[0]
