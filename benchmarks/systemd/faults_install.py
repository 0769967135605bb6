"""The installation: twice, judged by systemd's own tools, with devices that come and go, and taken away again."""

import time

from faults_process import slow_start
from trial import LOG, MAP, PATIENCE_S, Row, Trial
from world import wait_until

INSTALL = "/root/edgevpr/bin/edgevpr service install --config /etc/edgevpr/config.yaml"
_GADGET = "/sys/kernel/config/usb_gadget/fc"
# A flight controller on USB, made of the kernel's own parts: its vendor and product are ArduPilot's.
_PLUG_FC = f"""
modprobe dummy_hcd && modprobe libcomposite && mount -t configfs none /sys/kernel/config 2>/dev/null
mkdir -p {_GADGET}/strings/0x409 {_GADGET}/configs/c.1 {_GADGET}/functions/acm.0 && cd {_GADGET}
echo 0x1209 > idVendor && echo 0x5740 > idProduct && echo ArduPilot > strings/0x409/manufacturer
ln -s functions/acm.0 configs/c.1/ 2>/dev/null  # configfs takes the path from here
ls /sys/class/udc | head -1 > UDC && udevadm settle
"""
_UNPLUG_FC = f"echo > {_GADGET}/UDC; udevadm settle"


def installed_twice(trial: Trial) -> Row:
    row = Row(fault="`service install` a second time")
    trial.flies()
    begin_s, pid = time.monotonic(), trial.unit("MainPID")
    said = trial.run(INSTALL, limit_s=300)
    to_do = [line for line in said.splitlines() if line.startswith("to do")]
    row.again_s = trial.next_match(begin_s)
    row.does = f"finds all done but {len(to_do)} step, which has no state (udev names what is plugged in)"
    row.kept = "everything; the service that flies goes on"
    row.expect(len(to_do) == 1 and "udev" in to_do[0], f"nothing is done twice ({to_do})")
    row.expect(trial.unit("MainPID") == pid, "the service that flies goes on")
    return row


def judged(trial: Trial) -> Row:
    row = Row(fault="judged by systemd: `systemd-analyze verify` and `security`")
    verified = trial.tried("systemd-analyze verify edgevpr.service")
    exposure = trial.run("systemd-analyze security edgevpr.service --no-pager").splitlines()[-1]
    row.does = exposure.strip().lstrip("→ ").replace("for edgevpr.service: ", "").removesuffix(" :-)")
    row.expect(verified.code == 0 and not verified.text.strip(), f"verify is silent ({verified.text.strip()})")
    limits = {name: trial.unit(name) for name in ("MemoryMax", "CPUQuotaPerSecUSec", "WatchdogUSec", "MemoryCurrent")}
    row.kept = ", ".join(f"{name} {value}" for name, value in limits.items())
    row.expect(limits["MemoryMax"] == "256000000" and limits["MemoryCurrent"].isdigit(), "the limit of memory holds")
    return row


def usb_named(trial: Trial) -> Row:
    row = Row(fault="flight controller on USB pulled, and plugged in again after 10 s")
    world = trial.world
    trial.run(_PLUG_FC)
    wait_until(lambda: trial.tried("test -e /dev/edgevpr-fc").code == 0, PATIENCE_S, "/dev/edgevpr-fc", look_s=1.0)
    listed = trial.tried("ls -l /dev/edgevpr-fc; stat -Lc '%G %a' /dev/edgevpr-fc").text
    row.expect("dialout 660" in listed, f"/dev/edgevpr-fc is there, for the group dialout ({listed.strip()})")
    ground = f"udpout:10.0.2.2:{world.ground.port}"
    trial.configure(mavlink={"link": "serial:/dev/edgevpr-fc:921600", "ground": ground})
    fly = "/opt/edgevpr/bin/edgevpr simulate autopilot --link serial:/dev/ttyGS0:921600"
    trial.run(f"systemd-run -q --unit=fc {fly}; systemctl restart edgevpr", limit_s=PATIENCE_S)
    is_taken = lambda line: line["kind"] == "answer" and line["result"] == "ACCEPTED"  # noqa: E731
    trial.first_inside(is_taken, trial.inside_s())
    begin_s, restarts = time.monotonic(), trial.restarts()
    trial.run(f"systemctl stop fc; {_UNPLUG_FC}")
    time.sleep(10)
    row.expect(trial.tried("test -e /dev/edgevpr-fc").code, "the name goes with the device")
    back_inside_s = trial.inside_s()
    trial.run(f"ls /sys/class/udc | head -1 > {_GADGET}/UDC; udevadm settle; systemd-run -q --unit=fc {fly}")
    row.again_s = trial.first_inside(is_taken, back_inside_s)
    row.told = world.ground.told_since(begin_s)
    row.does = "goes on recognising, opens the port again, and finds the flight controller under the same name"
    row.kept, row.lost = "matches in the flight log", "fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    trial.tried(f"systemctl stop fc; {_UNPLUG_FC}")
    trial.configure()
    trial.run("systemctl restart edgevpr", limit_s=PATIENCE_S)
    return row


