"""Tests of capture.devices."""
