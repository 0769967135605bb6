"""Pictures of nothing real: what a camera, a receiver or a recorder gives when it shows no ground; and real ones of
which little is left: covered, out of focus, smeared, washed out."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from drawing import add_grain, blend_colours, draw_colour, fill, make_clouds, write_text

Draw = Callable[[np.random.Generator, int, int], np.ndarray]
SIZES = ((480, 640), (360, 640), (576, 720), (240, 320), (720, 1280), (240, 640))  # height, width
_BARS = ((191, 191, 191), (0, 191, 191), (191, 191, 0), (0, 191, 0), (191, 0, 191), (0, 0, 191), (191, 0, 0))  # BGR


def _draw_bars(rng, height, width):
    picture = fill(height, width, 0)
    edges = np.linspace(0, width, len(_BARS) + 1).astype(int)
    low = int(height * rng.uniform(0.6, 1.0))
    for left, right, colour in zip(edges[:-1], edges[1:], _BARS, strict=True):
        picture[:low, left:right] = colour
        picture[low:, left:right] = colour[::-1] if rng.random() < 0.5 else rng.integers(0, 60)
    if rng.random() < 0.7:
        write_text(picture, rng, "NO SIGNAL", (0.25, 0.55), 1.6)
    return add_grain(picture, rng, rng.choice((0, 2, 6)))


def _draw_blue(rng, height, width):
    picture = fill(height, width, (int(rng.integers(120, 256)), int(rng.integers(0, 60)), int(rng.integers(0, 60))))
    for row in range(int(rng.integers(1, 6))):
        text = str(rng.choice(("NO SIGNAL", "VIDEO LOSS", "CH 5  5865 MHz", "CHECK CONNECTION", "RX1 LOST", "AV1")))
        write_text(picture, rng, text, (rng.uniform(0.02, 0.5), 0.15 + 0.16 * row), rng.uniform(0.6, 2))
    return add_grain(picture, rng, rng.choice((0, 3)))


def _draw_logo(rng, height, width):
    picture = fill(height, width, draw_colour(rng, 0, 40))
    x, y = int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.2, 0.8) * height)
    size = int(rng.uniform(0.05, 0.2) * height)
    cv2.ellipse(picture, (x, y), (2 * size, size), 0, 0, 360, draw_colour(rng, 100), -1)
    cv2.ellipse(picture, (x, y), (size, size // 2), 30, 0, 360, draw_colour(rng), int(rng.integers(2, 9)))
    write_text(picture, rng, "DVR", (max(0, x - size) / width, y / height), rng.uniform(0.8, 2))
    return picture


def _draw_card(rng, height, width):
    """Draw a test card: grid, circle, wedges, grey steps."""
    picture, step = fill(height, width, 128), int(rng.integers(16, 64))
    for x in range(step // 2, width, step):
        cv2.line(picture, (x, 0), (x, height), (255, 255, 255), 1)
    for y in range(step // 2, height, step):
        cv2.line(picture, (0, y), (width, y), (255, 255, 255), 1)
    cv2.circle(picture, (width // 2, height // 2), int(0.45 * height), draw_colour(rng), int(rng.integers(2, 10)))
    for at in range(12):
        left, right = width // 4 + at * width // 24, width // 4 + (at + 1) * width // 24
        picture[height // 3 : height // 2, left:right] = int(255 * at / 11)
        picture[height // 2 : 2 * height // 3, left:right] = draw_colour(rng)
    every = np.arange(width // 4, 3 * width // 4)
    stripes = 255 * ((every**2 // (width * rng.integers(2, 9))) % 2)
    picture[2 * height // 3 : 3 * height // 4, every] = stripes.astype(np.uint8)[:, None]
    return picture


def overlay_figures(picture, rng):
    """Write the figures that a flight controller writes over a picture."""
    texts = ("16.2V", "12.4A", "ALT 83m", "GPS 14", "12:31", "ACRO", "RSSI 87", "HOME 412m", "-35.363261", "DISARMED")
    for text in rng.permutation(texts)[: rng.integers(3, len(texts) + 1)]:
        write_text(picture, rng, str(text), (rng.uniform(0, 0.85), rng.uniform(0.06, 0.97)), rng.uniform(0.5, 1.1))
    return picture


def draw_display(picture, rng):
    """Draw what a flight controller draws over a picture: figures, a cross, a ladder, a horizon line."""
    height, width = overlay_figures(picture, rng).shape[:2]
    middle, white = (width // 2, height // 2), (255, 255, 255)
    cv2.drawMarker(picture, middle, white, cv2.MARKER_CROSS, height // 12, 2)
    roll = np.tan(rng.normal(0, 0.2))
    for pitch in range(-3, 4):
        at, half = height // 2 + pitch * height // 10, width // (5 if pitch else 3)
        left, right = (middle[0] - half, int(at - roll * half)), (middle[0] + half, int(at + roll * half))
        cv2.line(picture, left, right, white, 2)
    if rng.random() < 0.5:
        for tick in range(0, height, height // 20):
            cv2.line(picture, (int(0.9 * width), tick), (int((0.92 + 0.02 * (tick % 3)) * width), tick), white, 2)
    return picture


def _draw_dark_display(rng, height, width):
    ground = blend_colours(make_clouds(rng, height, width, 8, 3), 0, rng.uniform(5, 40))
    return draw_display(add_grain(ground, rng, rng.uniform(0.5, 4)), rng)


def _draw_specks(rng, height, width):
    picture, dark = fill(height, width, int(rng.choice((0, 90, 128, 220)))), rng.random() < 0.5
    for _ in range(int(rng.integers(3, 150))):
        at = int(rng.integers(width)), int(rng.integers(height))
        radius, colour = int(rng.integers(1, 9)), draw_colour(rng, 0, 100) if dark else draw_colour(rng, 120)
        cv2.circle(picture, at, radius, colour, -1)
    return cv2.GaussianBlur(picture, (0, 0), 1.5) if rng.random() < 0.5 else picture


def _draw_scratches(rng, height, width):
    picture = fill(height, width, int(rng.integers(0, 256)))
    for _ in range(int(rng.integers(2, 40))):
        ends = [(int(rng.integers(width)), int(rng.integers(height))) for _ in range(2)]
        cv2.line(picture, *ends, draw_colour(rng), int(rng.integers(1, 5)), cv2.LINE_AA)
    return picture


def _draw_interlaced(rng, height, width):
    """Draw rows or columns: comb, hum bars, a torn synchronisation."""
    rows = np.arange(height)
    period = rng.uniform(2, 60)
    share = 0.5 + 0.5 * np.sin(2 * np.pi * rows / period + rng.uniform(0, 6))
    if rng.random() < 0.5:
        share = (share > 0.5).astype(float)
    share = np.repeat(share[:, None], width, axis=1)
    if rng.random() < 0.5:
        share = cv2.resize(np.ascontiguousarray(share.T), (width, height))
    return add_grain(blend_colours(share, draw_colour(rng), draw_colour(rng)), rng, rng.choice((0, 3, 10)))


def _draw_torn(rng, height, width):
    """Draw bars or clouds whose rows have slipped sideways: lost synchronisation."""
    picture = _draw_bars(rng, height, width) if rng.random() < 0.5 else _draw_sky(rng, height, width)
    slip = np.cumsum(rng.normal(0, rng.uniform(0.5, 20), height)).astype(int)
    if rng.random() < 0.5:
        slip = (np.arange(height) * rng.uniform(-2, 2)).astype(int)
    return np.stack([np.roll(row, by, axis=0) for row, by in zip(picture, slip, strict=True)])


def _draw_horizon(rng, height, width):
    y, x = np.mgrid[:height, :width]
    line = height * rng.uniform(0.2, 0.8) + np.tan(rng.normal(0, 0.3)) * (x - width / 2)
    below = np.clip((y - line) / rng.uniform(1, 12) + 0.5, 0, 1)
    picture = blend_colours(below, draw_colour(rng, 120), draw_colour(rng, 0, 140))
    return add_grain(cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 3)), rng, rng.choice((0, 2, 5)))


def _draw_sky(rng, height, width):
    share = make_clouds(rng, height, width, rng.uniform(16, 200), int(rng.integers(3, 7)))
    share = np.clip((share - rng.uniform(0.2, 0.6)) * rng.uniform(1, 5), 0, 1)
    share = share + np.linspace(0, rng.uniform(0, 0.5), height)[:, None]
    picture = blend_colours(share, (220, 160, 90), (250, 250, 250))
    if rng.random() < 0.4:
        cv2.circle(picture, (int(rng.integers(width)), int(rng.integers(height))), height // 8, (255, 255, 255), -1)
        picture = cv2.GaussianBlur(picture, (0, 0), height / 60)
    return add_grain(picture, rng, rng.uniform(0, 3))


def _draw_cap(rng, height, width):
    picture = fill(height, width, 0) + rng.normal(rng.uniform(0, 8), rng.uniform(0.5, 6), (height, width, 1))
    picture = picture + rng.normal(0, rng.uniform(0, 3), (1, width, 1))  # the columns of a sensor differ
    hot = rng.random((height, width)) < rng.uniform(0, 2e-3)
    picture[hot] = rng.uniform(60, 255)
    return np.clip(picture, 0, 255).astype(np.uint8)


def _draw_fog(rng, height, width):
    base, depth = rng.uniform(90, 220), rng.uniform(2, 25)
    share = make_clouds(rng, height, width, rng.uniform(4, 60), 4)
    return add_grain(blend_colours(share, base - depth, base + depth), rng, rng.uniform(0, 4))


def _draw_bright(rng, height, width):
    """Draw over-exposed ground: white, with a few greys left."""
    share = make_clouds(rng, height, width, rng.uniform(10, 120), 4)
    return add_grain(blend_colours(np.clip(share * 3 + rng.uniform(-0.6, 0.6), 0, 1), 150, 255), rng, rng.uniform(0, 2))


def _draw_white_noise(rng, height, width):
    middle, sigma = rng.uniform(40, 200), rng.uniform(5, 90)
    channels = 1 if rng.random() < 0.6 else 3
    noise = rng.normal(middle, sigma, (height, width, channels))
    return np.clip(fill(height, width, 0) + noise, 0, 255).astype(np.uint8)


def _draw_banded_noise(rng, height, width):
    """Draw noise of one bandwidth, which may differ along rows and columns."""
    noise = rng.standard_normal((height, width)).astype(np.float32)
    along, across = np.exp(rng.uniform(np.log(0.5), np.log(25), 2))
    noise = cv2.GaussianBlur(noise, (0, 0), along, sigmaY=along if rng.random() < 0.6 else across)
    noise = noise / noise.std() * rng.uniform(15, 70) + rng.uniform(60, 190)
    return np.clip(noise[..., None] + fill(height, width, 0), 0, 255).astype(np.uint8)


def _draw_snow(rng, height, width):
    """Draw the snow of an analogue receiver: dots that run along the rows."""
    noise = cv2.GaussianBlur(rng.random((height, width)).astype(np.float32), (0, 0), rng.uniform(0.5, 3), sigmaY=0.1)
    picture = blend_colours(cv2.normalize(noise, None, 0, 1, cv2.NORM_MINMAX), 0, 255)
    if rng.random() < 0.5:
        write_text(picture, rng, "NO SIGNAL", (rng.uniform(0, 0.4), rng.uniform(0.3, 0.8)), 1.6)
    return picture


def _draw_blocks(rng, height, width):
    """Draw the blocks of a codec that has lost its reference."""
    size = int(rng.choice((8, 16, 32)))
    small = rng.normal(128, rng.uniform(5, 60), (-(-height // size), -(-width // size), 1))
    picture = cv2.resize(small, None, fx=size, fy=size, interpolation=cv2.INTER_NEAREST)[:height, :width, None]
    return add_grain(picture + fill(height, width, 0), rng, rng.choice((0, 2)))


def _draw_tiles(rng, height, width):
    """Draw one small patch over and over."""
    side_y, side_x = (int(side) for side in rng.integers(12, 130, 2))
    patch = blend_colours(make_clouds(rng, side_y, side_x, rng.uniform(4, 40), 3), draw_colour(rng), draw_colour(rng))
    if rng.random() < 0.3:
        cv2.circle(patch, (side_x // 2, side_y // 2), min(side_x, side_y) // 4, draw_colour(rng), -1)
    times = -(-height // side_y), -(-width // side_x), 1
    return add_grain(np.tile(patch, times)[:height, :width], rng, rng.choice((0, 2)))


def _draw_checks(rng, height, width):
    side_y, side_x = (int(side) for side in rng.integers(6, 90, 2))
    y, x = np.mgrid[:height, :width]
    share = ((y // side_y + x // side_x) % 2).astype(np.float32)
    return add_grain(blend_colours(share, draw_colour(rng), draw_colour(rng)), rng, rng.choice((0, 3)))


NOTHING: dict[str, Draw] = {
    "no signal: bars": _draw_bars,
    "no signal: blue": _draw_blue,
    "no signal: logo": _draw_logo,
    "no signal: snow": _draw_snow,
    "test card": _draw_card,
    "display on blank": lambda rng, *size: draw_display(fill(*size, int(rng.choice((0, 16, 60, 128)))), rng),
    "display on dark": _draw_dark_display,
    "display on fog": lambda rng, *size: draw_display(_draw_fog(rng, *size), rng),
    "blank": lambda rng, *size: add_grain(fill(*size, draw_colour(rng)), rng, rng.choice((0, 0.5, 1))),
    "specks": _draw_specks,
    "scratches": _draw_scratches,
    "interlaced": _draw_interlaced,
    "torn": _draw_torn,
    "horizon": _draw_horizon,
    "sky": _draw_sky,
    "lens cap": _draw_cap,
    "fog": _draw_fog,
    "over-exposed": _draw_bright,
    "white noise": _draw_white_noise,
    "banded noise": _draw_banded_noise,
    "codec blocks": _draw_blocks,
    "tiles": _draw_tiles,
    "checks": _draw_checks,
}

Spoil = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def _cover_half(rng, picture):
    """Cover half or more of a picture from one side, black or grey."""
    covered, share = picture.copy(), rng.uniform(0.5, 0.9)
    height, width = picture.shape[:2]
    rows, columns = (slice(int(share * height)), slice(None)), (slice(None), slice(int(share * width)))
    covered[rows if rng.random() < 0.5 else columns] = int(rng.choice((0, 20, 128)))
    return covered if rng.random() < 0.5 else np.ascontiguousarray(covered[::-1, ::-1])


def _draw_struts(rng, picture):
    """Lay struts across a picture."""
    covered = picture.copy()
    height, width = picture.shape[:2]
    for _ in range(int(rng.integers(1, 4))):
        ends = (int(rng.integers(width)), 0), (int(rng.integers(width)), height)
        cv2.line(covered, *ends, int(rng.integers(0, 60)), max(2, int(width * rng.uniform(0.08, 0.3))))
    return covered


def _draw_finger(rng, picture):
    """Lay something blurred and bright over most of a picture."""
    height, width = picture.shape[:2]
    shape = np.zeros((height, width), np.float32)
    middle = int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.2, 0.8) * height)
    cv2.ellipse(shape, middle, (int(0.45 * width), int(0.5 * height)), rng.uniform(0, 180), 0, 360, 1, -1)
    shape = cv2.GaussianBlur(shape, (0, 0), width / 20)
    shape = shape if picture.ndim == 2 else shape[..., None]
    return (picture * (1 - shape) + rng.uniform(60, 160) * shape).astype(np.uint8)


def _smear(rng, picture):
    """Smear a picture along a line, as a fast turn does."""
    side = max(5, int(picture.shape[1] * rng.uniform(0.05, 0.25)))
    angle = rng.uniform(0, np.pi)
    kernel, half = np.zeros((side, side), np.float32), side / 2 * np.array([np.cos(angle), np.sin(angle)])
    ends = (tuple(np.rint(side / 2 + sign * half).astype(int).tolist()) for sign in (-1, 1))
    cv2.line(kernel, *ends, 1)
    return cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _darken(rng, picture):
    return add_grain(picture * rng.uniform(0.01, 0.06), rng, rng.uniform(0.5, 3))


def _cover_by_display(rng, picture):
    """Draw a display over a picture that is nearly dark."""
    dark = _darken(rng, picture)
    return draw_display(dark if dark.ndim == 3 else cv2.cvtColor(dark, cv2.COLOR_GRAY2BGR), rng)


SPOILT: dict[str, Spoil] = {
    "out of focus": lambda rng, it: cv2.GaussianBlur(it, (0, 0), it.shape[1] * rng.uniform(0.01, 0.08)),
    "half covered": _cover_half,
    "strut": _draw_struts,
    "finger": _draw_finger,
    "smeared": _smear,
    "washed out": lambda rng, it: np.clip(it * rng.uniform(2, 8), 0, 255).astype(np.uint8),
    "nearly dark": _darken,
    "foggy": lambda rng, it: add_grain(it * rng.uniform(0.01, 0.08) + rng.uniform(100, 200), rng, rng.uniform(0.5, 3)),
    "noisy": lambda rng, it: add_grain(it, rng, rng.uniform(30, 120)),
    "upside down": lambda rng, it: np.ascontiguousarray(it[::-1, ::-1]),
    "display on it": _cover_by_display,
}


def yield_pictures(seed: int, count: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield pictures of nothing real: the kind, and uint8 (H, W, 3) BGR. All kinds take turns."""
    for number in range(count):
        kind = list(NOTHING)[number % len(NOTHING)]
        rng = np.random.default_rng((seed, number))
        height, width = SIZES[rng.integers(len(SIZES))]
        yield kind, NOTHING[kind](rng, height, width)


def yield_spoilt(seed: int, picture: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield a real picture once in every way that hides most of it: the kind, and a uint8 picture."""
    for number, (kind, spoil) in enumerate(SPOILT.items()):
        yield kind, spoil(np.random.default_rng((seed, number)), picture)
