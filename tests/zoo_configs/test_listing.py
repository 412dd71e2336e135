"""``bulletarm-zoo list``, and ``train --dry-run``, which describes an experiment."""

from __future__ import annotations

import pytest

from zoo_configs.cli import main
from zoo_configs.yaml_files import parse_yaml

ENV = ["--env", "BulletArm/CloseLoopBlockPicking-v0"]


def test_a_dry_run_prints_the_source_and_the_reason_of_each_value(capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "--baseline",
        "drq_sacfd",
        "--preset",
        "paper",
        "-n",
        "7",
        "-params",
        "tau:1e-2",
        "callback:None",
    ]
    assert main(["train", "--dry-run", *ENV, *words]) == 0
    printed = capsys.readouterr().out
    content = parse_yaml(printed)
    assert content[ENV[1]]["augmentation"]["drq"]["pad"] == 4
    assert content[ENV[1]]["tau"] == 0.01 and content["options"]["n_timesteps"] == 7
    lines = {line.split(":")[0].strip(): line for line in printed.splitlines()}
    assert lines["pad"].endswith("# close_loop.yml, presets.paper.additions.drq")
    assert "defaults" in lines["gamma"] and "appendix" in lines["gamma"]
    assert all("command line" in lines[name] for name in ("tau", "callback", "n_timesteps"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--baseline", "sacfd", "--preset", "papre"], "'papre', did you mean 'paper'"),
        (["--baseline", "sacfd", "--benchmark", "open_loop_3d"], "'open_loop_3d'"),
        (["--baseline", "sacfd", "-params", "gama:1"], "'gama', did you mean 'gamma'"),
    ],
)
def test_a_dry_run_rejects_unknown_names(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--dry-run", *ENV, *words]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line


def test_baselines_are_listed_by_their_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--baselines"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["equi_sacfd_per_aug", "sacfd", "equivariant", "per_aug"] in lines
    assert ["sdqfd_equi_asr", "sdqfd", "equi_asr"] in lines


def test_the_parameters_of_an_environment_begin_with_its_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", *ENV]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["control", "'close_loop'"] in lines and ["surface", "'flat'"] in lines
