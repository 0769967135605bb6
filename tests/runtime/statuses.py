"""A status to be told and read."""

from edgevpr import __version__

MATCH = {
    "t_frame_s": 996.8,
    "query": "0007.jpg",
    "accepted": True,
    "reason": {"code": "ACCEPTED_BY_CONFIDENCE", "parameters": {"confidence": 0.9991}},
    "place": 812,
    "reference_image": "0812.jpg",
    "score": 0.87,
    "confidence": 0.9991,
    "accuracy_m": 12.0,
}
LINK = {
    "trouble": None,
    "autopilot": 1,
    "channel": "COMMAND",
    "fixes": "3 fixes sent, 2 taken",
    "accuracy_m": 7.25,
}
LOW_SCORE = {"code": "LOW_SCORE", "parameters": {"score": 0.4, "needed": 0.5}}
STATUS = {
    "version": __version__,
    "time": "2026-11-22T10:00:00Z",
    "t_mono_s": 1000.0,
    "elapsed_s": 3725.0,
    "health": "ACTIVE",
    "paused": False,
    "source": "streaming",
    "latency_s": 0.12,
    "queries": 1204,
    "accepted": 1100,
    "failed": 3,
    "asked_rate_hz": 2.0,
    "rss_mb": 61.5,
    "machine_cpu_share": 0.12,
    "machine_ram_mb": 380.0,
    "machine_ram_total_mb": 512.0,
    "used_mah": 12.346,
    "temperature_c": 54.3,
    "hot": False,
    "throttled": False,
    "under_voltage": None,
    "newest": {**MATCH, "accepted": False, "reason": LOW_SCORE, "t_frame_s": 999.6},
    "match": MATCH,
    "link": LINK,
    "remarks": ["held to 1 Hz"],
    "summary": "streaming; 1204 queries, 1100 accepted, 12.35 mAh; 3 fixes sent, 2 taken; held to 1 Hz",
}
