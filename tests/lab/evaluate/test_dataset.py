"""Reading a data set, and the sentence for every way in which its CSV can be wrong."""

import cv2
import numpy as np
import pytest

from edgevpr.core.errors import UsageError
from edgevpr.lab.evaluate.dataset import load_dataset


@pytest.fixture
def folder(tmp_path):
    """Three queries, three references; no ground truth yet."""
    for split in ("query", "ref"):
        (tmp_path / split).mkdir()
        for name in "abc":
            cv2.imwrite(str(tmp_path / split / f"{name}.png"), np.zeros((8, 8), np.uint8))
    return tmp_path


def load(folder, truth):
    if isinstance(truth, str):
        truth = truth.encode()
    (folder / "truth.csv").write_bytes(truth)
    return load_dataset(folder / "query", folder / "ref", folder / "truth.csv")


def test_right_and_ignored_references_of_scored_queries(folder):
    dataset = load(
        folder,
        "query_file,overlap,ref_files,ref_files_loose,status\n"
        "b.png,0.8,a.png b.png,a.png b.png c.png,ok\n"
        "a.png,,c.png,,ok\n"
        "c.png,0.1,,a.png,loose_only\n",
    )
    assert dataset.references == ("a.png", "b.png", "c.png")
    first, second = dataset.queries
    assert (first.path, first.right, first.ignored) == (folder / "query" / "b.png", {"a.png", "b.png"}, {"c.png"})
    assert (second.path.name, second.right, second.ignored) == ("a.png", {"c.png"}, set())


def test_a_query_that_the_csv_does_not_name_is_not_scored(folder):
    dataset = load(folder, "query_file,ref_files\nb.png,b.png\n")
    assert [query.path.name for query in dataset.queries] == ["b.png"]


def test_a_file_from_a_spreadsheet_with_byte_order_mark_and_blanks_is_read(folder):
    dataset = load(folder, b"\xef\xbb\xbfquery_file,ref_files\r\n b.png , b.png \r\n\r\n")
    assert dataset.queries[0].right == {"b.png"}


HEAD = "query_file,ref_files,status\n"


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("query_file,refs\na.png,a.png\n", ["truth.csv", "`ref_files` is missing"]),
        ("", ["truth.csv", "`query_file` is missing"]),
        (HEAD + "a.png,a.png,ok\nz.png,a.png,ok\n", ["truth.csv", "`z.png`", "correct its name"]),
        (HEAD + "z.png,,novel\n", ["truth.csv", "`z.png`"]),
        (HEAD + ",a.png,ok\n", ["truth.csv", "``"]),
        (HEAD + "a.png,a.png y.png,ok\n", ["truth.csv", "`y.png`", "correct its name"]),
        (HEAD + "a.png,,ok\n", ["truth.csv, line 2", "`a.png`", "no ref_files"]),
        (HEAD + "a.png,a.png,ok\na.png,b.png,ok\n", ["truth.csv, line 3", "`a.png`", "keep one"]),
        (HEAD + "a.png,a.png,b.png,ok\n", ["truth.csv, line 2", "fields"]),
        (HEAD + "a.png,a.png\n", ["truth.csv, line 2", "fields"]),
        (HEAD + "a.png,a.png,novel\n", ["truth.csv", "scores no query"]),
        (HEAD, ["truth.csv", "scores no query"]),
        (b"\xff\xd8\xff\xe0 a JPEG", ["truth.csv", "not a CSV file"]),
    ],
)
def test_a_wrong_file_gets_a_sentence_that_names_line_and_value(folder, truth, said):
    with pytest.raises(UsageError) as error:
        load(folder, truth)
    for part in said:
        assert part in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_gets_a_sentence(folder):
    with pytest.raises(UsageError, match=r"nowhere\.csv"):
        load_dataset(folder / "query", folder / "ref", folder / "nowhere.csv")
