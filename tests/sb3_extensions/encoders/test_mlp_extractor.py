"""Observations of numbers alone: their extractor and the policies behind it."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd import TQCfD

STATE = spaces.Box(-np.inf, np.inf, (7,), np.float32)
HOLDING = spaces.Box(0, 1, (1,), np.float32)
SPACE = spaces.Dict({"state": STATE, "holding": HOLDING})
IMAGE = spaces.Dict({"heightmap": spaces.Box(0, 0.4, (1, 16, 16), np.float32)})


def test_features_depend_on_every_number() -> None:
    extractor = MlpExtractor(SPACE, layers=[32, 16])
    observations = {"state": th.randn(3, 7), "holding": th.ones(3, 1)}
    features = extractor(observations)
    assert features.shape == (3, extractor.features_dim) == (3, 16)
    for key, values in observations.items():
        for column in range(values.shape[1]):
            changed = values.clone()
            changed[:, column] += 1
            assert not th.equal(extractor({**observations, key: changed}), features)
    in_another_order = dict(reversed(observations.items()))
    assert th.equal(extractor(in_another_order), features)


def test_box_observations_are_accepted() -> None:
    assert MlpExtractor(STATE)(th.zeros(2, 7)).shape == (2, 256)


def test_numbers_are_standardised() -> None:
    th.manual_seed(0)
    plain = MlpExtractor(STATE)
    standardised = MlpExtractor(STATE, standardise=[0.5, 0.1])
    standardised.load_state_dict(plain.state_dict())
    numbers = th.rand(4, 7)
    th.testing.assert_close(standardised(numbers), plain((numbers - 0.5) / 0.1))


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (IMAGE, {}, "no images: 'heightmap' is"),
        (spaces.Dict({"kind": spaces.Discrete(3)}), {}, "'kind' is Discrete"),
        (SPACE, {"layers": []}, "layers must be"),
        (SPACE, {"layers": [64, 0]}, "layers must be"),
        (SPACE, {"standardise": [0.0, 0.0]}, "standardise must be"),
        (SPACE, {"standardise": [0.1]}, "standardise must be"),
    ],
)
def test_invalid_arguments_are_rejected(space: Any, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MlpExtractor(space, **kwargs)


def test_image_extractors_recommend_the_mlp_extractor_for_numbers() -> None:
    with pytest.raises(ValueError, match="StatePolicy"):
        CnnExtractor(SPACE)


@pytest.mark.parametrize("algorithm", [SACfD, TQCfD])
def test_imitation_solves_the_toy_task(algorithm: type[SACfD], make_toy: Any, tmp_path: Any) -> None:
    env = make_toy(observation="state")
    model = algorithm(
        "StatePolicy",
        env,
        expert_episodes=20,
        pretrain_steps=150,
        learning_rate=1e-3,
        bc_weight=10.0,
        buffer_size=1000,
        policy_kwargs={"features_extractor_kwargs": {"layers": [32, 32]}, "net_arch": {"pi": [], "qf": [32]}},
        seed=0,
        device="cpu",
    ).learn(1)
    assert evaluate_policy(model, env, 10)[0] >= 0.9
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    observation = {"state": np.array([[0.4, -0.2]], np.float32)}
    actions = [one.predict(observation, deterministic=True)[0] for one in (model, loaded)]
    np.testing.assert_array_equal(*actions)
