"""A page of the documentation, carried out from top to bottom as a reader would.

Every fenced block is either done or, after a comment ``<!-- not executed: reason -->``, left out:

- ``bash`` is run by ``bash -e`` and ends with 0, or with what its title says: *exit code 3*; with *until Ctrl-C* in
  its title it runs beside the rest of the page;
- ``python`` is run in one namespace for the page, or written to the file that its first line names: ``# name.py``;
- ``toml`` is written to the file that its first line names;
- ``text`` is what the block before it printed, lines in a row: ``…`` is anything in a line or, alone, any lines;
- ``json`` is an object a line.
"""

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import warnings
from dataclasses import dataclass, field
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

import pumafuse as pf

ROOT = Path(__file__).parent.parent
LONGEST = 300.0  # s that any block may take
_FILE = re.compile(r"# ([\w./-]+\.(?:toml|py))\n")
_CODE = re.compile(r"exit code (\d+)")
_LEFT_OUT = re.compile(r"<!-- not executed: (.+) -->")
_COLOUR = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def paths() -> list[Path]:
    """Every page that a user reads."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@dataclass(frozen=True)
class Block:
    language: str
    title: str
    text: str
    line: int
    left_out: str | None  # the reason

    @property
    def stays(self) -> bool:
        return "until Ctrl-C" in self.title

    @property
    def code(self) -> int:
        said = _CODE.search(self.title)
        return int(said[1]) if said else 0

    @property
    def file(self) -> str | None:
        named = _FILE.match(self.text)
        return named[1] if named else None


def blocks(page: Path) -> list[Block]:
    """The blocks of a page in order; an indented one has an empty language."""
    tokens = MarkdownIt("commonmark").parse(page.read_text(encoding="utf-8"))
    return [
        _block(token, before)
        for before, token in zip([None, *tokens], tokens, strict=False)
        if token.type in {"fence", "code_block"}
    ]


def _block(token: Token, before: Token | None) -> Block:
    language, _, title = token.info.partition(" ")
    left_out = _LEFT_OUT.match(before.content) if before is not None and before.type == "html_block" else None
    line = token.map[0] + 1 if token.map else 0
    return Block(language, title, token.content, line, left_out[1] if left_out else None)


@dataclass
class Reader:
    """Somebody who does what a page says, in a folder of theirs."""

    page: Path
    folder: Path
    printed_text: str = ""  # by the last block
    names: dict[str, object] = field(default_factory=dict)
    beside: list[tuple[subprocess.Popen[bytes], Path]] = field(default_factory=list)

    def read(self) -> None:
        """Carry out the page.

        Raises:
            AssertionError: Something does not do what the page says.
        """
        _furnish(self.folder)
        try:
            with contextlib.chdir(self.folder):
                for block in blocks(self.page):
                    if block.left_out is None:
                        self._do(block)
                while self.beside:
                    self._stop(*self.beside.pop())
        finally:
            for process, _ in self.beside:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def _do(self, block: Block) -> None:
        where = f"{self.page.name}:{block.line}"
        match block.language:
            case "text":
                assert shows(self.printed_text, block.text), (
                    f"{where}: expected\n{block.text}\nbut what came was\n{self.printed_text}"
                )
            case "json":
                assert all(isinstance(json.loads(line), dict) for line in block.text.splitlines()), where
            case "toml" | "python" if block.file:
                compile(block.text, where, "exec") if block.language == "python" else tomllib.loads(block.text)
                Path(block.file).parent.mkdir(exist_ok=True)
                Path(block.file).write_text(block.text, encoding="utf-8")
            case "python":
                self.printed_text = self._python(block.text, where)
            case "bash" if block.stays:
                self._start(block.text, where)
            case "bash":
                done = subprocess.run(
                    ["bash", "-e", "-c", block.text],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    stdin=subprocess.DEVNULL,
                    env=_surroundings(),
                    timeout=LONGEST,
                    check=False,
                )
                self.printed_text = _plain(done.stdout)
                assert done.returncode == block.code, f"{where}: exit code {done.returncode}\n{self.printed_text}"
                assert "Traceback" not in self.printed_text, f"{where}\n{self.printed_text}"
            case _:
                raise AssertionError(f"{where}: unknown language '{block.language}'")

    def _python(self, text: str, where: str) -> str:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore", pf.PumafuseWarning)
            exec(compile(text, where, "exec"), self.names)
        return printed.getvalue()

    def _start(self, text: str, where: str) -> None:
        """Begin what stays, and wait until it listens, as a reader would before turning to another terminal."""
        log = self.folder / f".beside{len(self.beside)}"
        with log.open("wb") as out:
            process = subprocess.Popen(
                ["bash", "-e", "-c", f"exec {text}"],
                stdout=out,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=_surroundings(),
                start_new_session=True,
            )
        self.beside.append((process, log))
        until = time.monotonic() + LONGEST
        while "listening" not in log.read_text(errors="replace"):
            assert process.poll() is None, f"{where}: it ended\n{log.read_text()}"
            assert time.monotonic() < until, f"{where}: does not listen\n{log.read_text()}"
            time.sleep(0.1)

    def _stop(self, process: subprocess.Popen[bytes], log: Path) -> None:
        process.send_signal(signal.SIGINT)
        code = process.wait(LONGEST)
        printed_text = _plain(log.read_bytes())
        assert code == 0, printed_text
        assert "Traceback" not in printed_text, printed_text


def shows(printed_text: str, expected: str) -> bool:
    """Whether lines in a row of what was printed are the expected ones, but for white space and lengths of rules."""

    def squeezed(text: str) -> list[str]:
        return [re.sub("─+", "─", " ".join(line.split())) + "\n" for line in text.splitlines() if line.strip()]

    def pattern(line: str) -> str:
        return "(?:.*\n)*?" if line == "…\n" else "[^\n]*?".join(map(re.escape, line.split("…")))

    wanted = "".join(map(pattern, squeezed(expected)))
    return re.search(f"(?m)^{wanted}", "".join(squeezed(printed_text))) is not None


def _furnish(folder: Path) -> None:
    """What a clone has, but for the package; ``.venv`` is the environment that runs the tests."""
    for name in ("Makefile", "CMakeLists.txt", "README.md", "pyproject.toml", "LICENSE", "requirements.lock"):
        shutil.copy2(ROOT / name, folder)
    for name in ("core", "examples", "scenarios", "notebooks", "benchmarks", "src/pumafuse/data"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    (folder / ".venv").symlink_to(sys.prefix)


def _surroundings() -> dict[str, str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "COLUMNS": "120", "OPENBLAS_NUM_THREADS": "1", "BROWSER": "true"}


def _plain(output: bytes) -> str:
    return _COLOUR.sub("", output.decode("utf-8", errors="replace"))
