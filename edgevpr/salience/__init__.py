"""Memorable maps: which frames are worth remembering (thesis, chapter 3)."""
