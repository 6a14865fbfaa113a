"""What the payload knows of itself: board, radio, tasks and restarts."""

from pi_firmware.health.board import Board, BoardState
from pi_firmware.health.restarts import Restarts
from pi_firmware.health.tasks import PeriodicThread, Table, Task
from pi_firmware.health.wifi import Wifi, WifiState

__all__ = [
    "Board",
    "BoardState",
    "PeriodicThread",
    "Restarts",
    "Table",
    "Task",
    "Wifi",
    "WifiState",
]
