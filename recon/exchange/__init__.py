"""Cameras of other programs, in and out."""
