"""Poses, rectangles, footprints and triangle meshes."""

from bulletarm_gym.geometry.footprint import Footprint as Footprint, PlacementError as PlacementError
from bulletarm_gym.geometry.meshes import Mesh as Mesh, join as join, mass_properties as mass_properties
from bulletarm_gym.geometry.poses import (
    FloatArray as FloatArray,
    IntArray as IntArray,
    Pose as Pose,
    Quaternion as Quaternion,
    Rectangle as Rectangle,
    Vector as Vector,
    conjugate as conjugate,
    euler_angles as euler_angles,
    euler_pose as euler_pose,
    interpolate as interpolate,
    matrix as matrix,
    multiply as multiply,
    planar_distance as planar_distance,
    quaternion as quaternion,
    rotate as rotate,
    wrap_angle as wrap_angle,
    yaw_quaternion as yaw_quaternion,
)
