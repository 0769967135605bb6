"""`edgevpr train` and `models`: train networks on your own pictures; list, try, add and quantise networks."""

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, command, exit_code, group, path_of, show
from edgevpr.cli.wording import of_networks
from edgevpr.core.errors import EdgevprError, ImageError, ModelError
from edgevpr.core.text import progress


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    _add_train(group(commands, "train", "train a network on your own pictures (needs edgevpr[train])"))
    _add_models(group(commands, "models", "list, try and add the networks that techniques use"))


def _add_train(trainings: Any) -> None:
    calc = command(trainings, "calc", train_calc, "train the CALC autoencoder; no labels are needed")
    _add_images(calc)
    calc.add_argument("--out", required=True, metavar="FILE.onnx", help="the model to make; its card lies beside")
    calc.add_argument("--steps", type=int, default=4000, metavar="N", help="batches of 32 pictures (4000)")
    calc.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    add_json(calc)
    words = command(trainings, "words", train_words, "learn the words that vlad, regions or bow count")
    _add_images(words)
    words.add_argument("--model", default="calc", metavar="NAME", help="the card of the backbone (calc)")
    words.add_argument("--kind", required=True, choices=("vlad", "regions", "bow"), help="what the words are of")
    words.add_argument("--count", type=int, required=True, metavar="N", help="the number of words")
    words.add_argument("--whiten", type=int, metavar="D", help="also learn a whitening to D values (vlad)")
    words.add_argument("--out", metavar="DIR", help="folder to write to (default: your models folder)")
    words.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    add_json(words)


def _add_images(parser: ArgumentParser) -> None:
    parser.add_argument("--images", required=True, nargs="+", metavar="DIR", help="folders of images")


def _add_models(models: Any) -> None:
    add_json(command(models, "list", models_list, "say which networks there are, whose weights, and what uses them"))
    verify = command(models, "verify", models_verify, "run networks here: do they work, and what do they take")
    verify.add_argument("name", metavar="NAME", nargs="?", help="a network (default: all)")
    add_json(verify)
    adding = command(models, "add", models_add, "try a network, and copy it and its card to your models folder")
    adding.add_argument("file", metavar="FILE.onnx")
    adding.add_argument("--card", required=True, metavar="CARD.yaml", help="its name is that of the network")
    add_json(adding)
    quantise = command(models, "quantise", models_quantise, "make NAME_int8 of a network (needs edgevpr[train])")
    quantise.add_argument("name", metavar="NAME")
    quantise.add_argument("--calibrate", required=True, metavar="DIR", help="images like those of the flight")
    add_json(quantise)


def train_calc(args: Namespace) -> int:
    """Run `train calc`: train the CALC autoencoder, and print the result."""
    from edgevpr.lab.training import job

    unusable: list[ImageError] = []
    show(job.train_calc(args.images, Path(args.out), args.steps, args.seed, unusable), args.json)
    return exit_code(unusable)


def train_words(args: Namespace) -> int:
    """Run `train words`: learn words (see the glossary) for the technique that --kind names, and print the result."""
    from edgevpr.lab.training import words

    unusable: list[ImageError] = []
    wanted = words.WordsWanted(args.model, args.kind, args.count, args.whiten)
    show(words.train_words(args.images, wanted, path_of(args.out), args.seed, unusable), args.json)
    return exit_code(unusable)


def models_list(args: Namespace) -> int:
    """Run `models list`: print every network's card, also of those that cannot be used."""
    from edgevpr.core.files import model_folders
    from edgevpr.runtime.preflight.networks import list_models

    found = list_models()
    show([asdict(each) for each in found], args.json, of_networks(found, list(map(str, model_folders()))))
    return 0


def models_verify(args: Namespace) -> int:
    """Run `models verify`: run one network or all, and print what each takes in time and memory."""
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import verify
    from edgevpr.techniques.card import card_names, load_card

    threads = load_board("this").threads
    names = [args.name] if args.name else card_names()
    if not names:
        raise ModelError("There is no network yet: add one with `edgevpr models add FILE.onnx --card CARD.yaml`.")
    works, wrong = [], {}
    for name in progress(names, len(names), "trying networks"):
        try:
            works.append(asdict(verify(load_card(name), threads)))
        except EdgevprError as error:
            wrong[name] = str(error)
    show({"works": works, "wrong": wrong}, args.json)
    return 1 if wrong else 0


def models_add(args: Namespace) -> int:
    """Run `models add`: try a network, and copy it with its card to the user's models folder."""
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import add

    verified, card = add(Path(args.file), Path(args.card), load_board("this").threads)
    show({"card": str(card), **asdict(verified)}, args.json)
    return 0


def models_quantise(args: Namespace) -> int:
    """Run `models quantise`: make an 8-bit integer version of a network, and print the costs of both."""
    from edgevpr.lab.training.quantise import quantise
    from edgevpr.power.boards import load_board

    show(quantise(args.name, Path(args.calibrate), load_board("this").threads), args.json)
    return 0
