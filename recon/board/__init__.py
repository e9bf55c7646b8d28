"""Calibration boards: what they are, and where devices saw them."""
