"""Files as a hostile user would write them, from a seed: for `hostile_inputs.py`."""

import os
import random
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

NUMBERS = (0, 1, 2, 59, 60, 99, 255, 256, 65_535, 2**31 - 1, 2**31, 2**32 - 1)
TEXTS = (
    "", " ", "0", "-1", "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "1466699519000", "9" * 400, "0x" + "f" * 5000,
    "9999-12-31T23:59:59+14:00", "0001-01-01T00:00:00-14:00", "2016:06:23 16:31:59", "2016-02-30", "x" * 5000,
    "\0", "\x1b[31m", "a\nb", "'", '"', ",", "é", "\u202e", "½", "١٢", "1_0", "true", "~", "../../etc/passwd",
)  # fmt: skip
YAML_VALUES = (
    *TEXTS, "[]", "{}", "[1]", "{a: 1}", "null", ".nan", ".inf", "-.inf", "1.0e+400", "1:59:59", "0o777", "2001-01-01",
    r'"\0"', r'"\ud800"', r'"\x1b[31m"', "!!python/object/apply:os.system [id]", "!!binary eA==", "!!set {a, b}", "*a",
    "&a [*a]", "|", ">", "- a", "? a", "[" * 200, "{a: " * 200, "[" + "x, " * 5000 + "x]",
)  # fmt: skip
POSITIONS = [["file", "lat", "lon", "alt", "yaw_deg", "time"], ["0.jpg", "50", "8", "100", "10", "1466699519"]]
TRUTH = [["query_file", "ref_files", "ref_files_loose", "status"], ["0.jpg", "0.jpg", "", "ok"]]
CONFIGURATION = """\
board: this
technique: null
match: {matching: null, form: null, candidates: 42, sequence: null, min_score: 0.1, neighbour_m: 50, reach_m_s: 15}
memory: {budget_mb: 20}
mapping: {learn: false, spacing_m: 10}
mavlink: {component_id: 197, send_fixes: true, min_accuracy_m: 5}
battery: {pack: 4S5200, regulator_efficiency: 0.85}
"""
LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{after}: &{after} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, after in zip("abcdefghi", "bcdefghij", strict=True)
)
_EXTENSIONS = (".jpg", ".png", ".tif", ".bmp", ".webp", ".ppm")
_LARGE_FILE_BYTES = 1 << 30


def picture(extension: str, seed: int) -> bytes:
    """A picture of 160x120 with some texture, encoded."""
    noise = np.random.default_rng(seed).integers(0, 256, (30, 40, 3), np.uint8)
    return cv2.imencode(extension, cv2.resize(noise, (160, 120), interpolation=cv2.INTER_CUBIC))[1].tobytes()


def write_image(folder: Path, number: int, chance: random.Random) -> None:
    """Write a hostile image, or something that is called like one."""
    extension = chance.choice(_EXTENSIONS)
    name = os.fsencode(f"{number}") + chance.choice(
        (b"", b"\xff\xfe", b"\x1b[31m", b"\n", b" ", b"x" * 200, "é".encode())
    )
    path = os.path.join(os.fsencode(folder), name + extension.encode())
    kind = chance.randrange(12)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        os.symlink(path, path)
    elif kind == 2:
        os.symlink(chance.choice(("/dev/zero", "/dev/null", "/proc/self/mem", "/nowhere")), path)
    elif kind == 3:
        os.mkdir(path)
    else:
        with open(path, "wb") as file:
            file.write(_image(picture(extension, number), kind, chance))
        if kind == 4:
            os.truncate(path, _LARGE_FILE_BYTES)


def _image(whole: bytes, kind: int, chance: random.Random) -> bytes:
    if kind == 5:
        return b""
    if kind == 6:
        side = chance.choice((20_000, 65_535, 2**31 - 1))
        rows = bytes(side + 1) * 20_000 if side == 20_000 else b""
        return _png(side, side, rows)
    if kind == 7:  # a TIFF of random tags
        tags = [(tag, chance.randrange(14), chance.choice(NUMBERS), chance.choice(NUMBERS)) for tag in range(254, 340)]
        return b"II*\0\x08\0\0\0" + struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags)
    if kind == 8:
        return whole[: chance.randrange(len(whole))]
    return _mutated(whole, chance, within=64 if kind == 9 else len(whole))


def _png(width: int, height: int, rows: bytes) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = zlib.compress(rows, 1)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _mutated(whole: bytes, chance: random.Random, within: int) -> bytes:
    content = bytearray(whole)
    for _ in range(chance.choice((1, 4, 32))):
        content[chance.randrange(min(within, len(content)))] = chance.choice((0, 1, 127, 255, chance.randrange(256)))
    return bytes(content)


def with_exif(jpeg: bytes, chance: random.Random) -> bytes:
    """The JPEG with EXIF whose degrees, dates, counts and offsets are senseless."""
    order = chance.choice("<>")
    gps = [
        (1, 2, b"N\0"), (2, 5, _ratios(order, 3, chance)), (3, 2, b"E\0"), (4, 5, _ratios(order, 3, chance)),
        (5, 1, bytes([chance.randrange(4)])), (6, 5, _ratios(order, 1, chance)), (7, 5, _ratios(order, 3, chance)),
        (16, 2, b"T\0"), (17, 5, _ratios(order, 1, chance)), (29, 2, chance.choice(TEXTS).encode() + b"\0"),
    ]  # fmt: skip
    taken = [
        (0x9003, 2, chance.choice(TEXTS).encode() + b"\0"),
        (0x9011, 2, chance.choice(TEXTS).encode()[:90] + b"\0"),
    ]
    start = 8 + 2 + 2 * 12 + 4
    camera = _directory(order, taken, start, chance)
    first = struct.pack(order + "H", 2)
    first += struct.pack(order + "HHII", 0x8769, 4, 1, start)
    first += struct.pack(order + "HHII", 0x8825, 4, 1, start + len(camera)) + bytes(4)
    mark = b"II*\0\x08\0\0\0" if order == "<" else b"MM\0*\0\0\0\x08"
    block = b"Exif\0\0" + mark + first + camera + _directory(order, gps, start + len(camera), chance)
    if chance.random() < 0.5:
        block = b"Exif\0\0" + _mutated(block[6:], chance, within=len(block) - 6)
    block = block[:65_000]
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + jpeg[2:]


