"""Reads what is known of the queries of a data set beside their pictures, as in flight: `edgevpr eval --known`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import UsageError
from edgevpr.frames.positions import GeoTag
from edgevpr.frames.source import tags_of
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.places.sequence import length_of
from edgevpr.runtime.recognise import hints
from edgevpr.runtime.recognise.hints import Told, told_parts

NO_TAG = GeoTag()


@dataclass(frozen=True, slots=True)
class Known:
    """Knowledge of queries: the `parts` (members of `hints.TOLD`) of their `tags`, by the path of the picture.
    `map_height_m` is that of `Told`."""

    parts: tuple[str, ...] = ()
    tags: Mapping[Path, GeoTag] = field(default_factory=dict)
    map_height_m: float | None = None

    def prior(self, spec: TechniqueSpec) -> Told | None:
        """Make what narrows each query of a technique; None if nothing is known."""
        return Told(self.parts, spec.heading_within_deg, self.map_height_m) if self.parts else None


def known_of(text: str | None, dataset: Dataset, spec: TechniqueSpec, sequence: int | None) -> Known:
    """Return what is known of the queries of a data set, where `text` says what ("heading,height"; None: nothing). The
    height of the map is the median of those of its pictures. `sequence` is that of `MatchOptions`. Raises UsageError
    with the sentence of `lacking`, and for a text that cannot be read."""
    if why := lacking(text, dataset, spec, sequence):
        raise UsageError(why)
    if not (parts := told_parts(text)):
        return Known()
    queries, places = _sides(dataset)
    of_queries, of_places = (
        [tag.height_m for tag in side.values() if tag.height_m is not None and tag.height_m > 0]
        for side in (queries, places)
    )
    return Known(parts, queries, float(np.median(of_places)) if of_queries and of_places else None)


def lacking(text: str | None, dataset: Dataset, spec: TechniqueSpec, sequence: int | None) -> str | None:
    """Return a sentence on why no query of a data set can be asked with what `text` says is known (see `known_of`);
    None if some can."""
    if not (parts := told_parts(text)):
        return None
    queries, places = _sides(dataset)
    return hints.lacking(parts, queries.values(), places.values(), length_of(spec, sequence))


def _sides(dataset: Dataset) -> tuple[dict[Path, GeoTag], dict[Path, GeoTag]]:
    """Return the tags of all pictures beside the queries, and those of the references."""
    return tags_of(dataset.queries[0].path.parent), tags_of(dataset.ref_dir)
