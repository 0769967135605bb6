"""Calibration: a map is asked for changed pictures of its own places, and its confidence is fitted to that."""
