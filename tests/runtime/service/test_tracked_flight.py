"""`match.follow` of a flight."""

import pytest
from flights import select

from edgevpr.cli.main import main
from edgevpr.runtime.flight.flightlog import read_log

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("match", "technique", "follows"),
    [
        ("{}", "cohog", True),
        ("{follow: false}", "cohog", False),
        ("{sequence: 2}", "cohog", False),
        ("{follow: true}", "hog", False),
    ],
)
def test_run_follows_with_confidence_and_without_a_sequence(recording, tmp_path, match, technique, follows):
    config, log = tmp_path / "c.yaml", tmp_path / "log"
    config.write_text(
        f"map: {recording / technique}.gpkg\nsource: {{uri: {recording / 'seen' / 'images'}, rate_hz: 60}}\n"
        f"match: {match}\nlog: {{path: {log}}}\n"
    )
    assert main(["run", "--config", str(config)]) == 0
    assert {"track" in line for line in select(read_log(log), "query")} == {follows}
