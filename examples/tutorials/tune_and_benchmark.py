"""Tutorial 7: search hyperparameters, and compare what is found with what was there, over seeds.

Everything is a command of ``bulletarm-zoo``, given as it would be in a shell. Poses instead of images make it
quick; with ``sacfd`` in place of ``sacfd_state`` it is the same from images.
"""

import sys
from pathlib import Path
from typing import Any

import yaml

from zoo_configs.cli import main

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 300  # of an agent; the updates before them are as many
SEEDS = int(sys.argv[2]) if len(sys.argv) > 2 else 3
GIVEN = {"expert_episodes": max(2, STEPS // 10), "pretrain_steps": STEPS}
EPISODES = max(1, STEPS // 15)  # of an evaluation
# What is searched. What is not named here stays as the baseline has it.
SPACE = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "batch_size": {"choices": [32, 64, 256]},
}


def command(line: str) -> None:
    """Run a command, and show it."""
    print(f"$ bulletarm-zoo {line}", flush=True)
    if code := main(line.split()):
        sys.exit(code)


def tune() -> dict[str, Any]:
    """Return what a study of four trials finds best; the first trial is the baseline."""
    Path("space.yml").write_text(yaml.safe_dump(SPACE), encoding="utf-8")
    given = " ".join(f"{name}:{value}" for name, value in GIVEN.items())
    command(
        f"tune --baseline sacfd_state --env {ENV_ID} --preset quick --space space.yml --study-name reaching "
        f"--n-trials 4 --n-startup-trials 2 -n {STEPS} --n-evaluations 2 --eval-episodes {EPISODES} "
        f"--num-threads 1 -params {given}"
    )
    best = yaml.safe_load(Path("logs/studies/reaching/best.yml").read_text(encoding="utf-8"))[ENV_ID]
    return {name: best[name] for name in SPACE}


def benchmark(name: str, hyperparams: dict[str, Any]) -> None:
    """Train with seeds that the study had not: what is best of a few trials of one is so by luck in part."""
    content = {
        "tasks": [ENV_ID],
        "baselines": ["sacfd_state"],
        "preset": "quick",
        "seeds": list(range(1, SEEDS + 1)),
        "options": {"n_timesteps": STEPS, "eval_freq": max(1, STEPS // 2), "eval_episodes": EPISODES},
        "hyperparams": {**GIVEN, **hyperparams},
    }
    Path(f"{name}.yml").write_text(yaml.safe_dump(content), encoding="utf-8")
    command(f"benchmark {name}.yml")
    command(f"plot -f benchmarks/{name}")


# A benchmark's processes import this file, too, and must not begin it anew.
if __name__ == "__main__":
    found = tune()
    print("found:", found)
    benchmark("before", {})
    benchmark("found", found)
