"""A machine of its own for the service: QEMU boots the disk, runs commands in it, pulls plugs and cuts the power."""

import base64
import gzip
import json
import socket
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_BOOT_S, _CALL_S, _POLL_S = 600.0, 300.0, 0.05  # the first two are generous: they are no results
# No AVX: every instruction is emulated where there is no KVM, and wide ones cost more than they bring.
_CPU = "Nehalem"
HOST = "10.0.2.2"  # as the machine calls the one that it runs on


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command has said, both ways in one, and how it ended."""

    code: int
    text: str


class Machine:
    """One machine, from boot to power cut. `folder` keeps its sockets and disks: root, maps and logs.qcow2."""

    def __init__(self, image: Path, folder: Path) -> None:
        self._image, self._folder = image, folder
        self._process: subprocess.Popen | None = None
        self._agent: _Talk | None = None
        self._monitor: _Talk | None = None

    def boot(self, *, network: bool = True) -> float:
        """Switch the machine on; return the seconds until systemd has started what it is to start."""
        begin_s = time.monotonic()
        for name in ("agent", "monitor"):
            (self._folder / name).unlink(missing_ok=True)
        self._process = subprocess.Popen([*map(str, self._command(network))], stdin=subprocess.DEVNULL)
        self._monitor = _Talk(self._folder / "monitor", begin_s + _BOOT_S)
        self._monitor.call("qmp_capabilities")
        self._agent = _Talk(self._folder / "agent", begin_s + _BOOT_S)
        self._agent.wait_until_heard(begin_s + _BOOT_S)
        self.run("systemctl is-system-running --wait", check=False)
        return time.monotonic() - begin_s

    def is_on(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def run(self, script: str, *, check: bool = True, limit_s: float = _CALL_S) -> Answer:
        """Run a shell script as root. Raises RuntimeError where it fails and `check` is so."""
        pid = self._agent.call(
            "guest-exec", path="/bin/sh", arg=["-c", f"exec 2>&1\n{script}"], **{"capture-output": True}
        )["pid"]
        give_up_s = time.monotonic() + limit_s
        while not (state := self._agent.call("guest-exec-status", pid=pid))["exited"]:
            if time.monotonic() > give_up_s:
                raise RuntimeError(f"{script}: not done after {limit_s:g} s")
            time.sleep(_POLL_S)
        answer = Answer(
            state.get("exitcode", -1), base64.b64decode(state.get("out-data", "")).decode("utf-8", "replace")
        )
        if check and answer.code:
            raise RuntimeError(f"{script}: exit code {answer.code}: {answer.text[-2000:]}")
        return answer

    def put(self, path: str, content: bytes) -> None:
        """Write a file."""
        handle = self._agent.call("guest-file-open", path=path, mode="wb")
        for start in range(0, len(content), 1 << 20):
            part = base64.b64encode(content[start : start + (1 << 20)]).decode()
            self._agent.call("guest-file-write", handle=handle, **{"buf-b64": part})
        self._agent.call("guest-file-close", handle=handle)
        self.run("sync")

    def output(self, script: str) -> bytes:
        """Return what a shell script writes, to the byte, however it ends."""
        return gzip.decompress(base64.b64decode(self.run(f"({script}) | gzip | base64 -w0", check=False).text))

    def pull(self) -> None:
        """Pull the USB stick that the flight logs are written to."""
        self._monitor.call("device_del", id="stick")

    def plug(self) -> None:
        """Plug the stick in again."""
        self._monitor.call("device_add", driver="usb-storage", id="stick", drive="logs")

    def cut_power(self) -> None:
        """Cut the power: what has not reached the disk is lost."""
        self._process.kill()
        self._ended()

    def shut_down(self) -> None:
        """Switch the machine off as a user does."""
        if self._process and self._process.poll() is None:
            self._agent.say("guest-shutdown")
            try:
                self._process.wait(_CALL_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._ended()

    def _ended(self) -> None:
        if self._process:
            self._process.wait()
        for talk in (self._agent, self._monitor):
            if talk:
                talk.close()
        self._process = self._agent = self._monitor = None

    def _command(self, network: bool) -> list[object]:
        words: list[object] = ["nice", "qemu-system-x86_64", "-machine", "pc", "-cpu", _CPU, "-m", "1536"]
        words += ["-accel", "tcg,thread=multi", "-smp", "2", "-display", "none", "-nodefaults", "-no-reboot"]
        words += ["-kernel", self._image / "vmlinuz", "-initrd", self._image / "initrd.img"]
        words += ["-append", "root=/dev/vda rw console=ttyS0 quiet systemd.show_status=no panic=-1"]
        words += ["-serial", f"file:{self._folder / 'console.log'}"]
        words += ["-qmp", f"unix:{self._folder / 'monitor'},server=on,wait=off"]
        words += ["-device", "virtio-serial", "-device", "virtserialport,chardev=agent,name=org.qemu.guest_agent.0"]
        words += ["-chardev", f"socket,path={self._folder / 'agent'},server=on,wait=off,id=agent"]
        for name in ("root", "maps", "logs"):
            file = self._folder / f"{name}.qcow2"
            words += ["-blockdev", f"driver=qcow2,node-name={name},file.driver=file,file.filename={file}"]
        for name in ("root", "maps"):
            words += ["-device", f"virtio-blk-pci,drive={name}"]
        words += ["-device", "qemu-xhci", "-device", "usb-storage,id=stick,drive=logs"]
        if network:
            words += ["-netdev", "user,id=net", "-device", "virtio-net-pci,netdev=net"]
        return words


class _Talk:
    """A conversation in lines of JSON: with QEMU's monitor, or with the agent inside."""

    def __init__(self, path: Path, give_up_s: float) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        while True:
            try:
                self._socket.connect(str(path))
                break
            except OSError:
                if time.monotonic() > give_up_s:
                    raise RuntimeError(f"{path}: nobody listens") from None
                time.sleep(_POLL_S)
        self._socket.settimeout(_CALL_S)
        self._lines = self._socket.makefile("rb")

    def say(self, command: str, **arguments: Any) -> None:
        self._socket.sendall(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")

    def call(self, command: str, **arguments: Any) -> Any:
        self.say(command, **arguments)
        for line in self._lines:
            answer = json.loads(line)
            if "error" in answer:
                raise RuntimeError(f"{command}: {answer['error']['desc']}")
            if "return" in answer:
                return answer["return"]
        raise RuntimeError(f"{command}: the machine has ended")

    def wait_until_heard(self, give_up_s: float) -> None:
        """Ask again and again until the agent runs and answers."""
        self._socket.settimeout(2.0)
        number, heard = 0, b""
        while True:
            number += 1
            self.say("guest-sync", id=number)
            try:
                heard += self._socket.recv(65536)
            except TimeoutError:
                if time.monotonic() > give_up_s:
                    raise RuntimeError("the machine does not boot: see its console.log") from None
                continue
            if f'"return": {number}'.encode() in heard and heard.endswith(b"\n"):
                break
        self._socket.settimeout(_CALL_S)
        self._lines = self._socket.makefile("rb")

    def close(self) -> None:
        self._lines.close()
        self._socket.close()
