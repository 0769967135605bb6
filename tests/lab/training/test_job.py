"""What is refused before PyTorch is needed."""

import sys

import pytest
from pictures_on_disk import write_pictures

from edgevpr.cli.main import main


def refused(capsys, *arguments):
    code = main(["train", *arguments])
    said = capsys.readouterr().err.strip().splitlines()
    return code, said[-1]


@pytest.fixture
def folder(tmp_path):
    return write_pictures(tmp_path / "pictures", 16)


def test_settings_that_make_no_sense(folder, tmp_path, capsys):
    images = ("calc", "--images", str(folder), "--out")
    assert refused(capsys, *images, "m.onnx", "--steps", "0")[0] == 2
    assert refused(capsys, *images, "m.onnx", "--seed", "-1")[0] == 2
    assert ".onnx" in refused(capsys, *images, "m.pt")[1]
    assert "folder" in refused(capsys, *images, str(tmp_path / "none" / "m.onnx"))[1]
    (tmp_path / "m.yaml").write_text("")
    assert "m.yaml" in refused(capsys, *images, str(tmp_path / "m.onnx"))[1]


def test_without_images(tmp_path, capsys):
    code, said = refused(capsys, "calc", "--images", str(tmp_path), "--out", str(tmp_path / "m.onnx"))
    assert code == 1
    assert "no images" in said


def test_with_too_few_images_that_can_be_read(folder, tmp_path, capsys):
    for name in ("0.jpg", "1.jpg"):
        (folder / name).write_bytes(b"nothing")
    code, said = refused(capsys, "calc", "--images", str(folder), "--out", str(tmp_path / "m.onnx"))
    assert code == 2
    assert "14 usable" in said


@pytest.mark.parametrize("package", ["torch", "onnx", "onnxscript"])
def test_without_the_extra(package, folder, tmp_path, capsys, monkeypatch):
    if package != "torch":
        pytest.importorskip("torch", reason="PyTorch is not installed (pip install 'edgevpr[train]')")
    monkeypatch.setitem(sys.modules, package, None)
    code, said = refused(capsys, "calc", "--images", str(folder), "--out", str(tmp_path / "m.onnx"))
    assert code == 1
    assert said.startswith(f"edgevpr: Training needs {package}")
