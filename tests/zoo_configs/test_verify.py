"""Certificates: checksums of the first updates, and the comparison of a repeated training with them."""

import shutil

import pytest
import yaml

from zoo_configs.cli import main
from zoo_configs.publishing.published import read_card


def test_a_repeated_training_has_the_checksums_of_the_run(run_folder, capsys):
    first, *_, last = rows = yaml.safe_load((run_folder / "certificate.yml").read_text())["checksums"]
    numbers = [row["updates"] for row in rows]
    assert numbers[:3] == [0, 1, 2] and last["updates"] >= 10
    assert len({row["parameters"] for row in rows}) == len(rows)
    assert first["replay_buffer"] != last["replay_buffer"]
    before = sorted(run_folder.rglob("*"))
    assert main(["verify", str(run_folder), "--no-progress"]) == 0
    assert ", ".join(map(str, numbers)) in capsys.readouterr().out.splitlines()[-1]
    assert sorted(run_folder.rglob("*")) == before


def test_a_longer_run_repeats_until_its_first_end(run_folder, tmp_path, capsys):
    """Its learning rate depends on the number of time steps."""
    copy = shutil.copytree(run_folder, tmp_path / "run")
    assert main(["train", "--resume", str(copy), "-n", "30", "--no-progress"]) == 0
    assert (copy / "certificate.yml").read_text() == (run_folder / "certificate.yml").read_text()
    assert main(["verify", str(copy), "--no-progress"]) == 0


@pytest.mark.parametrize("quantity", ["observations", "parameters", "replay_buffer"])
def test_the_first_difference_and_other_versions_are_named(quantity, run_folder, tmp_path, refuse):
    copy = shutil.copytree(run_folder, tmp_path / "run")
    content = yaml.safe_load((copy / "certificate.yml").read_text())
    content["checksums"][1][quantity] = "0" * 16
    content["versions"]["python"] = "2.7"
    (copy / "certificate.yml").write_text(yaml.safe_dump(content))
    message = refuse("verify", str(copy), "--no-progress", "--updates", "1")
    assert f"{quantity} differ after 1 updates" in message and "2.7" in message


def test_a_published_agent_can_be_verified(run_folder, tmp_path):
    folder = str(tmp_path / "agent")
    assert main(["push", str(run_folder), "--folder", folder, "-n", "1", "--no-progress"]) == 0
    certificate = read_card(tmp_path / "agent").certificate
    assert certificate["options"] == {"n_timesteps": 12, "vec_env": "dummy", "num_threads": 1}
    assert main(["verify", "--published", folder, "--updates", "1", "--no-progress"]) == 0


def test_mistakes_are_one_line(run_folder, tmp_path, refuse):
    copy = shutil.copytree(run_folder, tmp_path / "run")
    (copy / "certificate.yml").write_text("checksums: 1")
    assert "certificate.yml" in refuse("verify", str(copy))
    (copy / "certificate.yml").unlink()
    assert "certificate.yml" in refuse("verify", str(copy))
    assert "RUN_FOLDER" in refuse("verify")
    assert "--baseline" in refuse("verify", str(run_folder), "--baseline", "sacfd")
    assert "'-1'" in refuse("verify", str(run_folder), "--updates", "-1")
