"""Poses, rectangles, footprints and triangle meshes."""

from bulletarm_gym.geometry.footprint import Footprint, PlacementError
from bulletarm_gym.geometry.meshes import Mesh, join, mass_properties
from bulletarm_gym.geometry.poses import (
    FloatArray,
    IntArray,
    Pose,
    Quaternion,
    Rectangle,
    Vector,
    conjugate,
    euler_angles,
    euler_pose,
    interpolate,
    matrix,
    multiply,
    planar_distance,
    quaternion,
    rotate,
    wrap_angle,
    yaw_quaternion,
)

__all__ = [
    "FloatArray",
    "Footprint",
    "IntArray",
    "Mesh",
    "PlacementError",
    "Pose",
    "Quaternion",
    "Rectangle",
    "Vector",
    "conjugate",
    "euler_angles",
    "euler_pose",
    "interpolate",
    "join",
    "mass_properties",
    "matrix",
    "multiply",
    "planar_distance",
    "quaternion",
    "rotate",
    "wrap_angle",
    "yaw_quaternion",
]
