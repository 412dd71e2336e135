import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC

from sb3_extensions.encoders.cnn import CnnEncoder
from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantEncoder, EquivariantExtractor
from sb3_extensions.encoders.observation import StackedImage
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.quantisation import Quantiser

SIZE = 16
CNN = (CnnExtractor, {"channels": [4, 8, 8]})
REGULAR = (EquivariantExtractor, {"n": 4, "channels": [2, 4, 4]})
INVARIANT = (EquivariantExtractor, {"n": 4, "channels": [2, 4, 4], "output": "invariant"})


def observation_space(size=SIZE, **others):
    heightmap = spaces.Box(0, 0.4, (1, size, size), np.float32)
    return spaces.Dict({"heightmap": heightmap, "holding": spaces.Box(0, 1, (1,), np.float32), **others})


def sample(space, batch=3, seed=0):
    space.seed(seed)
    observations = [space.sample() for _ in range(batch)]
    return {key: th.from_numpy(np.stack([each[key] for each in observations])).float() for key in space}


def with_small_images(size=SIZE, **others):
    """Return a space with an in-hand image, and a float and a uint8 image of a third size."""
    return observation_space(
        size,
        in_hand=spaces.Box(0, 0.4, (3, 10, 10), np.float32),
        touch=spaces.Box(0, 1, (1, 8, 8), np.float32),
        colour=spaces.Box(0, 255, (3, 8, 8), np.uint8),
        **others,
    )


class NoiseEnv(gym.Env):
    """Random images and rewards."""

    observation_space = observation_space()
    action_space = spaces.Box(-1, 1, (5,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), float(action.sum()), False, self.steps == 8, {}


class ImageNoiseEnv(NoiseEnv):
    """The same with all numbers in one image: CrossQ takes no Dict observations."""

    bounds = np.float32([[[0.4]], [[1.0]]]) * np.ones((2, SIZE, SIZE), np.float32)
    observation_space = spaces.Box(0 * bounds, bounds, dtype=np.float32)


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


def test_stack_scales_images_and_repeats_numbers():
    space = observation_space(
        extra=spaces.Box(-5, 5, (2,), np.float32), colour=spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8)
    )
    observations = sample(space)
    observations["colour"] /= 255  # as Stable-Baselines3 does before it calls an extractor
    stack = StackedImage(space, "uint8")
    image = stack(observations)
    assert image.shape == (3, 7, SIZE, SIZE) and stack.channels == 7 and stack.size == SIZE
    order = ["colour", "heightmap", "extra", "holding"]
    assert th.equal(image[:, :3], observations["colour"])
    assert th.allclose(image[:, 3:4], observations["heightmap"] / 0.4, atol=0.5 / 255 + 1e-6)
    for channel, key, number in ((4, "extra", 0), (5, "extra", 1), (6, "holding", 0)):
        assert th.equal(image[:, channel], observations[key][:, number, None, None].expand(3, SIZE, SIZE))
    assert sorted(observations) == sorted(order)


def test_stack_accepts_a_single_image():
    space = ImageNoiseEnv.observation_space
    space.seed(0)
    image = th.from_numpy(np.stack([space.sample() for _ in range(3)]))
    assert th.allclose(
        StackedImage(space, "uint8")(image) * th.from_numpy(space.high), image, atol=0.51 / 255
    )


def test_stack_accepts_one_hot_numbers():
    space = observation_space(stage=spaces.Discrete(4))
    assert StackedImage(space, None).channels == 1 + 1 + 4


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_features_equal_those_of_stored_images(dtype):
    """Features of an image and of its copy in the replay buffer are bit-identical."""
    space = observation_space()
    extractor, quantiser = (
        CnnExtractor(space, [4, 8, 8], quantise=dtype),
        Quantiser(space["heightmap"], dtype),
    )
    seen = sample(space)
    stored = {
        **seen,
        "heightmap": th.from_numpy(quantiser.decode(quantiser.encode(seen["heightmap"].numpy()))),
    }
    assert not th.equal(seen["heightmap"], stored["heightmap"])
    assert th.equal(extractor(seen), extractor(stored))


def test_without_quantisation_heights_are_only_scaled():
    observations = sample(observation_space())
    image = StackedImage(observation_space(), None)(observations)
    assert th.allclose(image[:, :1], observations["heightmap"] / 0.4)
    unbounded = observation_space(heightmap=spaces.Box(-np.inf, np.inf, (1, SIZE, SIZE), np.float32))
    assert th.equal(StackedImage(unbounded, None)(observations)[:, :1], observations["heightmap"])


