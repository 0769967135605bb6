"""The container: what its Dockerfile copies is enough, what it tells BlueOS is true, and where Docker works it is built
and says its version."""

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
REPOSITORY = "https://github.com/edgevpr/edgevpr"


@pytest.fixture(scope="module")
def dockerfile():
    with open(FILE, "rb") as handle:
        yield DockerfileParser(fileobj=handle)


@pytest.fixture(scope="module")
def flown(dockerfile):
    """The instructions of the last stage, by name; of an instruction that comes again, the last."""
    lines = [each for each in dockerfile.structure if each["instruction"] != "COMMENT"]
    first = max(number for number, each in enumerate(lines) if each["instruction"] == "FROM")
    return {each["instruction"]: each["value"] for each in lines[first:]}


@pytest.mark.slow
@pytest.mark.process
def test_what_is_copied_is_enough_for_the_wheel(dockerfile, tmp_path):
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


def test_what_flies_is_no_root_and_installs_nothing(dockerfile, flown):
    build, last = dockerfile.parent_images
    assert build == last, "another Python could not use the packages"
    assert flown["USER"] == "edgevpr"
    assert "pip" not in flown["RUN"]
    assert "apt" not in flown["RUN"]
    assert json.loads(flown["ENTRYPOINT"]) == ["edgevpr"]
    assert json.loads(flown["CMD"]) == ["run", "--config", f"{flown['WORKDIR']}/config.yaml"]


def test_what_blueos_reads_is_json_and_true(dockerfile, flown):
    labels = dockerfile.labels
    assert labels["version"] == __version__
    permissions, links = json.loads(labels["permissions"]), json.loads(labels["links"])
    host = permissions["HostConfig"]
    assert host["NetworkMode"] == "host", "the router of the autopilot listens on the loopback of the board"
    assert {bind.split(":")[1] for bind in host["Binds"]} == {flown["WORKDIR"], "/dev"}
    assert all({"name", "email"} <= author.keys() for author in json.loads(labels["authors"]))
    assert json.loads(labels["company"])["name"]
    assert labels["type"] in ("device-integration", "example", "theme", "other", "tool", "education")
    tags = json.loads(labels["tags"])
    assert len(tags) <= 10
    assert all(tag == tag.lower() and tag.replace("-", "").isalnum() for tag in tags)
    raw = REPOSITORY.replace("github.com", "raw.githubusercontent.com") + "/main/"
    for link in (labels["readme"], *links.values()):
        assert link.startswith((REPOSITORY, raw)), link
        assert (ROOT / link.removeprefix(raw).removeprefix(REPOSITORY).removeprefix("/tree/main/")).exists(), link


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.network
def test_it_is_built_and_starts_from_a_disk_that_cannot_be_written():
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "info"], capture_output=True).returncode:
        pytest.skip("no Docker runs here")
    pulled = subprocess.run([docker, "pull", "python:3.11-slim-bookworm"], capture_output=True, text=True)
    if pulled.returncode:
        pytest.skip(f"the image of Python cannot be had: {pulled.stderr.strip()[:200]}")
    built = subprocess.run([docker, "build", "-q", "-f", FILE, ROOT], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    image = built.stdout.strip()
    run = [docker, "run", "--rm", "--read-only", "--network", "none", image, "--version"]
    assert subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip() == f"edgevpr {__version__}"
    subprocess.run([docker, "image", "rm", image], capture_output=True)
