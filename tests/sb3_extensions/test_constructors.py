"""Learners that extend SACfD accept its arguments by name."""

import inspect
from typing import Any

import pytest

from sb3_extensions.common.env_metadata import constructor_keys
from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd import TQCfD

PARAMETERS = inspect.signature(SACfD).parameters


@pytest.mark.parametrize("learner", [FERM, TQCfD])
def test_learners_accept_the_arguments_of_sacfd(learner: type[SACfD], make_toy: Any) -> None:
    assert constructor_keys(learner) >= PARAMETERS.keys()
    arguments = {"gamma": 0.5, "exploration": 0.25, "augmentation": {"rad": {"size": 12}}, "buffer_size": 90}
    small = {"features_extractor_kwargs": {"channels": [4, 8, 8]}, "net_arch": [8]}
    model = learner("MultiInputPolicy", make_toy(), policy_kwargs=small, **arguments)
    assert (model.gamma, model.exploration, model.buffer_size) == (0.5, 0.25, 90)


@pytest.mark.parametrize("learner", [FERM, TQCfD])
def test_learners_refuse_unknown_arguments(learner: type[SACfD], make_toy: Any) -> None:
    with pytest.raises(TypeError, match="gama"):
        learner("MultiInputPolicy", make_toy(), gama=0.9)


def test_at_most_twelve_additions_and_all_off() -> None:
    """Arguments beyond those of SAC and of the paper's SACfD."""
    from stable_baselines3 import SAC

    papers = {"bc_weight", "expert_episodes", "expert_data", "augmentation"}
    additions = PARAMETERS.keys() - inspect.signature(SAC).parameters.keys() - papers
    assert len(additions) <= 12
    off = {name: PARAMETERS[name].default for name in additions}
    on = {"backup_entropy": True, "bc_limit": 1.0, "expert_q_weight": 1.0}
    assert all(
        default == on.get(name, default) and (name in on or not default) for name, default in off.items()
    )
