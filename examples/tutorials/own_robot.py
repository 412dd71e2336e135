"""Tutorial 4: pick a block with the arm of my_robots.py and with the four built-in arms."""

import gymnasium
import my_robots

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.geometry import Pose

joints, error = my_robots.xarm6().inverse(Pose.planar(0.6, 0.15, 0.02, yaw=1.0))
print(f"reaches the far corner within {error:.0e}")

for robot in ("kuka", "panda", "ur5", "ur5_robotiq", "xarm6"):
    env = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", robot=robot, obs_size=64)
    env.reset(seed=0)
    steps, over = 0, False
    while not over:
        _, _, terminated, truncated, info = env.step(env.unwrapped.expert_action())
        steps, over = steps + 1, terminated or truncated
    print(f"{robot}: {'picked the block' if info['is_success'] else 'failed'} in {steps} steps")
    env.close()
