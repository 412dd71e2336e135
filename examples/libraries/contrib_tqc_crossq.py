"""sb3-contrib: TQC with its CnnPolicy, CrossQ with the extractor that its policy lacks."""

import gymnasium
from sb3_contrib import TQC, CrossQ
from stable_baselines3.common.torch_layers import NatureCNN

from bulletarm_gym.wrappers import ImageObservation

env = ImageObservation(gymnasium.make("BulletArm/CloseLoopBlockReaching-v0", obs_size=64))
tqc = TQC("CnnPolicy", env, buffer_size=10_000, batch_size=64, seed=0)
crossq = CrossQ(
    "MlpPolicy",
    env,
    buffer_size=10_000,
    batch_size=64,
    policy_kwargs={"features_extractor_class": NatureCNN},
    seed=0,
)
for model in (tqc, crossq):
    model.learn(110)
    print(type(model).__name__, model.num_timesteps, "steps")
