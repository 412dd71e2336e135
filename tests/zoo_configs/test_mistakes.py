"""Command lines that cannot be followed: one line on the error output, exit status 2, nothing left behind."""

import errno
import os
import re
import shlex
import subprocess
import sys
from typing import Any

import pytest
import yaml
from sweeps import PATH, TINY

from zoo_configs.cli import main
from zoo_configs.training import options

TRAIN = "train --baseline sacfd --preset cpu --env TOY --device cpu"
TUNE = "tune --baseline sacfd --preset quick --env TOY --env-kwargs obs_size:48"
DEMOS = "demos --env REACHING"
RECORD = "record --expert --env TOY -n 1"
PUBLISHED = "enjoy --published CloseLoopBlockReaching"
NAMES = {"TRAIN": TRAIN, "TUNE": TUNE, "DEMOS": DEMOS, "RECORD": RECORD, "PUBLISHED": PUBLISHED}
NAMES["REACHING"] = "BulletArm/CloseLoopBlockReaching-v0"
NAMES["STACKING"] = "BulletArm/OpenLoopBlockStacking-v0"
MISTAKES = """
tarin                                                             => 'train'
list --env xyzzy                                                  => 'xyzzy'
TRAIN --frobnicate                                                => --frobnicate
TRAIN --vec-env frobnicate                                        => 'frobnicate'
train --baseline sacfd                                            => --env
train --baseline safcd --env TOY                                  => 'sacfd'
train --baseline sacfd --env BulletArm/CloseLopToy-v0             => CloseLoopToy-v0
train --baseline sacfd --env TOY --algo ppo                       => --algo
train --baseline sdqfd_fcn --env REACHING                         => OpenLoop
train --baseline sdqfd_fcn --env STACKING --preset quick          => 'quick'
train --algo dqfd --env STACKING --benchmark open_loop_3          => 'open_loop_3d'
train --algo ferm --env STACKING                                  => ferm
train --algo pp0 --env TOY                                        => 'ppo'
train --algo dqn --env Pendulum-v1                                => supports
train --algo ppo --env TOY --conf-file none.yml                   => none.yml
train --resume nowhere                                            => nowhere
train --resume garbled                                            => garbled
train --resume older                                              => older
TRAIN -n 0                                                        => '0'
TRAIN --eval-episodes 0                                           => --eval-episodes
TRAIN --seed 1e9                                                  => --seed
TRAIN --device cuda:99                                            => 'cuda:99'
TRAIN -i none.zip                                                 => none.zip
TRAIN -f /dev/null/folder                                         => /dev/null/folder
TRAIN --dry-run -f /dev/null/folder                               => --log-folder
TRAIN --dry-run -params expert_data:none.h5                       => none.h5
TRAIN --gym-packages frobnicate                                   => 'frobnicate'
TRAIN --gym-packages leaving                                      => 'leaving'
TRAIN --env-kwargs obs_size:8                                     => obs_size
TRAIN --env-kwargs options:x                                      => options
TRAIN -params gama:1                                              => 'gamma'
TRAIN -params gamma:0.9 gamma:0.99                                => gamma
TRAIN -params gamma:{                                             => gamma
TRAIN -params learning_rate:lin_x                                 => lin_x
TRAIN -params batch_size:0                                        => batch_size
TRAIN --dry-run -params ent_coef:auto-0.1                         => ent_coef
TRAIN --dry-run -params target_entropy:low                        => target_entropy
TRAIN -params train_freq:[1,week]                                 => train_freq
TRAIN -params action_noise:1                                      => noise_type
TRAIN -params expert_data:none.h5                                 => none.h5
TRAIN -params expert_data:3                                       => expert_data
TRAIN -params env_wrapper:none.Wrapper                            => env_wrapper
TRAIN -params "policy_kwargs:dict(net_arch="                      => policy_kwargs
TRAIN --num-threads 100000                                        => '100000'
TRAIN -params noise_type:red                                      => noise_type
TRAIN -params noise_type:normal                                   => noise_std
TRAIN -params normalize:3                                         => normalize
train --algo ppo --env TOY --dry-run -params clip_range:[1]       => clip_range
TRAIN -params ent_coef:.nan                                       => ent_coef
TRAIN -params env_kwargs:5                                        => env_kwargs must be
TRAIN -params env_kwargs:null --env-kwargs obs_size:48            => env_kwargs must be
TRAIN -params "policy_kwargs:{n: 1, n: 2}"                        => once, got n
TRAIN -params "env_wrapper:{collections.Counter: {}, x.B: {}}"    => one class
train --algo ppo --env REACHING --env-kwargs observation:5        => observation
train --algo ppo --env REACHING --env-kwargs observation:[{}]     => observation
TRAIN -params policy:EquivarantPolicy                             => 'EquivariantPolicy'
TRAIN -params policy_kwargs:{net_arc:1}                           => policy_kwargs
TRAIN -params "policy_kwargs:{features_extractor_kwargs: {chanels: []}}" => 'channels'
TRAIN -params "policy_kwargs:{features_extractor_class: 3}"       => features_extractor_class
TRAIN -params "policy_kwargs:exit(3)"                             => exit
TRAIN -params "replay_buffer_kwargs:{samplr: uniform}"            => 'sampler'
TRAIN -params "replay_buffer_kwargs:{sampler: priority}"          => priority
TRAIN -params replay_buffer_class:no_package.Buffer               => no_package
TRAIN -params augmentation:rda                                    => rotation
TRAIN --dry-run -params bc_weight:-1                              => bc_weight
TUNE -params critic_warmup_steps:x                                => critic_warmup_steps
train --baseline sdqfd_fcn --env STACKING -params augmentation:drq => rigid_motion
DEMOS --env-kwargs obs_size=64                                    => 'obs_size=64'
DEMOS --env-kwargs obssize:64                                     => 'obs_size'
DEMOS --env-kwargs robot:x                                        => 'kuka'
DEMOS --planner magic                                             => magic
DEMOS --planner deconstruction                                    => pick and place
DEMOS -o a.txt                                                    => .h5
DEMOS -o taken.h5                                                 => a new file
record                                                            => run folder
record --expert                                                   => --env
record nowhere --expert --env TOY                                 => --expert
record --expert --env Pendulum-v1                                 => expert
RECORD -o /dev/null/a.gif                                         => /dev/null
RECORD -o a.avi                                                   => a.avi
RECORD --baseline sac --load-last                                 => --baseline, --load-last
RECORD --device gpu0                                              => 'gpu0'
list --published --baselines                                      => --published
list --published --env TOY                                        => --env
verify --published ""                                             => published agent
enjoy nowhere                                                     => nowhere
enjoy nowhere --env TOY --preset cpu                              => --env, --preset
enjoy none.zip --env TOY --baseline sac --load-last               => --baseline, --load-last
enjoy none.zip --env TOY                                          => none.zip: No such
enjoy none.zip --env TOY --algo sac                               => none.zip
enjoy damaged.zip --env Pendulum-v1                               => damaged.zip
enjoy --env TOY --baseline tqc                                    => tqc
enjoy --published Frobnication                                    => Frobnication
enjoy --published blockreaching                                   => CloseLoopBlockReaching
PUBLISHED --baseline frobnicate                                   => equi_sacfd
PUBLISHED --env TOY --load-last                                   => --env, --load-last
plot                                                              => logs
plot -f nowhere                                                   => --log-folder must be a folder
plot -o curves                                                    => .png
push nowhere --folder b                                           => nowhere
push nowhere                                                      => --organization
push nowhere -orga a --folder b                                   => --folder
TUNE --env-kwargs view:above                                      => 'view'
TUNE --study-name ../other                                         => '../other'
TUNE --device gpu0                                                => 'gpu0'
TUNE --n-trials 0                                                 => '0'
TUNE --eval-freq 5                                                => --n-evaluations
TUNE --pruner halving                                             => 'halving'
TUNE --space space.yml                                            => 'bc_weight'
benchmark close_loop_4 --dry-run                                  => 'close_loop_4d'
benchmark broken.yml                                              => broken.yml
benchmark tiny.yml -f tiny.yml                                    => --log-folder
benchmark tiny.yml -f /proc/folder                                => /proc
benchmark tiny.yml --cpus 0                                       => --cpus
benchmark tiny.yml --gpus 1                                       => --ray
benchmark tiny.yml --ray -j 2                                     => --ray
benchmark tiny.yml --device gpu0                                  => 'gpu0'
"""
CASES = [line.split("=>") for line in MISTAKES.strip().splitlines()]
PLANS: list[tuple[Any, str]] = [
    ({"task": ["a"]}, "'tasks'"),
    ({**TINY, "tasks": "CloseLoopToy"}, "tasks"),
    ({**TINY, "tasks": ["CloseLoopBlockPickin"]}, "CloseLoopBlockPicking"),
    ({**TINY, "tasks": ["CloseLoopNothing*"]}, "CloseLoopNothing*"),
    ({**TINY, "baselines": ["x*"]}, "x*"),
    ({**TINY, "preset": "cpuu"}, "'cpu'"),
    ({**TINY, "preset": 3}, "preset of bench.yml must be a name, got 3"),
    ({**TINY, "benchmark": []}, "benchmark of bench.yml"),
    ({**TINY, "seeds": [-1]}, "seeds"),
    ({**TINY, "options": {"eval_frq": 1}}, "'eval_freq'"),
    ({**TINY, "options": 3}, "options"),
    ({**TINY, "options": {"n_timesteps": "5"}}, "--n-timesteps must be of the type int, got '5'"),
    ({**TINY, "hyperparams": {"expert_data": "none.h5"}}, "none.h5"),
    ({**TINY, "variants": {"one_step": 1}}, "one_step"),
    ({**TINY, "variants": {1: {}, "1": {}}}, "variants of bench.yml"),  # would share a folder
    ({**TINY, "hyperparams": {"gamma": 2}}, "gamma"),
    ({**TINY, "hyperparams": {"env_kwargs": {"obs_size": 8}}}, "obs_size"),
]


