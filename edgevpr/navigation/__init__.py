"""Position between the fixes: the way that the aircraft has flown by its own sensors, and a filter of how wrong that
is."""
