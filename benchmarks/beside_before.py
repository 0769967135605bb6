"""A query over 10 000 places, beside the same query as edgevpr was before its scan looked for words: both are measured
in turn, in one run, so that whatever else the machine does hits both. `python beside_before.py [COMMIT]`.
"""

import io
import json
import os
import shutil
import statistics
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from edgevpr.core.tables import markdown

REPOSITORY = Path(__file__).resolve().parents[1]
BEFORE = "3b363dc"  # the last commit whose nadir maps held place codes
TURNS = 15


def rows(commit: str = BEFORE) -> list[dict]:
    """Median milliseconds of each case before and now, and the median of the ratios of each turn; nothing where the
    repository's history is not at hand."""
    packed = subprocess.run(["git", "-C", str(REPOSITORY), "archive", commit], capture_output=True)
    if packed.returncode:
        return []
    with TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as tree:
            tree.extractall(folder, filter="data")
        shutil.copy(REPOSITORY / "benchmarks" / "query_turns.py", Path(folder) / "benchmarks")
        with _started(Path(folder)) as before, _started(REPOSITORY) as now:
            cases = _answer(before)
            if _answer(now) != cases:
                raise RuntimeError("the two versions measure other cases")
            turns = [(_asked(before), _asked(now)) for _ in range(TURNS)]
    return [
        {
            "query": case,
            "before": commit,
            "before_ms": statistics.median(before[at] for before, _ in turns),
            "now_ms": statistics.median(now[at] for _, now in turns),
            "ratio": statistics.median(before[at] / now[at] for before, now in turns),
        }
        for at, case in enumerate(cases)
    ]


@contextmanager
def _started(tree: Path) -> Iterator[subprocess.Popen]:
    variables = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(tree)}
    argv = [sys.executable, str(tree / "benchmarks" / "query_turns.py")]
    with subprocess.Popen(argv, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        yield child
        child.stdin.close()


def _asked(child: subprocess.Popen) -> list[float]:
    child.stdin.write("\n")
    child.stdin.flush()
    return _answer(child)


def _answer(child: subprocess.Popen) -> list:
    return json.loads(child.stdout.readline())


def table(results: list[dict]) -> str:
    """The results as a Markdown table."""
    rows = [[row["query"], f"{row['before_ms']:.0f}", f"{row['now_ms']:.0f}", f"{row['ratio']:.2f}"] for row in results]
    return markdown(("a query, 10 000 places", "before ms", "now ms", "ratio"), rows)


if __name__ == "__main__":
    print(table(rows(*sys.argv[1:])))
