"""What an agent sees of the scene, each thing by name."""

from bulletarm_gym.sensors.cameras import PointCloud, Rgb
from bulletarm_gym.sensors.images import Color, Heightmap, Segmentation
from bulletarm_gym.sensors.in_hand import InHand
from bulletarm_gym.sensors.numbers import Holding, State
from bulletarm_gym.sensors.observer import SENSORS, Observer
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import MAX_HEIGHT, Frame, Map, View

__all__ = [
    "MAX_HEIGHT",
    "SENSORS",
    "Color",
    "Frame",
    "Heightmap",
    "Holding",
    "InHand",
    "Map",
    "Observer",
    "PointCloud",
    "Rgb",
    "Segmentation",
    "Sensor",
    "State",
    "View",
]
