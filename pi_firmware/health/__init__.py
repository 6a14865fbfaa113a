"""What the payload knows of itself: board, radio, tasks, restarts, and what systemd is told."""

from pi_firmware.health.board import Board, BoardState
from pi_firmware.health.restarts import Restarts
from pi_firmware.health.systemd import Notifier
from pi_firmware.health.tasks import PeriodicThread, Table, Task
from pi_firmware.health.wifi import Wifi, WifiState

__all__ = [
    "Board",
    "BoardState",
    "Notifier",
    "PeriodicThread",
    "Restarts",
    "Table",
    "Task",
    "Wifi",
    "WifiState",
]
