"""Faults of the media: a full disk, one that turns read-only, and one that is pulled, under the log and the map."""

import time

from machine import HOST
from trial import PATIENCE_S, Row, Trial, of_kind
from world import wait_until, write_track

LOGS, MAPS = "/var/log/edgevpr", "/var/lib/edgevpr"
LEARNT = f"{MAPS}/learnt.gpkg"


def log_full(trial: Trial) -> Row:
    row = Row(fault="the disk of the flight log is full for 15 s")
    return _log_gone(trial, row, f"dd if=/dev/zero of={LOGS}/filler bs=64k 2>/dev/null", f"rm {LOGS}/filler")


def log_read_only(trial: Trial) -> Row:
    # So does the kernel itself after an error of the medium. Nothing but to mount it anew makes it writable again.
    row = Row(fault="the medium of the flight log turns read-only, and is mounted anew after 15 s")
    anew = f"umount -l {LOGS}; e2fsck -fy /dev/disk/by-label/logs > /dev/null; mount {LOGS}"
    return _log_gone(trial, row, f"mount -o remount,abort {LOGS}; touch {LOGS}/a", anew)


def log_pulled(trial: Trial) -> Row:
    row = Row(fault="the USB stick of the flight log is pulled, and plugged in and mounted again after 15 s")
    return _log_gone(trial, row, None, None)


def _log_gone(trial: Trial, row: Row, take: str | None, give: str | None) -> Row:
    mounted(trial)
    trial.flies()
    before = trial.log()
    begin_s, restarts = time.monotonic(), trial.restarts()
    trial.tried(take) if take else trial.machine.pull()
    time.sleep(15)
    status = trial.unit("StatusText")
    matches_s = [each for each in trial.world.ground.matches_s if each > begin_s]
    back_s, back_inside_s = time.monotonic(), trial.inside_s()
    if not give:
        trial.machine.plug()
        give = f"umount -l {LOGS}; sleep 5; mount {LOGS}"
    trial.tried(give)
    try:
        written_s = trial.first_inside(lambda line: True, back_inside_s, limit_s=60)
    except RuntimeError:
        row.expect(False, "the log is written again within 60 s")
        written_s = float("nan")
    row.told = trial.world.ground.told_since(begin_s)
    after = trial.log()
    missing = [line for line in before[:-3] if line not in after]
    gaps = [line for line in of_kind(after, "gap") if line["t_mono_s"] > back_inside_s - 1]
    lost = gaps[0]["lost_lines"] if gaps else 0
    row.does = f"flies on without a log, says so in its status, and writes again {written_s:.1f} s after it can"
    row.kept = "the flight and its fixes, and all lines from before"
    row.lost = f"the lines of that time ({lost} of them, counted in a line `gap`)"
    row.expect(matches_s[-1:] and matches_s[-1] > back_s - 5, "matches go on")
    row.expect("cannot be written" in status or "moved" in status, f"its status says so (it says {status!r})")
    row.expect(not missing, "no line from before is lost")
    row.expect(gaps, "the log says how much is missing")
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    return row


def mounted(trial: Trial) -> None:
    """Have the media of logs and maps mounted: a boot waits for them 10 s, in which a busy host may not find them. The
    service makes them its user's when it starts."""
    for folder in (LOGS, MAPS):
        if trial.tried(f"mountpoint -q {folder}").code:
            trial.run(f"systemctl stop edgevpr; mount {folder}", limit_s=PATIENCE_S)


def map_full(trial: Trial) -> Row:
    row = Row(fault="the disk of the map is full while a flight learns")
    learns(trial)
    begin_s, inside_s, restarts = time.monotonic(), trial.inside_s(), trial.restarts()
    trial.tried(f"dd if=/dev/zero of={MAPS}/filler bs=64k 2>/dev/null")
    told_s = trial.next_text("nothing more is learnt", begin_s)
    queries = len(trial.world.ground.queries_s)
    time.sleep(6)
    row.expect(len(trial.world.ground.queries_s) > queries, "the flight goes on")
    trial.run(f"rm {MAPS}/filler")
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    confirmed = len(of_kind([line for line in trial.log() if line["t_mono_s"] > 0], "learnt"))
    back_s = time.monotonic()
    trial.run("systemctl restart edgevpr", limit_s=PATIENCE_S)
    places = counted(trial)
    learnt_s = trial.first_inside(lambda line: line["kind"] == "learnt", trial.inside_s() - 5)
    row.told = trial.world.ground.told_since(begin_s)
    row.does = f"learns nothing more, says so after {told_s:.0f} s, and goes on; after the next start it learns again"
    row.kept, row.lost = "every place that the log calls learnt", "places that would have been learnt since"
    row.expect(places >= len(since_start(trial, inside_s)), "no place is lost")
    row.expect(confirmed and learnt_s >= 0 and back_s, "it learns again after the next start")
    usual(trial)
    return row


def learns(trial: Trial) -> None:
    """Begin a flight that makes a new map, and wait for its first places."""
    world = trial.world
    mounted(trial)
    trial.tried("systemctl stop edgevpr")
    trial.run(f"rm -f {LEARNT}* {LOGS}/*.jsonl")
    if world.autopilot and world.autopilot.poll() is None:
        world.kill(world.autopilot)
    if world.camera is None or world.camera.poll() is not None:
        world.start_camera()
    world.start_autopilot("--track", write_track(world.flight / "track.csv"))
    link = f"udpout:{HOST}:{world.autopilot_port}"
    ground = f"udpout:{HOST}:{world.ground.port}"
    # A dry run: no fix of ours is in the position that is learnt.
    mavlink = {"link": link, "ground": ground, "send_fixes": False}
    trial.configure(map=LEARNT, technique="hog", mapping={"learn": True}, mavlink=mavlink)
    trial.run("systemctl reset-failed edgevpr; systemctl start edgevpr", limit_s=PATIENCE_S)
    wait_until(lambda: len(of_kind(trial.log(), "learnt")) >= 3, PATIENCE_S, "three places learnt", look_s=1.0)


def usual(trial: Trial) -> None:
    """Have the usual flight configured again."""
    trial.world.kill(trial.world.autopilot)
    trial.configure()
    trial.tried("systemctl stop edgevpr")
    trial.run(f"rm -f {LEARNT}*")


def counted(trial: Trial) -> int:
    """Return how many places the map that is learnt has."""
    script = f"import sqlite3; print(sqlite3.connect('file:{LEARNT}?mode=ro', uri=True).execute("
    script += "'SELECT count(*) FROM places').fetchone()[0])"
    return int(trial.run(f'/opt/edgevpr/bin/python -c "{script}"'))


def since_start(trial: Trial, inside_s: float) -> list[dict]:
    """Return the places that the log of this flight calls learnt, up to a time."""
    return [line for line in of_kind(trial.log(), "learnt") if line["t_mono_s"] < inside_s]


FAULTS = (log_full, log_read_only, log_pulled, map_full)
