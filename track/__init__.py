"""Tracking: the same face through time. Rasterizer, flow, lifting, registration."""
