"""`match.follow` of a flight."""

import pytest
from flights import of_kind

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.runtime.flight.flightlog import read_log

pytestmark = pytest.mark.process


def flown(recording, tmp_path, match="{}", technique="cohog"):
    """The queries of a flight over the pictures of a map, with this section of the configuration."""
    config, log = tmp_path / "c.yaml", tmp_path / "log"
    config.write_text(
        f"map: {recording / technique}.gpkg\nsource: {{uri: {recording / 'seen' / 'images'}, rate_hz: 60}}\n"
        f"match: {match}\nlog: {{path: {log}}}\n"
    )
    assert main(["run", "--config", str(config)]) == 0
    return of_kind(read_log(log), "query")


def test_run_follows_the_flight_by_default(recording, tmp_path):
    assert load_config(None).match.follow
    followed = flown(recording, tmp_path)
    assert all({"confidence", "lost"} <= set(line["followed"]) for line in followed)
    assert followed[-1]["followed"]["lat_deg"] == pytest.approx(50.029, abs=1e-3)


@pytest.mark.parametrize(
    ("match", "technique"), [("{follow: false}", "cohog"), ("{sequence: 2}", "cohog"), ("{follow: true}", "hog")]
)
def test_run_does_not_follow_without_confidence_or_with_a_sequence(recording, tmp_path, match, technique):
    assert not any("followed" in line for line in flown(recording, tmp_path, match, technique))