@pytest.mark.parametrize("quantise, error", [(None, 1e-6), ("uint8", 0.2 / 255), ("uint16", 0.2 / 65535)])
def test_standardised_heights(quantise, error):
    observations = sample(observation_space())
    image = StackedImage(observation_space(), quantise, standardise=(0.1, 0.01))(observations)
    assert th.allclose(image[:, :1], (observations["heightmap"] - 0.1) / 0.01, atol=(error + 1e-6) / 0.01)
    assert th.equal(image[:, 1:], observations["holding"][..., None, None].expand(-1, -1, SIZE, SIZE))


def test_standardised_uint8_images_are_in_unit_range():
    space = spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8)
    image = th.rand(2, 3, SIZE, SIZE)
    assert th.allclose(StackedImage(space, "uint8", standardise=(0.5, 0.25))(image), (image - 0.5) / 0.25)


@pytest.mark.parametrize("quantise, error", [(None, 1e-6), ("uint8", 0.4 / 255), ("uint16", 0.4 / 65535)])
def test_heights_above_the_ground(quantise, error):
    observations = sample(observation_space())
    stack = StackedImage(observation_space(), quantise, standardise=(0.01, 0.03), above_ground=(0.2, 0.1))
    image = stack(observations)
    farthest = observations["heightmap"].amax(dim=(1, 2, 3), keepdim=True)
    heights = farthest - observations["heightmap"]
    assert image.shape[1] == stack.channels == 3
    assert th.allclose(image[:, :1], (heights - 0.01) / 0.03, atol=(error + 1e-6) / 0.03)
    distances = ((farthest - 0.2) / 0.1).expand_as(heights)
    assert th.allclose(image[:, 1:2], distances, atol=(error + 1e-6) / 0.1)
    assert th.equal(image[:, 2:], observations["holding"][..., None, None].expand(-1, -1, SIZE, SIZE))


def test_heights_above_the_ground_do_not_depend_on_the_camera_height():
    stack = StackedImage(observation_space(), None, crop=SIZE - 4, above_ground=(0.0, 1.0))
    near = {"heightmap": th.rand(3, 1, SIZE, SIZE) * 0.2, "holding": th.zeros(3, 1)}
    near["heightmap"][:, :, 0, 0] = 0.3  # outside the crop, so it is not the ground
    far = {**near, "heightmap": near["heightmap"] + 0.1}
    seen = stack(near), stack(far)
    th.testing.assert_close(seen[0][:, 0], seen[1][:, 0])
    th.testing.assert_close(seen[0][:, 1] + 0.1, seen[1][:, 1])
    assert seen[0][:, 0].min() == 0.0 and 0.4 < seen[0][:, 0].max() < 0.5  # of a range of 0.4 m


