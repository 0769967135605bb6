"""The table of `edgevpr match`: a row for each query, with its fix or the reason, and the summary."""

from edgevpr.cli.matched import of_matches

NAME = "DJI_20260412101112_0001_V.JPG"


def match(query="1.jpg", accepted=True, reason="", fix=None, off_m=None, **known):
    place = {"number": 1234, "image": NAME, "lat_deg": -46.8, "lon_deg": -123.9, "alt_m": None}
    row = {"query": query, "accepted": accepted, "reason": reason, "position": fix, "from_gps_tag_m": off_m}
    return {**row, "place": place, "score": 0.25, **known}


def fix(accuracy_m, of_place=False):
    return {"lat_deg": -46.8, "lon_deg": -123.9876543, "accuracy_m": accuracy_m, "of_place": of_place}


def test_a_row_has_the_fix_or_the_reason_in_few_words():
    rows = list(
        of_matches(
            [
                match(NAME, fix=fix(25.7, of_place=True), off_m=13.72, confidence=0.9999997),
                match(fix=fix(5.25), confidence=0.99995),
                match(accepted=False, reason="confidence 0.9, 0.9992 needed: 1.9 times as many", confidence=0.9),
                match(accepted=False, reason="0.2 sure by the flight so far; confidence 0.9, 0.9 needed: a"),
                match(accepted=False, reason="only 0.010 ahead of a place elsewhere, 0.020 needed"),
                match(accepted=False, reason="only 0.011 ahead of a place elsewhere, 0.020 needed"),
            ]
        )
    )
    head, first, second, *refused = rows[:7]
    assert head.endswith("lat          lon    ± m  m from its GPS tag")
    assert first.endswith("-46.800000  -123.987654  25.7*                13.7")
    assert first.split()[:5] == ["...112_0001_V.JPG", "yes", "0.99999970", "1234", "...112_0001_V.JPG"]
    assert second.split()[-4:] == ["-46.800000", "-123.987654", "5.2", "-"]
    assert [row.partition("_V.JPG")[2].strip() for row in refused] == [
        *["not sure enough"] * 2,
        "only 0.010 ahead of a place elsewhere",
        "only 0.011 ahead of a place elsewhere",
    ]
    assert rows[7] == "6 queries, 2 accepted; refused: 2 not sure enough, 2 only .. ahead of a place elsewhere"
    assert "15.5 m in the median; 13.7 m from the GPS tags" in rows[8]
    assert rows[9].startswith("*: 1 positions")
    assert max(map(len, rows)) <= 120


def test_without_a_fix_there_are_no_columns_for_it():
    nothing = match(accepted=False, reason="the picture says nothing: 1% of it holds information") | {"place": None}
    rows = list(of_matches([match(reason="score 0.25"), nothing]))
    assert rows[0].split() == ["query", "accepted", "score", "place,", "picture"]
    assert rows[1].endswith("its place has no position")
    assert rows[2].split("-")[-1].strip() == "the picture says nothing"
    assert rows[3] == "2 queries, 1 accepted; refused: 1 the picture says nothing"
    assert len(rows) == 4
