"""The work of `many`, job by job, in a process of its own: `python -m edgevpr.lab.evaluate.worker`.

A job encodes references, makes a map of them, or asks queries. Whatever is done is kept at once, so that a worker may
be killed at any time.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgevpr.core.config import load_config
from edgevpr.core.crew import serve
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.types import Frame
from edgevpr.frames.images import read_image
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate.asking import Asking, Walk, answer_of, asked
from edgevpr.lab.evaluate.dataset import Query
from edgevpr.lab.evaluate.evaluate import all_frames, make_map, opened
from edgevpr.lab.evaluate.kept import Kept
from edgevpr.lab.evaluate.measured import answer_as_kept
from edgevpr.lab.evaluate.remembering import Remembering
from edgevpr.power.boards import load_board
from edgevpr.runtime.recognise.opening import meter_of
from edgevpr.techniques import create


class Worker:
    """Does jobs, and keeps what the next one may need as well: the technique, and the map with its index."""

    def __init__(self) -> None:
        self._technique: tuple[Any, Remembering] | None = None
        self._walk: tuple[Any, Walk] | None = None
        self._stack = ExitStack()
        self._kept: Kept | None = None

    def work(self, job: dict[str, Any]) -> dict[str, Any]:
        """Do a job. Its answer says how many entries of the cache were damaged, and what went wrong, if anything."""
        error = None
        try:
            {"encode": self._encode, "map": self._map, "ask": self._ask}[job["do"]](job)
        except EdgevprError as problem:
            error = [str(problem), problem.exit_code]
        except Exception as problem:  # a fault of a technique or a library ends one row, and not all
            error = [f"an unforeseen {type(problem).__name__} ({problem}): report it.", 1]
        kept, damaged = self._kept, 0
        if kept is not None:
            damaged, kept.damaged = kept.damaged, 0
        return {"damaged": damaged, "error": error}

    def _encode(self, job: dict[str, Any]) -> None:
        technique = self._made(job, for_places=True)
        for path in map(Path, job["paths"]):
            frame = Frame(image=read_image(path), name=path.name, t_mono_s=0.0)
            try:
                technique.encode(frame.image)
            except EdgevprError as error:
                raise ModelError(f"{path}: {error}") from error

    def _map(self, job: dict[str, Any]) -> None:
        encoder, folder = self._made(job, for_places=True), Path(job["ref_dir"])
        technique = create(job["technique"], job["settings"])

        def make(path: Path) -> None:
            make_map(path, all_frames(open_source(str(folder), live=False)), technique, _meter(), folder, encoder)

        self._kept.put_file("maps", job["map_key"], make)

    def _ask(self, job: dict[str, Any]) -> None:
        walk, technique = self._opened(job), self._technique[1]
        references = job["references"]
        for path, judged in _asked_of(job):
            event = asked(walk.recogniser, path)
            if judged is None:
                continue
            answer_key, right, ignored = judged
            # The costs of encoding are those of the day when it was done.
            event = replace(event, steps=replace(event.steps, encode=technique.cost))
            query = Query(path, frozenset(right), frozenset(ignored))
            answer = answer_of(event, query, references, walk.recogniser.index)
            self._kept.put_json("answers", answer_key, [answer_as_kept(answer), technique.made_s, time.time()])

    def _made(self, job: dict[str, Any], for_places: bool = False) -> Remembering:
        who = [job["cache"], job["technique"], job["settings"], for_places]
        if self._technique is None or self._technique[0] != who:
            self._kept = Kept(job["cache"])
            self._technique = who, Remembering(create(job["technique"], job["settings"]), self._kept, for_places)
            self._walk = None
        return self._technique[1]

    def _opened(self, job: dict[str, Any]) -> Walk:
        technique = self._made(job)
        who = [job["map_key"], job["asking"]]
        # A walk in order begins anew: what it remembers of another begin must not count.
        if self._walk is None or self._walk[0] != who or job["in_order"]:
            self._stack.close()
            path = self._kept.get_file("maps", job["map_key"])
            if path is None:
                raise EdgevprError("The map of this row is damaged or gone from the cache: run again, to make it anew.")
            place_map, index = self._stack.enter_context(opened(path, technique))
            walk = Walk(technique, place_map, index, _meter(), asking=Asking(**job["asking"]))
            first = Path(job["queries"][0][0])
            technique.warm_up(read_image(first))
            walk.warm_up(first)
            self._walk = who, walk
        return self._walk[1]


def _asked_of(job: dict[str, Any]) -> Iterator[tuple[Path, list[Any] | None]]:
    """Yield each picture to ask with, and how its answer is judged and kept; None: it is not scored."""
    judged = {path: rest for path, *rest in job["queries"]}
    for path in job["in_order"] or judged:
        yield Path(path), judged.get(path)


def _meter() -> Any:
    return meter_of(load_config(None), load_board("this"))


if __name__ == "__main__":
    serve(Worker().work)
