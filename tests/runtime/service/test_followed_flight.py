"""`match.follow` and `match.accept_precision` of a flight: what they change, and what is wrong with a value."""

import pytest
from flights import of_kind

from edgevpr.cli.main import main
from edgevpr.core.config import load_config
from edgevpr.core.errors import ConfigError
from edgevpr.runtime.flight.flightlog import read_log


def flown(recording, tmp_path, match="{}", technique="cohog"):
    """The queries of a flight over the pictures of a map, with this section of the configuration."""
    config, log = tmp_path / "c.yaml", tmp_path / "log"
    config.write_text(
        f"map: {recording / technique}.gpkg\nsource: {{uri: {recording / 'seen' / 'images'}, rate_hz: 60}}\n"
        f"match: {match}\nlog: {{path: {log}}}\n"
    )
    assert main(["run", "--config", str(config)]) == 0
    return of_kind(read_log(log), "query")


def test_a_flight_is_followed_unless_it_is_told_not_to(recording, tmp_path):
    assert load_config(None).match.follow
    followed = flown(recording, tmp_path)
    assert all({"confidence", "lost"} <= set(line["followed"]) for line in followed)
    assert followed[-1]["followed"]["lat_deg"] == pytest.approx(50.029, abs=1e-3)


@pytest.mark.parametrize(
    ("match", "technique"), [("{follow: false}", "cohog"), ("{sequence: 2}", "cohog"), ("{follow: true}", "hog")]
)
def test_what_has_no_confidence_or_is_asked_for_a_sequence_is_not_followed(recording, tmp_path, match, technique):
    assert not any("followed" in line for line in flown(recording, tmp_path, match, technique))


@pytest.mark.parametrize(
    ("match", "says"),
    [
        ("{follow: maybe}", "`match.follow` must be true or false, not 'maybe'"),
        ("{follow: 1}", "`match.follow` must be true or false, not 1"),
        ("{follow: null}", "`match.follow` has no value: write one"),
        ("{folow: true}", "unknown key `match.folow` (did you mean `follow`?)"),
        ("{accept_precision: 1.0}", "`match.accept_precision` is 1; it must be between 0.5 and 0.999999"),
        ("{accept_precision: 0.49}", "it must be between 0.5 and 0.999999"),
        ("{accept_precision: .nan}", "`match.accept_precision` is nan; it must be between"),
        ("{accept_precision: high}", "`match.accept_precision` must be a number, not 'high'"),
        ("{accept_precision: true}", "`match.accept_precision` must be a number, not True"),
        ("{accept_precision: null}", "`match.accept_precision` has no value: write one"),
    ],
)
def test_a_value_that_makes_no_sense_is_said_in_a_sentence(tmp_path, match, says):
    (tmp_path / "c.yaml").write_text(f"match: {match}\n")
    with pytest.raises(ConfigError) as raised:
        load_config(tmp_path / "c.yaml")
    assert str(raised.value).startswith(str(tmp_path / "c.yaml"))
    assert says in str(raised.value)


def test_the_flags_say_what_they_are(capsys):
    for command, flags in (("run", ["--accept-precision"]), ("match", ["--accept-precision", "--follow"])):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        said = capsys.readouterr().out
        assert all(flag in said for flag in flags)
    assert main(["run", "--accept-precision", "2"]) == 2
    assert "`match.accept_precision` is 2; it must be between 0.5 and 0.999999" in capsys.readouterr().err
