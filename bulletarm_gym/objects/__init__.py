"""Objects: bodies made of convex pieces, built-in kinds, and objects from users' files."""

from bulletarm_gym.objects.blocks import (
    cube as cube,
    flat_block as flat_block,
    goal_area as goal_area,
    triangle as triangle,
)
from bulletarm_gym.objects.catalogue import create as create
from bulletarm_gym.objects.containers import bowl as bowl, corner as corner, drawer as drawer