@pytest.mark.parametrize("group, n", [("cyclic", 4), ("cyclic", 8), ("dihedral", 4)])
def test_outputs_are_equivariant_or_invariant(group, n):
    space = observation_space()
    regular = EquivariantExtractor(space, group, n, [4, 4, 4])
    invariant = EquivariantExtractor(space, group, n, [4, 4, 4], output="invariant")
    invariant.load_state_dict(regular.state_dict())
    order = regular.out_type.group.order
    assert regular.features_dim == 4 * order and invariant.features_dim == 4
    observations = sample(space)
    features = regular(observations)
    assert features.std() > 0
    for element in (e for e in range(order) if e % n % (n // 4) == 0):
        image = observations["heightmap"]
        image = image.flip(-1) if element >= n else image
        turned = {**observations, "heightmap": th.rot90(image, element % n // (n // 4), (-2, -1))}
        matrix = th.tensor(regular.out_type.matrix(element)).float()
        assert th.allclose(regular(turned), features @ matrix.T, atol=1e-5)
        assert th.allclose(invariant(turned), invariant(observations), atol=1e-5)


@pytest.mark.parametrize("output", ["regular", "invariant"])
@pytest.mark.parametrize(
    "space", [observation_space(), ImageNoiseEnv.observation_space], ids=["dict", "image"]
)
def test_extractor_without_small_images_equals_its_encoder(space, output):
    """Weights, features and later random numbers equal those of the encoder."""
    channels = StackedImage(space, "uint8").channels
    for make_encoder, make_extractor in (
        (
            lambda: CnnEncoder(channels, SIZE, [4, 8, 8]),
            lambda: CnnExtractor(space, [4, 8, 8]),
        ),
        (
            lambda: EquivariantEncoder(channels, SIZE, Group("cyclic", 4), [2, 4, 4], output),
            lambda: EquivariantExtractor(space, n=4, channels=[2, 4, 4], output=output),
        ),
    ):
        th.manual_seed(3)
        encoder, drawn = make_encoder(), th.rand(3)
        th.manual_seed(3)
        extractor = make_extractor()
        assert th.equal(th.rand(3), drawn)
        weights = {f"encoder.{key}": value for key, value in encoder.state_dict().items()}
        assert extractor.state_dict().keys() == weights.keys()
        assert all(th.equal(value, weights[key]) for key, value in extractor.state_dict().items())
        is_dict = isinstance(space, spaces.Dict)
        observations = sample(space) if is_dict else th.rand(3, 2, SIZE, SIZE) * 0.4
        features = encoder(extractor.stack(observations))
        assert th.equal(extractor(observations), features)


@pytest.mark.parametrize(
    "extractor_class, kwargs", [CNN, REGULAR, INVARIANT], ids=["cnn", "regular", "invariant"]
)
def test_features_of_small_images_are_appended(extractor_class, kwargs):
    space = with_small_images()
    plain = extractor_class(observation_space(), **kwargs)
    extractor = extractor_class(space, small_image_features=5, **kwargs)
    extractor.load_state_dict(plain.state_dict(), strict=False)
    assert extractor.features_dim == plain.features_dim + 2 * 5  # two sizes
    assert [stack.channels for stack, _ in extractor.small_images] == [3, 1 + 3]
    observations = sample(space)
    observations["colour"] /= 255
    features = extractor(observations)
    assert features.shape == (3, extractor.features_dim)
    scene = {key: observations[key] for key in observation_space()}
    assert th.equal(features[:, :-10], plain(scene))
    for key, places in (("in_hand", slice(-10, -5)), ("touch", slice(-5, None)), ("colour", slice(-5, None))):
        other = extractor({**observations, key: observations[key].flip(-1)})
        changed = ~th.isclose(other, features, atol=1e-7).all(dim=0)
        assert changed[places].any()
        changed[places] = False
        assert not changed.any()


def test_small_images_are_rounded_standardised_and_never_cropped():
    space = with_small_images()
    extractor = CnnExtractor(space, [4, 8, 8, 8], quantise="uint16", standardise=(0.1, 0.05), crop=12)
    stack = extractor.small_images[0][0]
    observations = sample(space)
    rounded = Quantiser(space["in_hand"], "uint16").round_trip(observations["in_hand"])
    assert extractor.stack.size == 12 and stack.size == 10
    assert th.allclose(stack(observations), (rounded - 0.1) / 0.05, atol=1e-6)
    assert not th.equal(rounded, observations["in_hand"])


@pytest.mark.parametrize("output", ["regular", "invariant"])
def test_features_of_small_images_are_invariant(output):
    space = with_small_images()
    extractor = EquivariantExtractor(space, n=4, channels=[4, 4, 4], output=output, small_image_features=6)
    fields = extractor.out_type.fields
    kinds = [(rep.kind, count) for rep, count in fields]
    assert kinds == ([("regular", 4), ("trivial", 12)] if output == "regular" else [("trivial", 4 + 12)])
    observations = sample(space)
    features = extractor(observations)
    assert features[:, -12:].std() > 0 and features[:, :-12].std() > 0
    for turns in range(1, 4):
        turned = {**observations, "heightmap": th.rot90(observations["heightmap"], turns, (-2, -1))}
        matrix = th.tensor(extractor.out_type.matrix(turns)).float()
        assert th.allclose(extractor(turned), features @ matrix.T, atol=1e-5)


@pytest.mark.parametrize(
    "extractor_class, kwargs",
    [(CnnExtractor, {"channels": [4, 8, 8, 8, 8, 8]}), (EquivariantExtractor, {"n": 4, "channels": [2] * 6})],
    ids=["cnn", "equivariant"],
)
@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_open_loop_observations(algorithm, extractor_class, kwargs):
    settings = {"n_steps": 4, "n_epochs": 1}
    if algorithm is SAC:
        settings = {"learning_starts": 4, "buffer_size": 16, "replay_buffer_class": ExpertReplayBuffer}
    model = algorithm(
        "MultiInputPolicy",
        "bulletarm_gym:BulletArm/OpenLoopBlockStacking-v0",
        policy_kwargs={
            "features_extractor_class": extractor_class,
            "features_extractor_kwargs": kwargs,
            "net_arch": [8],
        },
        batch_size=4,
        seed=0,
        device="cpu",
        **settings,
    )
    before = model.policy.parameters_to_vector()
    model.learn(6)
    after = model.policy.parameters_to_vector()
    assert np.isfinite(after).all() and not np.array_equal(after, before)
    vec_env = model.get_env()
    vec_env.reset()
    observation, *_ = vec_env.step(np.stack(vec_env.env_method("expert_action")))
    extractor = next(module for module in model.policy.modules() if isinstance(module, extractor_class))
    seen = {key: th.from_numpy(value) for key, value in observation.items()}
    features = extractor(seen) - extractor({**seen, "in_hand": 0 * seen["in_hand"]})
    assert (features[:, :-32] == 0).all() and (features[:, -32:] != 0).any()
    vec_env.close()


@pytest.mark.parametrize(
    "extractor_class, kwargs", [CNN, REGULAR, INVARIANT], ids=["cnn", "regular", "invariant"]
)
@pytest.mark.parametrize("algorithm", [PPO, TQC, CrossQ])
def test_extractors_serve_other_algorithms(algorithm, extractor_class, kwargs, tmp_path):
    on_policy = (
        {"n_steps": 8, "n_epochs": 1} if algorithm is PPO else {"learning_starts": 4, "buffer_size": 64}
    )
    policy_kwargs = {
        "features_extractor_class": extractor_class,
        "features_extractor_kwargs": kwargs,
        "net_arch": [8],
    }
    model = algorithm(
        "MlpPolicy" if algorithm is CrossQ else "MultiInputPolicy",
        ImageNoiseEnv() if algorithm is CrossQ else NoiseEnv(),
        policy_kwargs=policy_kwargs,
        batch_size=4,
        seed=0,
        device="cpu",
        **on_policy,
    )
    before = model.policy.parameters_to_vector()
    model.learn(12)
    assert not np.array_equal(model.policy.parameters_to_vector(), before)
    assert np.isfinite(model.policy.parameters_to_vector()).all()
    model.save(tmp_path / "model")
    observation = model.get_env().reset()
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )


@pytest.mark.parametrize(
    "space, kwargs, named",
    [
        (spaces.Box(0, 0.4, (16, 16), np.float32), {}, "must have images"),
        (spaces.Box(0, 0.4, (1, 16, 18), np.float32), {}, "must have images"),
        (spaces.Dict({"holding": spaces.Box(0, 1, (1,), np.float32)}), {}, "must have images"),
        (observation_space(in_hand=spaces.Box(0, 0.4, (1, 8, 10), np.float32)), {}, "must have images"),
        (observation_space(heightmap=spaces.Box(0, 0.4, (1, 16, 24), np.float32)), {}, "must have images"),
        (observation_space(in_hand=spaces.Box(0, np.inf, (1, 8, 8), np.float32)), {}, "finite bounds"),
        (observation_space(), {"small_image_features": 0}, "small_image_features"),
        (observation_space(heightmap=spaces.Box(0, np.inf, (1, 16, 16), np.float32)), {}, "finite bounds"),
        (observation_space(), {"quantise": "int4"}, "got 'int4'"),
        (observation_space(), {"channels": [4]}, "channels"),
        (observation_space(), {"strided": 3}, "strided"),
        (observation_space(), {"autocast": "fp16"}, "autocast"),
        (observation_space(), {"group": "square"}, "group"),
        (observation_space(), {"n": 0}, "n"),
        (observation_space(), {"output": "both"}, "output"),
        (observation_space(), {"standardise": (0.1, 0.0)}, "standardise"),
        (observation_space(), {"standardise": [0.1]}, "standardise"),
        (observation_space(), {"above_ground": [0.1]}, "above_ground"),
        (observation_space(), {"above_ground": (0.1, 0.0)}, "above_ground"),
        (spaces.Box(0, 255, (3, 16, 16), np.uint8), {"above_ground": (0.1, 0.1)}, "above_ground"),
    ],
)
def test_extractor_rejects_invalid_arguments(space, kwargs, named):
    with pytest.raises(ValueError, match=named):
        EquivariantExtractor(space, **kwargs)


def test_point_clouds_are_rejected():
    points = spaces.Box(-1, 1, (100, 3), np.float32)
    space = spaces.Dict({"heightmap": spaces.Box(0, 0.4, (1, 16, 16), np.float32), "points": points})
    with pytest.raises(ValueError, match="points"):
        CnnExtractor(space)


def test_compile_without_a_compiler_is_rejected(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError, match=r"compile.*no-such-compiler"):
        CnnExtractor(observation_space(), compile=True)


@pytest.mark.slow
@pytest.mark.parametrize("extractor_class", [CnnExtractor, EquivariantExtractor])
def test_compiled_extractor_has_the_same_features(extractor_class):
    th.manual_seed(0)
    extractor = extractor_class(observation_space(), channels=[4, 4, 4])
    compiled = extractor_class(observation_space(), channels=[4, 4, 4], compile=True)
    compiled.load_state_dict(extractor.state_dict())
    for batch in (4, 7):
        observations = sample(observation_space(), batch)
        features = extractor(observations)
        assert th.allclose(compiled(observations), features, atol=1e-4)
