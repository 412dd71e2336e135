"""What an agent sees of the scene, each thing by name."""

from bulletarm_gym.sensors.images import Heightmap
from bulletarm_gym.sensors.in_hand import InHand
from bulletarm_gym.sensors.numbers import Holding, State
from bulletarm_gym.sensors.observer import SENSORS, Observer
from bulletarm_gym.sensors.sensor import Sensor
from bulletarm_gym.sensors.view import MAX_HEIGHT, Frame, Map, View

__all__ = [
    "MAX_HEIGHT",
    "SENSORS",
    "Frame",
    "Heightmap",
    "Holding",
    "InHand",
    "Map",
    "Observer",
    "Sensor",
    "State",
    "View",
]