@pytest.fixture
def files(tmp_path):
    """Files that command lines name."""
    for name, content in {
        "garbled/hyperparams.yml": "run: 3",
        "older/hyperparams.yml": "run: {algo: sacfd}\nPendulum-v1: {}",
        "broken.yml": "tasks: [",
        "tiny.yml": yaml.safe_dump(TINY),
        "space.yml": "bc_wight: {low: 0, high: 1}",
        "damaged.zip": "x",
        "taken.h5": "x",
        "leaving.py": "import sys; sys.exit(0)",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(("line", "text"), CASES, ids=[line.strip() for line, _ in CASES])
def test_a_mistake_is_one_line_that_names_it(line, text, refuse):
    for name, meaning in NAMES.items():
        line = re.sub(rf"\b{name}\b", meaning, line)
    assert text.strip() in refuse(*shlex.split(line))


def test_a_plan_that_cannot_be_followed(refuse, tmp_path):
    for plan, text in PLANS:
        (tmp_path / "bench.yml").write_text(yaml.safe_dump(plan))
        assert text in refuse("benchmark", "bench.yml", "--device", "cpu")


def test_a_missing_package_is_named(refuse, monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    for flag in "--track", "-tb logs":
        assert "pip install" in refuse(*TRAIN.split(), *flag.split())


def test_a_learner_that_cannot_be_built_leaves_nothing(refuse):
    more = ["expert_episodes:0", "pretrain_steps:0", "n_envs:1", "learning_starts:0", "tau:1", "ent_coef:x"]
    refuse(*TRAIN.split(), "-n", "20", "--eval-freq", "0", "-params", *more)


def test_a_full_disk_is_one_line(refuse, monkeypatch):
    def fill(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", fill)
    assert "new/video.gif: No space left on device" in refuse(*RECORD.split(), "-o", "new/video.gif")
    demos = "demos --env BulletArm/CloseLoopBlockReaching-v0 -n 1 --env-kwargs obs_size:32 -o new.h5"
    assert "new.h5: No space left on device" in refuse(*demos.split())
    assert "No space left on device" in refuse(*TRAIN.split())


def test_an_unwritable_home_is_one_line(tmp_path):
    words = TRAIN.replace("TOY", "Pendulum-v1").replace("--baseline sacfd --preset cpu", "--algo sac").split()
    command = [sys.executable, "-m", "zoo_configs.cli", *words, "-f", "/proc/home/logs"]
    variables = {**os.environ, "HOME": "/proc/home", "PYTHONPATH": PATH}
    variables["MPLCONFIGDIR"] = str(tmp_path)  # Stable-Baselines3 2.7 imports Matplotlib, which warns
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    [line] = done.stderr.splitlines()
    assert done.returncode == 2 and "/proc/home" in line


def test_an_error_in_a_users_code_has_its_place(monkeypatch, capsys):
    def fail(*_):
        raise KeyError("no item of that name")

    monkeypatch.setattr("zoo_configs.commands.plot.main", fail)
    assert main(["plot"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"KeyError: 'no item of that name' ({__file__}, line " in line and "--traceback plot" in line
    with pytest.raises(KeyError):
        main(["--traceback", "plot"])


def test_a_reader_that_stops_gets_no_traceback():
    command = [sys.executable, "-m", "zoo_configs.cli", "--help"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    with process.stderr as errors:
        assert errors.read() == b""
    assert process.wait() == 141
