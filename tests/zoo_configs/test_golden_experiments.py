"""Resolved experiments equal ``golden_experiments.yml``, where a changed value is a readable diff."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import yaml

from zoo_configs.environments import register_environments
from zoo_configs.experiments.config import resolve
from zoo_configs.experiments.rules import families

register_environments()
GOLDEN_FILE = Path(__file__).with_name("golden_experiments.yml")
WRITE = "WRITE_GOLDEN_EXPERIMENTS"
"""Environment variable with which this test writes the file instead of comparing with it."""
PICKING, QUICK = "CloseLoopBlockPicking", "quick"
CLOSE_LOOP, OPEN_LOOP = families()
IN_3D = ("fcn", "equi_fcn", "rot_fcn", "cnn_asr", "equi_asr")
IN_6D = ("cnn_asr_6d", "equi_deictic_asr")
EXCEPTIONS = (
    ("equi_sacfd", QUICK, "CloseLoopHouseBuilding"),
    ("sacfd", QUICK, "CloseLoopHouseBuilding"),
    ("equi_sac", QUICK, "CloseLoopBlockStacking"),
    ("sacfd_state", QUICK, "CloseLoopBlockStacking"),
    ("equi_tqcfd", QUICK, "CloseLoopObjectGrasping"),
    ("equi_sacfd", QUICK, "CloseLoopCornerPicking"),
    ("drq_sacfd", QUICK, "CloseLoopDrawerOpening"),
    ("equi_sacfd", "cpu", "CloseLoopDrawerOpening"),
    ("equi_sacfd", "cpu", PICKING, "close_loop_3d"),
    ("sdqfd_equi_fcn", "cpu", "OpenLoopBlockStacking", "open_loop_2d"),
    ("sdqfd_equi_fcn", "paper", "OpenLoopBlockStacking", "open_loop_2d"),
    ("sdqfd_equi_asr", "cpu", "OpenLoopObjectGrasping"),
    ("sdqfd_equi_asr", "paper", "OpenLoopObjectGrasping"),
    ("sdqfd_equi_asr", "cpu", "OpenLoopBottleArrangement"),
    ("sdqfd_equi_asr", "cpu", "OpenLoopBinPacking"),
    ("sdqfd_equi_asr", "cpu", "OpenLoopBlockSorting"),
)
EXPERIMENTS = [
    *((name, preset, PICKING) for name in CLOSE_LOOP.baselines for preset in CLOSE_LOOP.presets),
    *((f"sdqfd_{net}", preset, "OpenLoopBlockStacking") for net in IN_3D for preset in OPEN_LOOP.presets),
    *((f"sdqfd_{net}", preset, "OpenLoopRampBlockStacking") for net in IN_6D for preset in OPEN_LOOP.presets),
    *((f"{name}_equi_asr", "cpu", "OpenLoopBlockStacking") for name in ("dqn", "adet", "dqfd")),
    *EXCEPTIONS,
]


def resolved(baseline: str, preset: str, task: str, benchmark: str | None = None) -> dict[str, Any]:
    """Return all values of an experiment."""
    experiment = resolve(baseline, preset, f"BulletArm/{task}-v0", benchmark=benchmark)
    return {"algo": experiment.algo, "flags": experiment.flags, "hyperparams": experiment.hyperparams}


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    if os.environ.get(WRITE):
        content = {" ".join(names): resolved(*names) for names in EXPERIMENTS}
        text = yaml.dump(content, Dumper=PlainDumper, default_flow_style=None, width=110)
        GOLDEN_FILE.write_text(text, encoding="utf-8")
    return dict(yaml.safe_load(GOLDEN_FILE.read_text(encoding="utf-8")))


class PlainDumper(yaml.SafeDumper):
    """Dumper that repeats equal values instead of referring to them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


@pytest.mark.parametrize("names", EXPERIMENTS, ids=" ".join)
def test_resolved_experiment_equals_the_golden_file(names: tuple[str, ...], golden: dict[str, Any]) -> None:
    assert resolved(*names) == golden[" ".join(names)]


def test_golden_file_has_no_other_experiments(golden: dict[str, Any]) -> None:
    assert set(golden) == {" ".join(names) for names in EXPERIMENTS}
