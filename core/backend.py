"""How pip builds pumafuse: scikit-build-core, with two things of its own.

A machine without a C++ compiler takes the one in the ziglang wheel. An editable install puts the library into `src`,
and a line with the path of `src` beside Python's packages: a hook that redirects imports would cost time at each start.

    python core/backend.py    ends with 1, and says so, where there is no compiler; make asks it
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from scikit_build_core import build
from scikit_build_core.build import (
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

Settings = dict[str, list[str] | str]
NONE = "There is no C++ compiler: zig's is taken, from the ziglang wheel (a minute or two the first time) ..."
VSWHERE = Path(os.environ.get("PROGRAMFILES(X86)", ""), "Microsoft Visual Studio", "Installer", "vswhere.exe")


def needs_zig() -> bool:
    """Whether there is no C++ compiler. What there is becomes CXX: it may be another one than Python was built with."""
    if os.environ.get("CXX"):
        return False
    if sys.platform == "win32":  # CMake finds Visual Studio by itself
        return not (shutil.which("cl") or _says(VSWHERE, "-products", "*", "-find", r"VC\Tools\MSVC\**\cl.exe"))
    if sys.platform == "darwin" and not _says(Path("/usr/bin/xcode-select"), "-p"):
        return True  # /usr/bin/c++ is there all the same; it would ask to install one
    found = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if found:
        os.environ["CXX"] = found
    return found is None


def _says(program: Path, *words: str) -> bool:
    """Whether there is this program, and it answers."""
    return program.exists() and bool(subprocess.run([program, *words], capture_output=True, check=False).stdout.strip())


def _asked_for(requires: list[str]) -> list[str]:
    return [*requires, "ninja", "ziglang"] if needs_zig() else requires


def get_requires_for_build_wheel(config_settings: Settings | None = None) -> list[str]:
    """What has to be installed first."""
    return _asked_for(build.get_requires_for_build_wheel(config_settings))


def get_requires_for_build_editable(config_settings: Settings | None = None) -> list[str]:
    """What has to be installed first."""
    return _asked_for(build.get_requires_for_build_editable(config_settings))


def build_wheel(
    wheel_directory: str, config_settings: Settings | None = None, metadata_directory: str | None = None
) -> str:
    """Make a wheel; its name."""
    if needs_zig():
        print(NONE, flush=True)
        python = f'"{Path(sys.executable).as_posix()}"'
        os.environ["CXX"] = f"{python} -m ziglang c++ -mcpu=baseline"  # not for this machine alone, which is zig's way
        os.environ["CMAKE_GENERATOR"] = "Ninja"  # on Windows it would be Visual Studio
    return build.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: Settings | None = None, metadata_directory: str | None = None
) -> str:
    """Make the library in `src`, anew only where its sources are, and a wheel with the path of `src`; its name."""
    inplace: Settings = {"build-dir": "build", "wheel.packages": [], "cmake.define.PUMAFUSE_INPLACE": "ON"}
    return build_wheel(wheel_directory, {**inplace, **(config_settings or {})}, metadata_directory)


if __name__ == "__main__":
    sys.exit(NONE if needs_zig() else 0)
