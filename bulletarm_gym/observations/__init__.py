"""Observations: views of the scene, the sensors that read them, and cameras."""

from bulletarm_gym.observations.camera_sensors import Depth, PointCloud, Rgb
from bulletarm_gym.observations.images import Color, Heightmap, Segmentation
from bulletarm_gym.observations.in_hand import InHand
from bulletarm_gym.observations.observer import SENSORS, Observer
from bulletarm_gym.observations.rasterizer import Window
from bulletarm_gym.observations.sensor import Holding, JointState, Sensor, State
from bulletarm_gym.observations.view import (
    MAX_HEIGHT,
    ElevationMap,
    Frame,
    HeightRenderer,
    Heights,
    Overlay,
    View,
)

__all__ = [
    "MAX_HEIGHT",
    "SENSORS",
    "Color",
    "Depth",
    "ElevationMap",
    "Frame",
    "HeightRenderer",
    "Heightmap",
    "Heights",
    "Holding",
    "InHand",
    "JointState",
    "Observer",
    "Overlay",
    "PointCloud",
    "Rgb",
    "Segmentation",
    "Sensor",
    "State",
    "View",
    "Window",
]
