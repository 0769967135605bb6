"""The coarse stage of `cohog` for a camera that looks straight down: a place is a hundred visual words.

Of each place, 10x10 regions are named by the most similar of 1024 *words*, which are typical regions of the ground
(`edgevpr train ground` learns them). A region or word is 20 numbers, its *patterns* (see `slow_patterns`). A place is
found by the words that it shares with the query, wherever they lie and however the camera has turned.

A query is looked up under 24 rotations, 15 degrees apart. Words come in fours, each the one before turned by 90
degrees, so only six rotations are computed and the others follow. A word that is everywhere says little. It counts once
in a place and at most four times in a query, or more where the query shows more ground than a place (see `views`).

The scan has two steps. First, all places are scored by how many words they share with the query under each rotation
(a bag of words: Sivic and Zisserman 2003). Then, for the best pairs of a place and a rotation, the shared words vote
for the shift of the picture, as all regions do in the full comparison (see `displacement`). The regions of a picture
are numbered row by row.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from edgevpr.core.arrays import Array, Bools, Ints, Singles
from edgevpr.core.errors import ModelError
from edgevpr.techniques.gradients import slow_patterns
from edgevpr.techniques.words import read_words

DTYPE = "<u2"  # of a word
SIDE = 10  # regions along one side
QUARTERS = 4
BINS = 8  # orientations of the regions that the words are of
COUNT = 256  # words in the file; each gives four, by quarter turns
NONE = COUNT * QUARTERS  # the number of no word
_ROUNDED = 0.01  # tolerance of a length of 1
_AT_MOST = 4  # times that a word of a query counts, for as much ground as a place shows
_VOTED_EACH = 125  # pairs of a place and a rotation that vote, for each possible rotation
_BIN_REGIONS = 4  # side of a bin of shifts, in regions; shifts within 2x2 bins agree
_VOTE_COUNTS = 5.0  # weight of a shared word that agrees on the shift, over that of any; about as both scatter
_ROWS_AT_ONCE = 2048  # 100 KB of counts for 24 rotations
_VOTING_AT_ONCE = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryWords:
    """The words of a query under each of R rotations, as E entries. `word`, `region`, `turn` int (E,): the word's
    number, the number of the region that has it, and the rotation in steps of 360 / R degrees. `counts` uint16 (1025,
    R): how often each word occurs under each rotation; its last row stands for "no word" and is 0."""

    word: Ints
    region: Ints
    turn: Ints
    counts: NDArray[np.uint16]
    sides: tuple[int, int]  # regions along one side, of the query and of a place


def of_place(vocabulary: Singles, patterns: Singles, good: Bools) -> NDArray[np.uint16]:
    """Return the words of a place, uint16 (100,). `vocabulary` float32 (1024, 20): all words. `patterns` float32 (100,
    20): those of the place's regions whose numbers `named` returns. A region gets no word (1024) if it is not `good`,
    bool (100,), or if an earlier region has the same word."""
    words = np.where(good, nearest(vocabulary, patterns), NONE)
    _, first = np.unique(words, return_index=True)
    once = np.full(len(words), NONE, np.uint16)
    once[first] = words[first]
    return once


def of_query(
    vocabulary: Singles, asking: dict[int, tuple[Singles, Ints]], within: int, sides: tuple[int, int]
) -> QueryWords:
    """Return the words of a query under all rotations. `within` is the number of rotation steps in a quarter turn. A
    key of `asking` is a clockwise rotation in steps, less than `within`; its value describes the good regions of the
    picture so turned: patterns float32 (G, 20) and numbers int (G,). All other rotations are these and quarter turns.
    `sides`: number of regions along one side of the query, and of a place, which has at most as many."""
    total = within * QUARTERS
    side, of_place = sides
    at_most = _AT_MOST * side**2 // of_place**2
    words, regions, turns = [], [], []
    for turn, (patterns, numbers) in asking.items():
        order = np.argsort(_shuffled(side)[numbers])
        found, here = nearest(vocabulary, patterns[order]), numbers[order]
        by_word = np.argsort(found, kind="stable")
        found, here = found[by_word], here[by_word]
        kept = np.flatnonzero(np.arange(len(found)) - np.searchsorted(found, found) < at_most)
        found, here = found[kept], here[kept]
        for quarter in range(QUARTERS):
            words.append(found - found % QUARTERS + (found + quarter) % QUARTERS)
            regions.append(here)
            turns.append(np.full(len(here), (turn - within * quarter) % total))
            here = turned_numbers(side)[here]
    word, region, turned = (np.concatenate(parts) for parts in (words, regions, turns))
    counts = np.bincount(word * total + turned, minlength=(NONE + 1) * total).reshape(NONE + 1, total)
    return QueryWords(word=word, region=region, turn=turned, counts=counts.astype(np.uint16), sides=sides)


def scan(asked: QueryWords, rows: Array, expected: Ints | None = None, voting: float = 1.0) -> Singles:
    """Score all places by their words, `rows` uint16 (N, 100), under each rotation: float32 (N, R), at most 1 for a
    query that shows as much ground as a place. `voting` is a factor of the number of pairs (place, rotation) for which
    the second step of the scan is done.

    `expected` int (N,) is the rotation, in steps, under which each place is expected if headings are known. Then only
    this rotation and the two beside it are scored, and the others are -inf. Below 0, or if `expected` is None, all
    rotations are scored.
    """
    turns = asked.counts.shape[1]
    rows = np.minimum(rows, NONE)  # a file that edgevpr has not written may hold any number
    if expected is None:
        scores = _shared(asked.counts, rows).astype(np.float32)
    else:
        scores = np.full((len(rows), turns), -np.inf, np.float32)
        for turn in np.unique(expected):
            group = np.flatnonzero(expected == turn)
            near = np.arange(turns) if turn < 0 else np.arange(turn - 1, turn + 2) % turns
            scores[group[:, None], near] = _shared(asked.counts[:, near], rows[group])
    flat = scores.ravel()
    possible = np.count_nonzero(np.isfinite(flat))
    voted = round(voting * _VOTED_EACH * max(1, int(possible) // max(1, len(rows))))
    best = np.argpartition(-flat, voted)[:voted] if len(flat) > voted else np.arange(len(flat))
    best = best[np.isfinite(flat[best])]
    slots, turned = np.divmod(best, turns)
    for turn in np.unique(turned):
        of_turn = turned == turn
        flat[best[of_turn]] += _VOTE_COUNTS * _votes(asked, int(turn), rows[slots[of_turn]])
    scores /= (_AT_MOST + _VOTE_COUNTS * _AT_MOST) * rows.shape[1]
    return scores


def nearest(vocabulary: Singles, patterns: Singles) -> Ints:
    """Return the number of the word most similar to each of `patterns` float32 (N, 20): int (N,)."""
    numbers: Ints = (patterns @ vocabulary.T).argmax(axis=1)
    return numbers


@lru_cache(maxsize=1)
def load(name: str) -> Singles:
    """Load the words of the file NAME.npz in a folder of models, as `edgevpr train ground` writes it: float32 (1024,
    20), of length 1. Word 4 k + q is word 4 k turned counter-clockwise by q quarter turns. Raises ModelError as
    `read_words` does."""
    command = f"make it with `edgevpr train ground --images DIR --out {name}.npz`"
    _, _, words = read_words(f"{name}.npz", command)
    length = np.linalg.norm(words, axis=-1)
    if words.shape != (COUNT, slow_patterns(BINS).shape[1]) or not (abs(length - 1) < _ROUNDED).all():
        raise ModelError(f"{name}.npz holds no {COUNT} words of the ground: {command}.")
    return turned_words(words)


def turned_words(words: Singles) -> Singles:
    """Return `words` float32 (K, 20), each turned counter-clockwise by 0, 90, 180, 270 degrees: float32 (4 K, 20)."""
    quarter = _quarter_turn()
    turned = [words]
    for _ in range(1, QUARTERS):
        turned.append(turned[-1] @ quarter)
    return np.ascontiguousarray(np.stack(turned, axis=1).reshape(-1, words.shape[1]))


def turned_blocks(blocks: Singles, quarters: int) -> Singles:
    """Turn the blocks (side, side, 4 L) of a picture counter-clockwise by `quarters` quarter turns; the number L of
    orientations must be a multiple of 4. The result equals the blocks of the turned picture, but for rounding."""
    for _ in range(quarters % QUARTERS):
        blocks = np.rot90(_turned_block(blocks))
    return np.ascontiguousarray(blocks)


@lru_cache
def turned_numbers(side: int) -> Ints:
    """Return the new number of each region of a picture with `side` x `side` regions after the picture is turned by a
    quarter counter-clockwise: int (side * side,)."""
    was = np.rot90(np.arange(side * side).reshape(side, side)).ravel()
    now = np.empty_like(was)
    now[was] = np.arange(side * side)
    return now


def _turned_block(blocks: Singles) -> Singles:
    """Turn each of the blocks (..., 4 L) counter-clockwise by a quarter turn; orientations turn from x to y (down)."""
    cells = blocks.reshape(*blocks.shape[:-1], 4, -1)[..., [1, 3, 0, 2], :]
    return np.roll(cells, -(cells.shape[-1] // QUARTERS), axis=-1).reshape(blocks.shape)


@lru_cache
def _quarter_turn() -> Singles:
    """Return the matrix float32 (20, 20) that, multiplied from the right, turns rows of patterns by 90 degrees."""
    kept = slow_patterns(BINS)
    turn: Array = kept.T @ _turned_block(np.eye(len(kept), dtype=np.float32)) @ kept
    return turn


def _shared(counts: NDArray[np.uint16], rows: Array) -> NDArray[np.uint16]:
    """Count the words that each place of `rows` (N, 100) shares with the query under each rotation: uint16 (N, R)."""
    turns = counts.shape[1]
    # Four counts are one number of 64 bits: no sum of a hundred of at most four runs over into the next.
    padded = np.zeros((len(counts), turns + -turns % 4), np.uint16)
    padded[:, :turns] = counts
    by_four = padded.view(np.uint64)
    shared = np.zeros((len(rows), by_four.shape[1]), np.uint64)
    of_one = np.empty((_ROWS_AT_ONCE, by_four.shape[1]), np.uint64)
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        # One word of all these places after the other: the sums stay in the cache, and no array of all words is made.
        sums = shared[start : start + _ROWS_AT_ONCE]
        for words in np.ascontiguousarray(rows[start : start + len(sums)].T):
            sums += np.take(by_four, words, axis=0, out=of_one[: len(sums)], mode="clip")
    return shared.view(np.uint16)[:, :turns]


def _votes(asked: QueryWords, turn: int, rows: Array) -> Singles:
    """Return for each place of `rows` (P, 100) the largest number of words shared with the query, under the rotation
    step `turn`, that agree on one shift: float32 (P,)."""
    mine = asked.turn == turn
    order = np.argsort(asked.word[mine], kind="stable")
    region = asked.region[mine][order]
    often = asked.counts[:, turn].astype(np.intp)
    first = np.cumsum(often) - often
    bins, wide = _bins(*asked.sides)
    votes = np.empty(len(rows), np.float32)
    for start in range(0, len(rows), _VOTING_AT_ONCE):
        part = rows[start : start + _VOTING_AT_ONCE]
        times = often[part].ravel()
        # Each word of a place meets each region of the query that has this word.
        entry = np.repeat(np.arange(len(times)), times)
        met = region[np.arange(len(entry)) + (first[part].ravel() - np.cumsum(times) + times)[entry]]
        place, position = np.divmod(entry, part.shape[1])
        number = place * wide * wide + bins[position, met]
        counted = np.bincount(number, minlength=len(part) * wide * wide).reshape(-1, wide, wide)
        counted = counted[:, 1:] + counted[:, :-1]
        counted = counted[:, :, 1:] + counted[:, :, :-1]
        votes[start : start + len(part)] = counted.max(axis=(1, 2))
    return votes


@lru_cache
def named(side: int) -> Ints:
    """Return the numbers of the regions of a place that get words: int (100,), spread evenly over `side` x `side`."""
    at = np.rint((np.arange(SIDE) + 0.5) * side / SIDE - 0.5).astype(np.intp)
    return np.add.outer(at * side, at).ravel()


@lru_cache
def _shuffled(side: int) -> Ints:
    """Return a fixed random rank of each region, int (side * side,). Where a word occurs too often in a query, only the
    regions of lowest rank keep it."""
    return np.random.default_rng(0).permutation(side * side)


@lru_cache
def _bins(side: int, of_place: int) -> tuple[Ints, int]:
    """Return two things: the bin of the shift from each region of a query (`side` x `side` regions) to each of the 100
    regions of a place that have words, int (100, side * side); and the number of bins along one side."""
    y, x = np.divmod(named(of_place)[:, None], of_place)
    query_y, query_x = np.divmod(np.arange(side * side), side)
    along = (side + of_place - 2) // _BIN_REGIONS + 1
    rows, columns = ((to - of + side - 1) // _BIN_REGIONS for to, of in ((y, query_y), (x, query_x)))
    return (rows * along + columns).astype(np.int32), along
