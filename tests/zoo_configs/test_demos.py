"""``bulletarm-zoo demos``, and training with its files."""

import re
import subprocess
import sys

import h5py
import pytest
from sweeps import ROOT

from bulletarm_gym.demonstrations import load
from zoo_configs.cli import main

PICKING, REACHING = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/CloseLoopBlockReaching-v0"
SMALL = ["--env-kwargs", "obs_size:48"]


@pytest.fixture(scope="module")
def picking(tmp_path_factory):
    """A file of two episodes."""
    path = tmp_path_factory.mktemp("demos") / "picking.h5"
    assert main(["demos", "--env", PICKING, "-n", "2", "--seed", "3", "-o", str(path), *SMALL]) == 0
    return path


def train(folder, data, *more):
    names = ["--baseline", "sacfd", "--preset", "cpu", "--env", PICKING, "--device", "cpu", "-f", str(folder)]
    tiny = ["-n", "4", "--eval-freq", "0", "--num-threads", "1", "--no-progress"]
    params = ["-params", f"expert_data:{data}", "pretrain_steps:2", "batch_size:4", "buffer_size:100"]
    return main(["train", *names, *tiny, *more, *params])


def test_a_file_is_written_and_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--env", "BulletArm/OpenLoopBlockStacking-v0", "--planner", "deconstruction", "-n", "1"]
    words += ["-f", "files", "--env-kwargs", "num_objects:2"]
    assert main(["demos", *words]) == 0
    printed, name = capsys.readouterr().out, "OpenLoopBlockStacking-v0-deconstruction.h5"
    assert "1 of 1 attempts succeeded, mean_length=2.00" in printed
    assert printed.endswith(f"Written:\n  files/{name}\n")
    assert [path.name for path in (tmp_path / "files").iterdir()] == [name]
    assert len(load(tmp_path / "files" / name)[0]) == 2


def test_a_training_starts_with_the_file_and_resumes_without_it(picking, tmp_path, capsys):
    (file := tmp_path / "picking.h5").write_bytes(picking.read_bytes())
    assert train(tmp_path, file, *SMALL, "--save-freq", "4") == 0
    assert "expert episodes" not in capsys.readouterr().err
    [run] = tmp_path.glob("sacfd/*")
    assert str(file) in (run / "hyperparams.yml").read_text()
    file.unlink()
    assert main(["train", "--resume", str(run), "-n", "6", "--no-progress"]) == 0


def test_demonstrations_of_another_environment_are_refused(picking, tmp_path, capsys):
    for more, texts in (
        ([], ("'obs_size': 48", "'obs_size': 64")),
        ([*SMALL, "--env", REACHING], (PICKING, REACHING)),
        ([*SMALL, "--env-kwargs", "max_steps:9"], ("'max_steps': 50", "'max_steps': 9")),
        ([*SMALL, "--env-kwargs", "action_sequence:xyzrp"], ("'pxyzr'", "'xyzrp'")),
    ):
        assert train(tmp_path, picking, *more) == 2
        message = capsys.readouterr().err
        assert all(text in message for text in texts)
    assert not list(tmp_path.iterdir())
    assert train(tmp_path, picking, *SMALL, "--env", REACHING, "--allow-mismatched-demos") == 0


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "hollow"])
def test_a_damaged_file_is_named(damage, picking, tmp_path, capsys):
    content = picking.read_bytes()
    (file := tmp_path / "damaged.h5").write_bytes({"cut": content[:5000], "empty": b""}.get(damage, content))
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
    assert str(file) in line


def test_a_killed_collection_leaves_nothing(tmp_path):
    words = ["demos", "--env", PICKING, "-n", "100000", "-P", *SMALL, "-o", str(tmp_path / "a.h5")]
    command = [sys.executable, "-m", "zoo_configs.cli", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, cwd=ROOT) as process:
        printed = b""
        while not re.search(rb"[1-9]\d*/100000 ", printed):
            character = process.stderr.read(1)
            assert character, printed
            printed += character
        process.kill()
    assert not list(tmp_path.iterdir())
