"""edgevpr: visual place recognition for the companion computer of a small drone."""

__version__ = "0.1.0"
