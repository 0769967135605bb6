"""A map made on one processor flies on another: descriptors are the same to the last bit.

The expected checksums were the same on x86-64 and on aarch64 (a Cortex-A53)."""

import itertools
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from edgevpr.techniques import create
from edgevpr.techniques.card import InputRule
from edgevpr.techniques.session import prepare_input

# What NumPy, OpenCV and OpenBLAS take this one for; a name that one of them does not know changes nothing.
_PROCESSORS = {
    "without FMA": {
        "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX X86_V4 AVX512_ICL AVX512_SPR AVX2 FMA3 X86_V3",
        "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX2,FMA3",
    },
    "an older one": {"OPENBLAS_CORETYPE": "Nehalem"},
    "another": {"OPENBLAS_CORETYPE": "Haswell"},
}


def draw_integers():
    """A picture made of whole numbers alone, 480 x 640."""
    y, x = np.mgrid[:480, :640]
    return ((x * x // 97 + y * y // 61 + x * y // 173 + (x // 9 * 37 ^ y // 7 * 29)) % 256).astype(np.uint8)


def make_dim_picture():
    """A picture with few grey levels, which is stretched."""
    y, x = np.mgrid[:480, :640]
    return (60 + draw_integers() // 24 + (x // 40 + y // 30 * 3) % 17).astype(np.uint8)


PICTURES = {"ordinary": draw_integers, "dim": make_dim_picture}
CHECKSUMS = {
    "forward, ordinary": "3849885506 598602243 4103587366 2563522183",
    "nadir, ordinary": "959436069 1475824441 556021769 4160277071",
    "forward, dim": "3324972193 3205433921 289916544 2563522183",
    "nadir, dim": "2264144535 3508613677 564903546 4160277071",
    "packed": "319593651",
    "seen by a network": "2049827080",
}


def compute_checksums(**environment):
    """Return the checksums of what a separate process makes of the pictures, by camera and picture."""
    asked = "import test_any_processor; test_any_processor.print_checksums()"
    cwd = Path(__file__).parent
    env = {**os.environ, **environment}
    command = [sys.executable, "-W", "ignore", "-c", asked]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=cwd, env=env)
    return dict(line.split(": ") for line in done.stdout.splitlines())


def print_checksums():
    for camera, kind in itertools.product(("forward", "nadir"), PICTURES):
        descriptor = create("cohog", {"camera": camera}).encode(PICTURES[kind]())
        print_crc(f"{camera}, {kind}", descriptor.coarse, descriptor.fine, descriptor.regions, descriptor.good)
    picture, forward = draw_integers(), create("cohog")
    print_crc("packed", forward.pack(forward.encode(picture).coarse[None], np.full((12, 12, 8), 90.0, np.float32)))
    rule = {"layout": "NCHW", "height": 512, "width": 512, "colour": "grey", "equalise": False, "resize": "linear"}
    print_crc("seen by a network", prepare_input(picture, InputRule(**rule, scale=1.0, mean=[0.0])).astype(np.uint8))


def print_crc(what, *parts):
    print(f"{what}:", *map(zlib.crc32, parts))


@pytest.mark.process
@pytest.mark.parametrize("processor", [{}, *_PROCESSORS.values()], ids=["this one", *_PROCESSORS])
def test_descriptors_are_identical_on_any_processor(processor):
    assert compute_checksums(**processor) == CHECKSUMS


def test_warp_picture_is_identical_for_rotated_queries():
    """Where there is FMA: without it some pixels differ, which no map holds."""
    technique = create("cohog", {"camera": "nadir"})
    turned, allowed, _ = technique._make_views(technique.encode(draw_integers()))._warp_picture(1.0, 5)
    assert (zlib.crc32(turned), zlib.crc32(allowed)) == (1188350251, 19798888)
