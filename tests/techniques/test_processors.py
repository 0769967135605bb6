"""`cohog` describes a picture alike on every processor, to the last bit."""

import os
import subprocess
import sys

import pytest

ASKED = """
import hashlib, sys
import numpy as np
from edgevpr.techniques import create
rng = np.random.default_rng(3)
noise = [rng.integers(0, 80, (250 // size, 350 // size, 3), np.uint8) for size in (50, 10, 2)]
picture = sum(each.repeat(size, 0).repeat(size, 1) for each, size in zip(noise, (50, 10, 2)))
told = create("cohog", {"camera": sys.argv[1]}).encode(picture)
for part in (told.coarse, told.fine, told.regions, told.good):
    print(hashlib.sha256(part.tobytes()).hexdigest())
"""
# What NumPy, OpenCV and OpenBLAS take for the processor; a name that one of them does not know changes nothing.
PROCESSORS = {
    "without FMA": {
        "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX X86_V4 AVX512_ICL AVX512_SPR AVX2 FMA3 X86_V3",
        "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX2,FMA3",
    },
    "an older one": {"OPENBLAS_CORETYPE": "Nehalem"},
    "another": {"OPENBLAS_CORETYPE": "Haswell"},
}


def told_by(camera, **environment):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ASKED, camera],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    return done.stdout


@pytest.mark.parametrize("camera", ["forward", "nadir"])
def test_a_picture_is_described_alike_on_every_processor(camera):
    here = told_by(camera)
    assert here.count("\n") == 4
    assert {name: told_by(camera, **each) for name, each in PROCESSORS.items()} == dict.fromkeys(PROCESSORS, here)
