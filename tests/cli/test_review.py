"""`edgevpr export`, as a user types it."""

from edgevpr.cli.main import main
from edgevpr.runtime.flight.flightlog import FlightLog


def write_log(path):
    with FlightLog(path) as log:
        for lat_deg in (50.0, 51.0):
            log.write("start", t_mono_s=lat_deg)  # two of one millisecond would be one flight
            at = {"lat_deg": lat_deg, "lon_deg": 8.0}
            log.write("query", query="one.jpg", accepted=True, reason="sure", located=at)
    return path


def test_export_writes_a_file_or_standard_output(tmp_path, capsys):
    log = write_log(tmp_path / "log")
    for form in ("geojson", "csv"):
        out = tmp_path / f"out.{form}"
        assert main(["export", str(log), f"--{form}", str(out)]) == 0
        assert capsys.readouterr().out == f"{out}: 1 points\n"
        assert main(["export", str(log), f"--{form}", "-"]) == 0
        assert capsys.readouterr().out == out.read_text("utf-8")
        assert "51" in out.read_text("utf-8")


def test_export_never_writes_over_the_log(tmp_path, capsys):
    log = write_log(tmp_path / "log")
    before = log.read_bytes()
    assert main(["export", str(log), "--csv", str(log)]) == 2
    assert "another name" in capsys.readouterr().err
    assert log.read_bytes() == before
