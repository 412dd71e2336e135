"""Tutorial 7: search hyperparameters, and compare the best with the baseline over several seeds.

The script runs commands of ``bulletarm-zoo``. The agents learn from poses instead of images, which is faster.
Replace ``sacfd_state`` by ``sacfd`` to learn from images.
"""

import sys
from pathlib import Path
from typing import Any

import yaml

from zoo_configs.cli import main

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 300  # also the number of updates before the first step
SEEDS = int(sys.argv[2]) if len(sys.argv) > 2 else 3
GIVEN = {"expert_episodes": max(2, STEPS // 10), "pretrain_steps": STEPS}
EPISODES = max(1, STEPS // 15)  # of an evaluation
# The search space. Other hyperparameters keep the values of the baseline.
SPACE = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "batch_size": {"choices": [32, 64, 256]},
}


def command(line: str) -> None:
    """Print a command and run it."""
    print(f"$ bulletarm-zoo {line}", flush=True)
    if code := main(line.split()):
        sys.exit(code)


def tune() -> dict[str, Any]:
    """Return the best values of a study of four trials; the first trial is the baseline."""
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
    """Train with other seeds than the study, because the best of a few trials is partly due to its seed."""
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


# The processes of the benchmark import this file and must not run it again.
if __name__ == "__main__":
    found = tune()
    print("found:", found)
    benchmark("before", {})
    benchmark("found", found)
