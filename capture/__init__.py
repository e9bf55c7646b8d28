"""Capture: devices, triggering, takes, and the nouns that every stage shares.

The lowest floor: it imports nothing of ours, and a capture machine runs it with numpy alone.
"""
