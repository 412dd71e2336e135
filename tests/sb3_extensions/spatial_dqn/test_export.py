"""Open-loop policies exported for use without this package."""

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_extensions.spatial_dqn import SpatialDQN
from sb3_extensions.spatial_dqn.policies import SpatialPolicy

SCENES = 10


@pytest.fixture
def policy(case: Any, make_picking: Any, make_policy_kwargs: Any) -> SpatialPolicy:
    env = make_picking(1, action_sequence=case[1])
    th.manual_seed(0)
    policy = SpatialDQN.policy_aliases[case[0]](
        env.observation_space, env.action_space, lambda _: 1e-3, **make_policy_kwargs(*case)
    )
    assert isinstance(policy, SpatialPolicy)
    policy.set_training_mode(False)
    return policy


def scenes(policy: SpatialPolicy) -> list[dict[str, th.Tensor]]:
    """Random observations, every other one with a grasped object."""
    policy.observation_space.seed(0)
    samples = [policy.observation_space.sample() for _ in range(SCENES)]
    for index, sample in enumerate(samples):
        sample["holding"] = np.full(1, index % 2, np.float32)
    return [{key: th.as_tensor(value)[None] for key, value in sample.items()} for sample in samples]


def test_exported_program_has_the_actions_of_the_policy(policy: SpatialPolicy) -> None:
    first, *others = scenes(policy)
    with th.no_grad():
        program = th.export.export(policy, (first,)).module()
        actions = [policy(scene) for scene in (first, *others)]
        for scene, action in zip((first, *others), actions, strict=True):
            th.testing.assert_close(program(scene), action)
    assert len({tuple(action[0].tolist()) for action in actions}) > 1


@pytest.mark.filterwarnings("ignore")
def test_traced_policy_has_the_actions_of_each_scene(policy: SpatialPolicy) -> None:
    first, *others = scenes(policy)
    with th.no_grad():
        traced = th.jit.trace(policy, (first,), check_trace=False, strict=False)
        for scene in others:
            th.testing.assert_close(traced(scene), policy(scene))


@pytest.mark.filterwarnings("ignore")
def test_onnx_model_has_the_actions_of_the_policy(policy: SpatialPolicy, tmp_path: Any) -> None:
    pytest.importorskip("onnxscript")
    onnxruntime = pytest.importorskip("onnxruntime")
    first, *others = scenes(policy)
    path = tmp_path / "policy.onnx"
    with th.no_grad():
        program = th.export.export(policy, (first,))
    th.onnx.export(program, f=path, verbose=False)
    session = onnxruntime.InferenceSession(str(path))
    names = [node.name for node in session.get_inputs()]
    with th.no_grad():
        for scene in (first, *others):
            inputs = dict(zip(names, (value.numpy() for value in scene.values()), strict=True))
            [action] = session.run(None, inputs)
            np.testing.assert_allclose(action, policy(scene).numpy(), atol=1e-6)


def test_parameters_are_restored_from_a_vector(policy: SpatialPolicy) -> None:
    vector = policy.parameters_to_vector()
    assert vector.shape == (sum(parameter.numel() for parameter in policy.parameters()),)
    policy.load_from_vector(np.arange(len(vector), dtype=np.float32))
    np.testing.assert_array_equal(policy.parameters_to_vector(), np.arange(len(vector)))
    policy.load_from_vector(vector)
    np.testing.assert_array_equal(policy.parameters_to_vector(), vector)
    for parameter in policy.parameters():
        assert parameter.dim() != 4 or parameter.is_contiguous(memory_format=th.channels_last)
