"""Live sources of a test: how they are waited for."""

import time

PATIENCE_S = 60.0


def wait_for(condition):
    """Turn until `condition()` is true and return what it gave."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not (result := condition()):
        assert time.monotonic() < give_up_s, "nothing happened"
        time.sleep(0.01)
    return result