def _ratios(order: str, count: int, chance: random.Random) -> bytes:
    return b"".join(
        struct.pack(order + "II", chance.choice(NUMBERS), chance.choice((1, 1, *NUMBERS))) for _ in range(count)
    )


def _directory(order: str, tags: list, start: int, chance: random.Random) -> bytes:
    """A directory of EXIF at the offset `start`, with its values behind it."""
    sizes = {1: 1, 2: 1, 5: 8}
    entries, values, values_at = struct.pack(order + "H", len(tags)), b"", start + 2 + 12 * len(tags) + 4
    for tag, kind, value in tags:
        count = len(value) // sizes[kind]
        if chance.random() < 0.03:
            count = chance.choice(NUMBERS)
        at = struct.pack(order + "I", values_at + len(values)) if len(value) > 4 else value.ljust(4, b"\0")
        entries += struct.pack(order + "HHI", tag, kind, count) + at
        values += value if len(value) > 4 else b""
    following = chance.choice((0, 0, 0, start, 8, 2**32 - 1))  # a directory that is followed by itself
    return entries + struct.pack(order + "I", following) + values


def _no_file(path: Path, kind: int, chance: random.Random) -> Path:
    """Return a pipe at `path`, or a device or a folder elsewhere."""
    if kind:
        return Path(chance.choice(("/dev/zero", "/dev/null", "/proc/self/mem", str(path.parent))))
    os.mkfifo(path)
    return path


def write_table(path: Path, rows: list[list[str]], chance: random.Random) -> Path:
    """Write a CSV of which one cell, one column or the whole is hostile."""
    rows = [list(row) for row in rows]
    kind = chance.randrange(8)
    if kind < 2:
        return _no_file(path, kind, chance)
    if kind == 2:
        twice = chance.randrange(len(rows[0]))
        rows = [[*row, row[twice]] for row in rows]
    else:
        rows[chance.choice((0, 1, 1, 1))][chance.randrange(len(rows[0]))] = chance.choice(TEXTS)
    text = "\n".join(",".join(row) for row in rows) + "\n"
    encoding = chance.choice(("utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16"))
    path.write_bytes(text.encode(encoding))
    return path


def write_yaml(path: Path, text: str, chance: random.Random) -> Path:
    """Write a YAML file of which one value, one line or the whole is hostile."""
    kind = chance.randrange(10)
    if kind < 2:
        return _no_file(path, kind, chance)
    lines = text.splitlines()
    at = chance.randrange(len(lines))
    if kind == 2:
        content = chance.choice((LAUGHS, "[" * 50_000, "a:\n" * 50_000, "- " * 50_000, "x" * 10_000_000, "\0", "\t"))
    elif kind == 3:
        content = "\n".join([*lines, lines[at]])  # a section that stands there twice
    elif kind == 4:
        content = _mutated(text.encode(), chance, len(text)).decode("latin-1")
    else:
        begin, _, value = lines[at].partition(": ")
        inner = value.strip("{}").split(", ")
        if value.startswith("{") and chance.random() < 0.8:  # one value of a section
            number = chance.randrange(len(inner))
            inner[number] = f"{inner[number].partition(': ')[0]}: {chance.choice(YAML_VALUES)}"
            lines[at] = f"{begin}: {{{', '.join(inner)}}}"
        else:
            lines[at] = f"{begin}: {chance.choice(YAML_VALUES)}"
        content = "\n".join(lines)
    path.write_text(content + "\n", chance.choice(("utf-8", "utf-8", "utf-8", "utf-16")), errors="replace")
    return path


def write_network(path: Path, whole: bytes, chance: random.Random) -> Path:
    """Write an ONNX file that is cut, changed or no file at all."""
    kind = chance.randrange(8)
    if kind < 2:
        return _no_file(path, kind, chance)
    if kind == 2:
        path.write_bytes(whole[: chance.randrange(len(whole))])
    elif kind == 3:
        path.touch()
        os.truncate(path, 3 << 30)
    else:  # its graph is at the beginning and the end, between them are the weights
        within = chance.choice((400, len(whole)))
        path.write_bytes(_mutated(whole, chance, within))
    return path


def odd_path(folder: Path, chance: random.Random) -> str | bytes:
    """A path that no command can use."""
    pipe, plain = folder / "pipe", folder / "plain"
    os.mkfifo(pipe)
    plain.touch()
    return chance.choice(
        (
            "", " ", ".", "/", "~", "-", "..", str(pipe), str(plain), f"{plain}/x", "/dev/null", "/dev/zero",
            "/dev/full", "/proc/self/mem", "/proc/self/fd/0", "x" * 300, "/x" * 3000, "a\nb", "\x1b[31m", "\u202e",
            "%s%n", "$(id)", "{}", b"\xff\xfe", b"\xed\xa0\x80.yaml", "file:///etc/passwd", "rtsp://pilot:secret@127.0.0.1:1/x",
            "http://[::1", "udp://", "x.sdp", "tcp://127.0.0.1:99999", "/var/../home/c.yaml", "C:\\x",
        )
    )  # fmt: skip
