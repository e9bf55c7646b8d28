"""Devices that hold a sensor: the simulated array here; real ones beside it."""
