"""``bulletarm-zoo demos``, and training on what it has collected."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import h5py
import pytest

from zoo_configs.cli import main
from zoo_configs.environments import demonstrations

ROOT = Path(__file__).resolve().parents[2]
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
SMALL = ["--env-kwargs", "obs_size:48"]


@pytest.fixture(scope="module")
def picking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of two episodes."""
    path = tmp_path_factory.mktemp("demos") / "picking.h5"
    assert main(["demos", "--env", PICKING, "-n", "2", "--seed", "3", "-o", str(path), *SMALL]) == 0
    return path


def test_a_file_is_written_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["--env", "BulletArm/OpenLoopBlockStacking-v0", "--planner", "deconstruction", "-n", "1"]
    assert main(["demos", *arguments, "--env-kwargs", "num_objects:2"]) == 0
    printed = capsys.readouterr().out
    assert "1 of 1 attempts succeeded, mean_length=2.00" in printed
    name = "OpenLoopBlockStacking-v0-deconstruction.h5"
    assert printed.endswith(f"Written:\n  {name}\n")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert len(demonstrations().load(name)[0]) == 2


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--env", PICKING, "--planner", "deconstruction"], "only pick and place can be reversed"),
        (["--env", PICKING, "--planner", "magic"], "must be one of"),
        (["--env", PICKING, "--env-kwargs", "obs_sise:3"], "obs_size"),
        (["--env", PICKING, "-o", "no/folder/.h5/"], "must end in .h5"),
        (["--env", "BulletArm/CloseLoopBlockPecking-v0"], "BlockPicking"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_what_cannot_be_is_refused(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demos", *arguments]) == 2
    assert reason in capsys.readouterr().err


def train(folder: Path, data: object, *more: str) -> int:
    names = ["--baseline", "sacfd", "--preset", "cpu", "--env", PICKING, "--device", "cpu", "-f", str(folder)]
    tiny = ["-n", "4", "--eval-freq", "0", "--num-threads", "1", "--no-progress"]
    params = ["-params", f"expert_data:{str(data)!r}", "pretrain_steps:2", "batch_size:4", "buffer_size:100"]
    return main(["train", *names, *tiny, *more, *params])


def test_training_begins_with_the_file(
    picking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path, picking, *SMALL) == 0
    printed = capsys.readouterr()
    assert "expert episodes" not in printed.err
    assert (
        str(picking) in (tmp_path / "sacfd/BulletArm-CloseLoopBlockPicking-v0_1/hyperparams.yml").read_text()
    )


def test_files_that_do_not_fit_are_refused_before_the_run(
    picking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path, picking) == 2
    assert "has observations {'heightmap': (1, 48, 48)" in capsys.readouterr().err
    assert train(tmp_path, tmp_path / "none.h5") == 2
    assert "none.h5 cannot be read" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_demonstrations_of_another_task_or_other_parameters_are_refused(
    picking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for more, theirs, ours in (
        (["--env", REACHING], f"'env': '{PICKING}'", f"'env': '{REACHING}'"),
        (["--env-kwargs", "max_steps:9"], "{'max_steps': 50}", "{'max_steps': 9}"),
        (["--env-kwargs", "action_sequence:'xyzrp'"], "'pxyzr'", "'xyzrp'"),
    ):
        assert train(tmp_path, picking, *SMALL, *more) == 2
        message = capsys.readouterr().err
        assert theirs in message and ours in message and "--allow-mismatched-demos" in message
    assert not list(tmp_path.iterdir())
    assert train(tmp_path, picking, *SMALL, "--env", REACHING, "--allow-mismatched-demos") == 0


@pytest.mark.parametrize("damage", ["cut", "empty", "foreign", "flipped", "hollow"])
def test_a_damaged_file_is_told(
    damage: str, picking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = picking.read_bytes()
    damaged = {"cut": content[: len(content) // 2], "empty": b"", "foreign": b"no HDF5"}
    file = tmp_path / "damaged.h5"
    file.write_bytes(damaged.get(damage, content))
    if damage == "flipped":
        with h5py.File(file) as opened:
            start = opened["episodes/0/observations/heightmap"].id.get_chunk_info(0).byte_offset
        file.write_bytes(content[:start] + bytes(100) + content[start + 100 :])
    if damage == "hollow":
        with h5py.File(file, "a") as opened:
            del opened["about"], opened["episodes/0/actions"]
            opened["about"] = "{}"
    assert train(tmp_path, file, *SMALL) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{file} cannot be read" in line


def test_a_resumed_run_does_not_need_the_file(picking: Path, tmp_path: Path) -> None:
    file = tmp_path / "picking.h5"
    file.write_bytes(picking.read_bytes())
    assert train(tmp_path, file, *SMALL, "--save-freq", "4") == 0
    file.unlink()
    [run] = tmp_path.glob("sacfd/*")
    assert main(["train", "--resume", str(run), "-n", "6", "--no-progress"]) == 0


def test_a_killed_collection_leaves_nothing(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "zoo_configs.cli",
        "demos",
        "--env",
        PICKING,
        "-n",
        "100000",
        "-P",
        *SMALL,
    ]
    process = subprocess.Popen([*command, "-o", str(tmp_path / "a.h5")], stderr=subprocess.PIPE, cwd=ROOT)
    try:
        assert process.stderr is not None
        seen = b""
        while not re.search(rb"[1-9]\d*/100000 ", seen):
            character = process.stderr.read(1)
            assert character, seen
            seen += character
    finally:
        process.kill()
        process.wait()
    assert not list(tmp_path.iterdir())
