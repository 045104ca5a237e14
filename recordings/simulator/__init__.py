"""A synthetic rover traverse with exact ground truth: rolling ground, rocks, two cameras, an inclinometer, one log."""

from recordings.simulator.log import write_log
from recordings.simulator.simulation import Simulation

__all__ = ["Simulation", "write_log"]
