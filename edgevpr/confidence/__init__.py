"""Confidence: from the evidence of a match to the probability that it is right."""