def v4l_lost(trial: Trial) -> Row:
    row = Row(fault="V4L2 camera lost, and back after 15 s")
    trial.run("modprobe vivid n_devs=1 node_types=0x1 && udevadm settle")
    device = trial.run("ls /dev/video* | head -1").strip()
    row.expect("video 660" in trial.run(f"stat -c '%G %a' {device}"), "the camera is for the group video")
    trial.configure(source={"uri": device, "rate_hz": 1.0})
    trial.run("systemctl restart edgevpr", limit_s=PATIENCE_S)
    ground = trial.world.ground
    queries = len(ground.queries_s)
    wait_until(lambda: len(ground.queries_s) > queries + 2, PATIENCE_S, "queries of the camera")
    begin_s, restarts = time.monotonic(), trial.restarts()
    trial.run("echo vivid.0 > /sys/bus/platform/drivers/vivid/unbind")
    told_s = trial.next_text("camera lost", begin_s)
    time.sleep(15)
    back_s = time.monotonic()
    trial.run("echo vivid.0 > /sys/bus/platform/drivers/vivid/bind; udevadm settle")
    wait_until(lambda: ground.queries_s[-1] > back_s + 1, PATIENCE_S, "a query of the camera that is back")
    row.again_s = next(each for each in ground.queries_s if each > back_s + 0.5) - back_s
    trial.next_text("camera is back", back_s)
    row.told = ground.told_since(begin_s)
    row.does = (
        f"says so after {told_s:.0f} s, goes on turning, and opens it again (a query counts, for it shows no ground)"
    )
    row.kept, row.lost = "all but new matches", "pictures and fixes of that time"
    row.expect(trial.restarts() == restarts, "the service was not restarted")
    trial.configure()
    trial.run("systemctl restart edgevpr", limit_s=PATIENCE_S)
    return row


def uninstalled(trial: Trial) -> Row:
    row = Row(fault="`service uninstall` while it flies")
    trial.flies()
    begin_s = time.monotonic()
    before = trial.run(f"sha256sum {MAP} /etc/edgevpr/config.yaml; wc -l < {LOG}").splitlines()
    trial.run("/root/edgevpr/bin/edgevpr service uninstall")
    after = trial.run(f"sha256sum {MAP} /etc/edgevpr/config.yaml; wc -l < {LOG}").splitlines()
    gone = trial.tried("ls -d /opt/edgevpr /etc/systemd/system/edgevpr.service /etc/udev/rules.d/99-edgevpr.rules").text
    row.expect(before[:2] == after[:2] and int(after[2]) >= int(before[2]), "map, log and configuration stay")
    row.expect(trial.log()[-1]["kind"] == "end", "the flight ends with its log flushed")
    row.expect(gone.count("No such file") == 3, f"program, unit and rules are gone ({gone})")
    row.expect(trial.tried("pgrep -f '[e]dgevpr run'").code == 1, "nothing of it runs")
    row.told = trial.world.ground.told_since(begin_s)
    row.does = "stops it, and takes program, unit and udev rules away"
    row.kept, row.lost = "map, flight log, configuration and the user", "program, unit and rules"
    return row


FAULTS = (judged, installed_twice, usb_named, v4l_lost, slow_start, uninstalled)  # the last leaves nothing to try
