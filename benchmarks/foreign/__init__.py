"""Logs of machines whose equations of motion are written here, without the simulator that the library uses."""
