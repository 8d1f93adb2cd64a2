"""The process that draws for a live view: ``python -m pumafuse.views.live_drawer``, frames on standard input.

It ends with its input. What there is to say goes to standard output, a sentence a line. A viewer that takes nothing
makes it leave frames out, not pile them up: rerun-sdk gets more only when the viewer has taken all before it.
"""

from __future__ import annotations

import contextlib
import os
import queue
import sys
import threading
import time
import uuid

import msgspec
import rerun as rr

from .live_frames import Frame, Header, bodies
from .live_picture import Picture
from .live_viewer import Viewer

_WAITING = 20  # frames
_DRAWN = 0.5  # s between pictures: a browser without a graphics card takes no more, and would fall behind for good
_LAST = 0.7  # s for the last frames, twice at most
_NICE = 5  # the estimator comes first


class Drawer:
    """Frames that wait to be drawn, and the thread that draws them."""

    def __init__(self, header: Header) -> None:
        """Start the viewer and the drawing."""
        self._header = header
        self._frames: queue.Queue[Frame | None] = queue.Queue(_WAITING)
        self._connected = self._ended = False
        self._left_out = 0
        self._viewer = Viewer(header, say)
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()

    def put(self, frame: Frame) -> None:
        """Have a frame drawn; leave it out if the viewer does not take what came before."""
        if self._frames.full() and not self._connected:
            with contextlib.suppress(queue.Empty):
                self._frames.get_nowait()  # what comes first is old when a viewer opens
        try:
            self._frames.put_nowait(frame)
        except queue.Full:
            self._leave_out()
            return
        if self._left_out:
            say(f"Rerun: the viewer draws again; {self._left_out} frames were left out")
        self._left_out = 0

    def end(self) -> None:
        """Draw what waits, but not for long, and leave."""
        with contextlib.suppress(queue.Full):
            self._frames.put(None, timeout=_LAST)
            self._thread.join(_LAST)
        self._leave()

    def _leave_out(self) -> None:
        if not self._left_out:
            say("Rerun: the viewer does not take what is drawn; frames are left out until it does")
        self._left_out += 1

    def _draw(self) -> None:
        """Draw into the viewer, and into the next one where there may be one."""
        recording = uuid.uuid4()
        while self._viewer.wait():
            stream = rr.RecordingStream("pumafuse live", recording_id=recording)
            try:
                stream.connect_grpc(self._viewer.url)
                stream.send_recording_name("live")
                picture = Picture(stream, self._header)
                self._connected = True
                while not self._ended:
                    picture.draw(self._together())
                    stream.flush()
                return
            except RuntimeError:  # what rerun-sdk raises for a connection that broke
                self._connected = False
        self._leave()

    def _together(self) -> Frame:
        """All frames of the time between two pictures as one."""
        frame, until = Frame(), time.monotonic() + _DRAWN
        with contextlib.suppress(queue.Empty):
            while (more := self._frames.get(timeout=max(until - time.monotonic(), 0.0))) is not None:
                frame.add(more)
            self._ended = True
        return frame

    def _leave(self) -> None:
        """At once: rerun-sdk would wait for a viewer that is gone."""
        self._viewer.end()
        os._exit(0)


def say(text: str) -> None:
    """A sentence for the estimator's log."""
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), text.encode() + b"\n")


def main() -> None:
    """Draw the frames that come on standard input until it ends."""
    os.nice(_NICE)
    messages = bodies(sys.stdin.buffer)
    header = next(messages, None)
    if header is None:
        return
    drawer = Drawer(msgspec.msgpack.decode(header, type=Header))
    decoder = msgspec.msgpack.Decoder(Frame)
    for message in messages:
        drawer.put(decoder.decode(message))
    drawer.end()


if __name__ == "__main__":
    main()
