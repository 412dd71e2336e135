"""Command lines drawn at random, valid ones and some with a mistake: followed, or refused in one line."""

import shutil

import numpy as np
import pytest

from zoo_configs.cli import main

JUNK = "|0|-1|1.5|x|'|a:1|a:|{|☃|nowhere|/dev/null/x|nan|None|[]|lambda: 0".split("|")
LEAST_SUCCESS = 0.3
LEARNING = ["expert_episodes:1", "pretrain_steps:1", "batch_size:2", "n_envs:1", "buffer_size:50"]
PARAMS = ["gamma:0.9", "learning_rate:lin_1e-3", "n_steps:2", "augmentation:rotation", "ent_coef:0.1"]
CHEAP = "-n 2 --eval-freq 0 --device cpu --num-threads 1 --no-progress --env-kwargs obs_size:48"
AGENT = "--device=cpu,auto --seed=3 --load-last -P"
COMMANDS = {
    "train": (
        f"--baseline sacfd --preset cpu --env TOY {CHEAP}",
        "--baseline=equi_sacfd,tqcfd,sac,drq_sacfd --preset=quick --seed=3,-1 -n=3,1 --eval-freq=1,2 "
        "--eval-episodes=1,2 --save-freq=1,2 --verbose=0,2 --allow-mismatched-demos --dry-run "
        "-i=RUN/best_model.zip --gym-packages=json",
    ),
    "enjoy": ("RUN -n 1", f"{AGENT} --n-envs=1 -n=2"),
    "record": ("RUN -n 1", f"{AGENT} -o=video.gif,new/video.mp4 --format=mp4,gif"),
    "plot": ("-f LOGS", "--env=TOY --baseline=equi_sacfd -o=curves.png,new/curves.pdf --training"),
    "demos": (
        "--env BulletArm/CloseLoopBlockReaching-v0 -n 1 --env-kwargs obs_size:16",
        "-o=demos.h5,new/demos.hdf5 --seed=3 --no-progress",
    ),
    "list": ("", "--env=TOY,Pendulum-v1 --baselines --published --gym-packages=json"),
}
"""Words that are always there, and flags with their valid values, by command."""


def draw(rng):
    """Return a valid line, every other time with a junk word in the place of another one."""
    command = str(rng.choice(list(COMMANDS)))
    words, flags = COMMANDS[command]
    line = [command, *words.split()]
    for chosen in rng.choice(flags.split(), size=rng.integers(4), replace=False):
        flag, _, values = str(chosen).partition("=")
        line += [flag, str(rng.choice(values.split(",")))] if values else [flag]
    if command == "train":
        line += ["-params", *LEARNING, *rng.choice(PARAMS, size=rng.integers(3), replace=False).tolist()]
    if rng.random() < 0.5 and len(line) > 1:
        place = int(rng.integers(1, len(line)))
        name, colon, _ = line[place].partition(":")
        junk = str(rng.choice(JUNK))
        line[place] = name + colon + junk if colon and rng.random() < 0.7 else junk
    return line


@pytest.mark.parametrize(
    ("seed", "number"), [(0, 20), *(pytest.param(seed, 150, marks=pytest.mark.slow) for seed in range(1, 11))]
)
def test_random_command_lines(seed, number, toy_id, trained, tmp_path, capsys, monkeypatch):
    [run] = trained.glob("sacfd/*_1")
    logs, here, rng, successes = tmp_path / "logs", tmp_path / "here", np.random.default_rng(seed), 0
    meanings = {"RUN": str(logs / "sacfd" / run.name), "LOGS": str(logs), "TOY": toy_id}
    for line in (draw(rng) for _ in range(number)):
        shutil.rmtree(logs, ignore_errors=True)
        shutil.copytree(trained, logs)
        here.mkdir()
        monkeypatch.chdir(here)
        words = line
        for name, meaning in meanings.items():
            words = [word.replace(name, meaning) for word in words]
        status, errors = main(words), capsys.readouterr().err
        assert status in (0, 2) and "Traceback" not in errors, line
        if status == 2:
            assert errors.splitlines()[-1].startswith(f"bulletarm-zoo {line[0]}: error: "), line
        for folder in here.glob("logs/*/*_[0-9]*/"):
            assert list(folder.glob("*.zip")) or list(folder.glob("checkpoints/*")), line
        shutil.rmtree(here)
        successes += status == 0
    assert successes >= LEAST_SUCCESS * number
