"""The container: what its Dockerfile copies is enough, and what flies is no root."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from dockerfile_parse import DockerfileParser

from edgevpr import __version__

ROOT = Path(__file__).parents[1]
FILE = ROOT / "deploy" / "Dockerfile"


@pytest.fixture(scope="module")
def dockerfile():
    with open(FILE, "rb") as handle:
        yield DockerfileParser(fileobj=handle)


@pytest.fixture(scope="module")
def last_stage(dockerfile):
    """The instructions of the last stage, by name; of an instruction that comes again, the last."""
    lines = [each for each in dockerfile.structure if each["instruction"] != "COMMENT"]
    first = max(number for number, each in enumerate(lines) if each["instruction"] == "FROM")
    return {each["instruction"]: each["value"] for each in lines[first:]}


@pytest.mark.slow
@pytest.mark.process
def test_dockerfile_copies_enough_for_the_wheel(dockerfile, tmp_path):
    for each in dockerfile.structure:
        if each["instruction"] == "COPY" and not each["value"].startswith("--from"):
            *sources, target = each["value"].split()
            for source in sources:
                assert target in ("./", source, f"{Path(source).parent}/"), "it lies where it lay"
                (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
                if (ROOT / source).is_dir():
                    shutil.copytree(ROOT / source, tmp_path / source, dirs_exist_ok=True)
                else:
                    shutil.copy(ROOT / source, tmp_path / source)
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob(f"dist/edgevpr-{__version__}-*.whl"))


def test_dockerfile_runs_without_root_and_installs_nothing(dockerfile, last_stage):
    build, last = dockerfile.parent_images
    assert build == last, "another Python could not use the packages"
    assert last_stage["USER"] == "edgevpr"
    assert "pip" not in last_stage["RUN"]
    assert "apt" not in last_stage["RUN"]
    assert json.loads(last_stage["ENTRYPOINT"]) == ["edgevpr"]
    assert json.loads(last_stage["CMD"]) == ["run", "--config", f"{last_stage['WORKDIR']}/config.yaml"]
