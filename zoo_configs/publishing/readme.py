"""Page of an agent, with the metadata and the layout of huggingface_sb3."""

from __future__ import annotations

import json
from typing import Any

import yaml

from zoo_configs.algorithms import ALGORITHMS, algorithm_classes
from zoo_configs.publishing.published import Card

README_FILE = "README.md"
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
| trained | {card.date}, {trained_with}{card.machine}{minutes} |
| evaluated | {measured[date]}, {tested_with}{measured[machine]}, scenes of `--seed {card.test_seed}` |
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


def render_readme(card: Card, repo_id: str | None = None) -> str:
    """Return the page of an agent, for a repository on the hub or for a folder."""
    algorithm = algorithm_classes()[card.algo]
    labels = [card.baseline or card.algo, *([f"preset {card.preset}"] if card.preset else [])]
    return PAGE.format(
        card=card,
        measured=card.measured,
        name=algorithm.__name__,
        label=", ".join(labels),
        metadata=yaml.safe_dump(_metadata(card, algorithm.__name__), sort_keys=False),
        snippet=_snippet(card, algorithm, repo_id),
        trained_with=_commit(card.commit),
        tested_with=_commit(card.measured["commit"]),
        minutes="" if card.minutes is None else f", {card.minutes:.0f} minutes",
        versions=", ".join(f"{package} {version}" for package, version in card.versions.items()),
        hyperparams=yaml.safe_dump(dict(card.hyperparams), sort_keys=False),
    )


def _commit(commit: str) -> str:
    return f"commit {commit}, " if commit else ""


def _metadata(card: Card, name: str) -> dict[str, Any]:
    metrics = {
        "mean_reward": f"{card.mean_return:.2f} +/- {card.std_return:.2f}",
        "success_rate": card.success,
    }
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
    values = [f"{json.dumps(key)}: {_literal(value)}" for key, value in card.env_kwargs.items()]
    return SNIPPET.format(
        imports="".join(imports),
        module=own or algorithm.__module__.partition(".")[0],
        name=algorithm.__name__,
        path=path,
        env_kwargs=f"{{{', '.join(values)}}}",
        env=json.dumps(card.env),
    )


def _literal(value: Any) -> str:
    return json.dumps(value) if isinstance(value, str) else repr(value)
