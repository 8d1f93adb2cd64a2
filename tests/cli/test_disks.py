"""Full disks, two at once, names that no disk takes: one line, and nothing half written."""

import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from executable import EXECUTABLE, FUSION, SCAN
from pumafuse.folders import FolderError, replacing, write_file
from pumafuse.fusion import results

FUSE = [str(EXECUTABLE), "fuse", str(SCAN), "-c", str(FUSION), "-o"]


def test_a_result_that_the_disk_cuts_short_is_absent(tmp_path: Path) -> None:
    """A table has no room, or the recording has not: no folder without it, none with a part of it; one line."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))

    words = [*FUSE, str(tmp_path / "out"), "--rrd"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, preexec_fn=limited)
    assert done.returncode == 1
    assert done.stderr == f"pumafuse: {tmp_path / 'out'}: cannot be written: File too large\n"
    assert not list(tmp_path.iterdir())


def test_a_full_standard_output_is_one_line(tmp_path: Path) -> None:
    """Exit code 1, and what was written stays."""
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*FUSE, "out"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False, cwd=tmp_path
        )
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["pumafuse: standard output: No space left on device"]
    if "out" in [*FUSE, "out"]:
        assert len(results.read(tmp_path / "out").time)


def test_a_closed_standard_output_is_no_fault(tmp_path: Path) -> None:
    """Whoever closes it does not want the tables."""
    line = f'"{EXECUTABLE}" fuse "{SCAN}" -c "{FUSION}" -o out'
    done = subprocess.run(f"{line} >&-", shell=True, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "summary.json").exists()


def test_two_that_write_one_folder_at_once(tmp_path: Path) -> None:
    """The first one to end wins, the other one says so and leaves nothing."""
    refuses = pytest.raises(FolderError, match="another process has written it meanwhile")
    with refuses, replacing(tmp_path / "out") as mine:
        (mine / "mine").touch()
        with replacing(tmp_path / "out") as theirs:
            (theirs / "theirs").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "theirs"]


def test_two_that_write_one_file_at_once(tmp_path: Path) -> None:
    """Where none was to be replaced, the one that comes second says so, and the first one's stays."""
    write_file(tmp_path / "arm.toml", "first")
    with pytest.raises(FolderError, match=r"arm\.toml: another process has written it meanwhile"):
        write_file(tmp_path / "arm.toml", "second", replace=False)
    assert (tmp_path / "arm.toml").read_text() == "first"
    write_file(tmp_path / "arm.toml", "second")
    assert (tmp_path / "arm.toml").read_text() == "second"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_nothing_is_left_by_a_signal(number: signal.Signals, tmp_path: Path) -> None:
    """The command ends as after an error, with 128 and the signal's number."""
    code = (
        "import sys, time\nfrom pathlib import Path\n"
        "from pumafuse import folders\nfrom pumafuse.cli import main\n"
        "def wait(*_, **__):\n"
        "    with folders.replacing(Path('out')):\n        print('writing', flush=True)\n        time.sleep(60)\n"
        "main.app = wait\nmain.main()\n"
    )

    words = [sys.executable, "-c", code]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    assert process.stdout.readline() == "writing\n"
    assert list(tmp_path.iterdir())
    process.send_signal(number)
    assert process.wait(30) == 128 + number
    process.stdout.close()
    assert not list(tmp_path.iterdir())
