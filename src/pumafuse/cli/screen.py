"""What commands write beside tables: names of logs and files may have in them what a terminal would obey."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import typer

INTERRUPTED = 130  # exit code after Ctrl-C, as shells have it: 128 and the number of SIGINT


def say(text: str, *, err: bool = False) -> None:
    """Print a text on standard output, or on standard error, without control characters but ends of lines."""
    typer.echo("".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in text), err=err)


def say_json(tree: Any) -> None:
    """Print a tree of dictionaries, lists and structs on standard output."""
    encoded = msgspec.json.Encoder(decimal_format="number").encode(tree)
    text = msgspec.json.format(encoded, indent=2).decode()
    say("".join(letter if letter.isprintable() or letter == "\n" else json.dumps(letter)[1:-1] for letter in text))
