"""The reported height against that of the pictures."""

from types import SimpleNamespace

import pytest
from fakes import format_note, make_vehicle

from edgevpr.core.reasons import ReasonCode
from edgevpr.frames.level import View
from edgevpr.runtime.flight.flightlog import read_log
from edgevpr.runtime.flight.heightwatch import HeightWatch


class Watch:
    def __init__(self, notifier, clock, link) -> None:
        self.clock, self.link, self.watch = clock, link, HeightWatch(notifier)

    def update(self, *heights_m, reported_m=100.0, accepted=True, ratio=1.0, every_s=1.0, age_s=0.0):
        """Let matches of these heights be seen; return the texts so far."""
        for height_m in heights_m:
            self.clock.now_s += every_s
            now_s = self.clock.now_s
            vehicle = make_vehicle(50.0, 8.0, now_s - age_s, has_gps=False, height_m=reported_m)
            self.watch.update(
                SimpleNamespace(
                    frame=SimpleNamespace(t_mono_s=now_s),
                    vehicle=vehicle,
                    accepted=accepted,
                    view=View(),
                    located=SimpleNamespace(height_m=height_m, height_ratio=ratio),
                )
            )
        return [text for _, text in self.link.texts()]


@pytest.fixture
def watch(notifier, clock, link):
    return Watch(notifier, clock, link)


def test_height_watch_reports_a_contradiction_once_and_its_end(watch, tmp_path):
    assert watch.update(150, 160, 158, 162) == []
    assert watch.watch.ratio == 1.0
    assert watch.update(155) == [format_note(ReasonCode.HEIGHT_DIFFERS, autopilot_height_m=100.0, image_height_m=158.0)]
    assert watch.watch.ratio == pytest.approx(1.58)
    watch.update(*[200] * 5, 100, 100, 100, 100)
    assert len(watch.link.texts()) == 1
    assert watch.update(100)[1:] == [format_note(ReasonCode.HEIGHT_AGREES)]
    assert watch.watch.ratio == 1.0
    assert [(line["kind"], line["note"]) for line in read_log(tmp_path / "log")] == [
        ("height", {"code": "HEIGHT_DIFFERS", "parameters": {"autopilot_height_m": 100.0, "image_height_m": 158.0}}),
        ("height", {"code": "HEIGHT_AGREES", "parameters": {}}),
    ]


def test_height_watch_accepts_a_reported_height_of_zero(watch):
    note = format_note(ReasonCode.HEIGHT_DIFFERS, autopilot_height_m=1.0, image_height_m=100.0)
    assert watch.update(*[100] * 5, reported_m=0.0) == [note]
    assert watch.watch.ratio == 100.0


def test_height_watch_corrects_by_less_than_it_reports(watch):
    assert watch.update(*[115, 120, 118, 120]) == []
    assert watch.watch.ratio == 1.0
    assert watch.update(122) == []
    assert watch.watch.ratio == pytest.approx(1.2)
    watch.update(130, 140, 150)
    assert watch.watch.ratio == pytest.approx(1.4), "the ground falls: two matches ago it was higher"
    watch.update(105)
    assert watch.watch.ratio == 1.0


@pytest.mark.parametrize(
    ("heights_m", "how"),
    [
        ([105] * 9, {}),
        ([150, 150, 150, 150, 100] * 3, {}),
        ([150, 60] * 9, {}),
        ([150] * 9, {"accepted": False}),
        ([150] * 9, {"ratio": None}),
        ([150] * 9, {"every_s": 0.0}),
        ([150] * 9, {"age_s": 2.0}),
        ([None] * 9, {}),
        ([150] * 9, {"reported_m": None}),
    ],
)
def test_height_watch_reports_only_after_five_contradicting_matches(watch, heights_m, how):
    assert watch.update(*heights_m, **how) == []
    assert watch.watch.ratio == 1.0
