"""`edgevpr models list`: what is listed, tried and found unusable."""

from tiny_networks import write_card, write_network

from edgevpr.runtime.preflight.networks import list_models


def listed(name):
    return next(each for each in list_models() if each.name == name)


def test_list_models_says_whose_weights_and_what_uses_them(models):
    write_network(models, "mine")
    mine = listed("mine")
    assert (mine.problem, mine.licence, mine.source) == (None, "MIT", "made by a test")
    assert (mine.outputs, mine.techniques) == (("descriptor", "features"), ("mine",))
    write_network(models, "calc")
    assert {"calc", "alexnet", "netvlad", "rmac", "region_vlad", "cross_region_bow"} <= set(listed("calc").techniques)
    write_network(models, "calc", card={"outputs": {"descriptor": "descriptor"}})
    assert listed("calc").techniques == ("calc",)


def test_list_models_says_what_would_not_fly_and_goes_on(models):
    write_network(models, "good")
    write_network(models, "other", card={"sha256": "0" * 64})
    write_network(models, "nan", fault="nan")
    write_network(models, "lacking", card={"outputs": {"features": "conv9"}})
    write_card(models / "gone.yaml", {"sha256": "0" * 64, "file": "gone.onnx"})
    write_card(models / "broken.yaml", {"sha256": "0" * 64, "titel": "x"})
    assert not listed("good").problem
    for name, named in (
        ("other", "SHA-256"),
        ("nan", "finite"),
        ("lacking", "conv9"),
        ("gone", "gone.onnx"),
        ("broken", "`titel`"),
    ):
        assert named in listed(name).problem
