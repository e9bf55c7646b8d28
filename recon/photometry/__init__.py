"""Vignetting, gain and black level of the devices."""
