"""``bulletarm-zoo list``: what it says of a cell."""

from __future__ import annotations

import pytest

from zoo_configs.cli import main

CELL = ["--env", "BulletArm/CloseLoopBlockPicking-v0", "--baseline", "drq_sacfd"]


def test_the_values_of_a_cell_are_explained(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--explain", *CELL, "--preset", "paper"]) == 0
    sections = capsys.readouterr().out.split("\n\n")
    [shifts] = [section for section in sections if "augmentation.drq.pad: 4" in section]
    assert shifts.splitlines()[0].endswith("preset is paper, addition is drq")
    [source] = [section for section in sections if "gamma: 0.99" in section]
    assert '# The paper\'s appendix "Benchmark Details"' in source


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (CELL[:2], "name it with --env and --baseline"),
        ([*CELL, "--preset", "papre"], "unknown preset 'papre', did you mean 'paper'"),
        ([*CELL, "--benchmark", "open_loop_3d"], "is not in the benchmark open_loop_3d"),
    ],
)
def test_an_unknown_cell_is_told(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--explain", *words]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line


def test_baselines_are_listed_by_their_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--baselines"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["equi_sacfd_per_aug", "sacfd", "equivariant", "per_aug"] in lines
    assert ["sdqfd_equi_asr", "sdqfd", "equi_asr"] in lines


def test_the_parameters_of_an_environment_begin_with_its_parts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", *CELL[:2]]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["control", "'close_loop'"] in lines and ["surface", "'flat'"] in lines
