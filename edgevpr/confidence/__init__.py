"""How sure a match is: from evidence to the probability that it is right."""
