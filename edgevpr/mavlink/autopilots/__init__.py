"""Autopilots that can be told a position, one file a firmware: by which channel, and why."""
